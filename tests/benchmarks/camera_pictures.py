"""Draws docs/camera-<family>.png: what one file of each camera family shows to the eye, and the degrees read from it.

    python tests/benchmarks/camera_pictures.py --data DATA [--output docs]

DATA is the folder of real camera files (arco/ and radiometric/). Files that need a library which is not there are drawn
with the error that a user gets.
"""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import tyro
from PIL import Image

from thermoxels_ns.capture.photograph import open_photograph
from thermoxels_ns.core.checks import replace_when_done
from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.radiometry.camera_file import RadiometryOptions, read_thermogram
from thermoxels_ns.radiometry.flir_rjpeg import is_flir_jpeg, read_flir_jpeg

_WIDTH, _HEIGHT_IN, _DPI = 480, 2.7, 80
_PERCENTILES = (3.0, 99.5)
_LINE = 46


@dataclass(frozen=True)
class Family:
    """One picture."""

    name: str
    """Ending of the picture's name."""
    title: str
    thermal: str
    """File, relative to the data; shell pattern, the first that fits."""
    photograph: str | None = None
    """Photograph that lies beside it; None: inside the file, or what the file shows to the eye."""
    options: RadiometryOptions | None = None


FAMILIES = (
    Family("flir-t", "FLIR T640, R-JPEG with a photograph inside", "radiometric/flir_t640*.jpg"),
    Family("flir-e", "FLIR E60, R-JPEG", "radiometric/flir_e60*.jpg"),
    Family("flir-b", "FLIR b60, R-JPEG", "radiometric/flir_b60*.jpg"),
    Family("flir-i", "FLIR i7, R-JPEG", "radiometric/flir_i7*.jpg"),
    Family("flir-infracam", "FLIR InfraCAM, R-JPEG", "radiometric/flir_infracam*.jpg"),
    Family(
        "workswell",
        "Workswell WIRIS Pro, photograph and 16-bit TIFF",
        "arco/thermal/11-07-08*.tiff",
        "arco/visible/11-07-08*.jpg",
        RadiometryOptions(camera="workswell"),
    ),
    Family("dji", "DJI Mavic 3T, R-JPEG, without DJI's library", "radiometric/dji_m3t*.jpg"),
)


def main(data: Path, output: Path = Path("docs")) -> None:
    """Draw the pictures.

    Args:
        data: Folder of real camera files.
        output: Folder for the pictures.
    """
    for family in FAMILIES:
        path = output / f"camera-{family.name}.png"
        draw(family, data, path)
        print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


def draw(family: Family, data: Path, path: Path) -> None:
    """Draw one picture: photograph, or what the file shows to the eye, beside degrees with their scale."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    file = _first(data, family.thermal)
    figure, (left, right) = plt.subplots(1, 2, figsize=(8.0, _HEIGHT_IN), layout="constrained")
    picture, words = _for_the_eye(family, data, file)
    left.imshow(picture)
    left.set_title(words, fontsize=9)
    try:
        temperature_c = read_thermogram(file, family.options).temperature_c
        low, high = np.nanpercentile(temperature_c, _PERCENTILES)
        image = right.imshow(temperature_c, cmap="inferno", vmin=low, vmax=high, interpolation="nearest")
        figure.colorbar(image, ax=right, label="°C", extend="both")
        height, width = temperature_c.shape
        right.set_title(
            f"as read: {width} x {height}, {np.nanmin(temperature_c):.1f} to {np.nanmax(temperature_c):.1f} °C",
            fontsize=9,
        )
    except ThermoxelsError as problem:
        message = str(problem).replace(str(file), file.name)
        right.text(0.0, 1.0, textwrap.fill(message, _LINE), va="top", fontsize=8, transform=right.transAxes)
        right.set_title("as read: the error that a user gets", fontsize=9)
    for axes in (left, right):
        axes.set_axis_off()
    figure.suptitle(family.title, fontsize=10)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replace_when_done(path) as temporary:
        figure.savefig(temporary, dpi=_DPI)
        # Few colours are enough, and a quarter of the size.
        with Image.open(temporary) as drawn:
            drawn.convert("RGB").quantize(128).save(temporary, optimize=True)
    plt.close(figure)


def _for_the_eye(family: Family, data: Path, file: Path) -> tuple[npt.NDArray, str]:
    inside = read_flir_jpeg(file).visible if is_flir_jpeg(file) else None
    if family.photograph is not None:
        picture, words = open_photograph(_first(data, family.photograph)), "photograph beside it"
    elif inside is not None:
        picture, words = open_photograph(file, inside), "photograph inside the file"
    else:
        picture, words = open_photograph(file), "what the file shows to the eye"
    factor = _WIDTH / picture.width
    return np.asarray(picture.resize((_WIDTH, round(picture.height * factor)), Image.Resampling.LANCZOS)), words


def _first(data: Path, pattern: str) -> Path:
    found = sorted(data.glob(pattern))
    if not found:
        raise SystemExit(f"{data}: no file fits {pattern}. Pass the folder that holds arco/ and radiometric/.")
    return found[0]


if __name__ == "__main__":
    tyro.cli(main)
