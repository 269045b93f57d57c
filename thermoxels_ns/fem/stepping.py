"""The temperatures of a body through time."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.effect_forms import effect_labels
from thermoxels_ns.fem.floating_components import check_stored
from thermoxels_ns.fem.marching import AdaptiveMarch, Taken, equal_steps
from thermoxels_ns.fem.problem import AdaptiveSteps, GivenSteps, HeatProblem, TimeSteps
from thermoxels_ns.fem.schemes import BACKWARD_EULER, SDIRK2, Scheme
from thermoxels_ns.fem.solution import HeatSolution
from thermoxels_ns.fem.steady import too_cold
from thermoxels_ns.fem.step_account import StepAccount
from thermoxels_ns.fem.system import HeatSystem

Vector = npt.NDArray[np.float64]

MAX_STATE_BYTES = 4 * 2**30
"""Most memory that the temperatures of all times may take, [bytes]; every time is also a file of an export."""


def solve_heat(
    problem: HeatProblem,
    time: TimeSteps | AdaptiveSteps | GivenSteps,
    *,
    scheme: Scheme | None = None,
    lumped: bool = True,
    lumped_boundary: bool = True,
    relative_tolerance: float = 1e-12,
    allow_unconverged: bool = False,
    progress: Callable[[float, int], None] | None = None,
) -> HeatSolution:
    """Follow the temperatures of a body through time.

    With the defaults no temperature leaves the range of the start and of the surroundings, unless a flux or source
    drives it out, at any step length and on any mesh: where obtuse angles would let one leave, see `RangeKeeper`. If
    other choices let one leave, the status says so.

    Args:
        problem: Body, materials, initial temperatures and effects; without effects the boundary is insulated.
        time: Equal steps, steps as long as a tolerance allows, or steps of given lengths.
        scheme: The scheme in time; None: backward Euler for equal steps, SDIRK2 (with backward Euler where it would
            overshoot) for a tolerance, which needs a scheme with an estimate.
        lumped: Lump the mass matrix, which keeps temperatures within their range at any step length.
        lumped_boundary: Evaluate convection and radiation at the nodes, for the same reason.
        relative_tolerance: Of the linear solver in each step.
        allow_unconverged: Return what was computed, with `converged` False and the reason in `status`, instead
            of raising when a step cannot be solved.
        progress: Called after every step with the share of the duration that is done and the number of steps.

    Returns:
        Temperatures at the start and after every step or interval, and the heat balance.

    Raises:
        HeatError: If the temperatures of all times do not fit into memory, an effect does not fit the mesh, heat flows
            into a piece that neither stores nor passes it on, a step's solver does not converge, or the temperature
            falls below absolute zero.
    """
    states = _room_for_states(time.num_times, len(problem.mesh.points_m))
    system = HeatSystem(problem, lumped=lumped, lumped_boundary=lumped_boundary)
    states[0] = problem.start_c - system.reference_c
    if len(system.fixed.nodes):
        states[0, system.fixed.nodes] = system.fixed.temperature_k(0.0)
    check_stored(system, time.duration_s)
    account = StepAccount(system, states, time.times_s)
    march: AdaptiveMarch | None = None
    if isinstance(time, TimeSteps):
        steps: Iterator[Taken] = equal_steps(system, scheme or BACKWARD_EULER, states[0], time, relative_tolerance)
    else:
        _check_estimate(scheme)
        march = AdaptiveMarch(system, scheme or SDIRK2, states[0], time, relative_tolerance=relative_tolerance)
        steps = march.steps()
    failure = ""
    for taken in steps:
        failure = taken.failure or too_cold(system, taken.step.relative_k)
        if failure:
            break
        account.add(taken)
        if progress is not None:
            progress(account.followed_s / time.duration_s, account.steps)
    if failure and not allow_unconverged:
        raise HeatError(failure)
    return account.close(failure or account.success(march) + skips(problem, time), not failure, adaptive=bool(march))


def skips(problem: HeatProblem, time: TimeSteps | AdaptiveSteps | GivenSteps) -> str:
    """Say that steps may be too long to see how an effect changes, or nothing.

    Args:
        problem: The effects.
        time: The steps.
    """
    if not isinstance(time, TimeSteps):
        labelled = zip(effect_labels(problem), problem.effects)
        names = [label for label, effect in labelled if any(effect.bounded(name).unresolved for name in effect.bounds)]
        if not names:
            return ""
        return (
            f" Nothing says how fast {', '.join(names)} may change with time: what happens between two steps is "
            "missed. Give the Varying its resolution_s, or use tabulated."
        )
    if time.step_seconds <= problem.resolution_s:
        return ""
    return (
        f" Steps of {time.step_seconds:g} s are longer than the {problem.resolution_s:g} s by which effects that "
        "change with time can be followed; what happens in between is missed."
    )


def _check_estimate(scheme: Scheme | None) -> None:
    if scheme is not None and scheme.estimate is None:
        remedy = "Use SDIRK2, or equal steps."
        raise HeatError(
            "scheme", expected="one with an error estimate for adaptive steps", got=scheme.name, remedy=remedy
        )


def _room_for_states(num_times: int, num_nodes: int) -> Vector:
    """Array for the temperatures of all times, or an error that says how much memory they need."""
    needed = num_times * num_nodes * 8
    try:
        if needed <= MAX_STATE_BYTES:
            return np.empty((num_times, num_nodes))
        got = "more than"
    except MemoryError:
        got = "less memory free than"
    raise HeatError(
        "steps",
        expected=f"temperatures of all times that fit into memory, at most {MAX_STATE_BYTES} bytes",
        got=f"{got} that: {num_times} times x {num_nodes} nodes x 8 bytes = {needed} bytes",
        remedy=f"Take at most {max(MAX_STATE_BYTES // (8 * num_nodes) - 1, 1)} steps, or a coarser mesh.",
    )
