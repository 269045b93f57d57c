"""Bounds of the heat that each effect can bring to each node."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.units import ZERO_CELSIUS_K
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem, TimeSteps, effect_labels
from thermoxels_ns.fem.quantities import Bounded, Places
from thermoxels_ns.fem.selection import Selection
from thermoxels_ns.fem.space import Space, sums_by_number
from thermoxels_ns.fem.terms import FixedTerm, FluxTerm, RobinTerm, SourceTerm, Term

Vector = npt.NDArray[np.float64]

MOST_TIMES = 241
"""Most times at which quantities that change are asked for."""


@dataclass(frozen=True)
class Span:
    """From a lowest to a highest value, each one number or one per place."""

    low: Vector
    """Lowest."""
    high: Vector
    """Highest."""

    def largest_distance(self, other: Span) -> Vector:
        """Largest difference between a value of this span and one of another."""
        return np.maximum(np.abs(self.high - other.low), np.abs(other.high - self.low))

    def to_power(self, power: int) -> Span:
        """Both ends to a power; they must not be negative."""
        return Span(self.low**power, self.high**power)


@dataclass(frozen=True)
class _Exchange:
    """Exchange with surroundings through boundary triangles: strength times a difference."""

    nodes: npt.NDArray[np.int64]
    """Nodes of the triangles, shape (k, 3)."""
    strength: Span
    """Coefficient times area, [W / K]; of radiation sigma eps times area, [W / K^4]."""
    surroundings_c: Span
    """Temperatures of the surroundings."""
    power: int
    """1 for convection, 4 for radiation."""


class NodalHeat:
    """What one effect can do to the nodes.

    Exchange counts at the nodes, as in the solvers' default. Quantities that change with time are asked for at given
    times; between them they may go beyond by as much as they change from one of them to the next. Where these times are
    too far apart to say how a quantity changes, such as every noon of a year for the sun, it may be all that it is
    allowed to be.
    """

    def __init__(self, effect: str, terms: Sequence[Term], space: Space, times_s: Vector, *, between: bool) -> None:
        """Evaluate an effect.

        Args:
            effect: Its label.
            terms: Its terms.
            space: The nodes.
            times_s: Times to ask for, shape (s,), [s].
            between: Whether quantities count between these times as well.
        """
        self.effect = effect
        self.cooling_w: Vector = np.zeros(space.num_nodes)
        """Largest given heat out of each node at any time, shape (n,), [W]; exchange is not in it."""
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
        self._exchanges: list[_Exchange] = []
        self._space, self._times, self._between = space, times_s, between
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
            robin = isinstance(term, RobinTerm)
            factor = term.coefficient_w_m2k if robin else term.emissivity
            around = self._over_time(term.ambient_c if robin else term.surroundings_c, places)
            scale = area if robin else area * term.stefan_boltzmann_w_m2k4
            share = self._over_time(factor, places)
            strength = Span(share.low * scale, share.high * scale)
            self.holds[nodes[strength.low > 0.0]] = True
            if robin:
                self.held_w_k += self._spread(nodes, strength.low)
            self.surroundings_c.append(around)
            self._exchanges.append(_Exchange(nodes, strength, around, 1 if robin else 4))

    def _over_time(self, quantity: Bounded, places: Places) -> Span:
        """Lowest and highest value at each place."""
        if self._between and self._times[1] - self._times[0] > quantity.resolution_s:
            return Span(np.full(len(places), quantity.bounds.low), np.full(len(places), quantity.bounds.high))
        first = quantity.at(places, float(self._times[0]))
        low, high, jump, last = first.copy(), first.copy(), np.zeros_like(first), first
        for time_s in self._times[1:] if quantity.in_time else ():
            now = quantity.at(places, float(time_s))
            low, high = np.minimum(low, now), np.maximum(high, now)
            jump, last = np.maximum(jump, np.abs(now - last)), now
        if self._between:
            low, high = low - jump, high + jump
        return Span(np.maximum(low, quantity.bounds.low), np.minimum(high, quantity.bounds.high))

    def _spread(self, nodes: npt.NDArray[np.int64], facet_w: Vector) -> Vector:
        return sums_by_number(nodes.ravel(), np.repeat(facet_w / 3.0, 3), self._space.num_nodes)


def nodal_heats(
    problem: HeatProblem, time: TimeSteps | AdaptiveSteps | None, space: Space | None = None
) -> list[NodalHeat]:
    """Evaluate all effects of a problem.

    Args:
        problem: The problem.
        time: How long effects act; None: the moment 0 counts, for a steady state.
        space: The nodes; None: those of the mesh.

    Raises:
        HeatError: An effect does not fit the mesh.
    """
    space = Space(Selection(problem.mesh, problem.up)) if space is None else space
    times_s, between = sample_times(time)
    return [
        NodalHeat(label, effect.terms(space.selection), space, times_s, between=between)
        for label, effect in zip(effect_labels(problem), problem.effects)
    ]


def sample_times(time: TimeSteps | AdaptiveSteps | None) -> tuple[Vector, bool]:
    """Times at which quantities are asked for, and whether the solver may ask for them in between."""
    if time is None:
        return np.zeros(1), False
    if isinstance(time, TimeSteps) and time.steps < MOST_TIMES:
        return time.times_s, False
    return np.linspace(0.0, time.duration_s, MOST_TIMES), True


def _product(first: Span, second: Span) -> Span:
    with np.errstate(invalid="ignore"):
        corners = [a * b for a in (first.low, first.high) for b in (second.low, second.high)]
    corners = [np.where(np.isnan(corner), 0.0, corner) for corner in corners]  # nothing of an unknown amount is nothing
    return Span(np.minimum.reduce(corners), np.maximum.reduce(corners))


def _kelvin(span: Span) -> Span:
    return Span(np.maximum(span.low + ZERO_CELSIUS_K, 0.0), span.high + ZERO_CELSIUS_K)
