"""The course and the result of a heat run: a scene on a mesh."""

from __future__ import annotations

import time as clock
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from thermoxels_ns.fem.probes import Probes, place_probes
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.fem.solution import Solution, SolutionNodes, solution_nodes
from thermoxels_ns.heat.results import HeatResults, heat_results, volume_shares
from thermoxels_ns.heat.scene import HeatScene
from thermoxels_ns.heat.scene_warnings import patch_warnings, shell_warnings, unused_settings
from thermoxels_ns.heat.screening import Screening
from thermoxels_ns.heat.sky import Vector as Direction
from thermoxels_ns.heat.solving import Accuracy, Goals, Say, solve_problem
from thermoxels_ns.heat.wall_results import WallResult, wall_of_scene
from thermoxels_ns.mesh.tetrahedra import TetMesh

Vector = npt.NDArray[np.float64]


@dataclass(frozen=True)
class HeatRun:
    """All that a run found out."""

    scene: HeatScene
    """The scene."""
    problem: HeatProblem
    """The problem with all that the scene names, on the given mesh."""
    solved: HeatProblem
    """What was solved: without what is left out, and, if a tolerance asked for it, on a finer mesh."""
    nodes: SolutionNodes
    """All temperatures of the solution on a mesh that has a node for each."""
    screening: Screening
    """What of it was built."""
    accuracy: Accuracy | None
    """What is known of the error; None if no tolerance was given."""
    warnings: tuple[str, ...]
    """What looks wrong about the scene on this mesh, a sentence or two each."""
    solution: Solution
    """Temperatures and heat flows."""
    results: HeatResults
    """Heat flows by patch, effect and region, extremes and the energy balance."""
    wall: WallResult | None
    """The body as a wall, if its steady state between two airs was asked for and nothing else acts."""
    no_wall: str
    """Why there is no wall although there are two airs, a sentence; else empty."""
    mean_c: Vector
    """Mean temperature of the volume at each time, shape (s,), [degrees Celsius]."""
    probes: Probes
    """Where temperatures were followed."""
    probes_c: Vector
    """Temperatures there, shape (s, p), [degrees Celsius]."""
    seconds: Mapping[str, float]
    """Time that each part took, [s]."""


def run_scene(
    scene: HeatScene,
    mesh: TetMesh,
    goals: Goals,
    *,
    up: Direction | None = None,
    probes_m: npt.ArrayLike = (),
    export: Mapping[str, Any] | None = None,
    say: Say = lambda _: None,
) -> HeatRun:
    """Put a scene around a body, solve it, and work out what people ask.

    Args:
        scene: What is around the body.
        mesh: The body, [m].
        goals: How exact the solution must be, and what it may take.
        up: Direction that points up, if the scene does not say; None: z.
        probes_m: Points whose temperature is followed, shape (p, 3), [m].
        export: The summary of the export that the mesh comes from, for warnings.
        say: Called with one line of progress at a time.

    Raises:
        HeatError: The scene does not fit the mesh, a probe lies outside, or the solver fails.
    """
    start = clock.perf_counter()
    problem = scene.problem(mesh, up=up)
    probes = place_probes(mesh, np.array(probes_m, dtype=np.float64).reshape(-1, 3))
    about_patches = patch_warnings(scene, mesh, problem.up)
    warnings = (*about_patches, *unused_settings(scene), *shell_warnings(scene, export or {}))
    for warning in warnings:
        say(f"Warning: {warning}")
    found = solve_problem(problem, scene.time, goals, say)
    solution, solved = found.solution, found.problem
    done = clock.perf_counter()
    seconds = {"screen": found.screening.seconds, "solve": done - start - found.screening.seconds}
    say(f"Heat: {solution.status} ({seconds['solve']:.1f} s)")
    say(f"Energy balance closed to {solution.energy_residual:.1e}.")
    if found.accuracy is not None and not found.accuracy.met:
        say("Warning: the tolerance was not met.")

    nodes = solution_nodes(solved, solution)
    wall = wall_of_scene(scene, solved, solution, nodes, doubtful=bool(about_patches))
    probes = place_probes(solved.mesh, probes.points_m)  # in the mesh that was solved
    results = heat_results(solved, solution, nodes)
    return HeatRun(
        scene=scene,
        problem=problem,
        solved=solved,
        nodes=nodes,
        screening=found.screening,
        accuracy=found.accuracy,
        warnings=warnings,
        solution=solution,
        results=results,
        wall=None if isinstance(wall, str) else wall,
        no_wall=wall if isinstance(wall, str) else "",
        mean_c=nodes.states_c @ volume_shares(nodes.mesh),
        probes=probes,
        probes_c=probes.at_quadratic(solved.mesh, nodes.states_c) if nodes.quadratic else probes.at(nodes.states_c),
        seconds={**seconds, "answers": clock.perf_counter() - done},
    )
