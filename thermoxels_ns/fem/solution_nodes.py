"""All points at which a solution knows the temperature, as the nodes of a mesh that can be shown."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.fem.refine_mesh import refine_mesh
from thermoxels_ns.fem.solution import HeatSolution, SteadySolution
from thermoxels_ns.mesh.tetrahedra import TetMesh

Vector = npt.NDArray[np.float64]
Solution: TypeAlias = HeatSolution | SteadySolution
"""What either solver returns."""

_CHILD_FACETS = 4


@dataclass(frozen=True)
class SolutionNodes:
    """A mesh with a temperature at every node."""

    mesh: TetMesh
    """The mesh that was solved; of quadratic tetrahedra the same with all edges halved, whose new nodes are where their
    further unknowns sit. So pictures, files and extremes show every temperature that was computed."""
    times_s: Vector
    """Times, shape (s,), [s]; 0 alone for a steady state."""
    states_c: Vector
    """Nodal temperatures, shape (s, n), [degrees Celsius]."""
    quadratic: bool
    """Whether the tetrahedra that were solved are quadratic."""

    def of_facets(self, values: npt.NDArray) -> npt.NDArray:
        """Give values of the boundary triangles that were solved to those of the mesh, shape (f, ...)."""
        return np.repeat(values, _CHILD_FACETS, axis=0) if self.quadratic else values


def solution_nodes(problem: HeatProblem, solution: Solution) -> SolutionNodes:
    """Put a solution on a mesh of linear tetrahedra without losing any of its temperatures.

    Args:
        problem: What was solved.
        solution: Its outcome.
    """
    if isinstance(solution, HeatSolution):
        return SolutionNodes(problem.mesh, solution.times_s, solution.temperature_c, False)
    if not len(solution.edge_temperature_c):
        return SolutionNodes(problem.mesh, np.zeros(1), solution.temperature_c[None], False)
    every_c = np.concatenate([solution.temperature_c, solution.edge_temperature_c])
    return SolutionNodes(refine_mesh(problem.mesh), np.zeros(1), every_c[None], True)
