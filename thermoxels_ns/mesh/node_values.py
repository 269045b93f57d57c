"""Values at mesh nodes from values at lattice corners."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.checks import check_shape
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.core.lattice import CORNER_OFFSETS


def interpolate_corners(
    points_index: npt.NDArray[np.float64], values: npt.NDArray, weights: npt.NDArray
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Interpolate between corners that know a value, leaving out those that do not (normalised convolution).

    value(x) = sum_c t_c w_c v_c / sum_c t_c w_c with the trilinear weights t_c of the eight corners around x and the
    weight w_c of what is known there (Knutsson and Westin, CVPR 1993). The result lies within the range of the values
    it is made of.

    Args:
        points_index: Positions as fractional corner indices, shape (n, 3), within the lattice.
        values: Values on the corners, shape (nx, ny, nz) or (nx, ny, nz, k).
        weights: How well each is known, at least 0, shape (nx, ny, nz).

    Returns:
        values: At the points, shape (n,) or (n, k); 0 where nothing around is known.
        weight: sum_c t_c w_c, shape (n,).

    Raises:
        MeshError: Shapes do not fit.
    """
    shape = weights.shape
    check_shape("values", values, (*shape, *values.shape[3:]), "Pass one value per corner.", MeshError)
    low = np.clip(np.floor(points_index).astype(np.int64), 0, np.array(shape) - 2)
    fraction = np.clip(points_index - low, 0.0, 1.0)
    flat_values = values.reshape(-1, *values.shape[3:])
    flat_weights = weights.ravel()
    total = np.zeros((len(low), *values.shape[3:]))
    weight = np.zeros(len(low))
    trailing = (slice(None), *[None] * (values.ndim - 3))
    # Chosen as the origin of the sum so that equal values come out as they are.
    first: npt.NDArray[np.float64] | None = None
    known = np.zeros(len(low), dtype=bool)
    for offset in CORNER_OFFSETS:
        at = ((low[:, 0] + offset[0]) * shape[1] + low[:, 1] + offset[1]) * shape[2] + low[:, 2] + offset[2]
        share = np.prod(np.where(offset == 1, fraction, 1.0 - fraction), axis=1) * flat_weights[at]
        weight += share
        here = flat_values[at].astype(np.float64)
        if first is None:
            first = np.zeros_like(here)
        fresh = ~known & (share > 0.0)
        first[fresh] = here[fresh]
        known |= fresh
        total += share[trailing] * (here - first)
    assert first is not None
    divisor = np.where(weight > 0.0, weight, 1.0)[trailing]
    return first + total / divisor, weight
