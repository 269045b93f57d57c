"""What counts of TIFF, PNG and NPY files mean: the scales of cameras."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from PIL import Image

from thermoxels_ns.core.errors import ThermalFileError
from thermoxels_ns.radiometry.decoders import check_thermal_size, errors_name
from thermoxels_ns.radiometry.exif import ExifFacts, read_exif_facts
from thermoxels_ns.radiometry.thermal_pixels import ThermalImage, ThermalUnit, read_thermal_file, size_of_double_tiff

CameraName = Literal["workswell", "flir-high-gain", "flir-low-gain", "flir-duo", "sensefly"]
_SAMPLE_BITS = 258
_COUNT_MODES = ("I", "I;16", "I;16B", "I;16L")
NPY_START = b"\x93NUMPY"
_NUMBERS = re.compile(rb"(?:\xef\xbb\xbf)?[-+0-9.,;eE\s\"]|nan|na|n/a|null|none", re.IGNORECASE)
_TEXT = re.compile(rb"[\t\n\r -~\xef\xbb\xbf]*")


@dataclass(frozen=True)
class CountScale:
    """A camera's counts: degrees C = count * celsius_per_count + celsius_offset."""

    celsius_per_count: float
    celsius_offset: float
    cameras: str  # which cameras write so, in words

    @property
    def unit(self) -> ThermalUnit:
        """The same for `read_thermal_file`."""
        return ThermalUnit.linear(self.celsius_per_count, self.celsius_offset)


COUNT_SCALES: dict[CameraName, CountScale] = {
    "workswell": CountScale(1.0 / 40.0, -100.0, "Workswell WIRIS Pro and later"),
    "flir-high-gain": CountScale(0.04, -273.15, "FLIR Duo Pro R and Vue Pro R, range -25 to 135 C"),
    "flir-low-gain": CountScale(0.4, -273.15, "FLIR Duo Pro R and Vue Pro R, range -40 to 550 C"),
    "flir-duo": CountScale(0.01, -273.15, "FLIR Duo R (the first one)"),
    "sensefly": CountScale(0.01, -100.0, "senseFly thermoMAP and Duet T"),
}
"""From the makers' manuals. FLIR's two gains cannot be told apart by the file, so the user says which."""

_RECOGNISED: tuple[tuple[str, str, CameraName], ...] = (
    ("workswell", "wiris pro", "workswell"),
    ("sensefly", "", "sensefly"),
)
"""Maker, start of the model and preset of the cameras that a file names without doubt, in small letters."""


def recognised_camera(make: str | None, model: str | None) -> CameraName | None:
    """Find the preset of a camera by what its file says of it; None where the file leaves a choice.

    >>> recognised_camera("Workswell", "WIRIS Pro")
    'workswell'
    >>> recognised_camera("FLIR", "Duo Pro R") is None
    True
    """
    make, model = (make or "").strip().lower(), (model or "").strip().lower()
    for maker, start, name in _RECOGNISED:
        if make.startswith(maker) and model.startswith(start):
            return name
    return None


def read_count_image(
    path: Path, suffix: str, camera: CameraName | None, unit: ThermalUnit | None, valid_range_c: tuple[float, float]
) -> tuple[ThermalImage, ExifFacts, float | None]:
    """Read a single-channel TIFF or PNG (`suffix` is what it is by content), and its degrees per count, if any.

    The unit that the user gave comes before any preset, and the user's preset before what the file says.

    Raises:
        ThermalFileError: The file is damaged, too large, of 8 bits or in colour, or its counts have no known unit.
    """
    with errors_name(path, "a readable TIFF or PNG", error=ThermalFileError):
        doubles = size_of_double_tiff(path) is not None
    if doubles:
        unit = unit or ThermalUnit.celsius()
        return read_thermal_file(path, unit, valid_range_c, suffix), ExifFacts(None, None, None, None), None
    with (
        errors_name(path, "a readable TIFF or PNG", error=ThermalFileError),
        Image.open(path, formats=("TIFF", "PNG")) as image,
    ):
        check_thermal_size(path, *image.size)
        mode, depth, exif = image.mode, _depth(image), read_exif_facts(image)
    if mode != "F" and mode not in _COUNT_MODES:
        expected = "one channel of 16-bit counts or of floats, [degrees C]"
        got = f"{depth}: a picture for the eye, whose shades are no temperatures"
        remedy = "Export the radiometric TIFF from the camera or its program."
        raise ThermalFileError(str(path), expected=expected, got=got, remedy=remedy)
    if mode == "F" and unit is None and camera is None:
        unit = ThermalUnit.celsius()
    if unit is None:
        camera = camera or recognised_camera(exif.make, exif.model)
        if camera is None:
            known = ", ".join(f"{name} ({scale.cameras})" for name, scale in COUNT_SCALES.items())
            remedy = f"Pass --camera with one of {known}; or --celsius-per-count and --celsius-offset."
            got = f"counts of {exif.camera or 'an unnamed camera'}, which may mean several things"
            raise ThermalFileError(str(path), expected="counts with a known unit", got=got, remedy=remedy)
        unit = COUNT_SCALES[camera].unit
    step = unit.scale if unit.kind == "linear" else None
    return read_thermal_file(path, unit, valid_range_c, suffix), exif, step


def _depth(image: Image.Image) -> str:
    """Channels and bits as the header has them."""
    tags: Any = getattr(image, "tag_v2", {})
    bits = tags.get(_SAMPLE_BITS)
    if bits is None:
        return f"image mode {image.mode}"
    samples, bits = len(image.getbands()), bits[0] if isinstance(bits, tuple) else bits
    return f"{samples} channel{'s' * (samples != 1)} of {bits} bits"


def looks_like_csv(head: bytes) -> bool:
    """Whether the first bytes of a file are text that starts as a table of numbers does.

    >>> looks_like_csv(b"21.5;21.6;21.4"), looks_like_csv(b"GIF89a"), looks_like_csv(b"")
    (True, False, False)
    """
    return bool(_TEXT.fullmatch(head) and _NUMBERS.match(head) and re.search(rb"[0-9]", head))


def read_npy(path: Path, unit: ThermalUnit | None, valid_range_c: tuple[float, float]) -> ThermalImage:
    """Read an array: degrees C where it holds fractions, else counts of this unit; a `ThermalFileError` without one."""
    try:
        kind = np.load(path, mmap_mode="r", allow_pickle=False).dtype.kind
    except Exception:  # the reader below says what is wrong with it
        kind = "f"
    if kind in "ui" and unit is None:
        expected = "an array of degrees C (float32 or float64), or whole numbers with a known unit"
        remedy = "Pass --camera, or --celsius-per-count and --celsius-offset."
        raise ThermalFileError(str(path), expected=expected, got="whole numbers and no unit", remedy=remedy)
    return read_thermal_file(path, unit or ThermalUnit.celsius(), valid_range_c, suffix=".npy")
