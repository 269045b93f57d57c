"""Conditions of a thermal measurement, the user's settings, and the formula from a camera's signal to degrees C."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.checks import check_positive, check_ranges
from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.core.units import ZERO_CELSIUS_K, celsius_to_kelvin, kelvin_to_celsius

DEFAULT_RELATIVE_HUMIDITY = 0.5  # as cameras assume, if file and user state none; indoors its effect is below noise
_COLDEST_AIR_C, _HOTTEST_AIR_C = -100.0, 150.0
_LARGEST_ATTENUATION, _LARGEST_WEIGHT = 1.0, 10.0
_LARGEST_EXPONENT = 700.0
_ABOVE_0 = sys.float_info.min
_PLANCK_REMEDY = "Use the constants of the camera file."

Floats = npt.NDArray[np.floating]
CameraName = Literal["workswell", "flir-high-gain", "flir-low-gain", "flir-duo", "sensefly"]


@dataclass(frozen=True)
class Conditions:
    """Conditions of a measurement. The defaults (black body, no air between) give apparent temperatures."""

    emissivity: float = 1.0
    """Emissivity of the objects in the picture, above 0, at most 1. Plaster, brick, wood, paint: 0.90 to 0.96."""
    reflected_c: float | None = None
    """Apparent temperature of what the objects reflect, [degrees C]; required if the emissivity is below 1."""
    distance_m: float = 0.0  # Distance from the camera to the objects, [m], 0 to 100000
    relative_humidity: float = DEFAULT_RELATIVE_HUMIDITY  # Relative humidity of the air, 0 to 1
    air_c: float | None = None  # Air temperature, [degrees C], -100 to 150; required if the distance is above 0
    window_transmission: float = 1.0  # Transmission of a window before the lens, above 0, at most 1 (1: no window)
    window_c: float | None = None  # Temperature of the window, [degrees C]; required if its transmission is below 1

    def __post_init__(self) -> None:
        values = {
            "emissivity": (self.emissivity, _ABOVE_0, 1.0, "above 0, at most 1"),
            "window_transmission": (self.window_transmission, _ABOVE_0, 1.0, "above 0, at most 1"),
            "relative_humidity": (self.relative_humidity, 0.0, 1.0, "from 0 to 1 (50 % is 0.5)"),
            "distance_m": (self.distance_m, 0.0, 1e5, "from 0 to 100000 m"),
        }
        check_ranges("--", values)
        for name, needed, why in (
            ("reflected_c", self.emissivity < 1, f"an emissivity of {self.emissivity:g}"),
            ("air_c", self.distance_m > 0, f"a distance of {self.distance_m:g} m"),
            ("window_c", self.window_transmission < 1, f"a window that passes {self.window_transmission:g}"),
        ):
            value = getattr(self, name)
            if value is not None:
                low, high = (_COLDEST_AIR_C, _HOTTEST_AIR_C) if name == "air_c" else (-ZERO_CELSIUS_K, 5000.0)
                check_ranges("--", {name: (value, low, high, f"from {low:g} to {high:g} degrees C")})
            elif needed:
                expected = f"a temperature, because {why} needs one"
                remedy = f"Pass --{name.replace('_', '-')} in degrees C; indoors the room's is a good guess."
                raise ThermoxelsError(name, expected=expected, got="none", remedy=remedy)


@dataclass(frozen=True)
class RadiometryOptions:
    """The user's settings for degrees C; None: the file's. Raises `ThermoxelsError` if they contradict each other."""

    camera: CameraName | None = None
    """Camera whose counts TIFF or PNG files hold. Default: recognised from the file, which some files do not allow."""
    celsius_per_count: float | None = None
    """Degrees per count of TIFF, PNG or whole-number NPY files, instead of --camera; goes with --celsius-offset."""
    celsius_offset: float | None = None
    """Temperature that count 0 stands for, in degrees C; goes with --celsius-per-count."""
    emissivity: float | None = None
    """Emissivity of the photographed surfaces, above 0, at most 1. Default: the camera's setting."""
    reflected_c: float | None = None
    """Apparent temperature of what the surfaces reflect, in degrees C. Default: the camera's setting."""
    distance_m: float | None = None
    """Distance from camera to surfaces, to correct for the air between, in metres. Default: the camera's setting."""
    relative_humidity: float | None = None
    """Relative humidity of the air, 0 to 1. Default: the camera's setting."""
    air_c: float | None = None
    """Air temperature, in degrees C. Default: the camera's setting."""
    dji_library: Path | None = None
    """Path of DJI's libdirp.so or libdirp.dll, for DJI R-JPEG (from the DJI Thermal SDK)."""

    def __post_init__(self) -> None:
        # The temperatures that may be required are given here, so that only wrong values raise.
        self.applied_to(Conditions(reflected_c=0.0, air_c=0.0))
        scale, offset = self.celsius_per_count, self.celsius_offset
        if (scale is None) != (offset is None) or scale == 0:
            expected, got = "both, with a scale other than 0, or neither", f"{scale} and {offset}"
            remedy = "Pass --celsius-per-count 0.04 --celsius-offset -273.15, for example."
            raise ThermoxelsError("celsius_per_count, celsius_offset", expected=expected, got=got, remedy=remedy)
        if scale is not None and self.camera is not None:
            remedy = "Leave --camera or --celsius-per-count and --celsius-offset out."
            got = f"the preset {self.camera} and {scale} K per count"
            raise ThermoxelsError("camera", expected="a preset or a scale of your own", got=got, remedy=remedy)

    def applied_to(self, conditions: Conditions) -> Conditions:
        """Return `conditions`, with each field replaced by the field of that name in these options, unless it is None.

        >>> RadiometryOptions(emissivity=0.9, reflected_c=15.0).applied_to(Conditions()).emissivity
        0.9
        """
        given = {each.name: getattr(self, each.name, None) for each in fields(Conditions)}
        return replace(conditions, **{name: value for name, value in given.items() if value is not None})


def conditions_text(conditions: Conditions) -> str:
    """Return a text for the report that lists the conditions that temperatures were computed with.

    >>> conditions_text(Conditions(emissivity=0.95, reflected_c=20.0))
    'emissivity 0.95, reflected temperature 20 °C'
    >>> conditions_text(Conditions())
    'emissivity 1 and no air between: apparent temperatures, which are too near that of the surroundings'
    """
    parts = [f"emissivity {conditions.emissivity:.4g}"]
    if conditions.emissivity < 1 and conditions.reflected_c is not None:
        parts.append(f"reflected temperature {conditions.reflected_c:.4g} °C")
    if conditions.distance_m > 0:
        parts.append(f"{conditions.distance_m:.4g} m of air of {100 * conditions.relative_humidity:.3g} % humidity")
        if conditions.air_c is not None:
            parts[-1] += f" and {conditions.air_c:.4g} °C"
    if conditions.window_transmission < 1:
        parts.append(f"a window that passes {100 * conditions.window_transmission:.4g} %")
    if len(parts) == 1 and conditions.emissivity == 1:
        return "emissivity 1 and no air between: apparent temperatures, which are too near that of the surroundings"
    return ", ".join(parts)


@dataclass(frozen=True)
class PlanckConstants:
    """Calibration of a sensor: the constants that give its counts as a function of a black body's temperature."""

    r1: float  # R1, gain of the calibration
    r2: float  # R2, second gain; only R1 / R2 matters
    b: float  # B, second radiation constant over effective wavelength, [K]; 1300 to 1600 for 7.5 to 14 micrometres
    f: float  # F, shape of the curve; 1 in Planck's law at one wavelength
    o: float  # O, offset of the counts (negative in camera files)

    def __post_init__(self) -> None:
        for name in ("r1", "r2", "b", "f"):
            check_positive(f"Planck constant {name.upper()}", getattr(self, name), _PLANCK_REMEDY)
        if not math.isfinite(self.o):
            raise ThermoxelsError("Planck constant O", expected="a finite number", got=self.o, remedy=_PLANCK_REMEDY)

    def signal(self, temperature_k: npt.ArrayLike) -> Floats:
        """Return the sensor's counts for a black body, S = R1 / (R2 (exp(B / T) - F)) - O, in the shape of T, float64.

        The caller must pass temperatures T [K] above 0 and, if F is above 1, below B / ln F (thousands of kelvin).
        """
        temperature_k = np.asarray(temperature_k, dtype=np.float64)
        with np.errstate(divide="ignore", over="ignore"):  # near absolute zero only the offset remains
            return self.r1 / (self.r2 * (np.exp(self.b / temperature_k) - self.f)) - self.o

    def temperature_k(self, signal: npt.ArrayLike) -> Floats:
        """Return a black body's temperature [K], B / ln(R1 / (R2 (S + O)) + F), in the shape of its counts S, float64.

        The result is NaN for counts with S + O not above 0, because no temperature gives them.
        """
        radiance = np.asarray(signal, dtype=np.float64) + self.o
        radiance = np.where(radiance > 0, radiance, np.nan)
        return self.b / np.log(self.r1 / (self.r2 * radiance) + self.f)


LONG_WAVE = PlanckConstants(r1=1.0, r2=1.0, b=1450.0, f=1.0, o=0.0)
"""Constants for microbolometers whose files hold degrees but no constants; only B and F influence a correction. For
emissivities from 0.9 on and surfaces of -20 to 40 degrees C, a correction with these constants differs by at most
0.04 K from one with Planck's law integrated from 7.5 to 13 micrometres."""


@dataclass(frozen=True)
class AirConstants:
    """Constants of `transmission`, which is a sum of two parts. All FLIR files hold the default values."""

    alpha1: float = 0.006569  # attenuation of the first part, [1/sqrt(m)]
    alpha2: float = 0.01262  # attenuation of the second part, [1/sqrt(m)]
    beta1: float = -0.002276  # change of the first attenuation per root of the water content w, see `transmission`
    beta2: float = -0.00667  # change of the second attenuation per root of the water content w
    x: float = 1.9  # weight of the first part; the second part has weight 1 - x

    def __post_init__(self) -> None:
        for field in fields(self):
            limit = _LARGEST_WEIGHT if field.name == "x" else _LARGEST_ATTENUATION
            check_ranges("", {field.name: (getattr(self, field.name), -limit, limit, f"from {-limit:g} to {limit:g}")})

    def transmission(self, distance_m: float, air_c: float, relative_humidity: float) -> float:
        """Return the transmission of humid air: the share of an object's radiation that reaches the camera, 0 to 1.

        tau = X exp(-sqrt(d) (alpha1 + beta1 sqrt(w))) + (1 - X) exp(-sqrt(d) (alpha2 + beta2 sqrt(w))), with distance d
        [m] and water content w = humidity exp(1.5587 + 0.06939 t - 2.7816e-4 t^2 + 6.8455e-7 t^3), t in degrees C,
        humidity 0 to 1 (Minkina and Dudzik 2009, section 2.3: the model of FLIR's cameras).

        >>> AirConstants().transmission(0.0, 20.0, 0.5)
        1.0
        >>> round(AirConstants().transmission(100.0, 20.0, 0.5), 3)
        0.937
        """
        water = relative_humidity * math.exp(1.5587 + 0.06939 * air_c - 2.7816e-4 * air_c**2 + 6.8455e-7 * air_c**3)
        root_d, root_w = math.sqrt(distance_m), math.sqrt(water)
        first = math.exp(min(-root_d * (self.alpha1 + self.beta1 * root_w), _LARGEST_EXPONENT))
        second = math.exp(min(-root_d * (self.alpha2 + self.beta2 * root_w), _LARGEST_EXPONENT))
        return min(max(self.x * first + (1.0 - self.x) * second, 0.0), 1.0)


@dataclass(frozen=True)
class RadiometricModel:
    """Relation between a sensor's signal and an object's temperature, for given air and conditions.

    S(T) is the sensor's signal for a black body of temperature T (`sensor`). Its signal for a real object is (FLIR's
    measurement formula in its manuals; Minkina and Dudzik, Infrared Thermography, 2009, equation 2.18)

        S_total = emissivity tau S(T_object) + (1 - emissivity) tau S(T_reflected) + (1 - tau) S(T_air)

    with the transmission tau of the air. A window before the lens multiplies these terms by its transmission and adds
    (1 - transmission) S(T_window). The weights add up to one, so a correction of temperatures does not depend on the
    offset and scale of S. If a camera hides its constants, the shape of Planck's law in its band is therefore enough.
    """

    conditions: Conditions
    sensor: PlanckConstants = LONG_WAVE
    air: AirConstants = AirConstants()

    def signal(self, temperature_c: npt.ArrayLike) -> Floats:
        """Return S_total for objects of these temperatures [degrees C], in their shape, float64."""
        weight, background = self._weights()
        kelvin = celsius_to_kelvin(np.asarray(temperature_c, dtype=np.float64))
        return weight * self.sensor.signal(kelvin) + background

    def temperature_c(self, signal: npt.ArrayLike) -> Floats:
        """Return the temperatures [degrees C] of objects with the total signals `signal`, in their shape, float64.

        The result is NaN for a signal that is not above what reflections and air alone give.
        """
        weight, background = self._weights()
        object_signal = (np.asarray(signal, dtype=np.float64) - background) / weight
        return kelvin_to_celsius(self.sensor.temperature_k(object_signal))

    def _weights(self) -> tuple[float, float]:
        """Return S(T_object)'s weight in S_total and the sum of the other terms; raise an error if that is 0."""
        given = self.conditions
        air_c = 0.0 if given.air_c is None else given.air_c
        tau = self.air.transmission(given.distance_m, air_c, given.relative_humidity)
        optics = given.window_transmission
        background = 0.0
        for share, celsius in (
            ((1.0 - given.emissivity) * tau * optics, given.reflected_c),
            ((1.0 - tau) * optics, given.air_c),
            (1.0 - optics, given.window_c),
        ):
            if share > 0 and celsius is not None:  # `Conditions` raises if a required temperature is None
                background += share * float(self.sensor.signal(celsius_to_kelvin(celsius)))
        weight = given.emissivity * tau * optics
        if not weight > 0:
            expected = "a distance that some radiation passes"
            got = f"{given.distance_m:g} m in air of {given.air_c} C and humidity {given.relative_humidity:g}"
            remedy = "Check --distance-m, --air-c and --relative-humidity."
            raise ThermoxelsError("distance_m", expected=expected, got=got, remedy=remedy)
        return weight, background


def corrected_temperature_c(apparent_c: npt.ArrayLike, conditions: Conditions) -> Floats:
    """Return temperatures [degrees C] from apparent ones, in their shape, for a `LONG_WAVE` sensor and `conditions`."""
    return RadiometricModel(conditions).temperature_c(RadiometricModel(Conditions()).signal(apparent_c))
