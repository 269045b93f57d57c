"""Leave out effects that can change no temperature by more than a tolerance."""

from __future__ import annotations

import time as clock
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy import sparse

from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.core.units import ZERO_CELSIUS_K
from thermoxels_ns.fem.linear_solver import LinearSolver
from thermoxels_ns.fem.p1_kernels import lumped_mass
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem, TimeSteps, effect_labels
from thermoxels_ns.fem.quantities import Bounded, Places
from thermoxels_ns.fem.selection import Selection
from thermoxels_ns.fem.space import Space, sums_by_number
from thermoxels_ns.fem.system import Pieces
from thermoxels_ns.fem.terms import ConvectionTerm, FixedTerm, FluxTerm, SourceTerm, Term

Vector = npt.NDArray[np.float64]

_LEAST_TIMES, _MOST_TIMES = 241, 200_001
"""Least and most times at which a quantity is asked for that the solver may ask for at any time."""


@dataclass(frozen=True)
class Span:
    """From a lowest to a highest value, each one number or one per place."""

    low: Vector
    high: Vector

    def largest_distance(self, other: Span) -> Vector:
        """Largest difference between a value of this span and one of another."""
        return np.maximum(np.abs(self.high - other.low), np.abs(other.high - self.low))

    def to_power(self, power: int) -> Span:
        """Both ends to a power; they must not be negative."""
        return Span(self.low**power, self.high**power)


@dataclass(frozen=True)
class _SurfaceExchange:
    """Strength times a difference of temperatures (`power` 1, convection) or their fourth powers; nodes (k, 3)."""

    nodes: npt.NDArray[np.int64]
    strength: Span  # Coefficient times area, [W / K]; of radiation sigma eps times area, [W / K^4]
    surroundings_c: Span
    power: int


class NodalHeat:
    """What one effect can do to the nodes. Convection and radiation count at the nodes, as in the solvers' default.

    Equal steps ask at their ends, and so do we. Adaptive steps may ask at any time: a quantity is asked for twice in
    the time that it resolves, and may go beyond by as much as it changes from one time to the next (so do tables, whose
    entries are no closer); without a resolution it may be all that it is allowed to be.
    """

    def __init__(
        self, effect: str, terms: Sequence[Term], space: Space, time: TimeSteps | AdaptiveSteps | None
    ) -> None:
        """Evaluate an effect at all times; without `time` at the moment 0."""
        self.effect = effect
        self.cooling_w: Vector = np.zeros(space.num_nodes)
        """Largest given heat out of each node at any time, shape (n,), [W]; convection and radiation are not in it."""
        self.heating_w: Vector = np.zeros(space.num_nodes)
        """The same into each node."""
        self.held_w_k: Vector = np.zeros(space.num_nodes)
        """Least convection of each node at any time, shape (n,), [W / K]."""
        self.holds: npt.NDArray[np.bool_] = np.zeros(space.num_nodes, dtype=bool)
        """Nodes whose temperature it ties to something at all times, shape (n,)."""
        self.fixed: npt.NDArray[np.bool_] = np.zeros(space.num_nodes, dtype=bool)
        """Nodes whose temperature it fixes, shape (n,)."""
        self.surroundings_c: list[Span] = []
        """Temperatures that it pulls towards."""
        self._exchanges: list[_SurfaceExchange] = []
        self._space, self._time = space, time
        for term in terms:
            self._add(term)

    def largest_w(self, range_c: Span) -> Vector:
        """Largest heat to or from each node if temperatures stay in a range, shape (n,), [W]."""
        total = np.maximum(self.cooling_w, self.heating_w)
        for exchange in self._exchanges:
            around, here = exchange.surroundings_c, range_c
            if exchange.power != 1:
                around, here = (_kelvin(span).to_power(exchange.power) for span in (around, here))
            # Nothing times an unknown range is nothing.
            strength = exchange.strength.high
            heat = np.zeros_like(strength)
            acting = strength > 0.0
            heat[acting] = strength[acting] * np.broadcast_to(around.largest_distance(here), strength.shape)[acting]
            total = total + self._spread(exchange.nodes, heat)
        return total

    def _add(self, term: Term) -> None:
        selection, space = self._space.selection, self._space
        if isinstance(term, SourceTerm):
            source = self._over_time(term.source_w_m3, selection.tet_places(term.tets))
            volume = space.tet_volumes_m3(term.tets)
            self.cooling_w += space.source_load(term.tets, volume * np.maximum(-source.low, 0.0))
            self.heating_w += space.source_load(term.tets, volume * np.maximum(source.high, 0.0))
            return
        nodes, places = selection.mesh.facets[term.facets], selection.facet_places(term.facets)
        area = selection.facet_area_m2[term.facets]
        if isinstance(term, FluxTerm):
            flux = Span(area, area)
            for factor in term.factors:
                flux = _product(flux, self._over_time(factor, places))
            self.cooling_w += self._spread(nodes, np.maximum(-flux.low, 0.0))
            self.heating_w += self._spread(nodes, np.maximum(flux.high, 0.0))
        elif isinstance(term, FixedTerm):
            used = np.unique(nodes)
            self.fixed[used] = self.holds[used] = True
            self.surroundings_c.append(self._over_time(term.temperature_c, space.node_places(used)))
        else:
            convection = isinstance(term, ConvectionTerm)
            factor = term.coefficient_w_m2k if convection else term.emissivity
            around = self._over_time(term.ambient_c if convection else term.surroundings_c, places)
            scale = area if convection else area * term.stefan_boltzmann_w_m2k4
            share = self._over_time(factor, places)
            strength = Span(share.low * scale, share.high * scale)
            self.holds[nodes[strength.low > 0.0]] = True
            if convection:
                self.held_w_k += self._spread(nodes, strength.low)
            self.surroundings_c.append(around)
            self._exchanges.append(_SurfaceExchange(nodes, strength, around, 1 if convection else 4))

    def _over_time(self, quantity: Bounded, places: Places) -> Span:
        """Lowest and highest value at each place."""
        times_s = asked_times(self._time, quantity.resolution_s) if quantity.in_time else np.zeros(1)
        if times_s is None:
            return Span(np.full(len(places), quantity.bounds.low), np.full(len(places), quantity.bounds.high))
        last = quantity.at(places, float(times_s[0]))
        low, high, jump = last.copy(), last.copy(), np.zeros_like(last)
        for time_s in times_s[1:]:
            now = quantity.at(places, float(time_s))
            np.minimum(low, now, out=low)
            np.maximum(high, now, out=high)
            if isinstance(self._time, AdaptiveSteps):
                np.maximum(jump, np.abs(now - last), out=jump)
            last = now
        return Span(np.maximum(low - jump, quantity.bounds.low), np.minimum(high + jump, quantity.bounds.high))

    def _spread(self, nodes: npt.NDArray[np.int64], facet_w: Vector) -> Vector:
        return sums_by_number(nodes.ravel(), np.repeat(facet_w / 3.0, 3), self._space.num_nodes)


def nodal_heats(
    problem: HeatProblem, time: TimeSteps | AdaptiveSteps | None, space: Space | None = None
) -> list[NodalHeat]:
    """Evaluate all effects of a problem; without `time` the moment 0 counts, for a steady state."""
    space = Space(Selection(problem.mesh, problem.up)) if space is None else space
    return [
        NodalHeat(label, effect.terms(space.selection), space, time)
        for label, effect in zip(effect_labels(problem), problem.effects)
    ]


def asked_times(time: TimeSteps | AdaptiveSteps | None, resolution_s: float) -> Vector | None:
    """Times at which to ask for a quantity with a resolution, [s], to miss nothing; None if none would do."""
    if time is None:
        return np.zeros(1)
    if isinstance(time, TimeSteps):
        # As the steps add it up: the product of their number and length may differ in the last digit.
        return np.concatenate([[0.0], time.times_s[:-1] + time.step_seconds])
    if not 2.0 * time.duration_s / resolution_s < _MOST_TIMES or np.isinf(resolution_s):
        return None
    return np.linspace(0.0, time.duration_s, max(int(np.ceil(2.0 * time.duration_s / resolution_s)) + 1, _LEAST_TIMES))


def _product(first: Span, second: Span) -> Span:
    with np.errstate(invalid="ignore"):
        corners = [a * b for a in (first.low, first.high) for b in (second.low, second.high)]
    corners = [np.where(np.isnan(corner), 0.0, corner) for corner in corners]  # nothing of an unknown amount is nothing
    return Span(np.minimum.reduce(corners), np.maximum.reduce(corners))


def _kelvin(span: Span) -> Span:
    return Span(np.maximum(span.low + ZERO_CELSIUS_K, 0.0), span.high + ZERO_CELSIUS_K)


_WORTH_A_STEP = 1e4
"""Bound over tolerance above which the implicit step is not tried: it would not bring the bound below the tolerance."""
_STEP_TOLERANCE = 1e-3
"""Relative tolerance of the linear solver in the implicit step; the bound of `screen` holds for an inexact v too."""
_POSITIVE = 1e-9  # Share of the diagonal above which an entry off it counts as above 0
_ROUND_OFF = 1e-12  # Share of the convection at a node below which nothing of it is kept


@dataclass(frozen=True)
class LeftOut:
    """An effect that is not built, and which bound says so."""

    effect: str
    bound_k: float  # Largest difference that it could make to any temperature at any time, [K]
    bound_w: float
    """Largest heat flow that it could bring, [W]. Averaged since the start, no other effect's changes by more."""
    reason: str


@dataclass(frozen=True)
class Kept:
    """An effect that is built, and why."""

    effect: str
    bound_k: float | None
    """Largest difference that it could make if nothing else were left out, [K]; None if no bound is known."""
    reason: str


@dataclass(frozen=True)
class Screening:
    """What a problem needs: the problem without what is left out, and its effects in their order."""

    problem: HeatProblem
    kept: tuple[Kept, ...]
    left_out: tuple[LeftOut, ...]
    tolerance_k: float  # Their bounds add up to no more than this, [K]
    note: str
    seconds: float

    @property
    def bound_k(self) -> float:
        """Largest difference that all that is left out could make together, [K]."""
        return sum(entry.bound_k for entry in self.left_out)

    @property
    def bound_w(self) -> float:
        """Largest heat flow that all that is left out could bring, and change of any other, [W]; means over time."""
        return sum(entry.bound_w for entry in self.left_out)


@dataclass(frozen=True)
class _Bound:
    value_k: float
    reason: str


def screen(
    problem: HeatProblem, time: TimeSteps | AdaptiveSteps | None, tolerance_k: float, most_w: float = np.inf
) -> Screening:
    """Leave out effects that together can change no temperature by more than a tolerance, [K].

    Nor can they bring more heat, or change the mean heat flow of another effect by more, than `most_w`, [W].

    Without an effect, the temperatures differ by w with M w' + (K + R) w + radiation's own damping = f, where f
    is the heat that the effect would bring, and w = 0 at the start. K has no entry above 0 off its diagonal (no
    obtuse angles), masses and convection are lumped: so whatever z >= 0 fulfils M z' + (K + R) z >= |f| at every
    node is a bound, |w| <= z (discrete maximum principle; it holds for backward Euler at any step length). Two
    such z are tried, F being the largest |f|:

    - z rises at the rate max F / M towards the ceiling max F / r, r being the convection that is kept at the node (in a
      steady state there is the ceiling alone: the flux over the coefficient, q / h);
    - from one implicit step over the whole duration t, (M / t + K) v = F: z = v + t max (F - K v) / M, which is 2 max v
      if v is exact. It knows how far heat spreads into the body in that time (the Fourier number).

    Convection and radiation bring at most their coefficient times the largest difference between their surroundings
    and the range that temperatures can reach, which follows from the start, all surroundings, and the bound of all
    fluxes and sources.

    Where angles are obtuse there is no such principle, so that only what brings no heat is left out, and so it is for a
    tolerance of 0. Without any effect nothing is computed. Raises `HeatError` if the tolerance is negative, or an
    effect does not fit the mesh.
    """
    if not tolerance_k >= 0.0:
        remedy = "Give a tolerance in kelvin, or 0 to keep everything."
        raise HeatError("tolerance_k", expected="a number of at least 0", got=tolerance_k, remedy=remedy)
    begin = clock.perf_counter()
    if not problem.effects:
        return Screening(problem, (), (), tolerance_k, "No effect acts.", clock.perf_counter() - begin)
    screener = _Screener(problem, time, tolerance_k, most_w if tolerance_k > 0.0 else 0.0)
    left = screener.left_out()
    names = [heat.effect for heat in screener.heats]
    kept_effects = tuple(effect for number, effect in enumerate(problem.effects) if number not in left)
    return Screening(
        problem=replace(problem, effects=kept_effects) if left else problem,
        kept=tuple(screener.why_kept(number) for number in range(len(names)) if number not in left),
        left_out=tuple(LeftOut(names[n], left[n].value_k, screener.brings_w[n], left[n].reason) for n in sorted(left)),
        tolerance_k=tolerance_k,
        note=screener.note(),
        seconds=clock.perf_counter() - begin,
    )


class _Screener:
    """Bounds of the effects of one problem."""

    def __init__(
        self, problem: HeatProblem, time: TimeSteps | AdaptiveSteps | None, tolerance_k: float, most_w: float
    ) -> None:
        self._problem, self._tolerance, self._most_w = problem, tolerance_k, most_w
        self._duration_s = np.inf if time is None else time.duration_s
        self._space = Space(Selection(problem.mesh, problem.up))
        self.heats = nodal_heats(problem, time, self._space)
        mesh = problem.mesh
        self._mass: Vector = np.ones(0)
        if time is not None:
            self._mass = lumped_mass(mesh.points_m, mesh.tets, problem.heat_capacity_j_m3k)
        self._held_w_k: Vector = sum((heat.held_w_k for heat in self.heats), np.zeros(self._space.num_nodes))
        self._holding: Vector = sum((heat.holds.astype(float) for heat in self.heats), np.zeros(self._space.num_nodes))
        self._free = ~np.logical_or.reduce([heat.fixed for heat in self.heats])
        self._stiffness: sparse.csr_matrix | None = None
        self._obtuse = False
        self._steps: dict[int, _Bound] = {}
        span = self._range()
        self.largest_w = [heat.largest_w(span) for heat in self.heats]
        self.brings_w = [float(heat_w.sum()) for heat_w in self.largest_w]
        self._alone_bounds = [self._alone(number) for number in range(len(self.heats))]
        if min(bound.value_k for bound in self._alone_bounds) <= _WORTH_A_STEP * tolerance_k:
            self._stiffness = self._space.stiffness(problem.conductivity_w_mk)
            self._obtuse = not holds_maximum_principle(self._stiffness)
            self._pieces = Pieces(self._stiffness)

    def left_out(self) -> dict[int, _Bound]:
        """Choose what is left out: the least first, as long as all bounds together keep within the tolerance."""
        left: dict[int, _Bound] = {}
        if self._stiffness is None:
            return left
        gone_w_k, gone, total_k, total_w = np.zeros_like(self._held_w_k), np.zeros_like(self._holding), 0.0, 0.0
        for number in sorted(range(len(self.heats)), key=lambda n: self._alone_bounds[n].value_k):
            if self._alone_bounds[number].value_k > _WORTH_A_STEP * self._tolerance or not self._may_go(number):
                continue
            heat = self.heats[number]
            held, holding = self._held(gone_w_k + heat.held_w_k), self._holding > gone + heat.holds
            tried = {number: self._bound(number, held)}
            if total_k + tried[number].value_k > self._tolerance:
                continue
            if heat.held_w_k.any():  # bounds of what is left already change only with the convection that is kept
                tried |= {n: self._bound(n, held) for n in left if self.brings_w[n] > 0.0}
            more_k = sum(bound.value_k - (left[n].value_k if n in left else 0.0) for n, bound in tried.items())
            within = total_k + more_k <= self._tolerance and total_w + self.brings_w[number] <= self._most_w
            if within and self._still_held(holding):
                left |= tried
                total_k, total_w = total_k + more_k, total_w + self.brings_w[number]
                gone_w_k, gone = gone_w_k + heat.held_w_k, gone + heat.holds
        return left

    def why_kept(self, number: int) -> Kept:
        """Say what an effect that is kept could do."""
        bound = self._alone_bounds[number]
        if number in self._steps and self._steps[number].value_k < bound.value_k:
            bound = self._steps[number]
        name = self.heats[number].effect
        if self.heats[number].fixed.any():
            return Kept(name, None, "it fixes temperatures")
        if not np.isfinite(bound.value_k):
            return Kept(name, None, "nothing that is kept bounds what it could do")
        if bound.value_k <= self._tolerance and not self._may_go(number):
            return Kept(name, bound.value_k, "on a mesh with obtuse angles only what brings no heat is left out")
        if bound.value_k <= self._tolerance and self.brings_w[number] > self._most_w:
            return Kept(name, bound.value_k, "it matters to heat flows")
        if bound.value_k <= self._tolerance:
            return Kept(name, bound.value_k, "with what is left out already, or as the only exchange, it matters")
        return Kept(name, bound.value_k, "its bound is above the tolerance")

    def note(self) -> str:
        """Say what the bounds hold for."""
        if self._stiffness is None:
            return "Every effect can do more than the tolerance."
        if self._obtuse:
            return "The mesh has obtuse angles: bounds are those of the heat equation, and what brings heat is built."
        return "Bounds hold for the equations on this mesh (discrete maximum principle)."

    def _range(self) -> Span:
        """What temperatures can be."""
        start = self._problem.start_c
        spans = [span for heat in self.heats for span in heat.surroundings_c]
        low = min([float(span.low.min()) for span in spans if span.low.size], default=np.inf)
        high = max([float(span.high.max()) for span in spans if span.high.size], default=-np.inf)
        if np.isfinite(self._duration_s):
            low, high = min(low, float(start.min())), max(high, float(start.max()))
        cooling = sum((heat.cooling_w for heat in self.heats), np.zeros(self._space.num_nodes))
        heating = sum((heat.heating_w for heat in self.heats), np.zeros(self._space.num_nodes))
        low -= self._even_rise(cooling, self._held_w_k).value_k
        high += self._even_rise(heating, self._held_w_k).value_k
        return Span(np.array(max(low, -ZERO_CELSIUS_K)), np.array(high))

    def _alone(self, number: int) -> _Bound:
        """Bound of an effect if all others are kept, without the implicit step."""
        if self.heats[number].fixed.any():
            return _Bound(np.inf, "")
        return self._even_rise(self.largest_w[number], self._held(self.heats[number].held_w_k))

    def _bound(self, number: int, held_w_k: Vector) -> _Bound:
        """Bound of an effect if convection of `held_w_k` at each node is kept."""
        if self.heats[number].fixed.any():
            return _Bound(np.inf, "")
        bound = self._even_rise(self.largest_w[number], held_w_k)
        worth = self._tolerance < bound.value_k <= _WORTH_A_STEP * self._tolerance
        if np.isfinite(self._duration_s) and worth:
            if number not in self._steps:
                self._steps[number] = self._implicit_step(self.largest_w[number])
            bound = min(bound, self._steps[number], key=lambda entry: entry.value_k)
        return bound

    def _held(self, gone_w_k: Vector) -> Vector:
        """Convection that is kept at each node, [W / K], without `gone_w_k`."""
        kept = self._held_w_k - gone_w_k
        return np.where(kept > _ROUND_OFF * self._held_w_k, kept, 0.0)

    def _even_rise(self, heat_w: Vector, held_w_k: Vector) -> _Bound:
        """The bound that rises at an even rate towards a ceiling."""
        acting = (heat_w > 0.0) & self._free
        if not acting.any():
            return _Bound(0.0, "it brings no heat")
        heat, held = heat_w[acting], held_w_k[acting]
        with np.errstate(divide="ignore"):
            ceiling_k = float(np.max(heat / held))
        if not np.isfinite(self._duration_s):
            return _Bound(ceiling_k, "the convection that is kept carries its heat away")
        rise_k = float(np.max(heat / self._mass[acting])) * self._duration_s
        if not np.isfinite(ceiling_k):
            return _Bound(rise_k, "its heat warms no node by more in that time")
        value_k = -ceiling_k * float(np.expm1(-rise_k / ceiling_k))
        return _Bound(value_k, "the convection that is kept carries its heat away")

    def _implicit_step(self, heat_w: Vector) -> _Bound:
        """The bound from one implicit step over the whole duration."""
        assert self._stiffness is not None
        matrix = sparse.csr_matrix(self._stiffness + sparse.diags(self._mass / self._duration_s, format="csr"))
        solver = LinearSolver(matrix, relative_tolerance=_STEP_TOLERANCE)
        v = np.maximum(solver.solve(np.where(self._free, heat_w, 0.0)).x, 0.0)
        if not np.all(np.isfinite(v)):
            return _Bound(np.inf, "")
        rest = ((heat_w - self._stiffness @ v) / self._mass)[self._free]
        value_k = float(v.max()) + self._duration_s * float(np.max(rest, initial=0.0))
        return _Bound(value_k, "its heat spreads into the depth in that time")

    def _may_go(self, number: int) -> bool:
        """Whether the mesh lets an effect go: one with obtuse angles only lets go what brings no heat."""
        return not (self._obtuse and self.largest_w[number].any())

    def _still_held(self, holding: npt.NDArray[np.bool_]) -> bool:
        """Whether every piece of a body whose steady state is asked for still has nodes that are held, shape (n,)."""
        return np.isfinite(self._duration_s) or bool(self._pieces.touched(np.flatnonzero(holding)).all())


def holds_maximum_principle(stiffness: sparse.csr_matrix) -> bool:
    """Whether a stiffness matrix has no entry above 0 off its diagonal, so that it is an M-matrix.

    So it is on meshes without obtuse angles between faces; then no temperature leaves the range of its neighbours.

    >>> holds_maximum_principle(sparse.csr_matrix([[1.0, -1.0], [-1.0, 1.0]]))
    True
    """
    entries = stiffness.tocoo()
    off = entries.row != entries.col
    return not np.any(entries.data[off] > _POSITIVE * stiffness.diagonal()[entries.row[off]])
