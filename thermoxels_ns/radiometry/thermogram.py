"""Any thermal camera file as degrees and what it says beside; found by content."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.errors import ThermalFileError
from thermoxels_ns.radiometry.conditions import ConditionOverrides, Conditions
from thermoxels_ns.radiometry.count_scales import (
    COUNT_SCALES,
    NPY_START,
    CameraName,
    looks_like_csv,
    read_count_image,
    read_npy,
)
from thermoxels_ns.radiometry.decoders import check_file_size, errors_name
from thermoxels_ns.radiometry.dji_rjpeg import is_dji_rjpeg, read_dji_rjpeg
from thermoxels_ns.radiometry.flir_records import PictureInPicture
from thermoxels_ns.radiometry.flir_rjpeg import is_flir_jpeg, read_flir_jpeg
from thermoxels_ns.radiometry.jpeg_segments import JPEG_START, check_jpeg
from thermoxels_ns.radiometry.measurement_model import corrected_temperature_c
from thermoxels_ns.radiometry.thermal_pixels import (
    PixelReport,
    ThermalImage,
    ThermalUnit,
    masked_image,
    read_thermal_file,
)

ThermogramFormat = Literal["FLIR R-JPEG", "DJI R-JPEG", "TIFF", "PNG", "NPY", "CSV"]

_HEAD_BYTES = 4096
_PNG_START = b"\x89PNG\r\n\x1a\n"
_TIFF_STARTS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")


@dataclass(frozen=True)
class ThermogramMetadata:
    """What a thermal file says besides its temperatures; None: it does not say."""

    format: ThermogramFormat  # by content, not by name
    camera: str | None = None  # maker and model
    serial: str | None = None  # of the camera
    lens: str | None = None
    taken_at: datetime | None = None  # when; with a time zone where the file has one
    field_of_view_deg: float | None = None
    """Horizontal, of the thermal lens, as the camera states it; some state nonsense such as 180."""
    camera_conditions: Conditions | None = None  # emissivity and the rest that the camera was set to
    conditions: Conditions | None = None
    """Those that the temperatures were computed with: the camera's, with the user's in their place."""
    picture_in_picture: PictureInPicture | None = None  # factory alignment of photograph and thermal image
    celsius_per_count: float | None = None  # step of the file's counts, [K], where they are linear in temperature


@dataclass(frozen=True)
class Thermogram:
    """One thermal image in degrees."""

    temperature_c: npt.NDArray[np.float32]  # shape (height, width), [degrees C], NaN where the camera measured nothing
    metadata: ThermogramMetadata
    report: PixelReport  # how many pixels are NaN and why


@dataclass(frozen=True)
class RadiometryOptions(ConditionOverrides):
    """How camera files are turned into degrees."""

    camera: CameraName | None = None
    """Which camera's counts a TIFF holds (None: by what the file says, which some files leave open)."""
    celsius_per_count: float | None = None
    """Degrees per count of a TIFF, PNG or whole-number NPY, in place of a camera's."""
    celsius_offset: float | None = None  # Temperature of count zero, [degrees C]; goes with --celsius-per-count
    stored: Conditions = field(default_factory=Conditions)
    """What the temperatures of TIFF, PNG, NPY and CSV files were computed with (default: apparent temperatures)."""
    dji_library: Path | None = None
    """Path of DJI's libdirp.so or libdirp.dll, for DJI R-JPEG (from the DJI Thermal SDK)."""
    valid_range_c: tuple[float, float] = (-100.0, 2000.0)  # Temperatures outside are no measurements, [degrees C]

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
        _ = self.given_unit  # a scale of 0 raises here and not at the first file

    @property
    def given_unit(self) -> ThermalUnit | None:
        """Meaning of counts as the user says it: a scale or a preset; None: not said."""
        if self.celsius_per_count is not None and self.celsius_offset is not None:
            return ThermalUnit.linear(self.celsius_per_count, self.celsius_offset)
        return COUNT_SCALES[self.camera].unit if self.camera is not None else None


def read_thermogram(path: Path, options: RadiometryOptions | None = None) -> Thermogram:
    """Read a thermal camera file as degrees C.

    | format | degrees by |
    |---|---|
    | FLIR R-JPEG | the counts and the Planck constants in the file |
    | DJI R-JPEG | DJI's own library, where the user has it |
    | TIFF, 16-bit PNG | a camera preset or the user's scale; floats are degrees C |
    | NPY, CSV | degrees C; whole numbers in NPY need a scale |

    A picture (palette JPEG, 8-bit PNG) is refused: its colours cannot be turned back into temperatures.

    Raises:
        ThermalFileError: The file is missing, empty, damaged, absurdly large, a picture without temperatures or of no
            known format, or its counts have no known unit.
        ThermoxelsError: The options cannot be, such as an emissivity above 1.
    """
    options = options or RadiometryOptions()
    try:
        found = detect_format(path)
        if found == "FLIR R-JPEG":
            return _read_flir(path, options)
        if found == "DJI R-JPEG":
            return _read_dji(path, options)
        return _read_stored(path, found, options)
    except OSError as problem:
        got, remedy = problem.strerror or str(problem), "Check its permissions, or copy it again."
        raise ThermalFileError(str(path), expected="a file that can be read", got=got, remedy=remedy) from problem


def detect_format(path: Path) -> ThermogramFormat:
    """Tell the format of a thermal file by its content; a `ThermalFileError` where it is none that holds degrees."""
    if not path.is_file():
        got, remedy = "nothing there", "Check the path."
        raise ThermalFileError("thermal file", expected=f"a file at {path}", got=got, remedy=remedy)
    check_file_size(path)
    with path.open("rb") as stream:
        head = stream.read(_HEAD_BYTES)
    if head.startswith(JPEG_START):
        return _jpeg_format(path)
    if head.startswith(_TIFF_STARTS):
        return "TIFF"
    if head.startswith(_PNG_START):
        return "PNG"
    if head.startswith(NPY_START):
        return "NPY"
    if looks_like_csv(head):
        return "CSV"
    expected = "a FLIR or DJI R-JPEG, a TIFF, a 16-bit PNG, or a table of degrees C (.npy, .csv)"
    got = f"none of them: it starts with {head[:8]!r}"
    remedy = "Export it from the camera's program in one of these formats."
    raise ThermalFileError(str(path), expected=expected, got=got, remedy=remedy)


def _jpeg_format(path: Path) -> ThermogramFormat:
    if is_flir_jpeg(path):
        return "FLIR R-JPEG"
    content = path.read_bytes()
    if is_dji_rjpeg(content):
        return "DJI R-JPEG"
    with errors_name(path, "a whole radiometric JPEG", "Copy the file from the camera again.", ThermalFileError):
        check_jpeg(content)
    expected = "a radiometric JPEG: counts and calibration beside the picture"
    got = "a plain JPEG: a photograph, or a false-colour picture, whose palette cannot be turned back"
    remedy = "Use the file as the camera wrote it; editing, messengers and cloud albums drop the thermal part."
    raise ThermalFileError(str(path), expected=expected, got=got, remedy=remedy)


def _read_flir(path: Path, options: RadiometryOptions) -> Thermogram:
    flir = read_flir_jpeg(path)
    camera = flir.camera
    conditions = options.applied_to(camera.conditions)
    image = masked_image(flir.temperature_c(conditions), options.valid_range_c, flir.outside_calibration)
    metadata = ThermogramMetadata(
        format="FLIR R-JPEG",
        camera=camera.model,
        serial=camera.serial,
        lens=camera.lens,
        taken_at=camera.taken_at,
        field_of_view_deg=camera.field_of_view_deg,
        camera_conditions=camera.conditions,
        conditions=conditions,
        picture_in_picture=flir.picture_in_picture,
    )
    return Thermogram(image.temperature_c, metadata, image.report)


def _read_dji(path: Path, options: RadiometryOptions) -> Thermogram:
    dji = read_dji_rjpeg(path, options.dji_library, options)
    image = masked_image(dji.temperature_c, options.valid_range_c)
    metadata = ThermogramMetadata(
        format="DJI R-JPEG",
        camera=dji.exif.camera,
        serial=dji.exif.serial,
        taken_at=dji.exif.taken_at,
        camera_conditions=dji.camera_conditions,
        conditions=dji.conditions,
    )
    return Thermogram(image.temperature_c, metadata, image.report)


def _read_stored(path: Path, found: ThermogramFormat, options: RadiometryOptions) -> Thermogram:
    """Formats that hold temperatures (or counts linear in them) and not what they were computed with."""
    before, after = options.stored, options.applied_to(options.stored)
    metadata = ThermogramMetadata(format=found, camera_conditions=before, conditions=after)
    if found in ("TIFF", "PNG"):
        given = options.camera, options.given_unit, options.valid_range_c
        image, exif, step = read_count_image(path, f".{found.lower()}", *given)
        metadata = replace(
            metadata, camera=exif.camera, serial=exif.serial, taken_at=exif.taken_at, celsius_per_count=step
        )
    elif found == "NPY":
        image = read_npy(path, options.given_unit, options.valid_range_c)
    else:
        image = read_thermal_file(path, ThermalUnit.celsius(), options.valid_range_c, ".csv")
    if before != after:  # pixels that are no temperature under other conditions count as out of range
        again = masked_image(corrected_temperature_c(image.temperature_c, before, after), options.valid_range_c)
        lost = again.report.masked - image.report.masked
        report = replace(image.report, out_of_range=image.report.out_of_range + lost)
        image = ThermalImage(again.temperature_c, report)
    return Thermogram(image.temperature_c, metadata, image.report)
