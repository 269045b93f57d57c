"""Camera files to degrees: one function reads them all, the format found by content and not by name.

| format | degrees by |
|---|---|
| FLIR R-JPEG | the counts and the Planck constants in the file |
| DJI R-JPEG | DJI's own library, where the user has it |
| TIFF, 16-bit PNG | a camera preset or the user's scale; floats are degrees C |
| NPY, CSV | degrees C; whole numbers in NPY need a scale |

A picture (palette JPEG, 8-bit PNG) is refused: its colours cannot be turned back into temperatures.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

from thermoxels_ns.core.errors import ThermalFileError
from thermoxels_ns.radiometry.conditions import ConditionOverrides, Conditions
from thermoxels_ns.radiometry.dji_rjpeg import is_dji_rjpeg, read_dji_rjpeg
from thermoxels_ns.radiometry.flir_rjpeg import is_flir_jpeg, read_flir_jpeg
from thermoxels_ns.radiometry.image_size import check_file_size
from thermoxels_ns.radiometry.jpeg_segments import JPEG_START, DamagedJpegError, check_jpeg
from thermoxels_ns.radiometry.known_cameras import COUNT_SCALES, CameraName
from thermoxels_ns.radiometry.measurement_model import corrected_temperature_c
from thermoxels_ns.radiometry.radiometric_tiff import read_count_image
from thermoxels_ns.radiometry.tables import NPY_START, looks_like_csv, read_csv, read_npy
from thermoxels_ns.radiometry.thermal_files import ThermalImage, ThermalUnit
from thermoxels_ns.radiometry.thermogram import Thermogram, ThermogramFormat, ThermogramMetadata, masked_image

_HEAD_BYTES = 4096
_PNG_START = b"\x89PNG\r\n\x1a\n"
_TIFF_STARTS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")


@dataclass(frozen=True)
class RadiometryOptions(ConditionOverrides):
    """How camera files are turned into degrees."""

    camera: CameraName | None = None
    """Which camera's counts a TIFF holds (None: by what the file says, which some files leave open)."""
    celsius_per_count: float | None = None
    """Degrees per count of a TIFF, PNG or whole-number NPY, in place of a camera's."""
    celsius_offset: float | None = None
    """Temperature of count zero, [degrees C]; goes with --celsius-per-count."""
    stored: Conditions = field(default_factory=Conditions)
    """What the temperatures of TIFF, PNG, NPY and CSV files were computed with (default: apparent temperatures)."""
    dji_library: Path | None = None
    """Path of DJI's libdirp.so or libdirp.dll, for DJI R-JPEG (from the DJI Thermal SDK)."""
    valid_range_c: tuple[float, float] = (-100.0, 2000.0)
    """Temperatures outside are no measurements, [degrees C]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.celsius_per_count is None) != (self.celsius_offset is None):
            raise ThermalFileError(
                "celsius_per_count and celsius_offset",
                expected="both or neither",
                got=f"{self.celsius_per_count} and {self.celsius_offset}",
                remedy="Pass --celsius-per-count 0.04 --celsius-offset -273.15, for example.",
            )
        if self.celsius_per_count is not None and self.camera is not None:
            raise ThermalFileError(
                "camera",
                expected="a preset or a scale of your own",
                got=f"the preset {self.camera} and {self.celsius_per_count} K per count",
                remedy="Leave --camera or --celsius-per-count and --celsius-offset out.",
            )
        _ = self.given_unit  # a scale of 0 raises here and not at the first file

    @property
    def given_unit(self) -> ThermalUnit | None:
        """Meaning of counts as the user says it: a scale or a preset; None: not said."""
        if self.celsius_per_count is not None and self.celsius_offset is not None:
            return ThermalUnit.linear(self.celsius_per_count, self.celsius_offset)
        return COUNT_SCALES[self.camera].unit if self.camera is not None else None


def read_thermogram(path: Path, options: RadiometryOptions | None = None) -> Thermogram:
    """Read a thermal camera file as degrees C.

    Args:
        path: The file; its name may end as it likes.
        options: Camera, scale, emissivity and the rest; None: what the file says.

    Returns:
        Temperatures with NaN where the camera measured nothing, and what the file says of the measurement.

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
        raise ThermalFileError(
            str(path),
            expected="a file that can be read",
            got=problem.strerror or str(problem),
            remedy="Check its permissions, or copy it again.",
        ) from problem


def detect_format(path: Path) -> ThermogramFormat:
    """Tell the format of a thermal file by its content.

    Raises:
        ThermalFileError: The file is missing, empty, a picture without temperatures or of no known format.
    """
    if not path.is_file():
        raise ThermalFileError(
            "thermal file", expected=f"a file at {path}", got="nothing there", remedy="Check the path."
        )
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
    raise ThermalFileError(
        str(path),
        expected="a FLIR or DJI R-JPEG, a TIFF, a 16-bit PNG, or a table of degrees C (.npy, .csv)",
        got=f"none of them: it starts with {head[:8]!r}",
        remedy="Export it from the camera's program in one of these formats.",
    )


def _jpeg_format(path: Path) -> ThermogramFormat:
    if is_flir_jpeg(path):
        return "FLIR R-JPEG"
    content = path.read_bytes()
    if is_dji_rjpeg(content):
        return "DJI R-JPEG"
    try:
        check_jpeg(content)
    except DamagedJpegError as problem:
        raise ThermalFileError(
            str(path),
            expected="a whole radiometric JPEG",
            got=str(problem),
            remedy="Copy the file from the camera again.",
        ) from problem
    raise ThermalFileError(
        str(path),
        expected="a radiometric JPEG: counts and calibration beside the picture",
        got="a plain JPEG: a photograph, or a false-colour picture, whose palette cannot be turned back",
        remedy="Use the file as the camera wrote it; editing, messengers and cloud albums drop the thermal part.",
    )


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
        read = read_count_image(path, f".{found.lower()}", options.camera, options.given_unit, options.valid_range_c)
        image = read.image
        metadata = replace(
            metadata,
            camera=read.exif.camera,
            serial=read.exif.serial,
            taken_at=read.exif.taken_at,
            celsius_per_count=read.celsius_per_count,
        )
    elif found == "NPY":
        image = read_npy(path, options.given_unit, options.valid_range_c)
    else:
        image = read_csv(path, options.valid_range_c)
    if before != after:
        image = _corrected(image, before, after, options.valid_range_c)
    return Thermogram(image.temperature_c, metadata, image.report)


def _corrected(
    image: ThermalImage, before: Conditions, after: Conditions, valid_range_c: tuple[float, float]
) -> ThermalImage:
    """Other conditions; pixels that are no temperature under them count as out of range."""
    again = masked_image(corrected_temperature_c(image.temperature_c, before, after), valid_range_c)
    lost = again.report.masked - image.report.masked
    return ThermalImage(again.temperature_c, replace(image.report, out_of_range=image.report.out_of_range + lost))
