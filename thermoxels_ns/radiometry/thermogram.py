"""Reads any thermal camera file, recognised by its content, as degrees C and metadata."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from PIL import Image

from thermoxels_ns.core.arrays import Float32Array
from thermoxels_ns.core.errors import ThermalFileError
from thermoxels_ns.radiometry.decoders import (
    JPEG_START,
    PNG_START,
    ExifFacts,
    app_segments,
    check_file_size,
    check_thermal_size,
    errors_name,
    read_exif_facts,
)
from thermoxels_ns.radiometry.dji_rjpeg import is_dji_rjpeg, read_dji_rjpeg
from thermoxels_ns.radiometry.flir_rjpeg import PictureInPicture, is_flir_jpeg, read_flir_jpeg
from thermoxels_ns.radiometry.measurement_model import ConditionOverrides, Conditions, corrected_temperature_c
from thermoxels_ns.radiometry.thermal_pixels import (
    VALID_RANGE_C,
    PixelReport,
    ThermalImage,
    ThermalUnit,
    load_array,
    masked_image,
    read_thermal_file,
    size_of_double_tiff,
)

ThermogramFormat = Literal["FLIR R-JPEG", "DJI R-JPEG", "TIFF", "PNG", "NPY", "CSV"]
CameraName = Literal["workswell", "flir-high-gain", "flir-low-gain", "flir-duo", "sensefly"]

_HEAD_BYTES = 4096
_STARTS: dict[bytes, ThermogramFormat] = {
    b"II*\0": "TIFF",
    b"MM\0*": "TIFF",
    b"II+\0": "TIFF",
    b"MM\0+": "TIFF",
    PNG_START: "PNG",
    b"\x93NUMPY": "NPY",
}
_NUMBERS = re.compile(rb"(?:\xef\xbb\xbf)?[-+0-9.,;eE\s\"]|nan|na|n/a|null|none", re.IGNORECASE)
_TEXT = re.compile(rb"[\t\n\r -~\xef\xbb\xbf]*")


COUNT_SCALES: dict[CameraName, tuple[ThermalUnit, str]] = {
    "workswell": (ThermalUnit.linear(1.0 / 40.0, -100.0), "Workswell WIRIS Pro and later"),
    "flir-high-gain": (ThermalUnit.linear(0.04, -273.15), "FLIR Duo Pro R and Vue Pro R, range -25 to 135 C"),
    "flir-low-gain": (ThermalUnit.linear(0.4, -273.15), "FLIR Duo Pro R and Vue Pro R, range -40 to 550 C"),
    "flir-duo": (ThermalUnit.linear(0.01, -273.15), "FLIR Duo R (the first one)"),
    "sensefly": (ThermalUnit.linear(0.01, -100.0), "senseFly thermoMAP and Duet T"),
}
"""Unit of the counts and names of the cameras, by preset, from the makers' manuals. A file does not state which of
FLIR's two gains was used, so the user must say."""


def recognised_camera(make: str | None, model: str | None) -> CameraName | None:
    """Return the preset (`COUNT_SCALES`) that the maker and model in a file determine; None if the user must choose.

    >>> recognised_camera("Workswell", "WIRIS Pro"), recognised_camera("FLIR", "Duo Pro R")
    ('workswell', None)
    """
    make, model = (make or "").strip().lower(), (model or "").strip().lower()
    if make.startswith("workswell") and model.startswith("wiris pro"):
        return "workswell"
    return "sensefly" if make.startswith("sensefly") else None


@dataclass(frozen=True)
class ThermogramMetadata:
    """What a thermal file states besides its temperatures; a field is None if the file does not state it."""

    format: ThermogramFormat  # detected from the content, not from the name
    camera: str | None = None  # maker and model
    field_of_view_deg: float | None = None
    """Horizontal angle of view of the thermal lens as the camera states it; some state nonsense such as 180."""
    conditions: Conditions | None = None
    """Conditions that the temperatures were computed with: the camera's, or the user's where these were given."""
    picture_in_picture: PictureInPicture | None = None  # factory alignment of photograph and thermal image
    celsius_per_count: float | None = None  # temperature step of one count, [K]; None if counts are not linear in it


@dataclass(frozen=True)
class Thermogram:
    """One thermal image in degrees C, with the metadata of its file."""

    temperature_c: Float32Array  # shape (height, width), [degrees C], NaN where masked
    metadata: ThermogramMetadata
    report: PixelReport  # numbers of masked pixels by reason


@dataclass(frozen=True)
class RadiometryOptions(ConditionOverrides):
    """Options for converting camera files to degrees C. Contradicting options raise `ThermalFileError`."""

    camera: CameraName | None = None
    """Camera whose counts a TIFF or PNG holds (None: recognised from the file, which some files do not allow)."""
    celsius_per_count: float | None = None
    """Degrees per count of a TIFF, PNG or whole-number NPY, instead of `camera`."""
    celsius_offset: float | None = None  # Temperature of count 0, [degrees C]; goes with --celsius-per-count
    dji_library: Path | None = None
    """Path of DJI's libdirp.so or libdirp.dll, for DJI R-JPEG (from the DJI Thermal SDK)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.celsius_per_count is None) != (self.celsius_offset is None):
            got = f"{self.celsius_per_count} and {self.celsius_offset}"
            remedy = "Pass --celsius-per-count 0.04 --celsius-offset -273.15, for example."
            what = "celsius_per_count and celsius_offset"
            raise ThermalFileError(what, expected="both or neither", got=got, remedy=remedy)
        if self.celsius_per_count is not None and self.camera is not None:
            remedy = "Leave --camera or --celsius-per-count and --celsius-offset out."
            got = f"the preset {self.camera} and {self.celsius_per_count} K per count"
            raise ThermalFileError("camera", expected="a preset or a scale of your own", got=got, remedy=remedy)
        _ = self.given_unit  # so that a scale of 0 raises here, not when the first file is read

    @property
    def given_unit(self) -> ThermalUnit | None:
        """Unit of counts from the user's scale or camera preset; None if neither is given."""
        if self.celsius_per_count is not None and self.celsius_offset is not None:
            return ThermalUnit.linear(self.celsius_per_count, self.celsius_offset)
        return COUNT_SCALES[self.camera][0] if self.camera is not None else None


def read_thermogram(path: Path, options: RadiometryOptions | None = None) -> Thermogram:
    """Return the temperatures and metadata of a thermal camera file. The format decides how degrees C are computed:

    | format | degrees from |
    |---|---|
    | FLIR R-JPEG | the counts and the Planck constants in the file |
    | DJI R-JPEG | DJI's own library, where the user has it |
    | TIFF, 16-bit PNG | a camera preset or the user's scale; floats are degrees C |
    | NPY, CSV | degrees C; whole numbers in NPY need a scale |

    A picture (palette JPEG, 8-bit PNG) is refused, because its colours cannot be turned back into temperatures.

    Raises:
        ThermalFileError: The file is missing, empty, damaged, absurdly large, a picture without temperatures or of an
            unknown format, or its counts have no known unit.
        ThermoxelsError: The options contradict the file's conditions, e.g. an emissivity below 1 without reflected_c.
    """
    options = options or RadiometryOptions()
    with errors_name(path, "a whole and readable thermal file", error=ThermalFileError):
        found = detect_format(path)
        if found == "FLIR R-JPEG":
            flir = read_flir_jpeg(path)
            conditions = options.applied_to(flir.camera.conditions)
            image = masked_image(flir.temperature_c(conditions), VALID_RANGE_C, flir.outside_calibration)
            camera, angle = flir.camera.model, flir.camera.field_of_view_deg
            metadata = ThermogramMetadata(found, camera, angle, conditions, flir.picture_in_picture)
        elif found == "DJI R-JPEG":
            dji = read_dji_rjpeg(path, options.dji_library, options)
            image = masked_image(dji.temperature_c, VALID_RANGE_C)
            metadata = ThermogramMetadata(found, dji.exif.camera, conditions=dji.conditions)
        else:
            image, metadata = _read_stored(path, found, options)
    return Thermogram(image.temperature_c, metadata, image.report)


def detect_format(path: Path) -> ThermogramFormat:
    """Return the format of a thermal file by its content; raise `ThermalFileError` if it holds no temperatures."""
    if not path.is_file():
        got, remedy = "nothing there", "Check the path."
        raise ThermalFileError("thermal file", expected=f"a file at {path}", got=got, remedy=remedy)
    check_file_size(path)
    with path.open("rb") as stream:
        head = stream.read(_HEAD_BYTES)
    found: ThermogramFormat | None = next((name for start, name in _STARTS.items() if head.startswith(start)), None)
    if found is not None:
        return found
    if _TEXT.fullmatch(head) and _NUMBERS.match(head) and re.search(rb"[0-9]", head):  # a table of numbers
        return "CSV"
    expected = "a FLIR or DJI R-JPEG, a TIFF, a 16-bit PNG, or a table of degrees C (.npy, .csv)"
    got, remedy = f"none of them: it starts with {head[:8]!r}", "Export it from the camera's program in one of these."
    if head.startswith(JPEG_START):
        if is_flir_jpeg(path):
            return "FLIR R-JPEG"
        if is_dji_rjpeg(path):
            return "DJI R-JPEG"
        app_segments(path, whole=True)
        got = "a plain JPEG: a photograph, or a false-colour picture, whose palette cannot be turned back"
        remedy = "Use the file as the camera wrote it; editing, messengers and cloud albums drop the thermal part."
    raise ThermalFileError(str(path), expected=expected, got=got, remedy=remedy)


def _read_stored(
    path: Path, found: ThermogramFormat, options: RadiometryOptions
) -> tuple[ThermalImage, ThermogramMetadata]:
    """Read a file of apparent temperatures or of counts linear in temperature; correct for the user's conditions."""
    unit, exif = options.given_unit, ExifFacts()
    if found in ("TIFF", "PNG"):
        unit, exif = _unit_of_image(path, options)
    elif found == "NPY" and unit is None and load_array(path).dtype.kind in "ui":
        expected = "an array of degrees C (float32 or float64), or whole numbers with a known unit"
        remedy = "Pass --camera, or --celsius-per-count and --celsius-offset."
        raise ThermalFileError(str(path), expected=expected, got="whole numbers and no unit", remedy=remedy)
    unit = ThermalUnit.celsius() if unit is None or found == "CSV" else unit
    image = read_thermal_file(path, unit, suffix=f".{found.lower()}")
    conditions = options.applied_to(Conditions())
    per_count = unit.scale if found in ("TIFF", "PNG") and unit.kind == "linear" else None
    metadata = ThermogramMetadata(found, exif.camera, conditions=conditions, celsius_per_count=per_count)
    if conditions != Conditions():  # pixels that have no temperature under the new conditions count as out of range
        corrected_c = corrected_temperature_c(image.temperature_c, Conditions(), conditions)
        again = masked_image(corrected_c, VALID_RANGE_C)
        lost = again.report.masked - image.report.masked
        report = replace(image.report, out_of_range=image.report.out_of_range + lost)
        image = ThermalImage(again.temperature_c, report)
    return image, metadata


def _unit_of_image(path: Path, options: RadiometryOptions) -> tuple[ThermalUnit, ExifFacts]:
    """Return the unit of a TIFF or PNG (the user's, else the one recognised from the file), and the facts in its tags.

    Raises `ThermalFileError` for pictures with 8 bits or in colour, and for counts whose unit is unknown.
    """
    unit = options.given_unit
    if size_of_double_tiff(path) is not None:
        return unit or ThermalUnit.celsius(), ExifFacts()
    with Image.open(path, formats=("TIFF", "PNG")) as image:
        check_thermal_size(path, *image.size)
        mode, exif = image.mode, read_exif_facts(image)
    if mode != "F" and not mode.startswith("I"):
        expected = "one channel of 16-bit counts or of floats, [degrees C]"
        got = f"image mode {mode}: a picture for the eye, whose shades are no temperatures"
        remedy = "Export the radiometric TIFF from the camera or its program."
        raise ThermalFileError(str(path), expected=expected, got=got, remedy=remedy)
    camera = recognised_camera(exif.make, exif.model)
    if unit is not None or mode == "F":
        return unit or ThermalUnit.celsius(), exif
    if camera is None:
        known = ", ".join(f"{name} ({cameras})" for name, (_, cameras) in COUNT_SCALES.items())
        remedy = f"Pass --camera with one of {known}; or --celsius-per-count and --celsius-offset."
        got = f"counts of {exif.camera or 'an unnamed camera'}, which may mean several things"
        raise ThermalFileError(str(path), expected="counts with a known unit", got=got, remedy=remedy)
    return COUNT_SCALES[camera][0], exif
