"""What acts on a body with an unknown on every edge, asked point by point instead of through matrices."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.units import ZERO_CELSIUS_K
from thermoxels_ns.fem.edge_midpoints import TET_EDGES, edge_numbers
from thermoxels_ns.fem.effect_forms import effect_forms
from thermoxels_ns.fem.fixed_nodes import FixedNodes
from thermoxels_ns.fem.forms import COLDEST_SLOPE_K, RadiationForm, RobinForm
from thermoxels_ns.fem.linear_space import SIX_POINTS, FacetRule, LinearSpace, sums_by_number
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.fem.quadratic_elements import edge_shapes
from thermoxels_ns.fem.quadratic_space import QuadraticSpace
from thermoxels_ns.fem.selection import Selection
from thermoxels_ns.fem.sparsity import MeshEdges

Vector = npt.NDArray[np.float64]


class EdgeSpace(QuadraticSpace):
    """Nodes and edges of a mesh, whose edges are known already."""

    def __init__(self, selection: Selection, edges: MeshEdges) -> None:
        """Number the edges of the tetrahedra.

        Args:
            selection: The mesh and its parts.
            edges: From `mesh_edges`.
        """
        LinearSpace.__init__(self, selection, lumped=False, lumped_boundary=False)
        self._num_corners, self._edges = len(selection.mesh.points_m), edges
        self._middles = edge_numbers(edges, selection.mesh.tets, TET_EDGES)
        self.rule = FacetRule(edge_shapes(SIX_POINTS.shapes), SIX_POINTS.weights)

    @property
    def tet_edges(self) -> npt.NDArray[np.int64]:
        """Numbers of the edges of each tetrahedron, in the order of `TET_EDGES`, shape (t, 6)."""
        return self._middles


class EdgeExchange:
    """The effects of a problem on the nodes and edges of its mesh."""

    def __init__(self, problem: HeatProblem, space: QuadraticSpace, reference_c: float) -> None:
        """Make the forms of the problem's effects.

        Args:
            problem: The effects.
            space: Nodes and edges.
            reference_c: What temperatures are relative to, [degrees Celsius].
        """
        self._space, self._reference_k = space, reference_c + ZERO_CELSIUS_K
        self._forms = effect_forms(problem, space, reference_c)
        self.fixed = FixedNodes(self._forms.fixed, space.num_nodes)
        """Nodes and edges whose temperature is given."""

    def heat(self, relative_k: Vector, time_s: float) -> Vector:
        """Heat into the body at quadratic temperatures, shape (n,), [W]."""
        total = np.zeros(self._space.num_nodes)
        for form in self._forms.robin:
            ambient = form.ambient_k(time_s)[:, None]
            point = self._strength(form, time_s) * (ambient - self._at_points(form, relative_k))
            total += self._spread(form, point)
        for load in self._forms.loads:
            total += load.load(time_s)
        for form in self._forms.radiation:
            total += form.load(relative_k, time_s)
        return total

    def slopes(self, relative_k: Vector, time_s: float) -> list[tuple[RobinForm | RadiationForm, Vector]]:
        """Heat that exchange takes per kelvin at the points of each form's triangles, shapes (k, q), [W / K]."""
        found: list[tuple[RobinForm | RadiationForm, Vector]] = [
            (form, self._strength(form, time_s)) for form in self._forms.robin
        ]
        for form in self._forms.radiation:
            emitted = form.term.stefan_boltzmann_w_m2k4 * form.at(form.term.emissivity, time_s) * form.area_m2
            kelvin = np.maximum(np.abs(self._at_points(form, relative_k) + self._reference_k), COLDEST_SLOPE_K)
            found.append((form, 4.0 * emitted[:, None] * form.rule.weights * kelvin**3))
        return found

    def taken(self, slopes: list[tuple[RobinForm | RadiationForm, Vector]], change_k: Vector) -> Vector:
        """Heat that exchange takes at a change of the temperatures, shape (n,), [W]."""
        total = np.zeros(self._space.num_nodes)
        for form, slope in slopes:
            total += self._spread(form, slope * self._at_points(form, change_k))
        return total

    def diagonal(self, slopes: list[tuple[RobinForm | RadiationForm, Vector]]) -> Vector:
        """Heat that each node's own change takes, shape (n,), [W / K]."""
        total = np.zeros(self._space.num_nodes)
        for form, slope in slopes:
            own = (slope @ form.rule.shapes**2).ravel()
            total += sums_by_number(form.nodes.ravel(), own, self._space.num_nodes)
        return total

    def group_heat_w(self, relative_k: Vector, time_s: float) -> Vector:
        """Heat flow into the body of each group but those of fixed nodes, in the order of a system, [W]."""
        flows = (form.group_heat_w(relative_k, time_s) for form in self._forms.exchanging)
        return np.concatenate([np.zeros(0), *flows])

    def _strength(self, form: RobinForm, time_s: float) -> Vector:
        return (form.at(form.term.coefficient_w_m2k, time_s) * form.area_m2)[:, None] * form.rule.weights

    def _at_points(self, form: RobinForm | RadiationForm, values: Vector) -> Vector:
        return values[form.nodes] @ form.rule.shapes.T

    def _spread(self, form: RobinForm | RadiationForm, point_w: Vector) -> Vector:
        return sums_by_number(form.nodes.ravel(), (point_w @ form.rule.shapes).ravel(), self._space.num_nodes)
