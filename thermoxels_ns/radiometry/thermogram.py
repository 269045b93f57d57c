"""Reads thermal camera files of all known formats as degrees C and metadata. The content shows the format."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from PIL import Image

from thermoxels_ns.core.arrays import Float32Array
from thermoxels_ns.core.errors import ThermalFileError
from thermoxels_ns.radiometry.decoders import app_segments, check_thermal_size, errors_name, read_exif_facts
from thermoxels_ns.radiometry.dji_rjpeg import read_dji_rjpeg
from thermoxels_ns.radiometry.flir_rjpeg import PictureInPicture, read_flir_jpeg
from thermoxels_ns.radiometry.measurement_model import (
    CameraName,
    Conditions,
    RadiometryOptions,
    corrected_temperature_c,
)
from thermoxels_ns.radiometry.thermal_pixels import (
    ThermalFormat,
    ThermalUnit,
    detect_format,
    masked_image,
    read_thermal_file,
)

COUNT_SCALES: dict[CameraName, tuple[ThermalUnit, str]] = {
    "workswell": (ThermalUnit.linear(1.0 / 40.0, -100.0), "Workswell WIRIS Pro and later"),
    "flir-high-gain": (ThermalUnit.linear(0.04, -273.15), "FLIR Duo Pro R and Vue Pro R, range -25 to 135 C"),
    "flir-low-gain": (ThermalUnit.linear(0.4, -273.15), "FLIR Duo Pro R and Vue Pro R, range -40 to 550 C"),
    "flir-duo": (ThermalUnit.linear(0.01, -273.15), "FLIR Duo R (the first one)"),
    "sensefly": (ThermalUnit.linear(0.01, -100.0), "senseFly thermoMAP and Duet T"),
}
"""Unit of the counts, and names of the cameras, by preset, from the makers' manuals. The user must choose between
FLIR's two gains, because files do not state which was used."""


def recognised_camera(camera: str | None) -> CameraName | None:
    """Return the preset (`COUNT_SCALES`) of the maker and model that a file states; None: the user must choose.

    >>> recognised_camera("Workswell s.r.o. WIRIS Pro"), recognised_camera("FLIR Duo Pro R")
    ('workswell', None)
    """
    named = (camera or "").lower()
    if named.startswith("workswell") and "wiris pro" in named:
        return "workswell"
    return "sensefly" if named.startswith("sensefly") else None


@dataclass(frozen=True)
class ThermogramMetadata:
    """Metadata of a thermal file. A field is None if the file does not state it."""

    format: ThermalFormat  # detected from the content, not from the name
    camera: str | None = None  # maker and model
    field_of_view_deg: float | None = None
    """Horizontal angle of view of the thermal lens as the camera states it; some state nonsense such as 180."""
    conditions: Conditions | None = None
    """Conditions that the temperatures were computed with: the camera's, replaced by those that the user gave."""
    picture_in_picture: PictureInPicture | None = None  # factory alignment of photograph and thermal image
    celsius_per_count: float | None = None  # temperature step of one count, [K]; None if counts are not linear in it


@dataclass(frozen=True)
class Thermogram:
    """One thermal image in degrees C, with the metadata of its file."""

    temperature_c: Float32Array  # shape (height, width), [degrees C], NaN in masked pixels
    metadata: ThermogramMetadata


def read_thermogram(path: Path, options: RadiometryOptions | None = None) -> Thermogram:
    """Return the temperatures and metadata of a thermal camera file. The format decides how degrees C are computed:

    | format | source of degrees C |
    |---|---|
    | FLIR R-JPEG | the counts and the Planck constants in the file |
    | DJI R-JPEG | DJI's own library, where the user has it |
    | TIFF, 16-bit PNG | a camera preset or the user's scale; floats are degrees C |
    | NPY, CSV | degrees C; whole numbers in NPY need a scale |

    Raises `ThermalFileError` if the file is missing, empty, damaged, absurdly large or of an unknown format, if its
    counts have no known unit, or if it is a picture (palette JPEG, 8-bit PNG), whose colours cannot be turned back into
    temperatures. Raises `ThermoxelsError` if the options contradict the file's conditions, for example an emissivity
    below 1 without reflected_c.
    """
    options = options or RadiometryOptions()
    with errors_name(path, "a whole and readable thermal file", error=ThermalFileError):
        found = detect_format(path)
        if found == "FLIR R-JPEG":
            flir = read_flir_jpeg(path)
            conditions = options.applied_to(flir.camera.conditions)
            temperature_c = flir.temperature_c(conditions)
            camera, angle = flir.camera.model, flir.camera.field_of_view_deg
            metadata = ThermogramMetadata(found, camera, angle, conditions, flir.picture_in_picture)
        elif found == "DJI R-JPEG":
            temperature_c, conditions = read_dji_rjpeg(path, options)
            with Image.open(path) as opened:
                metadata = ThermogramMetadata(found, read_exif_facts(opened)[0], conditions=conditions)
        elif found == "JPEG":
            app_segments(path, whole=True)  # says so if the file is cut off
            expected = "a FLIR or DJI R-JPEG, a TIFF, a 16-bit PNG, or a table of degrees C (.npy, .csv)"
            got = "a plain JPEG: a photograph, or a false-colour picture, whose palette cannot be turned back"
            remedy = "Use the file as the camera wrote it; editing, messengers and cloud albums drop the thermal part."
            raise ThermalFileError(str(path), expected=expected, got=got, remedy=remedy)
        else:
            temperature_c, metadata = _read_stored(path, found, options)
    return Thermogram(masked_image(temperature_c), metadata)


def _read_stored(
    path: Path, found: ThermalFormat, options: RadiometryOptions
) -> tuple[Float32Array, ThermogramMetadata]:
    """Return temperatures [degrees C] and metadata of a file of apparent temperatures, or of counts linear in them.
    `found` is the file's format. Temperatures are corrected for the conditions in `options`."""
    camera, picture = None, found in ("TIFF", "PNG")
    unit = None if options.camera is None else COUNT_SCALES[options.camera][0]
    if options.celsius_per_count is not None and options.celsius_offset is not None:
        unit = ThermalUnit.linear(options.celsius_per_count, options.celsius_offset)
    if picture:
        with Image.open(path) as image:
            check_thermal_size(path, *image.size)
            mode, (camera, _) = image.mode, read_exif_facts(image)
        if mode != "F" and not mode.startswith("I"):
            expected = "one channel of 16-bit counts or of floats, [degrees C]"
            got = f"image mode {mode}: a picture for the eye, whose shades are no temperatures"
            remedy = "Export the radiometric TIFF from the camera or its program."
            raise ThermalFileError(str(path), expected=expected, got=got, remedy=remedy)
        if mode != "F" and unit is None:
            preset = recognised_camera(camera)
            if preset is None:
                known = ", ".join(f"{name} ({cameras})" for name, (_, cameras) in COUNT_SCALES.items())
                remedy = f"Pass --camera with one of {known}; or --celsius-per-count and --celsius-offset."
                got = f"counts of {camera or 'an unnamed camera'}, which may mean several things"
                raise ThermalFileError(str(path), expected="counts with a known unit", got=got, remedy=remedy)
            unit = COUNT_SCALES[preset][0]
    unit = ThermalUnit() if unit is None or found == "CSV" else unit
    temperature_c = read_thermal_file(path, unit)
    conditions = options.applied_to(Conditions())
    per_count = unit.scale if picture and unit.kind == "linear" else None
    metadata = ThermogramMetadata(found, camera, conditions=conditions, celsius_per_count=per_count)
    if conditions != Conditions():
        temperature_c = corrected_temperature_c(temperature_c, conditions)
    return temperature_c, metadata
