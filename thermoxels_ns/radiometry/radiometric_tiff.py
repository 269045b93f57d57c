"""Radiometric TIFF (and 16-bit PNG): counts that are linear in temperature, or degrees as floats."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import Image

from thermoxels_ns.core.errors import ThermalFileError
from thermoxels_ns.radiometry.decoders import naming
from thermoxels_ns.radiometry.exif import ExifFacts, read_exif_facts
from thermoxels_ns.radiometry.image_size import check_thermal_size
from thermoxels_ns.radiometry.known_cameras import COUNT_SCALES, CameraName, known_cameras, recognised_camera
from thermoxels_ns.radiometry.thermal_files import ThermalImage, ThermalUnit, read_thermal_file

_SAMPLE_BITS = 258
_COUNT_MODES = ("I", "I;16", "I;16B", "I;16L")


@dataclass(frozen=True)
class CountImage:
    """A TIFF or PNG after reading."""

    image: ThermalImage
    exif: ExifFacts
    celsius_per_count: float | None
    """None: the file holds degrees."""


def read_count_image(
    path: Path,
    suffix: str,
    camera: CameraName | None,
    unit: ThermalUnit | None,
    valid_range_c: tuple[float, float],
) -> CountImage:
    """Read a single-channel TIFF or PNG.

    Args:
        path: The file.
        suffix: What it is by content, ``.tiff`` or ``.png``.
        camera: Preset that the user chose; None: by what the file says, for counts.
        unit: Meaning of the counts that the user gave; it comes before any preset.
        valid_range_c: Temperatures outside are masked, [degrees C].

    Raises:
        ThermalFileError: The file is damaged, too large, of 8 bits or in colour, or its counts have no known unit.
    """
    with (
        naming(path, "a readable TIFF or PNG", error=ThermalFileError),
        Image.open(path, formats=("TIFF", "PNG")) as image,
    ):
        check_thermal_size(path, *image.size)
        mode, depth, exif = image.mode, _depth(image), read_exif_facts(image)
    if mode != "F" and mode not in _COUNT_MODES:
        raise ThermalFileError(
            str(path),
            expected="one channel of 16-bit counts or of floats, [degrees C]",
            got=f"{depth}: a picture for the eye, whose shades are no temperatures",
            remedy="Export the radiometric TIFF from the camera or its program.",
        )
    if mode == "F" and unit is None and camera is None:
        unit = ThermalUnit.celsius()
    if unit is None:
        camera = camera or recognised_camera(exif.make, exif.model)
        if camera is None:
            raise ThermalFileError(
                str(path),
                expected="counts with a known unit",
                got=f"counts of {exif.camera or 'an unnamed camera'}, which may mean several things",
                remedy=f"Pass --camera with one of {known_cameras()}; or --celsius-per-count and --celsius-offset.",
            )
        unit = COUNT_SCALES[camera].unit
    return CountImage(
        image=read_thermal_file(path, unit, valid_range_c, suffix),
        exif=exif,
        celsius_per_count=unit.scale if unit.kind == "linear" else None,
    )


def _depth(image: Image.Image) -> str:
    """Channels and bits as the header has them."""
    tags: Any = getattr(image, "tag_v2", {})
    bits = tags.get(_SAMPLE_BITS)
    if bits is None:
        return f"image mode {image.mode}"
    samples, bits = len(image.getbands()), bits[0] if isinstance(bits, tuple) else bits
    return f"{samples} channel{'s' * (samples != 1)} of {bits} bits"
