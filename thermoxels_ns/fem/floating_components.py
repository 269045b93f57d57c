"""Connected components of a body that no known temperature holds."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.system import HeatSystem

MOST_RISE_K = 1e6
"""Change of a temperature beyond which a piece without heat capacity does not hold what flows into it, [K]."""
LEAST_CAPACITY_J_M3K = 1.0
"""Heat capacity per volume below which there is none to speak of: a thousandth of that of air, [J / (m3 K)]."""


def check_held(system: HeatSystem, time_s: float) -> None:
    """Refuse a body of which a piece may have any temperature in a steady state.

    Args:
        system: The equations.
        time_s: Time at which effects that change are taken, [s].

    Raises:
        HeatError: There is such a piece.
    """
    loose = np.flatnonzero(~system.exchanging_pieces(time_s))
    if len(loose):
        remedy = "Remove the piece, give its boundary an effect, or follow it through time instead."
        got = f"none on {len(loose)} of {system.pieces.count} pieces; {_largest(system, loose)}"
        expected = "convection, radiation, ground contact or a fixed temperature on every connected piece of a body"
        raise HeatError("steady heat problem", expected=expected, got=got, remedy=remedy)


def check_stored(system: HeatSystem, duration_s: float) -> None:
    """Refuse a piece without heat capacity into which heat flows that it does not pass on.

    Only fluxes and sources at the start count; what such a piece does later is found when it happens.

    Args:
        system: The equations.
        duration_s: Time that the body is followed for, [s].

    Raises:
        HeatError: There is such a piece.
    """
    given_w = system.load(0.0)
    if not given_w.any():
        return
    alone = ~system.exchanging_pieces(0.0)
    if not alone.any():
        return
    rise_k = np.abs(system.pieces.sums(given_w)) * duration_s / system.pieces.sums(system.nodal_mass_j_k)
    runaway = np.flatnonzero(alone & (rise_k > MOST_RISE_K) & (_largest_capacity(system) < LEAST_CAPACITY_J_M3K))
    if len(runaway):
        got = f"{len(runaway)} of {system.pieces.count} pieces that would change by up to {rise_k[runaway].max():.2g} K"
        got += f" in {duration_s:g} s; {_largest(system, runaway)}"
        expected = "heat capacity, or exchange of heat, that takes up given fluxes and sources in every connected piece"
        remedy = "Remove the piece, correct its material, or give it convection, radiation or a fixed temperature."
        raise HeatError("heat problem", expected=expected, got=got, remedy=remedy)


def _largest_capacity(system: HeatSystem) -> npt.NDArray[np.float64]:
    """Largest heat capacity per volume in each piece, shape (p,), [J / (m3 K)]."""
    largest = np.zeros(system.pieces.count)
    piece = system.pieces.number[system.problem.mesh.tets[:, 0]]
    np.maximum.at(largest, piece, system.problem.heat_capacity_j_m3k)
    return largest


def _largest(system: HeatSystem, chosen: npt.NDArray[np.int64]) -> str:
    """Say where the largest of some pieces is."""
    sizes = np.bincount(system.pieces.number, minlength=system.pieces.count)
    piece = int(chosen[np.argmax(sizes[chosen])])
    points = system.space.points_m[system.pieces.number == piece]
    low, high = (", ".join(f"{part:.4g}" for part in corner) for corner in (points.min(axis=0), points.max(axis=0)))
    return f"the largest has {sizes[piece]} nodes in the box from ({low}) to ({high}) m"
