"""Terms of the heat equation as vectors and matrices on the nodes of a body.

Temperatures come as differences from a reference, which keeps round-off relative to the differences. Every form also
gives its heat flow per patch or region, evaluated as the equations do, so that balances close to round-off.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt
from scipy import sparse

from thermoxels_ns.core.units import ZERO_CELSIUS_K
from thermoxels_ns.fem.linear_space import LinearSpace, sums_by_number
from thermoxels_ns.fem.quantities import Bounded
from thermoxels_ns.fem.terms import FixedTerm, FluxTerm, RadiationTerm, RobinTerm, SourceTerm

Vector = npt.NDArray[np.float64]

COLDEST_SLOPE_K = 1e-2
"""Below this temperature the slope of radiation is that at it, so that no Newton matrix is singular, [K]."""


class Form(Protocol):
    """What all forms that heat flows through have in common."""

    effect: str
    """Label of the effect that it comes from."""
    groups: tuple[str, ...]
    """Names of the patches or regions that it acts on."""

    def group_heat_w(self, relative_k: Vector, time_s: float) -> Vector:
        """Heat flow into the body through each group, shape (g,), [W]."""
        ...


class _Boundary:
    """Boundary triangles of a term and their grouping by patch."""

    def __init__(self, effect: str, facets: npt.NDArray[np.int64], space: LinearSpace) -> None:
        selection = space.selection
        self.effect = effect
        self.num_nodes = space.num_nodes
        self.nodes = space.facet_nodes(facets)
        self.area_m2 = selection.facet_area_m2[facets]
        self.places = selection.facet_places(facets)
        self.rule = space.rule
        self.mean = space.rule.weights @ space.rule.shapes
        used, self.group = np.unique(selection.facet_patch[facets], return_inverse=True)
        self.groups = tuple(selection.patch_names[number] for number in used)

    def at(self, quantity: Bounded, time_s: float) -> Vector:
        """Ask for a quantity at each triangle."""
        return quantity.at(self.places, time_s)

    def spread(self, facet_w: Vector) -> Vector:
        """Spread heat that is even over each triangle over its nodes."""
        return sums_by_number(self.nodes.ravel(), (facet_w[:, None] * self.mean).ravel(), self.num_nodes)

    def sums(self, facet_w: Vector) -> Vector:
        """Add up triangles by patch."""
        return sums_by_number(self.group, facet_w, len(self.groups))

    def matrix(self, point_w_k: Vector) -> sparse.csr_matrix:
        """Matrix of products of shape functions, weighted by a value per triangle and point, shape (k, q)."""
        shape = (self.num_nodes, self.num_nodes)
        if len(self.rule.weights) == self.nodes.shape[1] and np.array_equal(self.rule.shapes, np.eye(len(self.mean))):
            diagonal = sums_by_number(self.nodes.ravel(), point_w_k.ravel(), self.num_nodes)
            used = np.flatnonzero(diagonal)
            return sparse.csr_matrix((diagonal[used], (used, used)), shape=shape)
        entries = np.einsum("kq,qa,qb->kab", point_w_k, self.rule.shapes, self.rule.shapes)
        rows = np.repeat(self.nodes, self.nodes.shape[1], axis=1).ravel()
        columns = np.tile(self.nodes, (1, self.nodes.shape[1])).ravel()
        return sparse.csr_matrix(sparse.coo_matrix((entries.ravel(), (rows, columns)), shape=shape))


class RobinForm(_Boundary):
    """h (T_ambient - T): a matrix and a load."""

    def __init__(self, term: RobinTerm, space: LinearSpace, reference_c: float) -> None:
        super().__init__(term.effect, term.facets, space)
        self.term, self._reference_c = term, reference_c
        self.matrix_in_time = term.coefficient_w_m2k.in_time
        self.load_in_time = self.matrix_in_time or term.ambient_c.in_time

    def robin_matrix(self, time_s: float) -> sparse.csr_matrix:
        """Entries integral(h phi_i phi_j), [W / K]."""
        return self.matrix(self._conductance(time_s)[:, None] * self.rule.weights)

    def load(self, time_s: float) -> Vector:
        """Entries integral(h T_ambient phi_i), relative to the reference, [W]."""
        return self.spread(self._conductance(time_s) * self.ambient_k(time_s))

    def ambient_k(self, time_s: float) -> Vector:
        """T_ambient at each triangle, relative to the reference, [K]."""
        return self.at(self.term.ambient_c, time_s) - self._reference_c

    def exchanging_nodes(self, time_s: float) -> npt.NDArray[np.int64]:
        """Nodes whose temperature it holds."""
        return np.unique(self.nodes[self._conductance(time_s) > 0.0])

    def group_heat_w(self, relative_k: Vector, time_s: float) -> Vector:
        """Heat flow into the body through each patch, [W]."""
        surface = relative_k[self.nodes] @ self.mean
        return self.sums(self._conductance(time_s) * (self.ambient_k(time_s) - surface))

    def _conductance(self, time_s: float) -> Vector:
        return self.at(self.term.coefficient_w_m2k, time_s) * self.area_m2


class FluxForm(_Boundary):
    """A given heat flux: a load."""

    def __init__(self, term: FluxTerm, space: LinearSpace) -> None:
        super().__init__(term.effect, term.facets, space)
        self._factors = term.factors
        self.load_in_time = any(factor.in_time for factor in term.factors)

    def load(self, time_s: float) -> Vector:
        """Entries integral(q phi_i), [W]."""
        return self.spread(self._heat_w(time_s))

    def group_heat_w(self, relative_k: Vector, time_s: float) -> Vector:
        """Heat flow into the body through each patch, [W]."""
        return self.sums(self._heat_w(time_s))

    def signs(self, time_s: float) -> tuple[bool, bool]:
        """Whether it cools and whether it heats somewhere."""
        heat = self._heat_w(time_s)
        return bool(np.any(heat < 0.0)), bool(np.any(heat > 0.0))

    def _heat_w(self, time_s: float) -> Vector:
        heat = self.area_m2
        for factor in self._factors:
            heat = heat * self.at(factor, time_s)
        return heat


class SourceForm:
    """A given heat source: a load."""

    def __init__(self, term: SourceTerm, space: LinearSpace) -> None:
        self.effect = term.effect
        self.term, self._space = term, space
        self._places, self._volumes = space.source_points(term.tets)
        mesh = space.selection.mesh
        used, group = np.unique(mesh.region[term.tets], return_inverse=True)
        self._group = np.repeat(group, len(self._places) // len(term.tets))
        self.groups = tuple(mesh.region_names[number] for number in used)
        self.load_in_time = term.source_w_m3.in_time

    def load(self, time_s: float) -> Vector:
        """Entries integral(s phi_i), [W]."""
        return self._space.source_load(self.term.tets, self._heat_w(time_s))

    def group_heat_w(self, relative_k: Vector, time_s: float) -> Vector:
        """Heat set free in each region, [W]."""
        return sums_by_number(self._group, self._heat_w(time_s), len(self.groups))

    def signs(self, time_s: float) -> tuple[bool, bool]:
        """Whether it cools and whether it heats somewhere."""
        heat = self._heat_w(time_s)
        return bool(np.any(heat < 0.0)), bool(np.any(heat > 0.0))

    def _heat_w(self, time_s: float) -> Vector:
        return self.term.source_w_m3.at(self._places, time_s) * self._volumes


class RadiationForm(_Boundary):
    """sigma eps (T_s^4 - T^4): a load that depends on the temperature, and its exact slope.

    Below absolute zero, where only the iterations of a solver can get to, T^4 stands for |T|^3 T: the law is then
    monotone everywhere, the equations are those of a convex minimum, and their solution is unique.
    """

    def __init__(self, term: RadiationTerm, space: LinearSpace, reference_c: float) -> None:
        super().__init__(term.effect, term.facets, space)
        self.term, self._reference_c = term, reference_c
        self._reference_k = reference_c + ZERO_CELSIUS_K

    def load(self, relative_k: Vector, time_s: float) -> Vector:
        """Entries integral(sigma eps (T_s^4 - T^4) phi_i), [W]."""
        point = self._point_w(relative_k, time_s)
        return sums_by_number(self.nodes.ravel(), (point @ self.rule.shapes).ravel(), self.num_nodes)

    def slope(self, relative_k: Vector, time_s: float) -> sparse.csr_matrix:
        """Minus the derivative of the load, entries integral(4 sigma eps T^3 phi_i phi_j), [W / K]."""
        kelvin = np.maximum(np.abs(self._surface_k(relative_k) + self._reference_k), COLDEST_SLOPE_K)
        return self.matrix(4.0 * self._strength(time_s)[:, None] * self.rule.weights * kelvin**3)

    def magnitude(self, relative_k: Vector, time_s: float) -> Vector:
        """Sizes of what the load adds up, with those of the temperatures' differences from the reference, [W].

        Round-off of the load is a few eps of it.
        """
        surface, around = self._surface_k(relative_k), self.surroundings_k(time_s)[:, None]
        size = sum(
            (part + self._reference_k) ** 4 + 4.0 * np.abs(part + self._reference_k) ** 3 * np.abs(part)
            for part in (surface, around)
        )
        point = self._strength(time_s)[:, None] * self.rule.weights * size
        return sums_by_number(self.nodes.ravel(), (point @ self.rule.shapes).ravel(), self.num_nodes)

    def surroundings_k(self, time_s: float) -> Vector:
        """T_s at each triangle, relative to the reference, [K]."""
        return self.at(self.term.surroundings_c, time_s) - self._reference_c

    def exchanging_nodes(self, time_s: float) -> npt.NDArray[np.int64]:
        """Nodes whose temperature it holds."""
        return np.unique(self.nodes[self._strength(time_s) > 0.0])

    def group_heat_w(self, relative_k: Vector, time_s: float) -> Vector:
        """Heat flow into the body through each patch, [W]."""
        return self.sums(self._point_w(relative_k, time_s).sum(axis=1))

    def _strength(self, time_s: float) -> Vector:
        return self.term.stefan_boltzmann_w_m2k4 * self.at(self.term.emissivity, time_s) * self.area_m2

    def _surface_k(self, relative_k: Vector) -> Vector:
        return relative_k[self.nodes] @ self.rule.shapes.T

    def _point_w(self, relative_k: Vector, time_s: float) -> Vector:
        surface, around = self._surface_k(relative_k), self.surroundings_k(time_s)[:, None]
        t, s = surface + self._reference_k, around + self._reference_k
        # As a product with the difference, which loses nothing where both are close.
        fourth = np.where(t >= 0.0, (around - surface) * (s + t) * (s * s + t * t), s**4 + t**4)
        return self._strength(time_s)[:, None] * self.rule.weights * fourth


class FixedForm:
    """Given temperatures: nodes that are no unknowns, and the shares of their heat that belong to each patch."""

    def __init__(self, term: FixedTerm, space: LinearSpace, reference_c: float) -> None:
        selection = space.selection
        self.effect = term.effect
        self.reference_c = reference_c
        self.term = term
        facet_nodes = space.facet_nodes(term.facets)
        self.nodes = np.unique(facet_nodes)
        self._places = space.node_places(self.nodes)
        self.in_time = term.temperature_c.in_time
        used, group = np.unique(selection.facet_patch[term.facets], return_inverse=True)
        self.groups = tuple(selection.patch_names[number] for number in used)
        self.owners: npt.NDArray[np.int64] = facet_nodes
        """Nodes of each triangle, shape (k, m)."""
        self.group: npt.NDArray[np.int64] = group
        """Patch of each triangle, shape (k,)."""
        self.area_m2: Vector = selection.facet_area_m2[term.facets]
        """Area of each triangle, shape (k,), to share a node's heat by."""

    def temperature_k(self, time_s: float) -> Vector:
        """Temperatures of `nodes`, relative to the reference, [K]."""
        return self.term.temperature_c.at(self._places, time_s) - self.reference_c
