"""The temperatures of a body through time."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import numpy.typing as npt

from thermoxels_ns.errors import HeatError, explain
from thermoxels_ns.fem.marching import AdaptiveMarch, Taken, equal_steps
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem, TimeSteps
from thermoxels_ns.fem.schemes import BACKWARD_EULER, SDIRK2, Scheme
from thermoxels_ns.fem.solution import HeatSolution, heat_by_effect, left_out
from thermoxels_ns.fem.steady import too_cold
from thermoxels_ns.fem.system import HeatSystem, effect_labels
from thermoxels_ns.units import celsius_to_kelvin

Vector = npt.NDArray[np.float64]

MAX_STATE_BYTES = 4 * 2**30
"""Most memory that the temperatures of all times may take, [bytes]; every time is also a file of an export."""


def solve_heat(
    problem: HeatProblem,
    time: TimeSteps | AdaptiveSteps,
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
        time: Equal steps, or steps as long as a tolerance allows.
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
        HeatError: If the temperatures of all times do not fit into memory, an effect does not fit the mesh, a step's
            solver does not converge, or the temperature falls below absolute zero.
    """
    states = _room_for_states(time.num_times, len(problem.mesh.points_m))
    system = HeatSystem(problem, lumped=lumped, lumped_boundary=lumped_boundary)
    states[0] = problem.start_c - system.reference_c
    if len(system.fixed.nodes):
        states[0, system.fixed.nodes] = system.fixed.temperature_k(0.0)
    account = _Account(system, states, time.times_s)
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
    return account.close(failure or account.success(march) + _skips(problem, time), not failure, adaptive=bool(march))


class _Account:
    """Keeps states at the ends of intervals and adds up the heat that flowed in between."""

    def __init__(self, system: HeatSystem, states_k: Vector, times_s: Vector) -> None:
        self._system, self._states, self._times = system, states_k, times_s
        self._done = self._steps = self._most_iterations = 0
        self.followed_s = 0.0
        """Time that has been followed, [s]."""
        self._heat_j = np.zeros((len(times_s) - 1, len(system.groups)))
        self._exchanged_j = np.zeros(len(times_s) - 1)
        self._iterations = np.zeros((len(times_s) - 1, 2), dtype=np.int64)
        self._error_k = 0.0
        self._limited = self._out_of_range = 0

    @property
    def steps(self) -> int:
        """Number of steps so far."""
        return self._steps

    def add(self, taken: Taken) -> None:
        """Count a step."""
        step, row = taken.step, self._done
        self.followed_s += taken.step_s
        self._heat_j[row] += taken.step_s * step.group_heat_w
        self._exchanged_j[row] += taken.step_s * float(np.abs(step.group_heat_w).sum())
        self._iterations[row] += step.iterations, step.newton_iterations
        self._most_iterations = max(self._most_iterations, step.iterations)
        self._error_k += step.error_k
        self._steps += 1
        self._limited += taken.limited
        self._out_of_range += not taken.in_range
        if taken.ends_interval:
            self._done += 1
            self._states[self._done] = step.relative_k

    def success(self, march: AdaptiveMarch | None) -> str:
        """Say that all went well, and how."""
        sentence = f"All {self._steps} steps converged, in {self._most_iterations} iterations at most."
        if march is not None and march.repeated:
            sentence += f" {march.repeated} more were repeated with a shorter length."
        if march is not None and march.made_safe:
            sentence += f" {march.made_safe} were taken with backward Euler because {march.name} would have overshot."
        if self._limited:
            sentence += (
                f" In {self._limited}, obtuse angles would have let a temperature leave its range; couplings with the "
                "wrong sign were left out there."
            )
        if self._out_of_range:
            sentence += (
                f" In {self._out_of_range} a temperature left its range, which schemes other than backward Euler, "
                "consistent masses and integrated boundary exchange may do."
            )
        return sentence

    def close(self, status: str, converged: bool, *, adaptive: bool) -> HeatSolution:
        """Balance the heat and convert to degrees Celsius, in place because the states may be large."""
        system, done = self._system, self._done
        states_k, times_s = self._states[: done + 1], self._times[: done + 1]
        heat_j, mass = self._heat_j[:done], system.nodal_mass_j_k
        total_mass = float(mass.sum())
        relative_content = states_k @ mass
        content = relative_content + total_mass * celsius_to_kelvin(system.reference_c)
        supplied = np.concatenate([[0.0], np.cumsum(heat_j.sum(axis=1))])
        unexplained = float(np.max(np.abs(relative_content - relative_content[0] - supplied)))
        exchanged = float(self._exchanged_j[:done].sum())
        mean = relative_content[0] / total_mass
        spread = float(mass @ np.abs(states_k[0] - mean))
        states_k += system.reference_c
        lengths = np.diff(times_s)
        kinds = [effect.kind for effect in system.problem.effects]
        return HeatSolution(
            times_s=times_s,
            temperature_c=states_k,
            heat_w=np.diff(relative_content) / lengths,
            heat_content_j=content,
            energy_residual=_share(unexplained, max(float(content[0]), exchanged)),
            energy_residual_of_spread=_share(unexplained, spread + exchanged),
            status=status,
            converged=converged,
            iterations=self._iterations[:done, 0],
            skipped_effects=left_out(kinds),
            effects=heat_by_effect(effect_labels(system.problem), system.groups, heat_j / lengths[:, None]),
            newton_iterations=self._iterations[:done, 1],
            steps=self._steps,
            time_error_k=self._error_k if adaptive else float("nan"),
            assembled=system.assembled,
        )


def _skips(problem: HeatProblem, time: TimeSteps | AdaptiveSteps) -> str:
    """Say that equal steps are too long to see how an effect changes, or nothing."""
    if isinstance(time, AdaptiveSteps) or time.step_seconds <= problem.resolution_s:
        return ""
    return (
        f" Steps of {time.step_seconds:g} s are longer than the {problem.resolution_s:g} s by which effects that "
        "change with time can be followed; what happens in between is missed."
    )


def _check_estimate(scheme: Scheme | None) -> None:
    if scheme is not None and scheme.estimate is None:
        remedy = "Use SDIRK2, or equal steps."
        raise HeatError(
            explain("scheme", expected="one with an error estimate for adaptive steps", got=scheme.name, remedy=remedy)
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
        explain(
            "steps",
            expected=f"temperatures of all times that fit into memory, at most {MAX_STATE_BYTES} bytes",
            got=f"{got} that: {num_times} times x {num_nodes} nodes x 8 bytes = {needed} bytes",
            remedy=f"Take at most {max(MAX_STATE_BYTES // (8 * num_nodes) - 1, 1)} steps, or a coarser mesh.",
        )
    )


def _share(part: float, whole: float) -> float:
    """Part of a whole; nothing of nothing is 0, something of nothing is infinite."""
    if part == 0.0:
        return 0.0
    return part / whole if whole > 0.0 else float("inf")
