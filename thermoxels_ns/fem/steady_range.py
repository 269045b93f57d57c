"""Steady states whose temperatures stay in the range of the surroundings on any mesh.

What `RangeKeeper` does for steps, for a balance without them: where obtuse angles between faces let a temperature leave
the range of all that surrounds the body, the state is found again without the wrong-signed couplings of the nodes that
left, and again if others leave then. Where none leaves, the first answer is the last one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.units import ZERO_CELSIUS_K
from thermoxels_ns.fem.limiter import LEVEL_ROUND_OFF, MOST_SLACK, RANGE_ROUND_OFF
from thermoxels_ns.fem.positive_off_diagonals import WrongCouplings
from thermoxels_ns.fem.stage import Stage, StageSolution
from thermoxels_ns.fem.system import HeatSystem

Vector = npt.NDArray[np.float64]

_ERROR_OVER_TOLERANCE = 1e3
"""Error of a temperature that the linear solver's tolerance may leave, as a share of the range over the tolerance."""


@dataclass(frozen=True)
class RangedState:
    """A steady state and what was done to keep it in range."""

    solution: StageSolution
    """Temperatures and how they were found; iterations of all repetitions count."""
    system: HeatSystem
    """The equations that they fulfil."""
    left_out: int
    """Couplings with the wrong sign that were left out."""
    outside: int
    """Nodes that are out of range all the same."""
    outside_k: float
    """By how much at most, [K]."""

    def describe(self) -> str:
        """Say what was done and what was not, or nothing."""
        sentence = ""
        if self.left_out:
            sentence += (
                " Obtuse angles would have let temperatures leave the range of the surroundings; "
                f"{self.left_out} couplings with the wrong sign were left out."
            )
        if self.outside:
            sentence += (
                f" The temperature of {self.outside} of {self.system.num_nodes} nodes is up to {self.outside_k:.2g} K "
                "out of the range of the surroundings"
            )
            if self.system.lumped:
                sentence += ", by the tolerance of the linear solver."
            elif self.system.num_nodes > len(self.system.problem.mesh.points_m):
                sentence += ", which quadratic tetrahedra may do where they do not resolve the temperature."
            else:
                sentence += ", which boundary exchange that is not lumped may do."
        return sentence


def state_in_range(system: HeatSystem, time_s: float, *, relative_tolerance: float) -> RangedState:
    """Find a steady state in the range of all given and surrounding temperatures; fluxes and sources open its sides.

    Args:
        system: The equations. If masses or boundary exchange are not lumped, nodes out of range are counted only.
        time_s: Time at which effects that change are taken, [s].
        relative_tolerance: Of the linear solver, and of Newton's method.
    """
    start_k = system.start_k
    solution = Stage(system, time_s, np.inf, relative_tolerance=relative_tolerance).solve(start_k, time_s)
    if not solution.converged:
        return RangedState(solution, system, 0, 0, 0.0)
    low, high = system.surroundings_k(time_s)  # a steady state does not know its start
    slack_k = _slack_k(system, low, high, relative_tolerance)
    outside = _outside(solution.relative_k, low - slack_k, high + slack_k)
    if not outside.any():
        return RangedState(solution, system, 0, 0, 0.0)
    left_out, solved = 0, system
    if system.lumped:
        couplings = WrongCouplings(system).begin()
        while outside.any() and solution.converged:
            limited = couplings.more(outside)
            if limited is None:
                break
            # Radiation is found soonest from where the temperatures are already.
            from_k = solution.relative_k if system.nonlinear else start_k
            again = Stage(limited, time_s, np.inf, relative_tolerance=relative_tolerance).solve(from_k, time_s)
            iterations = solution.iterations + again.iterations
            newton_iterations = solution.newton_iterations + again.newton_iterations
            solution = replace(again, iterations=iterations, newton_iterations=newton_iterations)
            solved, left_out = limited, couplings.count
            outside = _outside(solution.relative_k, low - slack_k, high + slack_k)
    relative_k = solution.relative_k
    outside_k = max(low - float(relative_k.min()), float(relative_k.max()) - high, 0.0) if outside.any() else 0.0
    return RangedState(solution, solved, left_out, int(np.count_nonzero(outside)), outside_k)


def _slack_k(system: HeatSystem, low: float, high: float, relative_tolerance: float) -> float:
    """How far out of range floating point and the linear solver may put a temperature, [K].

    What the solver looks for is the change from the start, so that its error is a share of that.
    """
    start_k = system.start_k
    ends = [end for end in (low, high, float(start_k.min()), float(start_k.max())) if np.isfinite(end)]
    level_k = max(abs(end) for end in ends) + abs(system.reference_c + ZERO_CELSIUS_K)
    share = min(max(_ERROR_OVER_TOLERANCE * relative_tolerance, RANGE_ROUND_OFF), MOST_SLACK)
    return max(share * (max(ends) - min(ends)), LEVEL_ROUND_OFF * level_k)


def _outside(relative_k: Vector, low: float, high: float) -> npt.NDArray[np.bool_]:
    return (relative_k < low) | (relative_k > high)
