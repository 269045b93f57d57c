"""Steady states: where heat flow balances at every node, without steps in time."""

from __future__ import annotations

import numpy as np

from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.core.units import ZERO_CELSIUS_K
from thermoxels_ns.fem.effect_forms import effect_labels
from thermoxels_ns.fem.floating_components import check_held
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.fem.solution import SteadySolution, heat_by_effect
from thermoxels_ns.fem.stage import StageSolution
from thermoxels_ns.fem.steady_range import state_in_range
from thermoxels_ns.fem.system import HeatSystem

_SUSPICIOUS = 1e-12
"""Residual from which on it is worth to look whether it is a share of nothing."""
_ROUND_OFF = 64.0 * float(np.finfo(np.float64).eps)
"""Share of the absolute temperature below which a difference is round-off."""
_LEVEL = 1e-10
"""Share of the terms of a sum below which a level temperature balances them, if the linear solver allows it."""


def solve_steady(
    problem: HeatProblem,
    *,
    time_s: float = 0.0,
    order: int = 1,
    lumped_boundary: bool | None = None,
    relative_tolerance: float = 1e-12,
    allow_unconverged: bool = False,
    system: HeatSystem | None = None,
) -> SteadySolution:
    """Find the temperatures at which the effects of a problem balance, div(k grad T) + s = 0.

    With the defaults no temperature leaves the range of the surroundings, unless a flux or source drives it out, on any
    mesh: where obtuse angles would let one leave, see `state_in_range`. If other choices let one leave, the status
    says so.

    Args:
        problem: Body, materials and effects. Its initial temperatures are where iterations start.
        time_s: Time at which effects that change are taken, [s].
        order: 1 for linear tetrahedra; 2 for quadratic ones, which have eight times as many unknowns and an error that
            falls with the cube of the mesh size where the solution is smooth, but may overshoot the surroundings.
        lumped_boundary: Evaluate convection and radiation at the nodes, which keeps temperatures in the range of the
            surroundings. False integrates them over each triangle: on smooth problems the error is smaller by a
            constant. None: at the nodes of linear tetrahedra; quadratic ones are always integrated.
        relative_tolerance: Of the linear solver, and of Newton's method if there is radiation.
        allow_unconverged: Return what was computed, with `converged` False and the reason in `status`, instead of
            raising.
        system: The equations of the problem if they have been made already; `order` and `lumped_boundary` then say
            nothing. None: they are made here.

    Returns:
        Temperatures and heat flows.

    Raises:
        HeatError: A piece of the body exchanges heat with nothing whose temperature is known, two effects fix one node
            differently, quadratic tetrahedra are to be lumped, or the solver does not converge.
    """
    if system is None:
        system = HeatSystem(problem, lumped=order == 1, lumped_boundary=lumped_boundary, order=order)
    check_held(system, time_s)
    state = state_in_range(system, time_s, relative_tolerance=relative_tolerance)
    solution, system = state.solution, state.system
    failure = _failure(system, solution)
    if failure and not allow_unconverged:
        raise HeatError(failure)
    relative_k = solution.relative_k
    group_heat = heat_of_groups_w(system, relative_k, time_s)
    num_mesh_nodes = len(problem.mesh.points_m)
    return SteadySolution(
        temperature_c=relative_k[:num_mesh_nodes] + system.reference_c,
        effects=heat_by_effect(effect_labels(problem), system.groups, group_heat[None]),
        energy_residual=_residual(system, relative_k, time_s, group_heat, relative_tolerance),
        status=failure or f"The steady state was found. {solution.status}{state.describe()}",
        converged=not failure,
        iterations=solution.iterations,
        newton_iterations=solution.newton_iterations,
        assembled=system.assembled,
        edge_temperature_c=relative_k[num_mesh_nodes:] + system.reference_c,
    )


def _residual(
    system: HeatSystem,
    relative_k: np.ndarray,
    time_s: float,
    group_heat_w: np.ndarray,
    relative_tolerance: float = 1e-12,
) -> float:
    """Heat that comes in and does not go out, as a share of the heat that flows through the nodes.

    Opposite flows through one patch cancel in the sum of its group, not in that of its nodes. Where nothing makes heat
    flow, as between equal airs, what is left is round-off of the terms that cancel, and a share of these.
    """
    exchanged_w, terms_w = system.exchanged_heat(relative_k, time_s)
    flows_w = float(np.abs(exchanged_w).sum() + np.abs(system.net_heat_at_fixed(relative_k, time_s)).sum())
    surplus_w = abs(float(group_heat_w.sum()))
    if surplus_w > _SUSPICIOUS * flows_w and is_still(system, relative_k, time_s, relative_tolerance):
        # What flows to and from fixed nodes is a difference of conduction's terms.
        conducted_w = system.conducted_heat(relative_k)[1][system.fixed.nodes]
        flows_w = max(flows_w, float(terms_w.sum() + conducted_w.sum()))
    return surplus_w / flows_w if flows_w > 0.0 else 0.0


def is_still(system: HeatSystem, relative_k: np.ndarray, time_s: float, relative_tolerance: float = 1e-12) -> bool:
    """Whether nothing makes heat flow: each connected piece, at one temperature, balances what acts on every node.

    Args:
        system: The equations.
        relative_k: Temperatures, relative to the system's reference, shape (n,), [K].
        time_s: Time.
        relative_tolerance: Of the linear solver that found them.
    """
    pieces, fixed = system.pieces, system.fixed.nodes
    mean_k = pieces.sums(relative_k) / pieces.sums(np.ones_like(relative_k))
    level_k = np.zeros_like(relative_k) + pieces.at_nodes(mean_k)
    round_off_k = _ROUND_OFF * (np.abs(level_k).max() + abs(system.reference_c + ZERO_CELSIUS_K))
    share = max(_LEVEL, 100.0 * relative_tolerance)
    heat_w, terms_w = system.exchanged_heat(level_k, time_s)
    allowed_w = share * terms_w + round_off_k * system.held_w_k(time_s, np.inf)
    apart_k = np.abs(relative_k[fixed] - level_k[fixed])
    return bool(np.all(apart_k <= share * np.abs(level_k[fixed]) + round_off_k) and np.all(np.abs(heat_w) <= allowed_w))


def heat_of_groups_w(
    system: HeatSystem, relative_k: np.ndarray, time_s: float, stored_w: np.ndarray | None = None
) -> np.ndarray:
    """Heat flow into the body of each group of a system, fixed nodes included, shape (g,), [W].

    Args:
        system: The equations.
        relative_k: Temperatures, relative to the system's reference, shape (n,), [K].
        time_s: Time.
        stored_w: Heat that each node stores, shape (n,), [W]; None: a steady state.
    """
    kept = -system.net_heat_at_fixed(relative_k, time_s)
    if stored_w is not None:
        kept = kept + stored_w[system.fixed.nodes]
    return np.concatenate([system.group_heat_w(relative_k, time_s), system.fixed.shares @ kept])


def _failure(system: HeatSystem, solution: StageSolution) -> str:
    """Say why a solution is none, or nothing."""
    if not solution.converged:
        return f"No steady state was found. {solution.status} Check the mesh's quality and the effects."
    return too_cold(system, solution.relative_k)


def too_cold(system: HeatSystem, relative_k: np.ndarray) -> str:
    """Say that temperatures are impossible, or nothing."""
    coldest_k = float(relative_k.min())
    if not is_too_cold(system, coldest_k):
        return ""
    coldest_k += system.reference_c + ZERO_CELSIUS_K
    return (
        f"The temperature falls to {coldest_k:.6g} K, below absolute zero: the given fluxes or sources take out more "
        "heat than can flow in. Check their sign (positive is into the body). In long steps, schemes other than "
        "backward Euler may overshoot, too."
    )


def is_too_cold(system: HeatSystem, coldest_k: float) -> bool:
    """Whether the coldest temperature, relative to the system's reference, is below absolute zero."""
    return not coldest_k + system.reference_c + ZERO_CELSIUS_K >= -1e-6
