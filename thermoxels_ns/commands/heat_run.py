"""From an exported mesh and a heat scene to the files that ``thermoxels heat`` writes."""

from __future__ import annotations

import csv
import shlex
import time as clock
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from thermoxels_ns.commands.heat_options import HeatOptions
from thermoxels_ns.core.checks import (
    refuse_files_of_others,
    refuse_what_is_in_the_way,
    remove_file,
    remove_stale_temporaries,
    replace_when_done,
    writable_folder,
)
from thermoxels_ns.core.errors import HeatError, MeshError
from thermoxels_ns.core.json_values import read_json_object
from thermoxels_ns.fem.solution import HeatSolution, Solution, SteadySolution
from thermoxels_ns.heat.run import HeatRun, run_scene
from thermoxels_ns.heat.scene_file import load_heat_scene
from thermoxels_ns.heat.solving import Goals, Say
from thermoxels_ns.heat.vtk_series import STEP_PATTERN, remove_heat_series, write_heat_series
from thermoxels_ns.mesh.files.read import read_mesh
from thermoxels_ns.mesh.files.vtu import summary_text, write_summary, write_vtu
from thermoxels_ns.reports.heat_page import heat_page
from thermoxels_ns.reports.heat_pictures import PICTURES, draw_surface
from thermoxels_ns.reports.page import write_page

ANSWERS, SERIES, PAGE, THROUGH_TIME, STEADY = "answers.json", "series.csv", "report.html", "heat.pvd", "heat.vtu"
"""Files of a run; pictures come on top."""


def run_heat(options: HeatOptions, say: Say = lambda _: None) -> HeatRun:
    """Compute everything, then write it; answers.json comes last, so that files beside one belong together."""
    folder = prepared_folder(options.output_dir)
    run = compute_heat(options, say)
    write_heat_files(folder, options, run, say)
    return run


def compute_heat(options: HeatOptions, say: Say = lambda _: None) -> HeatRun:
    """Do what `run_heat` does without writing anything."""
    begin = clock.perf_counter()
    scene = load_heat_scene(options.scene)
    goals = Goals(
        tolerance_k=options.tolerance,
        flow_tolerance=options.flow_tolerance,
        leave_out_below_k=options.leave_out_below_k,
        memory_gb=options.memory_gb,
        allow_unmet=options.allow_unmet,
    )
    goals.check_fits(scene.time)
    mesh = read_mesh(options.mesh)
    export = read_export_summary(options.mesh, say)
    up = export.get("up") if options.up is None else options.up
    say(f"Mesh: {len(mesh.tets):,} tetrahedra, {len(mesh.points_m):,} nodes.")
    say(f"Scene: {scene.description or options.scene}.")
    read_s = clock.perf_counter() - begin
    run = run_scene(scene, mesh, goals, up=up, probes_m=options.probes, export=export, say=say)
    return replace(run, seconds={"read": read_s, **run.seconds})


def read_export_summary(mesh: Path, say: Say) -> dict[str, Any]:
    """Read what the export says about a mesh (empty without summary.json); `HeatError` for one without a scale."""
    path = mesh.with_name("summary.json")
    if not path.is_file():
        say(f"Warning: {path} is missing; the mesh is taken to be in metres.")
        return {}
    summary = read_json_object(path, "Export the mesh again, or move the file away.", MeshError)
    if summary.get("length_unit", "m") != "m":
        remedy = "Export again with --metres-per-unit or --known-distance."
        got = f"one in {summary['length_unit']}s"
        raise HeatError("scale of the mesh", expected="an export in metres", got=got, remedy=remedy)
    try:
        if summary.get("up") is not None:
            x, y, z = map(float, summary["up"])
            summary["up"] = (x, y, z)
    except (TypeError, ValueError) as problem:
        name, remedy = f"{path}: up", "Pass --up 0 0 1, or export the mesh again."
        raise MeshError(name, expected="three numbers", got=repr(summary["up"]), remedy=remedy) from problem
    return summary


def answers_of(options: HeatOptions, run: HeatRun) -> dict[str, Any]:
    """Everything that answers.json says."""
    screening = run.screening
    return {
        "mesh": options.mesh,
        "scene": options.scene,
        "description": run.scene.description,
        "steady": run.scene.steady,
        "warnings": list(run.warnings),
        "leave_out_below_k": screening.tolerance_k,
        "accuracy": None if run.accuracy is None else asdict(run.accuracy),
        "mesh_error": None
        if isinstance(run.solution, HeatSolution) or run.solution.error is None
        else asdict(run.solution.error),
        "solved": {
            "tets": len(run.solved.mesh.tets),
            "nodes": len(run.solved.mesh.points_m),
            "unknowns": run.nodes.states_c.shape[1],
        },
        **asdict(run.results),
        "wall": None if run.wall is None else asdict(run.wall),
        "no_wall": run.no_wall,
        "probes": [
            {"point_m": point, "temperature_c": run.probes_c[:, number]}
            for number, point in enumerate(run.probes.points_m)
        ],
        "built": [asdict(entry) for entry in screening.kept],
        "left_out": [asdict(entry) for entry in screening.left_out],
        "left_out_bound_k": screening.bound_k,
        "left_out_bound_w": screening.bound_w,
        "left_out_note": screening.note,
        "assembled": dict(run.solution.assembled.counts),
        "newton_iterations": int(np.sum(run.solution.newton_iterations)),
        "linear_iterations": int(np.sum(run.solution.iterations)),
        "steps": 0 if isinstance(run.solution, SteadySolution) else run.solution.steps,
        "time_error_k": _time_error_k(run.solution),
        "seconds": dict(run.seconds),
    }


def prepared_folder(output_dir: Path) -> Path:
    """Make the folder, and raise `OutputError` for what is in the way before anything is computed."""
    folder = writable_folder(output_dir)
    names = (ANSWERS, SERIES, PAGE, THROUGH_TIME, STEADY, *PICTURES)
    series = folder / Path(THROUGH_TIME).stem
    refuse_what_is_in_the_way(folder, names, [series.name])
    steps = f"{series.name}/{STEP_PATTERN}"
    refuse_files_of_others(folder, (*names, steps), (ANSWERS, SERIES), ("summary.json", "quality.json"))
    remove_stale_temporaries(folder, names)
    remove_stale_temporaries(series, [STEP_PATTERN])
    return folder


def write_heat_files(folder: Path, options: HeatOptions, run: HeatRun, say: Say) -> None:
    """Write everything into the folder of `prepared_folder`, answers.json last, or raise `OutputError`."""
    answers = answers_of(options, run)
    summary_text(answers)  # raises if json cannot hold it
    shown, pictures = run.nodes, list[str]()
    remove_file(folder / ANSWERS)
    _write_series(folder / SERIES, run)  # first: it tells the next run that the rest is a heat run's, too
    for name in (PAGE, STEADY, *PICTURES):
        remove_file(folder / name)
    if isinstance(run.solution, SteadySolution):
        remove_heat_series(folder / THROUGH_TIME)
        write_vtu(folder / STEADY, shown.mesh, temperature_c=shown.states_c[-1])
    else:
        write_heat_series(folder / THROUGH_TIME, shown.mesh, run.solution)
    if options.pictures:
        pictures = draw_surface(folder, shown.mesh, shown.states_c, shown.times_s, run.problem.up)
    drawn = {name: (folder / name).read_bytes() for name in pictures}
    shown_in = STEADY if isinstance(run.solution, SteadySolution) else THROUGH_TIME
    files = [PAGE, ANSWERS, SERIES, shown_in, *pictures]
    write_page(folder / PAGE, heat_page(run, drawn, options.mesh.name, command_line(options), files))
    write_summary(folder / ANSWERS, answers)
    say(f"Written to {folder}: {', '.join(files)}")


def _time_error_k(solution: Solution) -> float | None:
    """Give the estimated error of the steps as their controller adds it up, [K]; None if there is none."""
    if isinstance(solution, SteadySolution) or not np.isfinite(solution.time_error_k):
        return None
    return solution.time_error_k


def command_line(options: HeatOptions) -> str:
    """Write the command as it is typed, without what is left at its default."""
    words = ["thermoxels", "heat", str(options.mesh)]
    for field in fields(options)[1:]:
        value = getattr(options, field.name)
        if value != field.default:
            parts = np.ravel(value).tolist() if isinstance(value, tuple) else [value]
            words += [f"--{field.name.replace('_', '-')}", *map(str, parts)]
    return shlex.join(words)


def _write_series(path: Path, run: HeatRun) -> None:
    """Temperatures at each time, and mean heat flows during the interval that ends there."""
    times, states = run.nodes.times_s, run.nodes.states_c
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
