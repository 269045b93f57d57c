"""From an exported mesh and a heat scene to answers: what ``thermoxels heat`` does."""

from __future__ import annotations

import json
import time as clock
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from thermoxels_ns.commands.heat import Heat
from thermoxels_ns.commands.heat_files import prepared_folder, write_heat_files
from thermoxels_ns.core.errors import HeatError, MeshError
from thermoxels_ns.fem.probes import Probes, place_probes
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.fem.solution import SteadySolution
from thermoxels_ns.fem.solution_nodes import Solution, SolutionNodes, solution_nodes
from thermoxels_ns.heat.results import Answers, heat_answers
from thermoxels_ns.heat.scene import HeatScene
from thermoxels_ns.heat.scene_file import load_heat_scene
from thermoxels_ns.heat.scene_warnings import scene_doubts, unused_settings
from thermoxels_ns.heat.screening import Screening
from thermoxels_ns.heat.solving import (
    Accuracy,
    Say,
    check_accuracy_options,
    solve_scene,
)
from thermoxels_ns.heat.wall_results import WallAnswer, faces_inside, not_only_airs, wall_answer
from thermoxels_ns.mesh.boundary.facet_owners import facet_owners
from thermoxels_ns.mesh.files.read import read_mesh
from thermoxels_ns.mesh.tetrahedra import TetMesh

Vector = npt.NDArray[np.float64]
Direction = tuple[float, float, float]


@dataclass(frozen=True)
class HeatRun:
    """All that a run found out."""

    options: Heat
    """What was asked."""
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
    answers: Answers
    """What people ask."""
    wall: WallAnswer | None
    """The body as a wall, if its steady state between two airs was asked for and nothing else acts."""
    no_wall: str
    """Why there is no such answer although there are two airs, a sentence; else empty."""
    mean_c: Vector
    """Mean temperature of the volume at each time, shape (s,), [degrees Celsius]."""
    probes: Probes
    """Where temperatures were followed."""
    probes_c: Vector
    """Temperatures there, shape (s, p), [degrees Celsius]."""
    seconds: Mapping[str, float]
    """Time that each part took, [s]."""


def run_heat(options: Heat, say: Say = lambda _: None) -> HeatRun:
    """Compute everything, then write it; answers.json comes last, so that files beside one belong together.

    Args:
        options: What was asked.
        say: Called with one line of progress at a time.

    Raises:
        ThermoxelsError: The mesh, the scene or an option cannot be used, or the solver fails.
    """
    folder = prepared_folder(options.output_dir)
    run = compute_heat(options, say)
    write_heat_files(folder, run, say)
    return run


def compute_heat(options: Heat, say: Say = lambda _: None) -> HeatRun:
    """Do what `run_heat` does without writing anything."""
    seconds: dict[str, float] = {}
    start = clock.perf_counter()

    def lap(name: str) -> None:
        nonlocal start
        seconds[name], start = clock.perf_counter() - start, clock.perf_counter()

    scene = load_heat_scene(options.scene)
    check_accuracy_options(options, scene)
    mesh = read_mesh(options.mesh)
    export = _export_summary(options.mesh, say)
    up = options.up if options.up is not None else _direction(export.get("up"), options.mesh)
    problem = scene.problem(mesh, up=up)
    probes = place_probes(mesh, np.array(options.probes, dtype=np.float64).reshape(-1, 3))
    lap("read")
    say(f"Mesh: {len(mesh.tets):,} tetrahedra, {len(mesh.points_m):,} nodes.")
    say(f"Scene: {scene.description or options.scene}.")

    doubts = scene_doubts(scene, mesh, problem.up)
    warnings = (*doubts, *unused_settings(scene), *_shell_doubts(scene, export))
    for warning in warnings:
        say(f"Warning: {warning}")

    found = solve_scene(options, scene, problem, say, lap)
    screening, solution, solved = found.screening, found.solution, found.problem
    lap("solve")
    say(f"Heat: {solution.status} ({seconds['solve']:.1f} s)")
    say(f"Energy balance closed to {solution.energy_residual:.1e}.")
    if found.accuracy is not None and not found.accuracy.met:
        say("Warning: the tolerance was not met.")

    facet_region = solved.mesh.region[facet_owners(solved.mesh.tets, solved.mesh.facets)[0]]
    nodes = solution_nodes(solved, solution)
    wall, no_wall = _wall(scene, solved, solution, facet_region, nodes, doubtful=bool(doubts))
    # Around each probe in the mesh that was solved.
    probes = place_probes(solved.mesh, probes.points_m)
    run = HeatRun(
        options=options,
        scene=scene,
        problem=problem,
        solved=solved,
        nodes=nodes,
        screening=screening,
        accuracy=found.accuracy,
        warnings=warnings,
        solution=solution,
        answers=heat_answers(solved, solution, facet_region=facet_region, nodes=nodes),
        wall=wall,
        no_wall=no_wall,
        mean_c=nodes.states_c @ _volume_weights(nodes.mesh),
        probes=probes,
        probes_c=probes.at(nodes.states_c) if not nodes.quadratic else probes.at_quadratic(solved.mesh, nodes.states_c),
        seconds=seconds,
    )
    lap("answers")
    return run


def _shell_doubts(scene: HeatScene, export: Mapping[str, Any]) -> tuple[str, ...]:
    """Warn that the walls of a hollow export are as thick as photographs happened to make them."""
    options, mesh = export.get("options"), export.get("mesh")
    if scene.inside_air is None or not isinstance(options, dict) or not isinstance(mesh, dict):
        return ()
    if options.get("interior") != "hollow" or options.get("wall_thickness") is not None:
        return ()
    try:
        thickness_m = 2.0 * float(mesh["volume"]) / float(mesh["area"])
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return ()
    return (
        f"The mesh is a shell (--interior hollow), {thickness_m:.2g} m thick on average. Photographs do not show how "
        "thick walls are, nor what no camera saw, such as floors: heat losses and U-values are those of this shell, "
        "with its holes and loose parts. Where you know the walls, export with --wall-thickness.",
    )


def _export_summary(mesh: Path, say: Say) -> dict[str, Any]:
    """What the export says about a mesh: heat needs metres."""
    path = mesh.with_name("summary.json")
    if not path.is_file():
        say(f"Warning: {path} is missing; the mesh is taken to be in metres.")
        return {}
    try:
        summary = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as problem:
        remedy = "Export the mesh again, or move the file away."
        raise MeshError(str(path), expected="the summary of an export", got=problem, remedy=remedy) from problem
    if not isinstance(summary, dict):
        remedy = "Export the mesh again, or move the file away."
        raise MeshError(str(path), expected="the summary of an export", got=repr(summary)[:40], remedy=remedy)
    if summary.get("length_unit", "m") != "m":
        raise HeatError(
            "scale of the mesh",
            expected="an export in metres",
            got=f"one in {summary['length_unit']}s",
            remedy="Export again with --metres-per-unit or --known-distance.",
        )
    return summary


def _direction(up: Any, mesh: Path) -> Direction | None:
    """Return the three numbers that a summary gives, or None for none."""
    if up is None:
        return None
    try:
        x, y, z = (float(part) for part in up)
    except (TypeError, ValueError) as problem:
        raise MeshError(
            f"{mesh.with_name('summary.json')}: up",
            expected="three numbers",
            got=repr(up),
            remedy="Pass --up 0 0 1, or export the mesh again.",
        ) from problem
    return (x, y, z)


def _wall(
    scene: HeatScene,
    problem: HeatProblem,
    solution: Solution,
    facet_region: npt.NDArray[np.int64],
    nodes: SolutionNodes,
    *,
    doubtful: bool,
) -> tuple[WallAnswer | None, str]:
    """The body as a wall, if the scene asks for a steady state between two airs of different temperature and nothing
    else, or why that cannot be said.
    """
    inside, outside = scene.inside_air, scene.outside_air
    if not isinstance(solution, SteadySolution) or inside is None or outside is None:
        return None, ""
    if inside.air_c == outside.air_c:
        return None, ""
    if doubtful:
        return None, "There is no U-value, because it is doubtful which surface faces the air inside."
    other = not_only_airs(problem, inside.air_c, outside.air_c)
    if other:
        return None, f"There is no U-value, because its heat would count in it: {other}. Ask for the two airs alone."
    if not faces_inside(problem, inside.patches).any():
        return None, "There is no U-value, because no surface of the body faces the air inside."
    airs = inside.air_c, outside.air_c
    return wall_answer(problem, solution, inside.patches, *airs, facet_region=facet_region, nodes=nodes), ""


def _volume_weights(mesh: TetMesh) -> Vector:
    """Share of the volume around each node, shape (n,)."""
    corner = mesh.points_m[mesh.tets]
    sides = corner[:, 1:] - corner[:, :1]
    volume = np.einsum("ti,ti->t", sides[:, 0], np.cross(sides[:, 1], sides[:, 2])) / 24.0
    weights = np.bincount(mesh.tets.ravel(), np.repeat(volume, 4), len(mesh.points_m))
    return weights / weights.sum()
