"""Units of temperature: degrees Celsius for people, kelvin for the heat solver, [0, 1] for the optimiser."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from thermoxels_ns.core.errors import ThermoxelsError

if TYPE_CHECKING:
    import torch

ZERO_CELSIUS_K = 273.15  # 0 degrees Celsius in kelvin (exact, BIPM)
STEFAN_BOLTZMANN_W_M2K4 = 5.670374419e-8  # Stefan-Boltzmann constant (CODATA 2018), [W / (m2 K4)]

_SMALLEST_SPAN_K = 1e-3  # Least width of a range
_CONSTANT_SCENE_SPAN_K = 1.0  # Width of the range of a scene whose temperatures are all the same

Numbers = TypeVar("Numbers", float, np.ndarray, "torch.Tensor")


def celsius_to_kelvin(temperature_c: Numbers) -> Numbers:
    """Convert temperatures from degrees Celsius to kelvin.

    >>> celsius_to_kelvin(20.0)
    293.15
    """
    return temperature_c + ZERO_CELSIUS_K  # type: ignore[return-value]


def kelvin_to_celsius(temperature_k: Numbers) -> Numbers:
    """Convert temperatures from kelvin to degrees Celsius."""
    return temperature_k - ZERO_CELSIUS_K  # type: ignore[return-value]


@dataclass(frozen=True)
class TemperatureRange:
    """The temperatures that are normalised to 0 and 1. Raises `ThermoxelsError` if less than 0.001 K apart."""

    min_c: float  # Temperature with the normalised value 0, [degrees Celsius]
    max_c: float  # Temperature with the normalised value 1, [degrees Celsius]

    def __post_init__(self) -> None:
        finite = np.isfinite(self.min_c) and np.isfinite(self.max_c)
        if not finite or self.max_c - self.min_c < _SMALLEST_SPAN_K:
            expected, got = f"finite bounds at least {_SMALLEST_SPAN_K} K apart", f"{self.min_c} to {self.max_c} C"
            remedy = "Use TemperatureRange.spanning: it widens the range of a constant image."
            raise ThermoxelsError("temperature range", expected=expected, got=got, remedy=remedy)

    @classmethod
    def spanning(cls, min_c: float, max_c: float) -> TemperatureRange:
        """Return the range from `min_c` to `max_c`; if these are less than 0.001 K apart, the 1 K around them.

        >>> TemperatureRange.spanning(20.0, 20.0)
        TemperatureRange(min_c=19.5, max_c=20.5)
        """
        if np.isfinite(min_c) and np.isfinite(max_c) and abs(max_c - min_c) < _SMALLEST_SPAN_K:
            middle = 0.5 * (min_c + max_c)
            return cls(middle - 0.5 * _CONSTANT_SCENE_SPAN_K, middle + 0.5 * _CONSTANT_SCENE_SPAN_K)
        return cls(float(min_c), float(max_c))

    @property
    def span_k(self) -> float:
        """Width of the range, [K]."""
        return self.max_c - self.min_c

    def normalise(self, temperature_c: Numbers) -> Numbers:
        """Convert degrees Celsius to normalised temperature; values outside the range become values outside [0, 1]."""
        return (temperature_c - self.min_c) / self.span_k  # type: ignore[return-value]

    def to_celsius(self, thermal: Numbers) -> Numbers:
        """Convert normalised temperature to degrees Celsius.

        >>> TemperatureRange(10.0, 30.0).to_celsius(0.25)
        15.0
        """
        return thermal * self.span_k + self.min_c  # type: ignore[return-value]
