"""What a temperature measurement assumes: emissivity, reflections and the air between."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

from thermoxels_ns.core.checks import is_number
from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.core.units import ZERO_CELSIUS_K

DEFAULT_RELATIVE_HUMIDITY = 0.5
"""Where neither file nor user says: what cameras assume; over a room's distances it changes less than their noise."""
_COLDEST_AIR_C, _HOTTEST_AIR_C = -100.0, 150.0


@dataclass(frozen=True)
class Conditions:
    """What a temperature was computed with; the defaults make it the apparent temperature (a black body, no air)."""

    emissivity: float = 1.0
    """Emissivity of the objects in the picture, above 0, at most 1. Plaster, brick, wood, paint: 0.90 to 0.96."""
    reflected_c: float | None = None
    """Apparent temperature of what the objects mirror, [degrees C]; needed where the emissivity is below 1."""
    distance_m: float = 0.0  # From the camera to the objects, [m], at least 0
    relative_humidity: float = DEFAULT_RELATIVE_HUMIDITY  # Of the air, 0 to 1
    air_c: float | None = None  # Air temperature, [degrees C], -100 to 150; needed where the distance is above 0
    window_transmission: float = 1.0  # Of a window or filter in front of the lens, above 0, at most 1 (1: none)
    window_c: float | None = None  # Temperature of that window, [degrees C]; needed where it does not pass everything

    def __post_init__(self) -> None:
        for name in ("emissivity", "window_transmission"):
            check_between(name, getattr(self, name), 0.0, 1.0, "above 0, at most 1", zero=False)
        check_between("relative_humidity", self.relative_humidity, 0.0, 1.0, "from 0 to 1 (50 % is 0.5)")
        check_between("distance_m", self.distance_m, 0.0, 1e5, "from 0 to 100000 m")
        for name, needed, why in (
            ("reflected_c", self.emissivity < 1, f"an emissivity of {self.emissivity:g}"),
            ("air_c", self.distance_m > 0, f"a distance of {self.distance_m:g} m"),
            ("window_c", self.window_transmission < 1, f"a window that passes {self.window_transmission:g}"),
        ):
            value = getattr(self, name)
            if value is not None:
                low, high = (_COLDEST_AIR_C, _HOTTEST_AIR_C) if name == "air_c" else (-ZERO_CELSIUS_K, 5000.0)
                check_between(name, value, low, high, f"from {low:g} to {high:g} degrees C")
            elif needed:
                expected = f"a temperature, because {why} needs one"
                remedy = f"Pass --{name.replace('_', '-')} in degrees C; indoors the room's is a good guess."
                raise ThermoxelsError(name, expected=expected, got="none", remedy=remedy)


@dataclass(frozen=True)
class ConditionOverrides:
    """What the user knows better than the camera; None keeps what the file says. Units as in `Conditions`."""

    emissivity: float | None = None
    reflected_c: float | None = None
    distance_m: float | None = None
    relative_humidity: float | None = None
    air_c: float | None = None

    def __post_init__(self) -> None:
        # With temperatures for all that may need one, only wrong values raise.
        self.applied_to(Conditions(reflected_c=0.0, air_c=0.0))

    def given(self) -> dict[str, float]:
        """The settings that are not None, by name."""
        names = [field.name for field in fields(ConditionOverrides)]
        return {name: getattr(self, name) for name in names if getattr(self, name) is not None}

    def applied_to(self, conditions: Conditions) -> Conditions:
        """Return `conditions` with the given settings in their place.

        >>> ConditionOverrides(emissivity=0.9, reflected_c=15.0).applied_to(Conditions()).emissivity
        0.9
        """
        return replace(conditions, **self.given())


def conditions_text(conditions: Conditions) -> str:
    """Say what a temperature was computed with.

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


def check_between(name: str, value: float, low: float, high: float, expected: str, *, zero: bool = True) -> None:
    """Raise a `ThermoxelsError` that names the setting if it is no number from `low` to `high` (0 only if `zero`)."""
    if not (is_number(value) and low <= value <= high and (zero or value > 0)):
        remedy = f"Pass a right --{name.replace('_', '-')}."
        raise ThermoxelsError(name, expected=expected, got=repr(value), remedy=remedy)
