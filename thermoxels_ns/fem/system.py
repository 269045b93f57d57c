"""The discrete heat equation, M dT/dt + (K + R) T = load + radiation(T)."""

from __future__ import annotations

from copy import copy
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from thermoxels_ns.core.units import ZERO_CELSIUS_K
from thermoxels_ns.fem.conjugate_gradients import ConjugateGradients, LinearSolver, TwoLevel
from thermoxels_ns.fem.forms import ConvectionForm, FixedNodes, RadiationForm, SourceForm, at_time, effect_forms
from thermoxels_ns.fem.p1_kernels import conducted_and_bound, product_and_bound
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.fem.selection import Selection
from thermoxels_ns.fem.solution import Assembled
from thermoxels_ns.fem.space import Space

Vector = npt.NDArray[np.float64]

SystemSolver: TypeAlias = LinearSolver | ConjugateGradients
"""What solves the equations of a system, by the order of its tetrahedra."""

_ROUND_OFF = 64.0 * float(np.finfo(np.float64).eps)
"""Share of the absolute temperature below which a difference is round-off."""
_LEVEL = 1e-10
"""Share of the terms of a sum below which a level temperature balances them, if the linear solver allows it."""
_LEAST = float(np.finfo(np.float64).tiny)
_KEPT_RANGES = 64  # Times at which the range of the surroundings is kept


class Pieces:
    """Numbers of the connected pieces that a body's nodes belong to, and sums over them.

    >>> pieces = Pieces(sparse.csr_matrix([[2.0, -2.0, 0.0], [-2.0, 2.0, 0.0], [0.0, 0.0, 0.0]]))
    >>> pieces.count, pieces.sums(np.array([1.0, 2.0, 4.0])).tolist()
    (2, [3.0, 4.0])
    """

    def __init__(self, stiffness: sparse.csr_matrix) -> None:
        """Find the pieces of a matrix whose links go both ways."""
        # Links go both ways, so that strong connection is connection; for the undirected kind scipy would transpose.
        count, number = connected_components(stiffness, directed=True, connection="strong")
        self.count = int(count)
        """How many there are."""
        self.number: npt.NDArray[np.int32] = number
        """Number of each node's piece, shape (n,)."""

    def sums(self, nodal: Vector) -> Vector:
        """Add up over each piece, shape (p,)."""
        if self.count == 1:
            return np.array([np.sum(nodal)])
        return np.bincount(self.number, weights=nodal, minlength=self.count).astype(np.float64, copy=False)

    def at_nodes(self, values: Vector) -> Vector:
        """Values of the pieces where their nodes are; one value for all nodes if there is one piece."""
        return values[self.number] if self.count > 1 else values

    def touched(self, nodes: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
        """Mark the pieces that have any of the nodes, shape (p,)."""
        marks = np.zeros(self.count, dtype=bool)
        marks[self.number[nodes]] = True
        return marks

    def without_sums(self, floating: npt.NDArray[np.bool_], nodal: Vector, held: Vector, sums: Vector) -> Vector:
        """Subtract multiples of `held`, whose sums over the pieces are `sums`, until floating pieces sum to 0."""
        for _ in range(2):
            nodal = nodal - self.at_nodes(np.where(floating, self.sums(nodal) / sums, 0.0)) * held
        return nodal


class HeatSystem:
    """What schemes and the steady solver ask of a problem. Constant parts are assembled once, when first asked for.

    Temperatures are held relative to `reference_c`, so that round-off is relative to their differences.
    """

    def __init__(
        self, problem: HeatProblem, *, lumped: bool = True, lumped_boundary: bool | None = None, order: int = 1
    ) -> None:
        """Turn effects into terms and forms, and assemble the stiffness; options and errors are those of `Space`."""
        self.problem, self.assembled = problem, Assembled()
        start = problem.start_c
        # The middle of the range, not the mean: exact for a uniform temperature.
        self.reference_c: float = 0.5 * (float(start.min()) + float(start.max()))
        """What temperatures are relative to, [degrees Celsius]."""
        selection = Selection(problem.mesh, problem.up)
        self._space = Space(selection, order=order, lumped=lumped, lumped_boundary=lumped_boundary)
        forms = effect_forms(problem, self._space, self.reference_c, self.assembled)
        self._convection, self._loads, self._radiation = forms.convection, forms.loads, forms.radiation
        self.surface_forms: tuple[ConvectionForm | RadiationForm, ...] = (*forms.convection, *forms.radiation)
        """Heat flows through the surface that depend on its temperature."""
        self.sources: tuple[SourceForm, ...] = tuple(form for form in forms.loads if isinstance(form, SourceForm))
        """Heat sources."""
        self.fixed: FixedNodes = FixedNodes(forms.fixed, self.num_nodes)
        """Nodes whose temperature is given."""
        with self.assembled.form("stiffness"):
            self._stiffness = self._space.stiffness(problem.conductivity_w_mk)
        self.pieces: Pieces = Pieces(self._stiffness)
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
        self._mass: tuple[sparse.csr_matrix | None, Vector] | None = None
        self._kept_convection: sparse.csr_matrix | None = None
        self._convection_at: dict[float, sparse.csr_matrix | None] = {}
        self._kept_matrix: sparse.csr_matrix | None = None
        self._kept_load: Vector | None = None
        self._kept_loads: dict[float, Vector] = {}
        self._kept_outside: dict[float, tuple[Vector, Vector, Vector]] = {}
        self._fixed_rows: sparse.csr_matrix | None = None
        self._kept_ranges: dict[float, tuple[float, float]] = {}
        self._prolongation: sparse.csr_matrix | None = None

    @property
    def num_nodes(self) -> int:
        """Number of nodes; with quadratic tetrahedra the mesh's nodes come first and then its edges."""
        return self._space.num_nodes

    @property
    def space(self) -> Space:
        """The nodes, and how what happens becomes numbers on them."""
        return self._space

    @property
    def stiffness(self) -> sparse.csr_matrix:
        """K, shape (n, n), [W / K]."""
        return self._stiffness

    @property
    def lumped(self) -> bool:
        """Whether masses, convection and radiation are all on the diagonal."""
        return self._space.lumped and self._space.lumped_boundary

    def with_stiffness(self, stiffness: sparse.csr_matrix) -> HeatSystem:
        """Copy the system with another K between the same nodes; all else is shared."""
        other = copy(self)
        other._stiffness, other._fixed_rows, other._kept_matrix = stiffness, None, None
        return other

    @property
    def start_k(self) -> Vector:
        """Temperatures at the start, relative to the reference, shape (n,), [K]."""
        return self._space.from_mesh_nodes(self.problem.start_c - self.reference_c)

    @property
    def nodal_mass_j_k(self) -> Vector:
        """Row sums of the mass matrix, shape (n,), [J / K]."""
        return self._masses()[1]

    @property
    def total_mass_j_k(self) -> float:
        """Heat capacity of the whole body, [J / K]."""
        return float(np.sum(self.nodal_mass_j_k))

    @property
    def mass_matrix(self) -> sparse.csr_matrix | None:
        """M, shape (n, n), [J / K]; None if it is lumped."""
        return self._masses()[0]

    def mass_product(self, relative_k: Vector) -> Vector:
        """M T, shape (n,), [J]."""
        matrix, nodal = self._masses()
        return nodal * relative_k if matrix is None else matrix @ relative_k

    def convection_matrix(self, time_s: float) -> sparse.csr_matrix | None:
        """R, heat that convection takes from each node per kelvin, shape (n, n), [W / K]; None without convection."""
        if self._kept_convection is None:
            self._kept_convection = self._sum_of_convection(False, 0.0)
        if not self.matrix_in_time:
            return self._kept_convection
        constant = self._kept_convection
        return at_time(self._convection_at, time_s, lambda t: _sum_of(constant, self._sum_of_convection(True, t)))

    def matrix(self, time_s: float, step_s: float) -> sparse.csr_matrix:
        """M / step + K + R, shape (n, n), [W / K]; without M for a step without end."""
        matrix = self._kept_matrix
        if matrix is None:
            convection = self.convection_matrix(time_s)
            matrix = self._stiffness if convection is None else sparse.csr_matrix(self._stiffness + convection)
        if np.isinf(step_s):
            # An estimate of the error asks for it again.
            self._kept_matrix = None if self.matrix_in_time else matrix
            return matrix
        mass, nodal = self._masses()
        if mass is None:
            return sparse.csr_matrix(matrix + sparse.diags(nodal / step_s, format="csr"))
        return sparse.csr_matrix(matrix + mass / step_s)

    def linear_solver(self, matrix: sparse.csr_matrix, relative_tolerance: float) -> SystemSolver:
        """Make the solver for a matrix between the free nodes that suits the tetrahedra."""
        if self._space.order == 1:
            return LinearSolver(matrix, relative_tolerance=relative_tolerance)
        if self._prolongation is None:
            free, num_mesh_nodes = self.fixed.free, len(self.problem.mesh.points_m)
            rows = sparse.csr_matrix(self._space.prolongation()[free])
            self._prolongation = sparse.csr_matrix(rows[:, free[free < num_mesh_nodes]])
        given = TwoLevel(matrix, self._prolongation)
        return ConjugateGradients(matrix, given, relative_tolerance=relative_tolerance, max_iterations=500)

    def held_w_k(self, time_s: float, step_s: float) -> Vector:
        """Row sums of M / step + R, shape (n,), [W / K]: of the matrix too, because those of K are 0, but exact."""
        held = self.nodal_mass_j_k / step_s if np.isfinite(step_s) else np.zeros(self.num_nodes)
        convection = self.convection_matrix(time_s)
        return held if convection is None else held + convection @ np.ones(self.num_nodes)

    def load(self, time_s: float) -> Vector:
        """Heat that does not depend on the temperature, fluxes and sources, shape (n,), [W]."""
        if self._kept_load is None:
            self._kept_load = self._sum_of_loads(False, 0.0)
        if not any(form.load_in_time for form in self._loads):
            return self._kept_load
        constant = self._kept_load
        return at_time(self._kept_loads, time_s, lambda t: constant + self._sum_of_loads(True, t))

    def _outside(self, time_s: float) -> tuple[Vector, Vector, Vector]:
        """Mean temperature of the air at each node, what comes in if the body has it, and the sum of sizes added up.

        Shapes (n,), [K], [W] and [W]; 0 where there is no air. Convection is R times a difference from this
        temperature, and what different airs at one node leave.
        """
        in_time = any(form.load_in_time for form in (*self._convection, *self._loads))
        return at_time(self._kept_outside, time_s if in_time else 0.0, self._outside_at)

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

    def exchanged_heat(self, relative_k: Vector, time_s: float, rest_k: Vector | None = None) -> tuple[Vector, Vector]:
        """Heat from outside into each node, load + R (T_air - T) + radiation(T), and the sum of sizes added up, [W].

        Round-off in the first is a few eps of the second. The temperatures are T + `rest_k`.
        """
        around_k, heat, bound = self._outside(time_s)
        convection = self.convection_matrix(time_s)
        if convection is None:
            heat, bound = heat.copy(), bound.copy()
        else:
            apart_k = relative_k - around_k
            if rest_k is not None:
                apart_k += rest_k
            lost, size = product_and_bound(convection, apart_k)
            heat, bound = np.subtract(heat, lost, out=lost), np.add(bound, size, out=size)
        if self.nonlinear:
            heat += self.radiation_load(relative_k, time_s)
            bound += self.radiation_magnitude(relative_k, time_s)
        return heat, bound

    def net_heat(self, relative_k: Vector, time_s: float) -> tuple[Vector, Vector]:
        """Heat into each node from outside and from its neighbours, `exchanged_heat` - K T, and its bound, [W].

        What keeps fixed nodes fixed is not in it.
        """
        heat, bound = self.exchanged_heat(relative_k, time_s)
        conducted, size = self.conducted_heat(relative_k)
        return heat - conducted, bound + size

    def conducted_heat(self, relative_k: Vector, rest_k: Vector | None = None) -> tuple[Vector, Vector]:
        """Heat that flows from each node to its neighbours, K T, and its bound as in `exchanged_heat`."""
        heat, bound = conducted_and_bound(self._stiffness, relative_k, relative_k)
        if rest_k is not None:
            more, size = conducted_and_bound(self._stiffness, rest_k, rest_k)
            heat += more
            bound += size
        return heat, bound

    def net_heat_at_fixed(self, relative_k: Vector, time_s: float, rest_k: Vector | None = None) -> Vector:
        """`net_heat` at the fixed nodes only, shape (d,), [W]."""
        nodes = self.fixed.nodes
        if len(nodes) == 0:
            return np.zeros(0)
        if self._fixed_rows is None:
            self._fixed_rows = sparse.csr_matrix(self._stiffness[nodes])
        rows, parts = self._fixed_rows, (relative_k,) if rest_k is None else (relative_k, rest_k)
        from_nodes_w = sum((conducted_and_bound(rows, part, part[nodes])[0] for part in parts), np.zeros(len(nodes)))
        if not self.exchanges:
            return -from_nodes_w
        return self.exchanged_heat(relative_k, time_s, rest_k)[0][nodes] - from_nodes_w

    def radiation_magnitude(self, relative_k: Vector, time_s: float) -> Vector:
        """Sum of the sizes of what `radiation_load` adds up, shape (n,), [W]."""
        total = np.zeros(self.num_nodes)
        for form in self._radiation:
            total += form.magnitude(relative_k, time_s)
        return total

    def group_heat_w(self, relative_k: Vector, time_s: float, rest_k: Vector | None = None) -> Vector:
        """Heat flow into the body of each group but those of fixed nodes, [W]."""
        forms = (*self._convection, *self._loads, *self._radiation)
        return np.concatenate([np.zeros(0), *(form.group_heat_w(relative_k, time_s, rest_k) for form in forms)])

    def exchanging_pieces(self, time_s: float) -> npt.NDArray[np.bool_]:
        """Mark the pieces whose temperature convection, radiation or fixed nodes hold, shape (p,)."""
        marks = self.pieces.touched(self.fixed.nodes)
        for form in self.surface_forms:
            marks |= self.pieces.touched(form.exchanging_nodes(time_s))
        return marks

    def level_k(self, relative_k: Vector) -> Vector:
        """Mean temperature of each connected piece at its nodes, shape (n,), [K]."""
        mean_k = self.pieces.sums(relative_k) / self.pieces.sums(np.ones_like(relative_k))
        return np.zeros_like(relative_k) + self.pieces.at_nodes(mean_k)

    def is_still(self, relative_k: Vector, time_s: float, relative_tolerance: float = 1e-12) -> bool:
        """Whether nothing makes heat flow: each connected piece, at one temperature, balances what acts on it."""
        fixed, level_k, held_w_k = self.fixed.nodes, self.level_k(relative_k), self.held_w_k(time_s, np.inf)
        round_off_k = _ROUND_OFF * (np.abs(level_k).max() + abs(self.reference_c + ZERO_CELSIUS_K))
        share = max(_LEVEL, 100.0 * relative_tolerance)
        heat_w, terms_w = self.exchanged_heat(level_k, time_s)
        allowed_w = share * (terms_w + 2.0 * held_w_k * np.abs(level_k)) + round_off_k * held_w_k
        apart_k = np.abs(relative_k[fixed] - level_k[fixed])
        allowed_k = share * np.abs(level_k[fixed]) + round_off_k
        return bool(np.all(apart_k <= allowed_k) and np.all(np.abs(heat_w) <= allowed_w))

    def surface_w_k(self, relative_k: Vector, time_s: float, *, inside: bool = True) -> float:
        """Heat that leaves the body per kelvin through its surface, and through the cells there if asked, [W / K]."""
        held_w_k, inside_w_k = self.held_w_k(time_s, np.inf), np.maximum(self._stiffness.diagonal(), _LEAST)
        if self.nonlinear:
            held_w_k = held_w_k + self.radiation_slope(relative_k, time_s) @ np.ones(self.num_nodes)
        through_w_k = held_w_k / (1.0 + held_w_k / inside_w_k) if inside else held_w_k.copy()
        through_w_k[self.fixed.nodes] = inside_w_k[self.fixed.nodes]
        return float(np.sum(through_w_k))

    def allowed_range_k(self, start_k: tuple[float, float], times_s: tuple[float, ...]) -> tuple[float, float]:
        """Range that temperatures cannot leave in a step: from the start's and all surroundings' at these times.

        A source or flux opens it on the side that it pushes to.
        """
        ends = [start_k, *map(self.surroundings_k, times_s)]
        return min(low for low, _ in ends), max(high for _, high in ends)

    def surroundings_k(self, time_s: float) -> tuple[float, float]:
        """Range of all that surrounds the body at a time, [K]; kept for some of the last times that were asked for."""
        return at_time(self._kept_ranges, time_s, self._surroundings_k, most=_KEPT_RANGES)

    def _surroundings_k(self, time_s: float) -> tuple[float, float]:
        low, high = np.inf, -np.inf
        ambients = [form.ambient_k(time_s) for form in self._convection]
        ambients += [form.surroundings_k(time_s) for form in self._radiation]
        ambients += [self.fixed.temperature_k(time_s)] if len(self.fixed.nodes) else []
        for ambient in ambients:
            low, high = min(low, float(ambient.min())), max(high, float(ambient.max()))
        for form in self._loads:
            cools, heats = form.signs(time_s)
            low, high = -np.inf if cools else low, np.inf if heats else high
        return low, high

    def _masses(self) -> tuple[sparse.csr_matrix | None, Vector]:
        if self._mass is None:
            with self.assembled.form("mass"):
                self._mass = self._space.mass(self.problem.heat_capacity_j_m3k)
        return self._mass

    def _sum_of_convection(self, in_time: bool, time_s: float) -> sparse.csr_matrix | None:
        total: sparse.csr_matrix | None = None
        for form in self._convection:
            if form.matrix_in_time == in_time:
                with self.assembled.form("convection"):
                    total = _sum_of(total, form.convection_matrix(time_s))
        return total

    def _sum_of_loads(self, in_time: bool, time_s: float) -> Vector:
        total = np.zeros(self.num_nodes)
        for form in self._loads:
            if form.load_in_time == in_time:
                with self.assembled.form(form.kind):
                    total += form.load(time_s)
        return total

    def _outside_at(self, time_s: float) -> tuple[Vector, Vector, Vector]:
        weight, weighted, heat = (np.zeros(self.num_nodes) for _ in range(3))
        given = self.load(time_s)
        for form in self._convection:
            sums = form.ambient_sums(time_s)
            weight += sums[0]
            weighted += sums[1]
        around_k = np.divide(weighted, weight, out=np.zeros_like(weight), where=weight > 0.0)
        for form in self._convection:
            with self.assembled.form(form.kind):
                heat += form.load(around_k, time_s)
        return around_k, given + heat, np.add(np.abs(given), np.abs(heat))


def _sum_of(first: sparse.csr_matrix | None, second: sparse.csr_matrix | None) -> sparse.csr_matrix | None:
    if first is None or second is None:
        return second if first is None else first
    return sparse.csr_matrix(first + second)
