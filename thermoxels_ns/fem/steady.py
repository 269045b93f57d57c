"""Steady states: temperatures at which the heat flow balances at every node, found without steps in time."""

from __future__ import annotations

import numpy as np
from scipy.sparse.csgraph import connected_components

from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.core.units import ZERO_CELSIUS_K
from thermoxels_ns.fem.implicit_equation import ImplicitEquation
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.fem.solution import SteadySolution
from thermoxels_ns.fem.system import Engine, HeatSystem

Vector = FloatArray

OVERSHOOT_K = 0.01  # A temperature outside its range is reported if it is farther outside than this, [K]


def solve_steady(
    problem: HeatProblem, *, order: int = 1, relative_tolerance: float = 1e-12, engine: Engine | None = None
) -> SteadySolution:
    """Return the steady state of a problem: div(k grad T) + s = 0 with the source s, and the effects on the boundary.

    With linear tetrahedra without obtuse angles, only a flux or source can drive a temperature out of the range of the
    surroundings. If a temperature leaves this range without such a cause, the status says by how much.

    Args:
        problem: Body, materials and effects; effects that change with time act as at the time 0. Iterations start
            from the initial temperatures.
        order: 1 for linear tetrahedra, 2 for quadratic ones. Quadratic ones have eight times as many unknowns. Their
            error falls with the cube of the mesh size if the solution is smooth, but they may overshoot.
        relative_tolerance: Relative tolerance of the linear solver, and of Newton's method if there is radiation.
        engine: Function that finds the temperatures in place of our own solver; None: our own.

    Raises:
        HeatError: A connected piece of the body has neither convection, radiation nor a fixed temperature, two effects
            fix one node differently, the solver does not converge, or a temperature is below absolute zero.
    """
    system = HeatSystem(problem, order=order)
    _check_held(system)
    equation = ImplicitEquation(system, 0.0, np.inf, relative_tolerance=relative_tolerance)
    found_k = None if engine is None else engine(system, np.zeros(1))[0]
    solution = equation.solve(system.start_k, 0.0, found_k=found_k)
    if not solution.converged:
        raise HeatError(f"No steady state was found. {solution.status} Check the mesh's quality and the effects.")
    refuse_too_cold(system, solution.relative_k)
    relative_k, num_mesh_nodes = solution.relative_k, len(problem.mesh.points_m)
    group_heat = system.by_group(system.every_part_heat_w(relative_k, 0.0))
    flows_w = 0.0 if system.is_still(relative_k, 0.0) else max(solution.flows_w, 0.5 * np.abs(group_heat).sum())
    temperature_c = relative_k + system.reference_c
    low, high = system.surroundings_k(0.0)  # a steady state does not depend on its start
    overshoot_k, overshoot = out_of_range(max(low - float(relative_k.min()), float(relative_k.max()) - high))
    return SteadySolution(
        temperature_c=temperature_c[:num_mesh_nodes],
        effects=system.heat_of_effects(group_heat[None]),
        energy_residual=0.5 * abs(float(group_heat.sum())) / flows_w if flows_w > 0.0 else 0.0,
        status=f"The steady state was found. {solution.status}{overshoot}",
        iterations=solution.iterations,
        newton_iterations=solution.newton_iterations,
        edge_temperature_c=temperature_c[num_mesh_nodes:],
        unbalanced_w=solution.unbalanced_w,
        overshoot_k=overshoot_k,
        facet_heat_w=system.facet_heat_w(relative_k, 0.0),
    )


def out_of_range(beyond_k: float) -> tuple[float, str]:
    """Return `beyond_k`, [K], by which temperatures leave their range, and a sentence; (0, "") up to `OVERSHOOT_K`."""
    if beyond_k <= OVERSHOOT_K:
        return 0.0, ""
    said = f" A temperature left its range by up to {beyond_k:.2g} K: the mesh or the steps do not resolve a jump."
    return beyond_k, said


def refuse_too_cold(system: HeatSystem, relative_k: Vector) -> None:
    """Raise `HeatError` if a temperature `relative_k` (n,), minus `system.reference_c`, is below absolute zero."""
    coldest_k = float(relative_k.min()) + system.reference_c + ZERO_CELSIUS_K
    if coldest_k < -1e-6:
        raise HeatError(
            f"The temperature falls to {coldest_k:.6g} K, below absolute zero: the given fluxes or sources take out "
            "more heat than can flow in. Check their sign (positive is into the body). In long steps, schemes other "
            "than backward Euler may overshoot, too."
        )


def _check_held(system: HeatSystem) -> None:
    """Raise `HeatError` if a connected piece has neither convection, radiation nor a fixed temperature."""
    count, piece = connected_components(system.stiffness, directed=False)
    acting = (form.nodes[form.strength(0.0)[:, 0] > 0.0].ravel() for form in system.surface_forms)
    loose = np.setdiff1d(np.arange(count), piece[np.concatenate([system.fixed.nodes, *acting])])
    if len(loose):
        sizes = np.bincount(piece)
        largest = loose[np.argmax(sizes[loose])]
        points = system.space.points_m[piece == largest]
        low, high = (", ".join(f"{part:.4g}" for part in end) for end in (points.min(axis=0), points.max(axis=0)))
        got = f"none on {len(loose)} of {count} pieces; the largest has {sizes[largest]} nodes in the box from "
        got += f"({low}) to ({high}) m"
        remedy = "Remove the piece, give its boundary an effect, or follow it through time instead."
        expected = "convection, radiation, ground contact or a fixed temperature on every connected piece of a body"
        raise HeatError("steady heat problem", expected=expected, got=got, remedy=remedy)
