"""Forms: load vectors and matrices of convection, radiation, fluxes and sources, and fixed temperatures of nodes."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import TypeAlias, TypeVar

import numpy as np
from scipy import sparse

from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.core.units import ZERO_CELSIUS_K
from thermoxels_ns.fem.problem import Effect, HeatProblem, effect_labels, in_time, values_at
from thermoxels_ns.fem.selection import Places
from thermoxels_ns.fem.space import Space, sums_by_number

Vector = FloatArray

COLDEST_SLOPE_K = 1e-2
"""Lowest absolute temperature at which the slope of radiation is evaluated, so that no Newton matrix is singular."""
_SAME_TEMPERATURE_K = 1e-9  # Two effects may fix the same node if their temperatures differ by no more than this, [K]
_KEPT_TIMES = 4  # Number of times whose values `at_time` keeps; it is enough for the stages of a step

T = TypeVar("T")


def at_time(kept: dict[float, T], time_s: float, compute: Callable[[float], T]) -> T:
    """Return `compute(time_s)`, from the cache `kept` if it is there; the cache holds the last values."""
    if time_s not in kept:
        value = compute(time_s)
        while len(kept) >= _KEPT_TIMES:
            del kept[next(iter(kept))]
        kept[time_s] = value
    return kept[time_s]


class _Integrated(ABC):
    """The k boundary triangles, or for a source tetrahedra, on which an effect acts, and integrals over these parts.

    The arguments `relative_k` are temperatures of all n unknowns minus `reference_c`, (n,), [K]; round-off is then
    relative to differences. Heat flows of parts are evaluated like the load, so that heat balances close. The number q
    of integration points per triangle is 3 (the nodes) with linear tetrahedra. Heat of a source is per volume.
    """

    def __init__(self, label: str, effect: Effect, parts: IntArray, space: Space, reference_c: float) -> None:
        self.effect, self.kind, self.parts, self._reference_c = label, effect.form, parts, reference_c
        self.quantities = effect.quantities
        self.load_in_time = any(map(in_time, self.quantities))
        """True if the heat flow changes with time at constant temperatures of the body."""
        source = effect.form == "source"
        self.nodes, self._shapes, self._sizes, self.places = (space.tet_rule if source else space.facet_rule)(parts)
        self._numbers, self._num_nodes = self.nodes.T.ravel(), space.num_nodes
        self._lumped = space.order == 1 and not source  # the integration points are the nodes
        self._kept: dict[int, dict[float, Vector]] = {}

    def at(self, number: int, time_s: float) -> Vector:
        """Return entry `number` of `Effect.quantities` at `places`: centroids of triangles, (k, 1), or (k, q)."""
        quantity, kept = self.quantities[number], self._kept.setdefault(number, {})
        time_s = time_s if in_time(quantity) else 0.0
        return at_time(kept, time_s, lambda t: values_at(quantity, self.places, t).reshape(len(self.parts), -1))

    def surface_k(self, relative_k: Vector) -> Vector:
        """Return the temperatures at the integration points, minus the reference, shape (k, q), [K]."""
        nodal = relative_k[self.nodes]
        return nodal if self._lumped else np.einsum("ka,aq->kq", nodal, self._shapes)

    def vector(self, flux_w_m2: Vector) -> Vector:
        """Return the load vector integral(f phi_i), shape (n,), [W], of a flux f of shape (k, q) or (k, 1)."""
        heat_w = flux_w_m2 * self._sizes
        shares = heat_w.T if self._lumped else np.einsum("kq,aq->ak", heat_w, self._shapes)
        return sums_by_number(self._numbers, shares.ravel(), self._num_nodes)

    def matrix(self, coefficient_w_m2k: Vector) -> sparse.csr_matrix:
        """Return the boundary matrix integral(h phi_i phi_j), (n, n), [W / K], for h of shape (k, q) or (k, 1). It is
        lumped, thus diagonal, for linear tetrahedra."""
        if self._lumped:
            matrix = sparse.csr_matrix(sparse.diags(self.vector(coefficient_w_m2k), format="csr"))
        else:
            local = np.einsum("kq,aq,bq->kab", coefficient_w_m2k * self._sizes, self._shapes, self._shapes)
            rows, columns = np.broadcast_arrays(self.nodes[:, :, None], self.nodes[:, None, :])
            entries = local.ravel(), (rows.ravel(), columns.ravel())
            matrix = sparse.csr_matrix(entries, shape=(self._num_nodes,) * 2)
        matrix.eliminate_zeros()
        return matrix

    @abstractmethod
    def flux_w_m2(self, relative_k: Vector, time_s: float) -> Vector:
        """Return the heat flux into the body, [W / m2], at the integration points (k, q), or per triangle (k, 1)."""

    def part_heat_w(self, relative_k: Vector, time_s: float) -> Vector:
        """Return the heat flow into the body through each triangle, or released in each tetrahedron, (k,), [W]."""
        return (self.flux_w_m2(relative_k, time_s) * self._sizes).sum(axis=1)


class _Exchange(_Integrated):
    """Exchange of heat with surroundings. Entry 1 of `Effect.quantities` is the temperature of the surroundings."""

    def strength(self, time_s: float) -> Vector:
        """Return convection's h, [W / (m2 K)], per triangle, shape (k, 1); radiation returns sigma eps instead."""
        return self.at(0, time_s)

    def surroundings_k(self, time_s: float) -> Vector:
        """Return the temperature of the surroundings per triangle, minus the reference, shape (k, 1), [K]."""
        return self.at(1, time_s) - self._reference_c


class ConvectionForm(_Exchange):
    """Convection or ground contact, a Robin boundary condition with the flux h (T_ambient - T): a matrix and a load."""

    def convection_matrix(self, time_s: float) -> sparse.csr_matrix:
        """Return the Robin boundary matrix integral(h phi_i phi_j), (n, n), [W / K]; lumped for linear tetrahedra."""
        return self.matrix(self.strength(time_s))

    def load(self, time_s: float) -> Vector:
        """Return the load integral(h T_ambient phi_i), shape (n,), [W], with T_ambient minus the reference."""
        return self.vector(self.strength(time_s) * self.surroundings_k(time_s))

    def flux_w_m2(self, relative_k: Vector, time_s: float) -> Vector:
        """Return the flux into the body, h (T_ambient - T), at the integration points, shape (k, q), [W / m2]."""
        return self.strength(time_s) * (self.surroundings_k(time_s) - self.surface_k(relative_k))


class FluxForm(_Integrated):
    """A given heat flux f into the body, or source per volume, the product of the effect's quantities: a load."""

    def load(self, time_s: float) -> Vector:
        """Return the load integral(f phi_i), shape (n,), [W]."""
        return self.vector(self.flux_w_m2(np.zeros(0), time_s))

    def flux_w_m2(self, relative_k: Vector, time_s: float) -> Vector:
        """Return the flux f into the body, (k, 1), [W / m2], or a source, (k, q), [W / m3]; `relative_k` is unused."""
        return math.prod((self.at(number, time_s) for number in range(len(self.quantities))), start=np.ones(1))


class RadiationForm(_Exchange):
    """Radiation with the flux sigma eps (T_s^4 - T^4) into the body, T in kelvin: a nonlinear load, and its slope.

    Within a solver's iterations, temperatures may fall below absolute zero; |T|^3 T then replaces T^4. The law is thus
    monotone everywhere, the equations describe the minimum of a convex function, and their solution is unique.
    """

    def strength(self, time_s: float) -> Vector:
        """Return sigma eps per triangle, [W / (m2 K4)], shape (k, 1)."""
        return self.at(2, time_s) * self.at(0, time_s)

    def slope(self, relative_k: Vector, time_s: float) -> sparse.csr_matrix:
        """Return minus the Jacobian of the load, integral(4 sigma eps |T|^3 phi_i phi_j), shape (n, n), [W / K]. T is
        absolute, `relative_k` is relative to the reference. The matrix is lumped for linear tetrahedra."""
        kelvin = self.surface_k(relative_k) + self._reference_c + ZERO_CELSIUS_K
        return self.matrix(4.0 * self.strength(time_s) * np.maximum(np.abs(kelvin), COLDEST_SLOPE_K) ** 3)

    def flux_w_m2(self, relative_k: Vector, time_s: float) -> Vector:
        """Return the flux into the body, sigma eps (T_s^4 - T^4), at the integration points, (k, q), [W / m2]."""
        surface, around = self.surface_k(relative_k), self.surroundings_k(time_s)
        t, s = (kelvin + self._reference_c + ZERO_CELSIUS_K for kelvin in (surface, around))
        # s^4 - t^4 = (s - t) (s + t) (s^2 + t^2): no digits are lost where both are close.
        ss, tt = s * s, t * t
        fourth = np.where(t >= 0.0, (around - surface) * (s + t) * (ss + tt), ss * ss + tt * tt)
        return self.strength(time_s) * fourth


class FixedForm:
    """Given temperatures of the nodes of k boundary triangles (a Dirichlet condition)."""

    def __init__(self, label: str, effect: Effect, parts: IntArray, space: Space, reference_c: float) -> None:
        self.effect, self.kind, self.parts, self.reference_c = label, effect.form, parts, reference_c
        self.owners: IntArray = space.facet_nodes(parts)
        """Nodes of each triangle, shape (k, m): m is 3, or 6 with quadratic tetrahedra."""
        self.nodes = np.unique(self.owners)
        points_m, self._temperature = space.points_m[self.nodes], effect.quantities[0]
        self._places = Places(points_m, np.zeros_like(points_m), space.selection.up)

    def surroundings_k(self, time_s: float) -> Vector:
        """Return the given temperatures of `nodes` minus the reference, shape (len(nodes),), [K]."""
        return values_at(self._temperature, self._places, time_s) - self.reference_c


class FixedNodes:
    """All d nodes whose temperature any effect fixes, and the shares of triangles in their heat."""

    def __init__(self, forms: Sequence[FixedForm], space: Space) -> None:
        self._forms, self._space = tuple(forms), space
        self.nodes: IntArray = np.unique(np.concatenate([np.zeros(0, np.int64), *(f.nodes for f in forms)]))
        """Numbers of the fixed nodes, ascending, shape (d,)."""

    @cached_property
    def facet_shares(self) -> sparse.csr_matrix:
        """Share of each triangle (row, effect after effect) in the heat of each fixed node (column), (triangles, d).
        Triangles that fix a node share its heat in proportion to their areas; columns sum to 1."""
        if not self._forms:
            return sparse.csr_matrix((0, 0))
        owners = np.concatenate([form.owners for form in self._forms])
        column, width = np.searchsorted(self.nodes, owners.ravel()), owners.shape[1]
        parts = np.concatenate([form.parts for form in self._forms])
        area = np.repeat(self._space.selection.facet_area_m2[parts], width)
        share = area / np.bincount(column, area, len(self.nodes))[column]
        begins = width * np.arange(len(owners) + 1)
        return sparse.csr_matrix((share, column, begins), (len(owners), len(self.nodes)))

    @cached_property
    def free(self) -> IntArray:
        """Numbers of the nodes that are not fixed, ascending."""
        free = np.ones(self._space.num_nodes, dtype=bool)
        free[self.nodes] = False
        return np.flatnonzero(free)

    def temperature_k(self, time_s: float) -> Vector:
        """Return the temperatures of `nodes` minus the reference, (d,), [K]; raise `HeatError` if effects disagree."""
        known = np.full(len(self.nodes), np.nan)
        for number, form in enumerate(self._forms):
            place, wanted = np.searchsorted(self.nodes, form.nodes), form.surroundings_k(time_s)
            clash = np.abs(known[place] - wanted) > _SAME_TEMPERATURE_K
            if clash.any():
                first, second = (part[clash][0] + form.reference_c for part in (known[place], wanted))
                node = form.nodes[clash][0]
                other = next(form.effect for form in self._forms[number - 1 :: -1] if node in form.nodes)
                raise HeatError(
                    "fixed temperature",
                    expected="one temperature at each node",
                    got=f"{first:g} C from {other} and {second:g} C from {form.effect} at node {node} and"
                    f" {np.count_nonzero(clash) - 1} more",
                    remedy="Let one effect fix all patches that meet, with a Varying that says what holds there.",
                )
            known[place] = wanted
        return known


Form: TypeAlias = ConvectionForm | FluxForm | RadiationForm | FixedForm
_FORMS: dict[str, type[Form]] = {
    "convection": ConvectionForm,
    "flux": FluxForm,
    "source": FluxForm,
    "radiation": RadiationForm,
    "fixed": FixedForm,
}


def effect_forms(problem: HeatProblem, space: Space, reference_c: float) -> tuple[Form, ...]:
    """Return the forms of a problem's effects, sorted by kind: convection, fluxes, sources, radiation, fixed nodes.

    Effects that act on no triangle or tetrahedron are left out. Forms take and give temperatures minus `reference_c`,
    [degrees Celsius]. Raises `HeatError` if the mesh lacks a patch or region of an effect.
    """
    named = zip(effect_labels(problem), problem.effects)
    acting = [(label, effect, effect.parts(space.selection)) for label, effect in named]
    acting.sort(key=lambda one: list(_FORMS).index(one[1].form))
    return tuple(_FORMS[one[1].form](*one, space, reference_c) for one in acting if len(one[2]))
