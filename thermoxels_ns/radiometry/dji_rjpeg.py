"""Reads DJI's radiometric JPEG through DJI's own library."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from thermoxels_ns.core.arrays import Float32Array
from thermoxels_ns.core.errors import ThermalFileError, ThermoxelsError
from thermoxels_ns.radiometry.decoders import app_segments, check_thermal_size, errors_name
from thermoxels_ns.radiometry.measurement_model import Conditions, RadiometryOptions

_SDK = "the DJI Thermal SDK (www.dji.com/downloads/softwares/dji-thermal-sdk)"
_FUNCTIONS = (
    "dirp_create_from_rjpeg",
    "dirp_get_rjpeg_resolution",
    "dirp_get_measurement_params",
    "dirp_set_measurement_params",
    "dirp_measure_ex",
    "dirp_destroy",
)
_SPARE_FLOATS = 12
_LIMITS = "DJI's library takes distances of 1 to 25 m, humidities of 0.2 to 1 and emissivities of 0.1 to 1."


class _Resolution(ctypes.Structure):
    _fields_ = [("width", ctypes.c_int32), ("height", ctypes.c_int32)]


class _Parameters(ctypes.Structure):
    """Measurement parameters of `libdirp`. Newer libraries also write the air temperature, and have spare room."""

    _fields_ = [
        ("distance_m", ctypes.c_float),
        ("humidity", ctypes.c_float),
        ("emissivity", ctypes.c_float),
        ("reflected_c", ctypes.c_float),
        ("air_c", ctypes.c_float),
        ("spare", ctypes.c_float * _SPARE_FLOATS),
    ]


def is_dji_rjpeg(path: Path) -> bool:
    """Return whether a JPEG names DJI and has APP3 segments. These hold counts; DJI's photographs have none."""
    segments = app_segments(path)
    made_by_dji = any(name == "APP1" and b"DJI" in content for name, content in segments)
    return made_by_dji and any(name == "APP3" for name, _ in segments)


def read_dji_rjpeg(path: Path, options: RadiometryOptions) -> tuple[Float32Array, Conditions]:
    """Return the temperatures (height, width) [degrees C] of a DJI R-JPEG, and the settings they were computed with.

    The settings are the file's, replaced by those that `options` state. DJI's conversion of counts is not public, so
    `libdirp` of DJI's Thermal SDK converts them. The SDK is free to download but must not be passed on, so the user
    names the library (`options.dji_library`). Raises `ThermalFileError` if the library is missing or is another one, if
    it refuses the file or the settings, or if the file is cut off.
    """
    library = options.dji_library
    whole = "a whole DJI R-JPEG, as the drone wrote it"
    with errors_name(path, whole, "Copy the file from the drone again.", ThermalFileError):
        app_segments(path, whole=True)  # before a library in another language takes it
        content = path.read_bytes()
    if library is None:
        expected = "DJI's library libdirp, the only one that turns the counts of a DJI R-JPEG into degrees"
        remedy = f"Download {_SDK} and pass --dji-library with the path of libdirp.so (libdirp.dll on Windows)."
        raise ThermalFileError(str(path), expected=expected, got="no library", remedy=remedy)
    dirp = _load(library)
    data = (ctypes.c_uint8 * len(content)).from_buffer_copy(content)
    handle = ctypes.c_void_p()

    def call(function: str, *arguments: Any) -> None:
        status = getattr(dirp, function)(*arguments)
        if status != 0:
            expected = f"{function} of {library.name} to take the file"
            got = f"status {status}"
            remedy = f"Copy the file from the drone again, unedited; use a newer library. {_LIMITS}"
            raise ThermalFileError(str(path), expected=expected, got=got, remedy=remedy)

    call("dirp_create_from_rjpeg", data, ctypes.c_int32(len(content)), ctypes.byref(handle))
    try:
        return _measure(path, call, handle, options)
    finally:
        dirp.dirp_destroy(handle)


def _measure(
    path: Path, call: Callable[..., None], handle: ctypes.c_void_p, options: RadiometryOptions
) -> tuple[Float32Array, Conditions]:
    size = _Resolution()
    call("dirp_get_rjpeg_resolution", handle, ctypes.byref(size))
    check_thermal_size(path, size.width, size.height)
    parameters = _Parameters(air_c=math.nan)  # a library that knows the air temperature overwrites the NaN
    call("dirp_get_measurement_params", handle, ctypes.byref(parameters))
    knows_air = not math.isnan(parameters.air_c)
    percent = parameters.humidity > 1.0
    try:
        before = Conditions(
            emissivity=parameters.emissivity,
            reflected_c=parameters.reflected_c,
            distance_m=parameters.distance_m,
            relative_humidity=parameters.humidity / 100.0 if percent else parameters.humidity,
            air_c=parameters.air_c if knows_air else parameters.reflected_c,
        )
    except ThermoxelsError as problem:
        expected, remedy = "possible measurement parameters", "Copy the file from the drone again, unedited."
        raise ThermalFileError(str(path), expected=expected, got=str(problem), remedy=remedy) from problem
    after = options.applied_to(before)
    if after != before:
        if options.air_c is not None and not knows_air:
            remedy = "Use a newer DJI Thermal SDK, or leave --air-c out."
            got = "one that takes the reflected temperature for it"
            raise ThermalFileError("air_c", expected="a libdirp that knows the air temperature", got=got, remedy=remedy)
        if not knows_air:
            after = replace(after, air_c=after.reflected_c)
        for name in ("distance_m", "emissivity", "reflected_c", *(("air_c",) if knows_air else ())):
            setattr(parameters, name, getattr(after, name))
        parameters.humidity = after.relative_humidity * (100.0 if percent else 1.0)
        call("dirp_set_measurement_params", handle, ctypes.byref(parameters))
    temperature_c = np.full((size.height, size.width), np.nan, dtype=np.float32)
    pointer = temperature_c.ctypes.data_as(ctypes.POINTER(ctypes.c_float))
    call("dirp_measure_ex", handle, pointer, ctypes.c_int32(temperature_c.nbytes))
    return temperature_c, after


def _load(library: Path) -> ctypes.CDLL:
    wrong = "nothing there"
    if library.is_file():
        try:
            dirp = ctypes.CDLL(str(library.resolve()))
            for name in _FUNCTIONS:
                getattr(dirp, name).restype = ctypes.c_int32
            return dirp
        except OSError as problem:
            wrong = f"a file that cannot be loaded ({problem})"
        except AttributeError as problem:
            wrong = f"another library ({problem})"
    expected = f"DJI's libdirp for this computer at {library}"
    remedy = f"Pass --dji-library with the path of the file in {_SDK}, and leave the libraries beside it."
    raise ThermalFileError("dji_library", expected=expected, got=wrong, remedy=remedy)
