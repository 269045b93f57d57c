"""Heat balance of a computation in time, with the states that are kept."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.units import celsius_to_kelvin
from thermoxels_ns.fem.problem import effect_labels
from thermoxels_ns.fem.solution import HeatSolution, heat_by_effect, left_out
from thermoxels_ns.fem.steady import is_still
from thermoxels_ns.fem.stepper import Step
from thermoxels_ns.fem.system import HeatSystem

Vector = npt.NDArray[np.float64]

_ROUND_OFF = 64.0 * float(np.finfo(np.float64).eps)
"""Share of the terms of a sum that round-off leaves of it at most."""
_SUSPICIOUS = 1e-12
"""Residual from which on it is worth to look whether it is round-off."""


class HeatBalance:
    """Keeps states at the ends of intervals and adds up the heat that flowed in between."""

    def __init__(self, system: HeatSystem, states_k: Vector, times_s: Vector) -> None:
        """Begin with room for the states, shape (s + 1, n), [K], the first one given, and their times, [s]."""
        self._system, self._states, self._times = system, states_k, times_s
        self._done = self._steps = self._most_iterations = 0
        self.followed_s = 0.0
        """Time that has been followed, [s]."""
        self._heat_j = np.zeros((len(times_s) - 1, len(system.groups)))
        self._exchanged_j = np.zeros(len(times_s) - 1)
        self._iterations = np.zeros((len(times_s) - 1, 2), dtype=np.int64)
        self._error_k = 0.0
        self._lengths_s: list[list[float]] = [[] for _ in times_s[1:]]
        self._limited = self._out_of_range = 0

    @property
    def steps(self) -> int:
        """Number of steps so far."""
        return self._steps

    def add(self, step: Step, step_s: float, *, ends_interval: bool) -> None:
        """Count a step of a length, [s]; at the end of an interval its temperatures are kept."""
        row = self._done
        self.followed_s += step_s
        self._lengths_s[row].append(step_s)
        self._heat_j[row] += step_s * step.group_heat_w
        self._exchanged_j[row] += step_s * float(np.abs(step.group_heat_w).sum())
        self._iterations[row] += step.iterations, step.newton_iterations
        self._most_iterations = max(self._most_iterations, step.iterations)
        self._error_k += step.error_k
        self._steps += 1
        self._limited += step.limited
        self._out_of_range += not step.in_range
        if ends_interval:
            self._done += 1
            self._states[self._done] = step.relative_k

    def success(self, of_steps: str) -> str:
        """Say that all went well, and how; `of_steps` is what is to be said about other steps."""
        sentence = f"All {self._steps} steps converged, in {self._most_iterations} iterations at most.{of_steps}"
        if self._limited:
            sentence += (
                f" In {self._limited}, obtuse angles would have let a temperature leave its range; positive "
                "off-diagonals were left out there."
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
        # Not by BLAS, whose sum depends on the number of its threads.
        spread = float(np.sum(mass * np.abs(states_k[0] - mean)))
        scale, spread_scale = max(float(content[0]), exchanged), spread + exchanged
        if unexplained > _SUSPICIOUS * min(scale, spread_scale):
            terms = self._terms_j(states_k, times_s, unexplained / _ROUND_OFF)
            if unexplained <= _ROUND_OFF * terms:
                scale, spread_scale = max(scale, terms), max(spread_scale, terms)
        states_k += system.reference_c
        lengths = np.diff(times_s)
        kinds = [effect.kind for effect in system.problem.effects]
        return HeatSolution(
            times_s=times_s,
            temperature_c=states_k,
            heat_w=np.diff(relative_content) / lengths,
            heat_content_j=content,
            energy_residual=_share(unexplained, scale),
            energy_residual_of_spread=_share(unexplained, spread_scale),
            status=status,
            converged=converged,
            iterations=self._iterations[:done, 0],
            skipped_effects=left_out(kinds),
            effects=heat_by_effect(effect_labels(system.problem), system.groups, heat_j / lengths[:, None]),
            newton_iterations=self._iterations[:done, 1],
            steps=self._steps,
            step_lengths_s=tuple(np.array(lengths) for lengths in self._lengths_s[:done]),
            time_error_k=self._error_k if adaptive else float("nan"),
            assembled=system.assembled,
        )

    def _terms_j(self, states_k: Vector, times_s: Vector, least_j: float) -> float:
        """Sizes of all that is added up to the heat that flows in where nothing makes heat flow, [J].

        If no more than `least_j` can come of it, no state is looked at.
        """
        system, fixed, lengths_s = self._system, self._system.fixed.nodes, np.diff(times_s)
        most_w = np.zeros(len(lengths_s))
        if len(fixed):
            around_w_k = float(system.conducted_heat(np.ones(system.num_nodes))[1][fixed].sum())
            most_w += around_w_k * np.abs(states_k[1:]).max(axis=1)
        states = list(zip(states_k[1:], times_s[1:].tolist()))
        if system.exchanges:
            most_w += [float(system.exchanged_heat(state_k, time_s)[1].sum()) for state_k, time_s in states]
        if float(lengths_s @ most_w) < least_j:
            return 0.0
        total_j = 0.0
        for (state_k, time_s), length_s in zip(states, lengths_s.tolist()):
            if not is_still(system, state_k, time_s):
                continue
            terms_w = float(system.exchanged_heat(state_k, time_s)[1].sum())
            if len(fixed):
                terms_w += float(system.conducted_heat(state_k)[1][fixed].sum())
            total_j += length_s * terms_w
        return total_j


def _share(part: float, whole: float) -> float:
    """Part of a whole; nothing of nothing is 0, something of nothing is infinite."""
    if part == 0.0:
        return 0.0
    return part / whole if whole > 0.0 else float("inf")
