"""The discrete heat equation, M dT/dt + (K + R) T = load + radiation(T)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from thermoxels_ns.core.arrays import BoolArray, FloatArray, IntArray
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.core.units import ZERO_CELSIUS_K
from thermoxels_ns.fem.forms import (
    ConvectionForm,
    FixedNodes,
    FluxForm,
    RadiationForm,
    SourceForm,
    at_time,
    effect_forms,
)
from thermoxels_ns.fem.p1_kernels import lumped_mass
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.fem.solution import Assembled, FacetHeat
from thermoxels_ns.fem.space import Space

Vector = FloatArray

MOST_TIMES_CONDUCTION = 1e10
"""Largest convection at a node over what the cells around it conduct: more is a given temperature in all but name, and
the difference from the air, by which heat flows, would be lost to round-off."""
NOTHING = 1e-9
"""Differences below this share of the absolute temperature let no heat flow to speak of."""
_LEAST = float(np.finfo(np.float64).tiny)
_KEPT_RANGES = 64  # Times at which the range of the surroundings is kept


class Pieces:
    """Numbers of the connected pieces that a body's nodes belong to, and sums over them.

    >>> pieces = Pieces(sparse.csr_matrix([[2.0, -2.0, 0.0], [-2.0, 2.0, 0.0], [0.0, 0.0, 0.0]]))
    >>> pieces.count, pieces.sums(np.array([1.0, 2.0, 4.0])).tolist()
    (2, [3.0, 4.0])
    """

    def __init__(self, stiffness: sparse.csr_matrix) -> None:
        """Find the pieces between which a symmetric matrix has no entry."""
        count, number = connected_components(stiffness, directed=False)
        self.count = int(count)
        """How many there are."""
        self.number: npt.NDArray[np.int32] = number
        """Number of each node's piece, shape (n,)."""
        self._sizes = np.bincount(number, minlength=self.count)

    def sums(self, nodal: Vector) -> Vector:
        """Add up over each piece, shape (p,)."""
        if self.count == 1:
            return np.array([np.sum(nodal)])
        return np.bincount(self.number, weights=nodal, minlength=self.count).astype(np.float64, copy=False)

    def at_nodes(self, values: Vector) -> Vector:
        """Values of the pieces where their nodes are; one value for all nodes if there is one piece."""
        return values[self.number] if self.count > 1 else values

    def without_means(self, nodal: Vector) -> Vector:
        """Subtract the mean of each piece, shape (n,)."""
        return nodal - self.at_nodes(self.sums(nodal) / self._sizes)

    def touched(self, nodes: IntArray) -> BoolArray:
        """Mark the pieces that have any of the nodes, shape (p,)."""
        marks = np.zeros(self.count, dtype=bool)
        marks[self.number[nodes]] = True
        return marks


class HeatSystem:
    """What schemes and the steady solver ask of a problem. Constant parts are assembled once, when first asked for.

    Temperatures are held relative to `reference_c`, so that round-off is relative to their differences.
    """

    def __init__(self, problem: HeatProblem, *, order: int = 1) -> None:
        """Turn effects into terms and forms, and assemble the stiffness of linear or quadratic tetrahedra."""
        self.problem, self.assembled = problem, Assembled()
        start = problem.start_c
        # The middle of the range, not the mean: exact for a uniform temperature.
        self.reference_c: float = 0.5 * (float(start.min()) + float(start.max()))
        """What temperatures are relative to, [degrees Celsius]."""
        self.space: Space = Space(problem.selection, order=order)
        """The nodes, and how what happens becomes numbers on them."""
        self.num_nodes: int = self.space.num_nodes
        """Number of nodes; with quadratic tetrahedra the mesh's nodes come first and then its edges."""
        forms = effect_forms(problem, self.space, self.reference_c, self.assembled)
        self._convection, self._loads, self._radiation = forms.convection, forms.loads, forms.radiation
        self.surface_forms: tuple[ConvectionForm | RadiationForm, ...] = (*forms.convection, *forms.radiation)
        """Heat flows through the surface that depend on its temperature."""
        self.fixed: FixedNodes = FixedNodes(forms.fixed, self.num_nodes)
        """Nodes whose temperature is given."""
        with self.assembled.form("stiffness"):
            self.stiffness: sparse.csr_matrix = self.space.stiffness(problem.conductivity_w_mk)
            """K, shape (n, n), [W / K]."""
        self.pieces: Pieces = Pieces(self.stiffness)
        """Connected pieces of the body."""
        self.matrix_in_time: bool = any(form.matrix_in_time for form in self._convection)
        """Whether the matrix of the linear part changes with time."""
        self.nonlinear: bool = bool(self._radiation)
        """Whether there is radiation."""
        self.exchanges: bool = bool(forms.exchanging)
        """Whether heat flows into the body other than through fixed nodes."""
        self.groups: tuple[tuple[str, str], ...] = (
            *((form.effect, group) for form in forms.exchanging for group in form.groups),
            *self.fixed.groups,
        )
        """Effect and patch or region of each heat flow of `group_heat_w`, then of each of the fixed nodes."""
        self._convection_at: dict[float, sparse.csr_matrix | None] = {}
        self._loads_at: dict[float, Vector] = {}
        self._ambient_at: dict[float, Vector] = {}
        self._ranges_at: dict[float, tuple[float, float]] = {}

    @property
    def start_k(self) -> Vector:
        """Temperatures at the start, relative to the reference, shape (n,), [K]."""
        return self.space.from_mesh_nodes(self.problem.start_c - self.reference_c)

    @cached_property
    def nodal_mass_j_k(self) -> Vector:
        """Diagonal of the lumped mass matrix of linear tetrahedra, shape (n,), [J / K]."""
        with self.assembled.form("mass"):
            mesh = self.problem.mesh
            return lumped_mass(mesh.points_m, mesh.tets, self.problem.heat_capacity_j_m3k)

    def convection_matrix(self, time_s: float) -> sparse.csr_matrix | None:
        """R, heat that convection takes from each node per kelvin, shape (n, n), [W / K]; None without convection.

        Raises `HeatError` if it is more than `MOST_TIMES_CONDUCTION` of what the cells conduct.
        """
        return at_time(self._convection_at, time_s if self.matrix_in_time else 0.0, self._sum_of_convection)

    def _sum_of_convection(self, time_s: float) -> sparse.csr_matrix | None:
        if not self._convection:
            return None
        total = sparse.csr_matrix(self.stiffness.shape)
        for form in self._convection:
            with self.assembled.form("convection"):
                total = sparse.csr_matrix(total + form.convection_matrix(time_s))
        most = float(np.max(total.diagonal() / np.maximum(self.stiffness.diagonal(), _LEAST)))
        if not most <= MOST_TIMES_CONDUCTION:
            remedy = "Give the surface the temperature of the air instead, or a smaller coefficient."
            expected = f"at most {MOST_TIMES_CONDUCTION:g} times as much heat per kelvin as the cells behind conduct"
            raise HeatError("convection coefficient", expected=expected, got=f"{most:.1e} times", remedy=remedy)
        return total

    def matrix(self, time_s: float, step_s: float) -> sparse.csr_matrix:
        """M / step + K + R, shape (n, n), [W / K]; without M for a step without end."""
        convection = self.convection_matrix(time_s)
        matrix = self.stiffness if convection is None else sparse.csr_matrix(self.stiffness + convection)
        if np.isinf(step_s):
            return matrix
        return sparse.csr_matrix(matrix + sparse.diags(self.nodal_mass_j_k / step_s, format="csr"))

    def load(self, time_s: float) -> Vector:
        """Heat that does not depend on the temperature, fluxes and sources, shape (n,), [W]."""
        return self._sum_of_loads(self._loads, self._loads_at, time_s)

    def _sum_of_loads(
        self, forms: Sequence[ConvectionForm | FluxForm | SourceForm], kept: dict[float, Vector], time_s: float
    ) -> Vector:
        def add_up(at_s: float) -> Vector:
            total = np.zeros(self.num_nodes)
            for form in forms:
                with self.assembled.form(form.kind):
                    total += form.load(at_s)
            return total

        return at_time(kept, time_s if any(form.load_in_time for form in forms) else 0.0, add_up)

    def radiation_load(self, relative_k: Vector, time_s: float) -> Vector:
        """Heat radiated into the body, shape (n,), [W]."""
        total = np.zeros(self.num_nodes)
        for form in self._radiation:
            with self.assembled.form("radiation"):
                total += form.load(relative_k, time_s)
        return total

    def radiation_slope(self, relative_k: Vector, time_s: float) -> sparse.csr_matrix:
        """Minus the exact derivative of `radiation_load`, shape (n, n), [W / K]."""
        total = sparse.csr_matrix((self.num_nodes, self.num_nodes))
        for form in self._radiation:
            with self.assembled.form("radiation"):
                total = sparse.csr_matrix(total + form.slope(relative_k, time_s))
        return total

    def exchange_parts(self, relative_k: Vector, time_s: float) -> list[Vector]:
        """Heat from outside into each node: load, R (T_air - T) and radiation(T), each of shape (n,), [W]."""
        parts, convection = [self.load(time_s)], self.convection_matrix(time_s)
        if convection is not None:
            parts.append(self._sum_of_loads(self._convection, self._ambient_at, time_s) - convection @ relative_k)
        if self.nonlinear:
            parts.append(self.radiation_load(relative_k, time_s))
        return parts

    def exchanged_heat(self, relative_k: Vector, time_s: float) -> Vector:
        """Sum of the `exchange_parts`, shape (n,), [W]."""
        return np.sum(self.exchange_parts(relative_k, time_s), axis=0)

    def conducted_heat(self, relative_k: Vector) -> Vector:
        """Heat that flows from each node to its neighbours, K T, shape (n,), [W].

        The mean of each piece, which conducts nothing, is taken from T first, so that it leaves no round-off.
        """
        return self.stiffness @ self.pieces.without_means(relative_k)

    def net_heat(self, relative_k: Vector, time_s: float) -> Vector:
        """Heat into each node from outside and from its neighbours, shape (n,), [W].

        What keeps fixed nodes fixed is not in it.
        """
        return self.exchanged_heat(relative_k, time_s) - self.conducted_heat(relative_k)

    def net_heat_at_fixed(self, relative_k: Vector, time_s: float) -> Vector:
        """`net_heat` at the fixed nodes only, shape (d,), [W]."""
        nodes = self.fixed.nodes
        if len(nodes) == 0:
            return np.zeros(0)
        return self.exchanged_heat(relative_k, time_s)[nodes] - self._fixed_rows @ self.pieces.without_means(relative_k)

    def group_heat_w(self, relative_k: Vector, time_s: float) -> Vector:
        """Heat flow into the body of each group but those of fixed nodes, [W]."""
        forms = (*self._convection, *self._loads, *self._radiation)
        return np.concatenate([np.zeros(0), *(form.group_heat_w(relative_k, time_s) for form in forms)])

    def facet_heat(self, relative_k: Vector, time_s: float) -> tuple[FacetHeat, ...]:
        """Heat flow of each effect but sources through boundary triangles, as if fixed nodes stored nothing."""
        forms = [
            form for form in (*self._convection, *self._loads, *self._radiation) if not isinstance(form, SourceForm)
        ]
        found = [FacetHeat(form.effect, form.facets, form.part_heat_w(relative_k, time_s)) for form in forms]
        kept_w = -self.net_heat_at_fixed(relative_k, time_s)
        return (*found, *(FacetHeat(*part) for part in self.fixed.facet_heat_w(kept_w)))

    def exchanging_pieces(self, time_s: float) -> BoolArray:
        """Mark the pieces whose temperature convection, radiation or fixed nodes hold, shape (p,)."""
        marks = self.pieces.touched(self.fixed.nodes)
        for form in self.surface_forms:
            marks |= self.pieces.touched(form.exchanging_nodes(time_s))
        return marks

    def is_still(self, relative_k: Vector, time_s: float) -> bool:
        """Whether all temperatures, those around included, differ by no more than `NOTHING` of the absolute one."""
        ends = np.array([*self.surroundings_k(time_s), relative_k.min(), relative_k.max()])
        ends = ends[np.isfinite(ends)]
        level_k = float(np.abs(ends).max()) + abs(self.reference_c + ZERO_CELSIUS_K)
        return float(np.ptp(ends)) <= NOTHING * level_k

    def allowed_range_k(self, start_k: tuple[float, float], times_s: tuple[float, ...]) -> tuple[float, float]:
        """Range that temperatures cannot leave in a step: from the start's and all surroundings' at these times.

        A source or flux opens it on the side that it pushes to.
        """
        ends = [start_k, *map(self.surroundings_k, times_s)]
        return min(low for low, _ in ends), max(high for _, high in ends)

    def surroundings_k(self, time_s: float) -> tuple[float, float]:
        """Range of all that surrounds the body at a time, [K]; kept for some of the last times that were asked for."""
        return at_time(self._ranges_at, time_s, self._surroundings_k, most=_KEPT_RANGES)

    def _surroundings_k(self, time_s: float) -> tuple[float, float]:
        low, high = np.inf, -np.inf
        ambients = [form.surroundings_k(time_s) for form in self.surface_forms]
        ambients += [self.fixed.temperature_k(time_s)] if len(self.fixed.nodes) else []
        for ambient in ambients:
            low, high = min(low, float(ambient.min())), max(high, float(ambient.max()))
        for form in self._loads:
            heat_w = form.part_heat_w(np.zeros(0), time_s)
            low, high = -np.inf if np.any(heat_w < 0.0) else low, np.inf if np.any(heat_w > 0.0) else high
        return low, high

    @cached_property
    def _fixed_rows(self) -> sparse.csr_matrix:
        return sparse.csr_matrix(self.stiffness[self.fixed.nodes])
