"""Solution of a heat problem without its negligible effects, either on the given mesh and steps or to a tolerance."""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.errors import HeatError, HeatMemoryError
from thermoxels_ns.fem.forms import FixedForm, FluxForm, effect_forms
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem, TimeSteps, effect_labels
from thermoxels_ns.fem.solution import Solution, SteadySolution, mean_flows_w
from thermoxels_ns.fem.space import Space
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.system import Engine
from thermoxels_ns.fem.time_loop import Progress, solve_heat
from thermoxels_ns.fem.tolerance import (
    Goals,
    ToleratedSolution,
    describe_bytes,
    peak_bytes,
    solve_to_tolerance,
    steady_error,
)

Say = Callable[[str], None]
Time = TimeSteps | AdaptiveSteps | None  # Time steps in which a body is followed; None: its steady state

MOST_ESTIMATED = 300_000
"""Largest number of tetrahedra for which the mesh error is estimated without a request. The estimate solves with
quadratic tetrahedra, which take 60 times as long as linear ones (131,712 tetrahedra: 5.4 s instead of 0.09 s)."""
SAY_EVERY_S = 10.0  # Least time between two lines of progress, [s]


@dataclass(frozen=True)
class LeftOut:
    """An effect that was left out because it brings too little heat."""

    effect: str  # Label of the effect
    heat_w: float  # Largest heat flow, in or out, that the effect would have at the temperatures found, [W]
    share: float  # `heat_w` as a share of all heat that flows through the body on average


@dataclass(frozen=True)
class SolvedProblem:
    """The outcome of `solve_problem`."""

    problem: HeatProblem
    """The problem that was solved: without the effects left out, and perhaps on a finer mesh than the given one."""
    solution: Solution  # Temperatures and heat flows
    left_out: tuple[LeftOut, ...]  # Effects that were left out
    accuracy: ToleratedSolution | None  # The solution with estimated errors; None without a tolerance


def solve_problem(
    problem: HeatProblem, time: Time, goals: Goals, say: Say = lambda _: None, engine: Engine | None = None
) -> SolvedProblem:
    """Return the solution of a problem without its negligible effects; `say` is called with lines of progress.

    An `engine` finds steady states, and equal steps, of the given mesh in place of our own solver.

    Effects that bring little heat at the extreme temperatures of start and surroundings are left out at first. The heat
    that they would bring is then computed at the solution. If it exceeds `goals.left_out_share` of all heat, or if no
    solution was found, the problem is solved again with all effects.

    Raises `HeatError` if more memory than allowed is needed, the solver fails, the tolerance cannot be met, or the
    engine cannot follow what is asked.
    """
    if engine is not None and goals.estimated:
        remedy = "Leave out --engine, or --tolerance and --flow-tolerance."
        raise HeatError("engine", expected="no tolerance beside it", got="a tolerance", remedy=remedy)
    if not goals.estimated:
        needed = peak_bytes(problem, times=1 if time is None else len(time.times_s))
        say(f"Memory: about {describe_bytes(needed)} at most.")
        if needed > goals.memory_bytes:
            expected, got = f"at most {describe_bytes(goals.memory_bytes)}", f"about {describe_bytes(needed)}"
            remedy = "Pass a larger --memory-gb, fewer steps or outputs, or export a coarser mesh."
            raise HeatMemoryError("memory of the heat problem", expected=expected, got=got, remedy=remedy)
    labels, left = effect_labels(problem), _weak(problem, time, goals.left_out_share)
    while True:  # twice at most
        kept = replace(problem, effects=tuple(e for n, e in enumerate(problem.effects) if n not in left))
        shown = ", ".join(label for n, label in enumerate(labels) if n not in left)
        say(f"Effects: {shown or 'none, so no heat crosses the surface'}.")
        try:
            found = _solve(kept, time, goals, say, engine)
        except HeatError:
            if not left:
                raise
            say("Without what is left out there is no solution: solved again with it.")
            left = []
            continue
        if not left:
            return _with_mesh_error(found, goals)
        through_w = 0.5 * sum(map(abs, mean_flows_w(found.solution).values()))
        brings_w = _largest_w(problem, left, np.atleast_2d(found.solution.temperature_c))
        if sum(brings_w.values()) <= goals.left_out_share * through_w:
            shares = {n: brings_w[n] / through_w if through_w > 0.0 else 0.0 for n in left}
            gone = tuple(LeftOut(labels[n], brings_w[n], shares[n]) for n in left)
            for entry in gone:
                say(f"Left out: {entry.effect}, up to {entry.heat_w:.3g} W, {entry.share:.2%} of all heat.")
            return _with_mesh_error(replace(found, left_out=gone), goals)
        back = ", ".join(f"{labels[n]} (up to {brings_w[n]:.3g} W)" for n in left)
        say(f"Of {through_w:.3g} W that flow too much is left out: solved again with {back}.")
        left = []


def _weak(problem: HeatProblem, time: Time, share: float) -> list[int]:
    """Return the numbers of the weakest effects, which together have at most `share` of the power of the others.

    An effect's power is its largest heat flow if the whole body has the coldest, or the warmest, temperature of start
    and surroundings. The result is empty if any effect changes with time, because heat between kept times is unknown.
    """
    if time is not None and any(effect.changing for effect in problem.effects):
        return []
    forms = effect_forms(problem, Space(problem.selection), 0.0)
    around_c = [form.surroundings_k(0.0).ravel() for form in forms if not isinstance(form, FluxForm)]
    every_c = np.concatenate([np.zeros(0) if time is None else problem.start_c, *around_c])
    ends_c = [every_c.min(), every_c.max()] if len(every_c) else [0.0]
    states_c = np.repeat(np.array(ends_c)[:, None], len(problem.mesh.points_m), axis=1)
    power_w = _largest_w(problem, range(len(problem.effects)), states_c)
    total_w = sum(power for power in power_w.values() if np.isfinite(power))
    weak, left_w = list[int](), 0.0
    for number in sorted(power_w, key=power_w.__getitem__):
        left_w += power_w[number]
        if left_w <= share * (total_w - left_w) or left_w == 0.0:
            weak.append(number)
    return sorted(weak)


def _largest_w(problem: HeatProblem, chosen: Sequence[int], states_c: FloatArray) -> dict[int, float]:
    """Return, by number of each `chosen` effect, the largest absolute heat flow in any state, summed over parts, [W].

    `states_c`, (s, n), are temperatures, [degrees Celsius]. The result is infinite for effects that fix temperatures or
    change with time, because they are never left out.
    """
    reference_c, num_nodes = float(problem.start_c.mean()), len(problem.mesh.points_m)
    forms = effect_forms(problem, Space(problem.selection), reference_c)
    numbers = {label: number for number, label in enumerate(effect_labels(problem))}
    largest = dict.fromkeys(chosen, 0.0)
    for form in forms:
        number = numbers[form.effect]
        if number in largest:
            effect = problem.effects[number]
            if isinstance(form, FixedForm) or effect.changing:
                largest[number] = np.inf
            else:
                flows_w = (np.abs(form.part_heat_w(one - reference_c, 0.0)) for one in states_c[:, :num_nodes])
                largest[number] = float(max(flow_w.sum() for flow_w in flows_w))
    return largest


def _solve(problem: HeatProblem, time: Time, goals: Goals, say: Say, engine: Engine | None) -> SolvedProblem:
    if not goals.estimated:
        if time is None:
            return SolvedProblem(problem, solve_steady(problem, engine=engine), (), None)
        solution = solve_heat(problem, time, estimate_steps=True, progress=_progress(say), engine=engine)
        return SolvedProblem(problem, solution, (), None)
    found = solve_to_tolerance(problem, goals, time, log=say, progress=_progress(say))
    return SolvedProblem(found.problem, found.solution, (), found)


def _with_mesh_error(found: SolvedProblem, goals: Goals) -> SolvedProblem:
    """Return `found` with an estimate of the mesh error, if it is a steady state without one. There is no estimate for
    too many tetrahedra (`MOST_ESTIMATED`, memory), or if quadratic ones cannot be solved."""
    fits = len(found.problem.mesh.tets) <= MOST_ESTIMATED and peak_bytes(found.problem, order=2) <= goals.memory_bytes
    if isinstance(found.solution, SteadySolution) and found.accuracy is None and fits:
        with suppress(HeatError):
            error = steady_error(found.problem, found.solution)
            return replace(found, solution=replace(found.solution, error=error))
    return found


def _progress(say: Say) -> Progress:
    """Return the argument `progress` of `solve_heat`, which reports through `say` at most every `SAY_EVERY_S`."""
    said_s = clock.perf_counter()

    def progress(share: float, steps: int) -> None:
        nonlocal said_s
        if clock.perf_counter() - said_s >= SAY_EVERY_S:
            said_s = clock.perf_counter()
            say(f"{share:.2%} of the time after {steps} steps.")

    return progress
