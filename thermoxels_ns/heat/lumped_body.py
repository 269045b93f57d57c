"""A body that conducts so well that it has one temperature: one ordinary differential equation per connected piece.

The Biot number h L / k, L being volume over surface, compares the resistance inside a body with that of its surface.
Far below 0.1 temperatures inside differ little. How little is bounded here for the case at hand.

Let L(t) be the lumped temperature and g = (heat that flows into each node at L) - M dL/dt, which sums to 0 over each
piece. With K psi = g, the difference to the full equations, e = T - L, is psi + eta with
M eta' + (K + R) eta = -M psi' - R psi: by the maximum principle |e| <= max |e(0) - psi(0)| + 2 max |psi| + the sum of
all changes of psi in time. If nothing that acts changes with time, L rises or falls without turning, and
psi = a + b L + c L^4 (c for radiation): psi at the start, b and c are three solutions with K. What they lack of
K psi = g heats or cools a node for all of the time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import sparse

from thermoxels_ns.core.units import ZERO_CELSIUS_K
from thermoxels_ns.fem.effect_forms import effect_labels
from thermoxels_ns.fem.effects import Effect, FixedTemperature
from thermoxels_ns.fem.linear_space import LinearSpace
from thermoxels_ns.fem.maximum_principle import holds_maximum_principle
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem, TimeSteps
from thermoxels_ns.fem.quantities import Varying
from thermoxels_ns.fem.selection import Selection
from thermoxels_ns.fem.solution import HeatSolution, heat_by_effect, left_out
from thermoxels_ns.fem.solver_choice import LinearSolver
from thermoxels_ns.fem.steady import is_still, is_too_cold
from thermoxels_ns.fem.system import HeatSystem
from thermoxels_ns.heat.lumped_pieces import HOT_K, PieceEquations, PieceHistory, TooHardError, follow_pieces
from thermoxels_ns.heat.nodal_heat import nodal_heats

Vector = npt.NDArray[np.float64]

MOST_BIOT = 0.1
"""Biot number above which a body is not tried."""
_OBTUSE_FACTOR = 2.0
_SLACK = 1e-4
"""How much storage is added to K, per duration, so that it can be inverted; what that changes is bounded too."""
_SOLVER_TOLERANCE = 1e-10
_SUSPICIOUS = 1e-12
"""Residual from which on it is worth to look whether it is round-off."""


@dataclass(frozen=True)
class LumpedBody:
    """Whether a body may have one temperature, and what it then is."""

    biot: float | None
    """Biot number of the worst piece; None if it was not computed."""
    bound_k: float | None
    """Largest difference to the full equations at any place and time, [K]; None if it was not computed."""
    reason: str
    """Why it may or may not be used, a sentence."""
    solution: HeatSolution | None
    """Temperatures and heat flows, if it may be used."""


def lumped_body(problem: HeatProblem, time: TimeSteps | AdaptiveSteps, tolerance_k: float) -> LumpedBody:
    """Follow a body with one temperature per piece, if that is close enough.

    Args:
        problem: Body, materials and effects.
        time: How long it is followed; steps are not taken, temperatures are those at its times.
        tolerance_k: Largest difference to the full equations, [K].

    Returns:
        The solution, or why there is none.
    """
    spread = _spread(problem)
    if spread > 2.0 * tolerance_k:
        return LumpedBody(None, None, f"The body starts with differences of {spread:.3g} K.", None)
    if any(_fixes_or_changes(effect) for effect in problem.effects):
        return LumpedBody(None, None, "Something fixes a temperature or changes with time.", None)
    space = LinearSpace(Selection(problem.mesh, problem.up))
    held = sum((heat.held_w_k for heat in nodal_heats(problem, time, space)), np.zeros(space.num_nodes))
    biot = _biot(problem, space, np.zeros(space.num_nodes, np.int64), held)
    if biot > MOST_BIOT:
        return LumpedBody(biot, None, f"The Biot number is {biot:.3g}, above {MOST_BIOT:g}.", None)
    body = _Body(HeatSystem(problem), time.duration_s)
    try:
        history = body.follow(time.times_s)
    except TooHardError:
        return LumpedBody(biot, None, "Its radiation could not be integrated with one temperature.", None)
    lumped_k = history.relative_k
    if is_too_cold(body.system, float(lumped_k.min())):
        # The full equations say so, too, and why.
        return LumpedBody(biot, None, "One temperature would fall below absolute zero.", None)
    biot = _biot(problem, space, body.system.pieces.number.astype(np.int64), body.conductance_w_k(lumped_k))
    bound = body.bound_k(lumped_k[0], lumped_k[-1])
    if not bound <= tolerance_k:
        reason = f"One temperature could be wrong by {bound:.2g} K, at a Biot number of {biot:.2g}."
        return LumpedBody(biot, bound, reason, None)
    reason = f"One temperature per connected piece is right to {bound:.2g} K: the Biot number is {biot:.2g}."
    return LumpedBody(biot, bound, reason, body.solution(time.times_s, history, reason))


class _Body:
    """The equations of the pieces, one each. Temperatures are relative to the system's reference."""

    def __init__(self, system: HeatSystem, duration_s: float) -> None:
        self.system = system
        self._duration_s = duration_s
        self._mass = system.nodal_mass_j_k
        self._capacity = system.pieces.sums(self._mass)
        self._start_k = system.problem.start_c - system.reference_c
        self._mean_k = system.pieces.sums(self._mass * self._start_k) / self._capacity
        self._zero_k = system.reference_c + ZERO_CELSIUS_K

    def follow(self, times_s: Vector) -> PieceHistory:
        """Solve the equations of the pieces.

        Raises:
            TooHardError: Radiation could not be integrated.
        """
        system, pieces = self.system, self.system.pieces
        nothing = np.zeros(pieces.count)
        absorbed, emitted = nothing, nothing
        if system.nonlinear:
            cold, hot = (np.full(system.num_nodes, kelvin - self._zero_k) for kelvin in (0.0, HOT_K))
            absorbed = pieces.sums(system.radiation_load(cold, 0.0))
            emitted = absorbed - pieces.sums(system.radiation_load(hot, 0.0))
        equations = PieceEquations(
            capacity_j_k=self._capacity,
            given_w=pieces.sums(system.load(0.0)),
            held_w_k=pieces.sums(system.held_w_k(0.0, np.inf)),
            radiated_in_w=absorbed,
            emitted_at_hot_w=emitted,
            reference_k=self._zero_k,
        )
        return follow_pieces(equations, self._mean_k, times_s)

    def conductance_w_k(self, lumped_k: Vector) -> Vector:
        """Exchange of each node at the warmest temperature of its piece, shape (n,), [W / K]."""
        warmest = self._at_nodes(lumped_k.max(axis=0))
        slope = self.system.radiation_slope(warmest, 0.0) @ np.ones(self.system.num_nodes)
        return self.system.held_w_k(0.0, np.inf) + slope

    def bound_k(self, first_k: Vector, last_k: Vector) -> float:
        """Largest difference to the full equations between two lumped temperatures, shapes (p,)."""
        system = self.system
        zero_k = self._zero_k
        exchange = self._without_sum(-system.held_w_k(0.0, np.inf))
        at_start = self._without_sum(system.exchanged_heat(self._at_nodes(first_k), 0.0)[0])
        parts = [(at_start, np.ones_like(first_k)), (exchange, np.abs(last_k - first_k))]
        if system.nonlinear:
            cold, hot = (np.full(system.num_nodes, kelvin - zero_k) for kelvin in (0.0, HOT_K))
            per_fourth_power = system.radiation_load(hot, 0.0) - system.radiation_load(cold, 0.0)
            change = np.abs((last_k + zero_k) ** 4 - (first_k + zero_k) ** 4) / HOT_K**4
            parts.append((self._without_sum(per_fourth_power), change))
        solver = LinearSolver(self._matrix(), relative_tolerance=_SOLVER_TOLERANCE)
        sizes, rest = [], np.zeros(system.num_nodes)
        for heat_w, amount in parts:
            psi = solver.solve(heat_w).x if np.any(heat_w) else np.zeros_like(heat_w)
            lacking = heat_w - system.conducted_heat(psi)[0]
            rest += np.abs(lacking) / self._mass * self._at_nodes(amount)
            sizes.append((psi, np.abs(psi) * self._at_nodes(amount)))
        changes = sum((size for _, size in sizes[1:]), np.zeros(system.num_nodes))
        start = np.abs(self._start_k - self._at_nodes(self._mean_k) - sizes[0][0])
        most_psi = float(np.max(sizes[0][1] + changes))
        bound = float(start.max()) + 2.0 * most_psi + float(changes.max()) + self._duration_s * float(rest.max())
        return bound if holds_maximum_principle(self._conduction()) else _OBTUSE_FACTOR * bound

    def solution(self, times_s: Vector, history: PieceHistory, reason: str) -> HeatSolution:
        """Put it into the form of a full solution."""
        system, lumped_k = self.system, history.relative_k
        lengths, content = np.diff(times_s), lumped_k @ self._capacity
        heat_w = np.zeros((len(lengths), len(system.groups)))
        for row, (mean_k, radiating_k) in enumerate(zip(history.mean_k, history.radiating_k)):
            heat_w[row] = system.group_heat_w(self._at_nodes(mean_k), 0.0, radiating_k=self._at_nodes(radiating_k))
        interval_j = heat_w * lengths[:, None]
        supplied = np.concatenate([[0.0], np.cumsum(interval_j.sum(axis=1))])
        unexplained = float(np.max(np.abs(content - content[0] - supplied)))
        total = content + float(self._capacity.sum()) * self._zero_k
        exchanged = float(np.abs(interval_j).sum())
        states = np.stack([self._at_nodes(row) for row in lumped_k]) + system.reference_c
        # Not by BLAS, whose sum depends on the number of its threads.
        spread = float(np.sum(self._mass * np.abs(self._start_k - content[0] / self._capacity.sum())))
        scale, within = max(float(total[0]), exchanged), spread + exchanged
        if unexplained > _SUSPICIOUS * min(scale, within):
            terms_j = self._terms_j(times_s, lumped_k)
            scale, within = max(scale, terms_j), max(within, terms_j)
        return HeatSolution(
            times_s=times_s,
            temperature_c=states,
            heat_w=np.diff(content) / lengths,
            heat_content_j=total,
            energy_residual=unexplained / scale,
            energy_residual_of_spread=unexplained / within if within > 0.0 else 0.0,
            status=f"The lumped model was used, without steps or conduction. {reason}",
            converged=True,
            iterations=np.zeros(len(lengths), np.int64),
            skipped_effects=left_out([effect.kind for effect in system.problem.effects]),
            effects=heat_by_effect(effect_labels(system.problem), system.groups, heat_w),
            newton_iterations=np.zeros(len(lengths), np.int64),
            assembled=system.assembled,
        )

    def _terms_j(self, times_s: Vector, lumped_k: Vector) -> float:
        """Sizes of all that cancels where nothing makes heat flow any more, [J]: round-off is a share of that."""
        total_j = 0.0
        for row_k, length_s in zip(lumped_k[1:], np.diff(times_s).tolist()):
            state_k = self._at_nodes(row_k)
            if is_still(self.system, state_k, 0.0):
                total_j += length_s * float(self.system.exchanged_heat(state_k, 0.0)[1].sum())
        return total_j

    def _at_nodes(self, piece_k: Vector) -> Vector:
        return piece_k[self.system.pieces.number]

    def _without_sum(self, heat_w: Vector) -> Vector:
        """Take each piece's sum out, by the mass of its nodes."""
        pieces = self.system.pieces
        return heat_w - self._mass * self._at_nodes(pieces.sums(heat_w) / self._capacity)

    def _conduction(self) -> sparse.csr_matrix:
        exchange = self.system.exchange_matrix(0.0)
        matrix = self.system.matrix(0.0, np.inf)
        return matrix if exchange is None else sparse.csr_matrix(matrix - exchange)

    def _matrix(self) -> sparse.csr_matrix:
        """K, and a little storage so that it can be inverted."""
        return sparse.csr_matrix(self._conduction() + sparse.diags(self._mass * (_SLACK / self._duration_s)))


def _biot(problem: HeatProblem, space: LinearSpace, piece: npt.NDArray[np.int64], held_w_k: Vector) -> float:
    """Biot number of the worst piece: exchange per area, times volume per area, over conductivity."""
    mesh, count = problem.mesh, int(piece.max()) + 1
    volume = np.bincount(piece[mesh.tets[:, 0]], space.tet_volumes_m3(np.arange(len(mesh.tets))), count)
    area = np.bincount(piece[mesh.facets[:, 0]], space.selection.facet_area_m2, count)
    held = np.bincount(piece, held_w_k, count)
    return float(np.max(held * volume / area**2)) / float(np.min(problem.conductivity_w_mk))


def _spread(problem: HeatProblem) -> float:
    """Largest difference at the start within a body; pieces may differ, but that shows later."""
    start, tets = problem.start_c, problem.mesh.tets
    return float(np.ptp(start[tets], axis=1).max())


def _fixes_or_changes(effect: Effect) -> bool:
    if isinstance(effect, FixedTemperature):
        return True
    values = (getattr(effect, name) for name in effect.bounds)
    return any(isinstance(value, Varying) and value.in_time for value in values)
