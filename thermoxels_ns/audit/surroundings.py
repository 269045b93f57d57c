"""What a surface sees of sky, horizon and ground, and how warm that is."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.heat.sky import ground_view, sky_view

_DEW_POINT_K = 273.0  # as the formula has it


def sky_emissivity(dew_point_c: npt.ArrayLike, cloud: npt.ArrayLike) -> FloatArray:
    """Emissivity of the sky for the temperature of the air at the ground.

    eps_sky = (0.787 + 0.764 ln(T_dp / 273)) (1 + 0.0224 N - 0.0035 N^2 + 0.00028 N^3), T_dp in kelvin, N in tenths
    (EnergyPlus Engineering Reference, "Sky Radiation Modeling"; Clark and Allen 1978, Walton 1983).

    Args:
        dew_point_c: Dew point of the air, [degrees Celsius].
        cloud: Share of the sky that is covered, 0 to 1.

    >>> round(float(sky_emissivity(283.0 - 273.15, 0.0)), 4)
    0.8145
    """
    tenths = 10.0 * np.asarray(cloud, dtype=np.float64)
    clear = 0.787 + 0.764 * np.log((np.asarray(dew_point_c, dtype=np.float64) + 273.15) / _DEW_POINT_K)
    return clear * (1.0 + 0.0224 * tenths - 0.0035 * tenths**2 + 0.00028 * tenths**3)


def view_shares(normals: FloatArray, up: tuple[float, float, float]) -> FloatArray:
    """Shares of a surface's view that are sky, air near the horizon, and ground, shape (k, 3); rows add up to 1.

    F_ground = (1 - cos tilt) / 2; of the rest, b = sqrt((1 + cos tilt) / 2) is sky and 1 - b air near the horizon,
    which is about as warm as that at the ground (EnergyPlus Engineering Reference, "External Longwave Radiation";
    Walton 1983). A wall sees 0.354 sky, 0.146 horizon and 0.5 ground.

    Args:
        normals: Outward unit normals, shape (k, 3).
        up: Unit vector that points up.
    """
    above, below = sky_view(normals, up), ground_view(normals, up)
    sky = above * np.sqrt(above)
    return np.stack([sky, above - sky, below], axis=1)
