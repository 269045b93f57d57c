"""From an exported mesh and a heat scene to answers: what ``thermoxels heat`` does."""

from __future__ import annotations

import csv
import json
import shlex
import time as clock
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from thermoxels_ns.checks import (
    refuse_what_is_in_the_way,
    remove_file,
    remove_stale_temporaries,
    replace_when_done,
    writable_folder,
)
from thermoxels_ns.errors import HeatError, MeshError, explain
from thermoxels_ns.fem.answers import Answers, Solution, heat_answers, plain_values, times_and_states
from thermoxels_ns.fem.files import STEP_PATTERN, remove_heat_series, write_heat_series
from thermoxels_ns.fem.heat_scene import HeatScene
from thermoxels_ns.fem.lumped_body import LumpedBody, lumped_body
from thermoxels_ns.fem.probes import Probes, place_probes
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.fem.savings import seconds_saved
from thermoxels_ns.fem.scene_file import load_heat_scene
from thermoxels_ns.fem.screening import Screening, screen
from thermoxels_ns.fem.solution import HeatSolution, SteadySolution
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.stepping import solve_heat
from thermoxels_ns.fem.wall_answers import WallAnswer, wall_answer
from thermoxels_ns.heat_command import Heat
from thermoxels_ns.heat_pictures import PICTURES, draw_surface
from thermoxels_ns.mesh.facet_owners import facet_owners
from thermoxels_ns.mesh.files import summary_text, write_summary, write_vtu
from thermoxels_ns.mesh.read_mesh import read_mesh
from thermoxels_ns.mesh.tetrahedra import TetMesh

Say = Callable[[str], None]
Vector = npt.NDArray[np.float64]
Direction = tuple[float, float, float]

ANSWERS, SERIES, PAGE, THROUGH_TIME, STEADY = "answers.json", "series.csv", "report.html", "heat.pvd", "heat.vtu"
"""Files of a run; pictures come on top."""


@dataclass(frozen=True)
class HeatRun:
    """All that a run found out."""

    options: Heat
    """What was asked."""
    scene: HeatScene
    """The scene."""
    problem: HeatProblem
    """The problem with all that the scene names."""
    screening: Screening
    """What of it was built."""
    lumped: LumpedBody | None
    """Whether the body could have one temperature; None if that was not asked, as in a steady state."""
    solution: Solution
    """Temperatures and heat flows."""
    answers: Answers
    """What people ask."""
    wall: WallAnswer | None
    """The body as a wall, if its steady state between two airs was asked for."""
    mean_c: Vector
    """Mean temperature of the volume at each time, shape (s,), [degrees Celsius]."""
    probes: Probes
    """Where temperatures were followed."""
    probes_c: Vector
    """Temperatures there, shape (s, p), [degrees Celsius]."""
    seconds: Mapping[str, float]
    """Time that each part took, [s]."""
    seconds_saved: float | None
    """Time that leaving effects out saved, [s]; None if nothing was left out, or in a steady state."""


def run_heat(options: Heat, say: Say = lambda _: None) -> HeatRun:
    """Compute everything, then write it; answers.json comes last, so that files beside one belong together.

    Args:
        options: What was asked.
        say: Called with one line of progress at a time.

    Raises:
        ThermoxelsError: The mesh, the scene or an option cannot be used, or the solver fails.
    """
    folder = _prepared(options.output_dir)
    run = compute_heat(options, say)
    _write(folder, run, say)
    return run


def compute_heat(options: Heat, say: Say = lambda _: None) -> HeatRun:
    """Do what `run_heat` does without writing anything."""
    seconds: dict[str, float] = {}
    start = clock.perf_counter()

    def lap(name: str) -> None:
        nonlocal start
        seconds[name], start = clock.perf_counter() - start, clock.perf_counter()

    if not options.leave_out_below_k >= 0.0:
        got, remedy = options.leave_out_below_k, "Pass 0 to build everything."
        raise HeatError(explain("leave-out-below-k", expected="a number of at least 0", got=got, remedy=remedy))
    scene = load_heat_scene(options.scene)
    export = _export_summary(options.mesh)
    mesh = read_mesh(options.mesh)
    up = _direction(options.up if options.up is not None else export.get("up"))
    problem = scene.problem(mesh, up=up)
    probes = place_probes(mesh, np.array(options.probes, dtype=np.float64).reshape(-1, 3))
    lap("read")
    say(f"Mesh: {len(mesh.tets):,} tetrahedra, {len(mesh.points_m):,} nodes.")
    say(f"Scene: {scene.description or options.scene}.")

    screening = screen(problem, scene.time, options.leave_out_below_k)
    lap("screen")
    for entry in screening.left_out:
        say(f"Left out: {entry.effect}, at most {entry.bound_k:.2g} K and {entry.bound_w:.3g} W: {entry.reason}.")
    for entry in screening.kept:
        bound = "" if entry.bound_k is None else f" (up to {entry.bound_k:.2g} K)"
        say(f"Built: {entry.effect}{bound}")
    if not problem.effects:
        say("Nothing acts on the body: its surface is insulated.")

    solution: Solution
    lumped: LumpedBody | None = None
    if scene.time is None:
        solution = solve_steady(screening.problem)
    else:
        allowed_k = options.leave_out_below_k - screening.bound_k
        lumped = lumped_body(screening.problem, scene.time, allowed_k) if allowed_k > 0.0 else None
        if lumped is not None and lumped.solution is not None:
            solution = lumped.solution
        else:
            solution = solve_heat(screening.problem, scene.time)
    lap("solve")
    say(f"Heat: {solution.status} ({seconds['solve']:.1f} s)")
    say(f"Energy balance closed to {solution.energy_residual:.1e}.")

    saved = None
    if screening.left_out and scene.time is not None and isinstance(solution, HeatSolution) and solution.steps:
        saved = seconds_saved(problem, screening.problem, scene.time, solution.steps)
        say(f"Leaving out saved about {saved:.1f} s and cost {screening.seconds:.1f} s.")
        lap("measure what was saved")

    facet_region = mesh.region[facet_owners(mesh.tets, mesh.facets)[0]]
    answers = heat_answers(screening.problem, solution, facet_region=facet_region)
    _, states = times_and_states(solution)
    run = HeatRun(
        options=options,
        scene=scene,
        problem=problem,
        screening=screening,
        lumped=lumped,
        solution=solution,
        answers=answers,
        wall=_wall(scene, screening.problem, solution, facet_region),
        mean_c=states @ _volume_weights(mesh),
        probes=probes,
        probes_c=probes.at(states),
        seconds=seconds,
        seconds_saved=saved,
    )
    lap("answers")
    return run


def summary_of(run: HeatRun) -> dict[str, Any]:
    """Everything that answers.json says."""
    screening = run.screening
    return {
        "mesh": run.options.mesh,
        "scene": run.options.scene,
        "description": run.scene.description,
        "steady": run.scene.steady,
        "leave_out_below_k": run.options.leave_out_below_k,
        **run.answers.as_mapping(),
        "wall": None if run.wall is None else plain_values(run.wall),
        "probes": [
            {"point_m": point, "temperature_c": run.probes_c[:, number]}
            for number, point in enumerate(run.probes.points_m)
        ],
        "built": plain_values(screening.kept),
        "left_out": plain_values(screening.left_out),
        "left_out_bound_k": screening.bound_k,
        "left_out_note": screening.note,
        "lumped_model": _lumped_summary(run.lumped),
        "assembled": dict(run.solution.assembled.counts),
        "newton_iterations": int(np.sum(run.solution.newton_iterations)),
        "linear_iterations": int(np.sum(run.solution.iterations)),
        "steps": run.solution.steps if isinstance(run.solution, HeatSolution) else 0,
        "time_error_k": _time_error(run.solution),
        "seconds": dict(run.seconds),
        "seconds_saved": run.seconds_saved,
    }


def _lumped_summary(lumped: LumpedBody | None) -> dict[str, Any] | None:
    if lumped is None:
        return None
    used = lumped.solution is not None
    return {"used": used, "biot": lumped.biot, "bound_k": lumped.bound_k, "reason": lumped.reason}


def _prepared(output_dir: Path) -> Path:
    """Make the folder, and find out what is in the way before anything is computed."""
    folder = writable_folder(output_dir)
    names = (ANSWERS, SERIES, PAGE, THROUGH_TIME, STEADY, *PICTURES)
    series = folder / Path(THROUGH_TIME).stem
    refuse_what_is_in_the_way(folder, names, [series.name])
    remove_stale_temporaries(folder, names)
    remove_stale_temporaries(series, [STEP_PATTERN])
    return folder


def _write(folder: Path, run: HeatRun, say: Say) -> None:
    from thermoxels_ns.heat_page import heat_page
    from thermoxels_ns.heat_report import build_report

    summary_text(summary_of(run))  # raises if json cannot hold it
    times, states = times_and_states(run.solution)
    mesh, pictures = run.problem.mesh, list[str]()
    remove_file(folder / ANSWERS)
    for name in (PAGE, STEADY, *PICTURES):
        remove_file(folder / name)
    if isinstance(run.solution, SteadySolution):
        remove_heat_series(folder / THROUGH_TIME)
        write_vtu(folder / STEADY, mesh, temperature_c=run.solution.temperature_c)
    else:
        write_heat_series(folder / THROUGH_TIME, mesh, run.solution)
    _write_series(folder / SERIES, run)
    if run.options.pictures:
        pictures = draw_surface(folder, mesh, states, times, run.problem.up)
    shown = {name: (folder / name).read_bytes() for name in pictures}
    fields = STEADY if isinstance(run.solution, SteadySolution) else THROUGH_TIME
    files = [PAGE, ANSWERS, SERIES, fields, *pictures]
    page = build_report(heat_page(run, shown, command_line(run.options), files))
    with replace_when_done(folder / PAGE) as temporary:
        temporary.write_text(page, encoding="utf-8")
    write_summary(folder / ANSWERS, summary_of(run))
    say(f"Written to {folder}: {', '.join(files)}")


def command_line(options: Heat) -> str:
    """Write the command as it is typed."""
    words = ["thermoxels", "heat", str(options.mesh), "--scene", options.scene, "--output-dir", str(options.output_dir)]
    if options.probes:
        words += ["--probes", *(f"{part:g}" for point in options.probes for part in point)]
    if options.leave_out_below_k != Heat.leave_out_below_k:
        words += ["--leave-out-below-k", f"{options.leave_out_below_k:g}"]
    if options.up is not None:
        words += ["--up", *(f"{part:g}" for part in options.up)]
    return shlex.join(words)


def _write_series(path: Path, run: HeatRun) -> None:
    """Temperatures at each time, and mean heat flows during the interval that ends there."""
    times, states = times_and_states(run.solution)
    effects = run.solution.effects
    head = ["time_s", "min_c", "mean_c", "max_c"]
    head += [f"probe {number + 1} [C]" for number in range(run.probes_c.shape[1])]
    head += [f"{heat.effect} [W]" for heat in effects]
    heat_w = np.stack([heat.heat_w for heat in effects], axis=1) if effects else np.zeros((max(len(times) - 1, 1), 0))
    with replace_when_done(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(head)
        for number, time_s in enumerate(times):
            temperatures = [states[number].min(), run.mean_c[number], states[number].max(), *run.probes_c[number]]
            interval = number if len(times) == 1 else number - 1
            flows = ["" for _ in effects] if interval < 0 else [repr(float(flow)) for flow in heat_w[interval]]
            writer.writerow([repr(float(time_s)), *(repr(float(value)) for value in temperatures), *flows])


def _export_summary(mesh: Path) -> dict[str, Any]:
    """What the export says about a mesh: heat needs metres."""
    path = mesh.with_name("summary.json")
    if not path.is_file():
        return {}
    try:
        summary = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as problem:
        remedy = "Export the mesh again, or move the file away."
        raise MeshError(
            explain(str(path), expected="the summary of an export", got=problem, remedy=remedy)
        ) from problem
    if not isinstance(summary, dict):
        return {}
    if summary.get("length_unit", "m") != "m":
        raise HeatError(
            explain(
                "scale of the mesh",
                expected="an export in metres",
                got=f"one in {summary['length_unit']}s",
                remedy="Export again with --metres-per-unit or --known-distance.",
            )
        )
    return summary


def _direction(up: Any) -> Direction | None:
    """Return three numbers, or None for none."""
    if up is None:
        return None
    x, y, z = (float(part) for part in up)
    return (x, y, z)


def _wall(
    scene: HeatScene, problem: HeatProblem, solution: Solution, facet_region: npt.NDArray[np.int64]
) -> WallAnswer | None:
    """The body as a wall, if the scene asks for a steady state between two airs of different temperature."""
    inside, outside = scene.inside_air, scene.outside_air
    if not isinstance(solution, SteadySolution) or inside is None or outside is None:
        return None
    if inside.air_c == outside.air_c:
        return None
    return wall_answer(problem, solution, inside.patches, inside.air_c, outside.air_c, facet_region=facet_region)


def _volume_weights(mesh: TetMesh) -> Vector:
    """Share of the volume around each node, shape (n,)."""
    corner = mesh.points_m[mesh.tets]
    sides = corner[:, 1:] - corner[:, :1]
    volume = np.einsum("ti,ti->t", sides[:, 0], np.cross(sides[:, 1], sides[:, 2])) / 24.0
    weights = np.bincount(mesh.tets.ravel(), np.repeat(volume, 4), len(mesh.points_m))
    return weights / weights.sum()


def _time_error(solution: Solution) -> float | None:
    """Estimated error of the steps, if there is one."""
    if isinstance(solution, SteadySolution) or not np.isfinite(solution.time_error_k):
        return None
    return solution.time_error_k
