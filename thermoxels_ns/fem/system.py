"""The discrete heat equation M dT/dt + (K + R) T = load + radiation(T); the load includes convection's h T_ambient."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import TypeAlias

import numpy as np
from scipy import sparse

from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.core.units import ZERO_CELSIUS_K
from thermoxels_ns.fem.forms import (
    ConvectionForm,
    FixedForm,
    FixedNodes,
    FluxForm,
    RadiationForm,
    at_time,
    effect_forms,
)
from thermoxels_ns.fem.linear_tets import lumped_mass
from thermoxels_ns.fem.problem import HeatProblem, effect_labels, in_time
from thermoxels_ns.fem.solution import NOTHING, EffectHeat
from thermoxels_ns.fem.space import Space, sums_by_number

Vector = FloatArray

MOST_TIMES_CONDUCTION = 1e10
"""Largest ratio of a node's convection to its conduction (diagonals of R and K). Above it, the surface practically has
the temperature of the air, and their difference would be lost to round-off."""


class HeatSystem:
    """The matrices and vectors of a `HeatProblem` with n nodes, for time schemes and the steady solver.

    Constant parts are assembled once. The arguments `relative_k` are nodal temperatures minus `reference_c`, (n,), [K],
    which keeps round-off small; `time_s` is the time since the start, [s].
    """

    def __init__(self, problem: HeatProblem, *, order: int = 1) -> None:
        """Make forms of the effects and assemble the stiffness; `order` 1: linear tetrahedra, 2: quadratic ones."""
        self.problem = problem
        start = problem.start_c
        # The middle of the range, not the mean: exact for a uniform temperature.
        self.reference_c: float = 0.5 * (float(start.min()) + float(start.max()))
        """Reference temperature, [degrees Celsius]: the middle of the range of initial temperatures."""
        self.space: Space = Space(problem.selection, order=order)
        """The finite element space: unknowns at nodes, and integrals over triangles and tetrahedra."""
        self.num_nodes: int = self.space.num_nodes
        """Number of nodes, n: the mesh's nodes and, with quadratic tetrahedra, then the midpoints of its edges."""
        forms = effect_forms(problem, self.space, self.reference_c)
        self._convection = tuple(form for form in forms if isinstance(form, ConvectionForm))
        self._loads = tuple(form for form in forms if isinstance(form, FluxForm))
        self._radiation = tuple(form for form in forms if isinstance(form, RadiationForm))
        self._exchanging, self._every_form = (*self._convection, *self._loads, *self._radiation), forms
        self.surface_forms: tuple[ConvectionForm | RadiationForm, ...] = (*self._convection, *self._radiation)
        """Forms of convection and radiation, whose heat flow depends on the temperature of the surface."""
        fixed = tuple(form for form in forms if isinstance(form, FixedForm))
        self.fixed: FixedNodes = FixedNodes(fixed, self.space)  # Nodes whose temperature is given
        self.stiffness: sparse.csr_matrix = self.space.stiffness(problem.conductivity_w_mk)
        """Stiffness matrix K, integral(k grad phi_i . grad phi_j), shape (n, n), [W / K]."""
        self.matrix_in_time: bool = any(in_time(form.quantities[0]) for form in self._convection)
        """True if the convection matrix R changes with time."""
        self.nonlinear: bool = bool(self._radiation)  # True if there is radiation
        groups, numbers = list[tuple[str, str]](), [np.zeros(0, np.int64)]
        for form in self._every_form:
            names, of_part = problem.mesh.region_names, problem.mesh.region
            if form.kind != "source":
                names, of_part = problem.selection.patch_names, problem.selection.facet_patch
            used, number = np.unique(of_part[form.parts], return_inverse=True)
            numbers.append(len(groups) + number)
            groups += [(form.effect, names[n]) for n in used]
        self.groups: tuple[tuple[str, str], ...] = tuple(groups)
        """Effect label, and patch or region, of each of the g heat flows that `by_group` returns."""
        self._group: IntArray = np.concatenate(numbers)
        self._convection_at: dict[float, sparse.csr_matrix | None] = {}
        self._loads_at: dict[float, Vector] = {}
        self._ambient_at: dict[float, Vector] = {}

    @property
    def start_k(self) -> Vector:
        """Initial temperatures minus `reference_c`, shape (n,), [K]."""
        return self.space.from_mesh_nodes(self.problem.start_c - self.reference_c)

    @cached_property
    def nodal_mass_j_k(self) -> Vector:
        """Diagonal of the lumped mass matrix of linear tetrahedra, shape (n,), [J / K]."""
        mesh = self.problem.mesh
        return lumped_mass(mesh.points_m, mesh.tets, self.problem.heat_capacity_j_m3k)

    def convection_matrix(self, time_s: float) -> sparse.csr_matrix | None:
        """Return the sum R of all convection's boundary matrices, (n, n), [W / K]; None without convection.

        Raises `HeatError` if a diagonal entry of R is more than `MOST_TIMES_CONDUCTION` times that of K.
        """
        return at_time(self._convection_at, time_s if self.matrix_in_time else 0.0, self._sum_of_convection)

    def _sum_of_convection(self, time_s: float) -> sparse.csr_matrix | None:
        if not self._convection:
            return None
        matrices = (form.convection_matrix(time_s) for form in self._convection)
        total = sum(matrices, sparse.csr_matrix(self.stiffness.shape))
        most = float(np.max(total.diagonal() / np.maximum(self.stiffness.diagonal(), np.finfo(np.float64).tiny)))
        if not most <= MOST_TIMES_CONDUCTION:
            remedy = "Give the surface the temperature of the air instead, or a smaller coefficient."
            expected = f"at most {MOST_TIMES_CONDUCTION:g} times as much heat per kelvin as the cells behind conduct"
            raise HeatError("convection coefficient", expected=expected, got=f"{most:.1e} times", remedy=remedy)
        return total

    def matrix(self, time_s: float, step_s: float) -> sparse.csr_matrix:
        """Return M / `step_s` + K + R, shape (n, n), [W / K], or K + R if `step_s` is inf."""
        convection = self.convection_matrix(time_s)
        matrix = self.stiffness if convection is None else sparse.csr_matrix(self.stiffness + convection)
        if np.isinf(step_s):
            return matrix
        return sparse.csr_matrix(matrix + sparse.diags(self.nodal_mass_j_k / step_s, format="csr"))

    def _sum_of_loads(
        self, forms: Sequence[ConvectionForm | FluxForm], kept: dict[float, Vector], time_s: float
    ) -> Vector:
        def add_up(at_s: float) -> Vector:
            return sum((form.load(at_s) for form in forms), np.zeros(self.num_nodes))

        return at_time(kept, time_s if any(form.load_in_time for form in forms) else 0.0, add_up)

    def radiation_load(self, relative_k: Vector, time_s: float) -> Vector:
        """Return the load vector of radiation, the net heat into each node, shape (n,), [W]."""
        loads = (form.vector(form.flux_w_m2(relative_k, time_s)) for form in self._radiation)
        return sum(loads, np.zeros(self.num_nodes))

    def radiation_slope(self, relative_k: Vector, time_s: float) -> sparse.csr_matrix:
        """Return minus the Jacobian of `radiation_load`, shape (n, n), [W / K]."""
        slopes = (form.slope(relative_k, time_s) for form in self._radiation)
        return sum(slopes, sparse.csr_matrix(self.stiffness.shape))

    def exchange_parts(self, relative_k: Vector, time_s: float) -> list[Vector]:
        """Return the heat into each node, (n,), [W], from fluxes and sources, then convection and radiation if any."""
        parts, convection = [self._sum_of_loads(self._loads, self._loads_at, time_s)], self.convection_matrix(time_s)
        if convection is not None:
            parts.append(self._sum_of_loads(self._convection, self._ambient_at, time_s) - convection @ relative_k)
        if self.nonlinear:
            parts.append(self.radiation_load(relative_k, time_s))
        return parts

    def exchanged_heat(self, relative_k: Vector, time_s: float) -> Vector:
        """Return the sum of `exchange_parts`: the heat from outside into each node, shape (n,), [W]."""
        return np.sum(self.exchange_parts(relative_k, time_s), axis=0)

    def conducted_heat(self, relative_k: Vector) -> Vector:
        """Return K T, the heat that flows from each node to its neighbours, shape (n,), [W].

        The mean of T is subtracted first, because it conducts nothing but would cause round-off.
        """
        return self.stiffness @ (relative_k - relative_k.mean())

    def net_heat(self, relative_k: Vector, time_s: float) -> Vector:
        """Return `exchanged_heat` minus `conducted_heat`, the net heat into each node, shape (n,), [W].

        The heat that keeps fixed nodes at their temperature is not included.
        """
        return self.exchanged_heat(relative_k, time_s) - self.conducted_heat(relative_k)

    def net_heat_at_fixed(self, relative_k: Vector, time_s: float) -> Vector:
        """Return `net_heat` at the fixed nodes only, shape (d,), [W]."""
        nodes = self.fixed.nodes
        return self.net_heat(relative_k, time_s)[nodes] if len(nodes) else np.zeros(0)

    def part_heat_w(self, relative_k: Vector, time_s: float) -> Vector:
        """Return the heat into the body through each part (triangle, tetrahedron) of each effect, (parts,), [W].
        Effects follow each other in the order of `groups`. Fixed temperatures are not included."""
        return np.concatenate([np.zeros(0), *(form.part_heat_w(relative_k, time_s) for form in self._exchanging)])

    def every_part_heat_w(self, relative_k: Vector, time_s: float) -> Vector:
        """Return `part_heat_w`, then the heat of fixed temperatures per triangle, as if their nodes stored no heat."""
        kept_w = -self.net_heat_at_fixed(relative_k, time_s)
        return np.concatenate([self.part_heat_w(relative_k, time_s), self.fixed.facet_shares @ kept_w])

    def by_group(self, heat_w: Vector) -> Vector:
        """Return the sum over each entry of `groups`, (g,), [W], of heat flows in the order of `every_part_heat_w`."""
        return sums_by_number(self._group[: len(heat_w)], heat_w, len(self.groups))

    def heat_of_effects(self, group_heat_w: Vector) -> tuple[EffectHeat, ...]:
        """Return heat flows by effect, in the order of the problem, from those of `groups`, (s, g), [W]."""
        found = []
        for effect in effect_labels(self.problem):
            chosen = [number for number, (owner, _) in enumerate(self.groups) if owner == effect]
            heat_w, names = group_heat_w[:, chosen], tuple(self.groups[number][1] for number in chosen)
            found.append(EffectHeat(effect, heat_w.sum(axis=1), names, heat_w))
        return tuple(found)

    def facet_heat_w(self, relative_k: Vector, time_s: float) -> Vector:
        """Return the heat into the body through each boundary triangle, as if fixed nodes stored no heat, (f,), [W]."""
        total_w = np.zeros(len(self.problem.mesh.facets))
        ends = np.cumsum([len(form.parts) for form in self._every_form])
        for form, heat_w in zip(self._every_form, np.split(self.every_part_heat_w(relative_k, time_s), ends[:-1])):
            if form.kind != "source":
                total_w[form.parts] += heat_w
        return total_w

    def is_still(self, relative_k: Vector, time_s: float) -> bool:
        """Return whether all temperatures of body and surroundings are equal within `NOTHING`."""
        ends = np.array([*self.surroundings_k(time_s), relative_k.min(), relative_k.max()])
        ends = ends[np.isfinite(ends)]
        level_k = float(np.abs(ends).max()) + abs(self.reference_c + ZERO_CELSIUS_K)
        return float(np.ptp(ends)) <= NOTHING * level_k

    def surroundings_k(self, time_s: float) -> tuple[float, float]:
        """Return the lowest and highest temperature around the body minus the reference, [K]. The lowest is -inf if a
        flux or source cools the body, the highest is inf if one heats it."""
        low, high = np.inf, -np.inf
        ambients = [form.surroundings_k(time_s) for form in self.surface_forms]
        ambients += [self.fixed.temperature_k(time_s)] if len(self.fixed.nodes) else []
        for ambient in ambients:
            low, high = min(low, float(ambient.min())), max(high, float(ambient.max()))
        for form in self._loads:
            heat_w = form.part_heat_w(np.zeros(0), time_s)
            low, high = -np.inf if np.any(heat_w < 0.0) else low, np.inf if np.any(heat_w > 0.0) else high
        return low, high


Engine: TypeAlias = Callable[[HeatSystem, FloatArray], FloatArray]
"""Another solver: from a system of linear tetrahedra and the ends of the steps of backward Euler, (s + 1,), [s], or the
one time 0 for the steady state, it returns the temperatures minus `HeatSystem.reference_c`, (s, n) or (1, n), [K]."""
