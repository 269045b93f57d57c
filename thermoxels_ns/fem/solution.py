"""Solutions of heat problems, and their temperatures on a mesh of linear tetrahedra."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.core.units import ZERO_CELSIUS_K
from thermoxels_ns.fem.linear_tets import refine_mesh
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.mesh.tetrahedra import TetMesh

Vector = FloatArray


@dataclass(frozen=True)
class EffectHeat:
    """Heat that one effect brings into the body."""

    effect: str  # Label of the effect, from `effect_labels`
    heat_w: FloatArray
    """Mean heat flow into the body during each interval, as the scheme evaluates it, shape (s,), [W]; negative if heat
    leaves. A steady state has one interval."""
    group_names: tuple[str, ...]  # Names of the patches, or for a source of the regions, that the effect acts on
    group_heat_w: FloatArray  # `heat_w` of each patch or region alone, shape (s, g), [W]


@dataclass(frozen=True)
class ErrorSize:
    """Estimated largest errors of a solution."""

    temperature_k: float  # Largest error of the temperature at the nodes of the given mesh, [K]
    heat_flow: float  # Largest error of an effect's mean heat flow, as a share of all heat that flows through the body

    def describe(self) -> str:
        """Return both errors as text, such as "0.05 K and 1 % of the heat flow"."""
        return f"{self.temperature_k:.2g} K and {100.0 * self.heat_flow:.2g} % of the heat flow"


@dataclass(frozen=True)
class HeatSolution:
    """Temperatures of n nodes over s intervals of time, and the heat balance."""

    times_s: FloatArray  # Time of each state, the start first, shape (s + 1,), [s]
    temperature_c: FloatArray
    """Nodal temperatures, (s + 1, n), [degrees Celsius]; fixed nodes have their fixed temperature also at the start."""
    heat_w: FloatArray
    """Mean net heat flow into the body in each interval, shape (s,), [W]: the change of the heat content divided by the
    interval's length. Without boundary effects and sources the flow is 0 up to round-off."""
    heat_content_j: FloatArray  # Heat content above absolute zero at each time, 1^T M T with T in kelvin, (s + 1,), [J]
    energy_residual: float
    """Largest change of the heat content without a heat flow as its cause, relative to the heat of the initial
    differences, sum m_i |T_i - mean T|, plus all heat exchanged."""
    status: str  # Sentences on how the steps converged
    iterations: IntArray  # Iterations of the linear solver in each interval, shape (s,)
    effects: tuple[EffectHeat, ...]  # Heat that each effect of the problem brought, in the order of the problem
    newton_iterations: IntArray  # Steps of Newton's method in each interval, shape (s,); all 0 without radiation
    steps: int  # Number of steps
    time_error_k: float
    """Estimated largest error of any temperature due to the time steps, [K]. Adaptive steps: the sum of their
    estimates. Equal steps: from a solution with steps twice as long, or NaN if it was not asked for."""
    unbalanced_w: float  # Largest heat that a step left unbalanced, summed over all nodes, plus round-off, [W]
    overshoot_k: float
    """Largest distance of a temperature outside the range of the start and of the surroundings, [K]; 0 up to 0.01 K."""
    facet_heat_w: FloatArray
    """Heat flow into the body through each triangle at the end, (f,), [W], as if fixed nodes stored no heat."""


@dataclass(frozen=True)
class SteadySolution:
    """Temperatures of a steady state, and the heat balance."""

    temperature_c: FloatArray  # Temperatures of the mesh's nodes, shape (n,), [degrees Celsius]
    effects: tuple[EffectHeat, ...]
    """Heat that each effect of the problem brings, in the order of the problem; the heat flows add up to 0."""
    energy_residual: float  # Half the absolute sum of all heat flows (ideally 0) divided by the heat that flows
    status: str  # Sentences on how the iterations converged
    iterations: int  # Iterations of the linear solver
    newton_iterations: int  # Steps of Newton's method; 0 without radiation
    edge_temperature_c: FloatArray
    """Temperatures at midpoints of edges, in the order of `mesh_edges`, (e,), [degrees Celsius]; empty if linear."""
    unbalanced_w: float
    """Unbalanced heat summed over all nodes, plus round-off, [W]; no heat flow is more uncertain than this."""
    overshoot_k: float  # Largest distance of a temperature outside the surroundings' range, [K]; 0 up to 0.01 K
    facet_heat_w: FloatArray  # Heat flow into the body through each boundary triangle, shape (f,), [W]
    error: ErrorSize | None = None  # Errors due to the mesh, as `tolerance.steady_error` estimates them, if it did


Solution: TypeAlias = HeatSolution | SteadySolution  # A solution through time or of a steady state

_CHILD_FACETS = 4  # Triangles into which `refine_mesh` cuts a triangle
NOTHING = 1e-9  # Temperatures that differ by at most this share of the absolute temperature count as equal


def mean_flows_w(solution: Solution) -> dict[str, float]:
    """Return the mean heat flow over time into the body by effect label, [W]."""
    lengths = np.diff(solution.times_s) if isinstance(solution, HeatSolution) else np.ones(1)
    return {heat.effect: float(lengths @ heat.heat_w / lengths.sum()) for heat in solution.effects}


def share_of_heat(heat_w: float, solution: Solution) -> float:
    """Return `heat_w` divided by the mean heat that flows through the body; 0 if all temperatures are equal."""
    level_k = float(np.abs(solution.temperature_c).max()) + ZERO_CELSIUS_K
    if heat_w == 0.0 or float(np.ptp(solution.temperature_c)) <= NOTHING * level_k:
        return 0.0
    through_w = 0.5 * sum(map(abs, mean_flows_w(solution).values()))
    return heat_w / through_w if through_w > 0.0 else math.inf


@dataclass(frozen=True)
class SolutionNodes:
    """All temperatures of a solution on a mesh of linear tetrahedra that has a node for each unknown."""

    mesh: TetMesh
    """The mesh of the problem; for quadratic tetrahedra refined once, so that each edge has a node at its midpoint."""
    times_s: Vector  # Times, shape (s,), [s]; 0 alone for a steady state
    states_c: Vector  # Nodal temperatures, shape (s, n), [degrees Celsius]
    quadratic: bool  # True if the tetrahedra that were solved are quadratic

    def of_facets(self, values: npt.NDArray) -> npt.NDArray:
        """Return values per boundary triangle of `mesh`, (f, ...), from values per triangle of the problem's mesh."""
        return np.repeat(values, _CHILD_FACETS, axis=0) if self.quadratic else values


def solution_nodes(problem: HeatProblem, solution: Solution) -> SolutionNodes:
    """Return all temperatures of a solution of `problem` on a mesh of linear tetrahedra."""
    if isinstance(solution, HeatSolution):
        return SolutionNodes(problem.mesh, solution.times_s, solution.temperature_c, False)
    if not len(solution.edge_temperature_c):
        return SolutionNodes(problem.mesh, np.zeros(1), solution.temperature_c[None], False)
    every_c = np.concatenate([solution.temperature_c, solution.edge_temperature_c])
    return SolutionNodes(refine_mesh(problem.mesh), np.zeros(1), every_c[None], True)
