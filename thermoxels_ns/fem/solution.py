"""What a heat computation returns, and its temperatures on a mesh that can be shown."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.core.units import ZERO_CELSIUS_K
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.fem.refine_mesh import refine_mesh
from thermoxels_ns.mesh.tetrahedra import TetMesh

Vector = FloatArray


@dataclass
class Assembled:
    """Forms that were assembled, by kind; what a problem does not call for has no entry.

    >>> assembled = Assembled()
    >>> with assembled.form("stiffness"):
    ...     pass
    >>> assembled.counts
    {'stiffness': 1}
    """

    counts: dict[str, int] = field(default_factory=dict)
    """How often each kind was assembled: stiffness, mass, convection, flux, radiation, source, fixed."""
    seconds: dict[str, float] = field(default_factory=dict)  # Time each kind took, [s]

    @contextmanager
    def form(self, kind: str) -> Iterator[None]:
        """Count what is assembled inside."""
        start = time.perf_counter()
        yield
        self.seconds[kind] = self.seconds.get(kind, 0.0) + time.perf_counter() - start
        self.counts[kind] = self.counts.get(kind, 0) + 1


@dataclass(frozen=True)
class EffectHeat:
    """Heat that one effect brings into the body."""

    effect: str  # What it is and where it acts
    heat_w: FloatArray
    """Mean heat flow into the body during each interval, as the scheme evaluates it, shape (s,), [W]; negative where
    heat leaves. A steady state has one interval."""
    group_names: tuple[str, ...]  # Names of the patches, or for a source of the regions, that it acts on
    group_heat_w: FloatArray  # The same for each of them, shape (s, g), [W]


@dataclass(frozen=True)
class FacetHeat:
    """Heat that one effect brings into the body through single boundary triangles, at one moment."""

    effect: str
    facets: IntArray  # Numbers of the triangles, shape (k,)
    heat_w: FloatArray  # Heat flow into the body through each, shape (k,), [W]


@dataclass(frozen=True)
class ErrorSize:
    """Errors of a solution."""

    temperature_k: float  # Largest error of the temperature at the nodes of the given mesh, [K]
    heat_flow: float
    """Largest error of the mean heat flow of an effect, as a share of all heat that flows through the body."""

    def describe(self) -> str:
        """Describe both errors in words."""
        return f"{self.temperature_k:.2g} K and {100.0 * self.heat_flow:.2g} % of the heat flow"


@dataclass(frozen=True)
class HeatSolution:
    """Temperatures over time and the account of the heat."""

    times_s: FloatArray  # Time of each state, the start first, shape (s + 1,), [s]
    temperature_c: FloatArray
    """Nodal temperatures, shape (s + 1, n), [degrees Celsius]. Surfaces with a fixed temperature have it from the
    start."""
    heat_w: FloatArray
    """Net heat flow into the body during each interval, measured as the change of its heat content over it,
    shape (s,), [W], positive into the body. Behind an insulated boundary it is 0 up to round-off."""
    heat_content_j: FloatArray
    """Heat content above absolute zero at each time, 1^T M T with T in kelvin, shape (s + 1,), [J]."""
    energy_residual: float
    """Largest change of the heat content that no heat flow accounts for, relative to the heat content or to all heat
    exchanged, whichever is more."""
    energy_residual_of_spread: float
    """The same change relative to the heat stored in the initial differences, sum m_i |T_i - mean T|, plus all heat
    exchanged: the stricter measure. 0 where nothing is unaccounted for."""
    status: str
    iterations: IntArray  # Iterations of the linear solver in each interval, shape (s,)
    effects: tuple[EffectHeat, ...] = ()  # Heat that each effect of the problem brought, in the order of the problem
    newton_iterations: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    """Steps of Newton's method in each interval, shape (s,); all 0 without radiation."""
    steps: int = 0
    step_lengths_s: tuple[FloatArray, ...] = ()  # Lengths of the steps in each interval, [s]
    time_error_k: float = float("nan")
    """Estimated largest error of the steps at any temperature, [K]: of adaptive ones their estimates added up, of equal
    ones by steps of twice the length, if asked for; else NaN."""
    unbalanced_w: float = 0.0  # Most heat that a step left unbalanced at all nodes, round-off included, [W]
    overshoot_k: float = 0.0
    """How far any temperature left the range of the start and of the surroundings, [K]; 0 up to 0.01 K."""
    last_facet_heat: tuple[FacetHeat, ...] = ()
    """Heat flow of each effect through boundary triangles at the end; fixed nodes count as if they stored nothing."""
    assembled: Assembled = field(default_factory=Assembled)


@dataclass(frozen=True)
class SteadySolution:
    """Temperatures that no longer change, and the account of the heat."""

    temperature_c: FloatArray  # Temperatures of the mesh's nodes, shape (n,), [degrees Celsius]
    effects: tuple[EffectHeat, ...]
    """Heat that each effect of the problem brings, in the order of the problem; they add up to 0."""
    energy_residual: float  # Sum of all heat flows, which should be 0, relative to the sum of their sizes
    status: str
    iterations: int
    newton_iterations: int  # Steps of Newton's method; 0 without radiation
    assembled: Assembled  # What was assembled
    edge_temperature_c: FloatArray = field(default_factory=lambda: np.zeros(0))
    """Temperatures of the middles of the mesh's edges, in the order of `mesh_edges`, shape (e,), [degrees Celsius];
    empty with linear tetrahedra."""
    unbalanced_w: float = 0.0
    """Heat that is unbalanced at all nodes, round-off included, [W]; heat flows are uncertain by no more."""
    overshoot_k: float = 0.0  # How far any temperature is out of the range of the surroundings, [K]; 0 up to 0.01 K
    last_facet_heat: tuple[FacetHeat, ...] = ()  # Heat flow of each effect through boundary triangles
    error: ErrorSize | None = None  # Estimated errors of the mesh, see `tolerance.steady_error`; None: not estimated


def heat_by_effect(
    effects: Sequence[str], groups: Iterable[tuple[str, str]], group_heat_w: FloatArray
) -> tuple[EffectHeat, ...]:
    """Sort heat flows, shape (s, g), [W], of groups, each an effect and a patch or region, by effect."""
    columns: dict[str, list[tuple[int, str]]] = {effect: [] for effect in effects}
    for number, (owner, name) in enumerate(groups):
        columns[owner].append((number, name))
    found = []
    for effect, chosen in columns.items():
        heat_w = group_heat_w[:, [number for number, _ in chosen]]
        found.append(EffectHeat(effect, heat_w.sum(axis=1), tuple(name for _, name in chosen), heat_w))
    return tuple(found)


Solution: TypeAlias = HeatSolution | SteadySolution  # What either solver returns

_CHILD_FACETS = 4
_EQUAL = 1e-9  # Temperatures that differ by less than this share of the absolute temperature are equal


def mean_flows_w(solution: Solution) -> dict[str, float]:
    """Give the mean heat flow into the body of each effect over all times, [W]."""
    lengths = np.diff(solution.times_s) if isinstance(solution, HeatSolution) else np.ones(1)
    return {heat.effect: float(lengths @ heat.heat_w / lengths.sum()) for heat in solution.effects}


def share_of_heat(heat_w: float, solution: Solution) -> float:
    """Give a heat flow as a share of all heat that flows through the body on average; 0 where nothing flows."""
    level_k = float(np.abs(solution.temperature_c).max()) + ZERO_CELSIUS_K
    if heat_w == 0.0 or float(np.ptp(solution.temperature_c)) <= _EQUAL * level_k:
        return 0.0
    through_w = 0.5 * sum(map(abs, mean_flows_w(solution).values()))
    return heat_w / through_w if through_w > 0.0 else math.inf


@dataclass(frozen=True)
class SolutionNodes:
    """A mesh with a temperature at every node, and whether the tetrahedra that were solved are quadratic."""

    mesh: TetMesh
    """The mesh that was solved; of quadratic tetrahedra with all edges halved, for their unknowns on edges."""
    times_s: Vector  # Times, shape (s,), [s]; 0 alone for a steady state
    states_c: Vector  # Nodal temperatures, shape (s, n), [degrees Celsius]
    quadratic: bool

    def of_facets(self, values: npt.NDArray) -> npt.NDArray:
        """Give values of the boundary triangles that were solved to those of the mesh, shape (f, ...)."""
        return np.repeat(values, _CHILD_FACETS, axis=0) if self.quadratic else values


def solution_nodes(problem: HeatProblem, solution: Solution) -> SolutionNodes:
    """Put a solution on a mesh of linear tetrahedra without losing any of its temperatures."""
    if isinstance(solution, HeatSolution):
        return SolutionNodes(problem.mesh, solution.times_s, solution.temperature_c, False)
    if not len(solution.edge_temperature_c):
        return SolutionNodes(problem.mesh, np.zeros(1), solution.temperature_c[None], False)
    every_c = np.concatenate([solution.temperature_c, solution.edge_temperature_c])
    return SolutionNodes(refine_mesh(problem.mesh), np.zeros(1), every_c[None], True)
