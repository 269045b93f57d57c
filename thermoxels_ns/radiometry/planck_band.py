"""A sensor that weighs a band of wavelengths equally, for cameras that say degrees but not how they got them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

FIRST_RADIATION_W_UM4_M2_SR = 1.191042972e8
"""2 h c^2 (exact constants of the SI, rounded), [W um^4 / (m2 sr)]."""
SECOND_RADIATION_UM_K = 14387.76877
"""h c / k (exact constants of the SI, rounded), [um K]."""
_COLDEST_K, _HOTTEST_K = 50.0, 6000.0
_STEPS = 8192


@dataclass(frozen=True)
class PlanckBand:
    """Planck's law integrated over a band, as a curve of signal over temperature.

    The curve is tabled: the logarithm of the radiance is nearly a straight line over 1 / T, and the table's straight
    pieces can be read both ways, so there and back again is exact.
    """

    shortest_um: float = 7.5
    """Lower end of the band, [micrometres]."""
    longest_um: float = 13.0
    """Upper end of the band, [micrometres]."""

    @cached_property
    def _table(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """1 / T rising, and the logarithm of the radiance, [W / (m2 sr)]."""
        inverse_k = np.linspace(1.0 / _HOTTEST_K, 1.0 / _COLDEST_K, _STEPS)
        nodes, weights = np.polynomial.legendre.leggauss(48)
        half = 0.5 * (self.longest_um - self.shortest_um)
        wavelengths = self.shortest_um + half * (nodes + 1.0)
        spectral = FIRST_RADIATION_W_UM4_M2_SR / wavelengths**5
        radiance = np.zeros(_STEPS)
        for wavelength, strength in zip(wavelengths, half * weights * spectral):
            radiance += strength / np.expm1(SECOND_RADIATION_UM_K / wavelength * inverse_k)
        return inverse_k, np.log(radiance)

    def signal(self, temperature_k: npt.ArrayLike) -> npt.NDArray[np.floating]:
        """Radiance of a black body in the band, [W / (m2 sr)].

        Args:
            temperature_k: Any shape, [K], from 50 to 6000.

        Returns:
            Same shape, float64.

        >>> round(float(PlanckBand().signal(300.0)), 2)
        51.48
        """
        inverse_k, logarithm = self._table
        return np.exp(np.interp(1.0 / np.asarray(temperature_k, dtype=np.float64), inverse_k, logarithm))

    def temperature_k(self, signal: npt.ArrayLike) -> npt.NDArray[np.floating]:
        """Temperature of a black body with this radiance, [K]; NaN where it is below that of 50 K or not above 0.

        Args:
            signal: Radiance, [W / (m2 sr)], any shape.

        Returns:
            Same shape, float64.
        """
        inverse_k, logarithm = self._table
        radiance = np.asarray(signal, dtype=np.float64)
        known = radiance >= np.exp(logarithm[-1])
        falling = np.log(np.where(known, radiance, 1.0))
        return np.where(known, 1.0 / np.interp(falling, logarithm[::-1], inverse_k[::-1]), np.nan)


LONG_WAVE = PlanckBand()
"""7.5 to 13 micrometres, the band of microbolometer cameras."""
