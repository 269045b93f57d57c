"""The command ``thermoxels heat``: compute the heat flow through an exported mesh in a heat scene."""

from __future__ import annotations

# Only light imports at the top, so that --help answers at once.
import csv
import math
import time as clock
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import tyro
from threadpoolctl import threadpool_limits

from thermoxels_ns.commands.installed_commands import command_of
from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.checks import remove_file, replace_when_done, result_folder, writable_folder
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.core.json_values import plain_values, read_json_object, write_json

if TYPE_CHECKING:
    from thermoxels_ns.fem.solution import HeatSolution
    from thermoxels_ns.heat.run import HeatRun
    from thermoxels_ns.mesh.tetrahedra import TetMesh

ANSWERS, SERIES, PAGE, THROUGH_TIME, STEADY = "answers.json", "series.csv", "report.html", "heat.pvd", "heat.vtu"
"""Files that a run writes beside its pictures."""
STEP_PATTERN = "step-*.vtu"  # Names of the files of a series
EXAMPLE = "scene-all-effects.yaml"

Say = Callable[[str], None]


@dataclass
class Heat:
    """Let heat flow through an exported mesh: heat losses, U-values, cold spots, temperatures over time, a report.

    Writes report.html (open it first), answers.json, series.csv, temperatures for ParaView (heat.pvd through time,
    heat.vtu of a steady state) and pictures."""

    mesh: tyro.conf.Positional[Path | None] = None
    """The mesh.vtu of an export with a known scale; its mesh-boundary.vtp must lie in the same folder."""
    scene: str | None = None
    """Heat scene: the path of a yaml file, or the NAME of a configs/scene-NAME.yaml, such as winter-night."""
    output_dir: Path = Path("heat")
    """Folder for the results; made if it does not exist. Results of an earlier run in the folder are replaced."""
    probes: tuple[tuple[float, float, float], ...] = ()
    """Points whose temperature is reported, x y z in the coordinates of the mesh, one after the other, [m]."""
    tolerance: float | None = None
    """Largest error that any temperature may have, [K], such as 0.05. Linear or quadratic tetrahedra, the mesh size and
    the time steps are then chosen so that the estimated error stays below; of the scene's time settings only the
    duration and the times at which temperatures are kept remain. The error is that of solving the heat equation in the
    body as the mesh describes it. Left out: the mesh and the scene's time steps are used as they are; the error of a
    steady state is estimated all the same."""
    flow_tolerance: float | None = None
    """Largest error that the mean heat flow of any effect may have, as a share of all heat that flows through the body,
    such as 0.01."""
    memory_gb: float = 4.0
    """Most memory that solving may take, [GiB]. A computation that needs more is refused before it starts."""
    allow_unmet: bool = False
    """If a tolerance cannot be met within the memory, write the best result that fits, marked as such, instead of an
    error. The first estimate needs memory for quadratic tetrahedra; over time, for a mesh of half the size."""
    leave_out_below: float | None = None
    """Effects that together bring less than this share of all heat that flows are left out; the report lists each with
    its watts at the solution. With 0, and with a tolerance, all effects that bring heat are used. Left out: 0.005, half
    the accuracy that building physics asks of a heat flow."""
    engine: Literal["own", "dolfinx"] = "own"
    """What solves: own, or dolfinx: DOLFINx and PETSc in processes of their own, for meshes of many million tetrahedra
    (docs/heat.md says how to get it). It solves steady states and equal time steps, without a tolerance."""
    ranks: int = 1
    """Number of processes of the engine dolfinx, which mpirun starts; each holds a part of the mesh."""
    up: tuple[float, float, float] | None = None
    """Direction that points up in the coordinates of the mesh, if the scene has none. Default: the direction in the
    summary.json beside the mesh, or else z."""
    vtk_times: Literal["all"] | tuple[float, ...] = ()
    """Times whose temperatures are written for ParaView beside those of the start and of the end, [s]: for each the
    nearest time that the scene keeps. all: every kept time; each takes as much space as the mesh."""
    pictures: bool = True
    """Draw pictures of the surface."""
    write_scene: Path | None = None
    """Write an example of a scene that explains every key to this file, and do nothing else."""
    from_audit: Path | None = None
    """The answers.json of ``thermoxels audit`` on a mesh with the same patches: a layer outside each patch then makes
    up for what the wall of the mesh lacks of the resistance that the audit found. The mesh needs rooms (--interior
    hollow), and the scene no more than the two airs, as in winter-night."""

    def main(self) -> None:
        """Run; raises `ThermoxelsError` if the mesh, the scene or an option cannot be used, or the solver fails."""
        from thermoxels_ns.core.yaml_records import write_example

        if self.write_scene is not None:
            write_example(self.write_scene, EXAMPLE, HeatError)
            print(f"Written to {self.write_scene}: keep what your scene has, and pass it with --scene.")
            return
        # With more BLAS threads, the last bits of results would depend on the number of threads.
        with threadpool_limits(1, "blas"):
            run_heat(self, partial(print, flush=True))


def run_heat(options: Heat, say: Say = lambda _: None) -> HeatRun:
    """Compute a heat run, write its files, and return it; answers.json is written last, as it marks complete files."""
    from thermoxels_ns.reports.mesh_pictures import HEAT_PICTURES

    names, series = (ANSWERS, SERIES, PAGE, THROUGH_TIME, STEADY), f"{Path(THROUGH_TIME).stem}/{STEP_PATTERN}"
    folder = result_folder(options.output_dir, (*names, *HEAT_PICTURES, series), SERIES)
    run = compute_heat(options, say)
    write_heat_files(folder, options, run, say)
    return run


def compute_heat(options: Heat, say: Say = lambda _: None) -> HeatRun:
    """Read mesh and scene, compute the heat run and return it without writing files; errors: see `Heat.main`."""
    from thermoxels_ns.heat.dolfinx_engine import DolfinxEngine
    from thermoxels_ns.heat.run import run_scene
    from thermoxels_ns.heat.scene import load_heat_scene
    from thermoxels_ns.heat.solving import Goals
    from thermoxels_ns.mesh.files.vtu import read_export_summary, read_mesh

    begin = clock.perf_counter()
    engine = None
    if options.engine == "dolfinx":
        engine = DolfinxEngine(options.ranks, say)
        _ = engine.command  # raises before anything slow
    elif options.ranks != 1:
        raise HeatError("ranks", expected="--engine dolfinx beside it", got="none", remedy="Pass both, or neither.")
    if options.mesh is None or options.scene is None:
        missing = "mesh" if options.mesh is None else "scene"
        remedy = "Pass the mesh.vtu of an export, and --scene winter-night; --write-scene writes one to change."
        raise HeatError(missing, expected="a file", got="none", remedy=remedy)
    behind = None if options.from_audit is None else resistances_of_audit(options.from_audit, say)
    scene = load_heat_scene(options.scene)
    goals = Goals(
        tolerance_k=options.tolerance,
        flow_tolerance=options.flow_tolerance,
        leave_out_below=options.leave_out_below,
        memory_gb=options.memory_gb,
        allow_unmet=options.allow_unmet,
    )
    mesh = read_mesh(options.mesh)
    export = read_export_summary(options.mesh, say)
    up = export.get("up") if options.up is None else options.up
    say(f"Mesh: {len(mesh.tets):,} tetrahedra, {len(mesh.points_m):,} nodes.")
    say(f"Scene: {scene.description or options.scene}.")
    read_s = clock.perf_counter() - begin
    run = run_scene(
        scene, mesh, goals, up=up, probes_m=options.probes, export=export, behind_m2k_w=behind, say=say, engine=engine
    )
    return replace(run, seconds={"read": read_s, **run.seconds})


def resistances_of_audit(path: Path, say: Say = lambda _: None) -> dict[str, float]:
    """Return the resistance from the air inside to the outer surface by patch, [m2 K / W], from an answers.json.

    R = (Ti - Ts) A / Q with the temperatures Ti of the air inside and Ts of the surface, the area A and the heat flow Q
    that the audit found. The film outside is no part of R, as the scene has one. A patch whose interval of Q reaches
    down to 0 is left out. Raises `HeatError` for other files, for audits from inside, and if no patch is left.
    """
    content, remedy = read_json_object(path, "Pass the answers.json of thermoxels audit.", HeatError), "Audit again."
    try:
        side, inside_c = content["conditions"]["side"], float(content["conditions"]["inside"]["air"]["value"])
        loss = {one["name"]: (one["area_m2"], one["surface_c"]["value"], one["loss_w"]) for one in content["patches"]}
        clear = {name: one for name, one in loss.items() if one[2]["low"] > 0.0}
        found = {name: (inside_c - c) * area / float(w["value"]) for name, (area, c, w) in clear.items()}
    except (KeyError, TypeError, ValueError) as problem:
        raise HeatError(str(path), expected="the answers of an audit", got=f"no {problem}", remedy=remedy) from problem
    if side != "outside" or not clear:
        got = f"one from {side}" if clear else "no heat flow that is more than a bound"
        remedy = "Give the scene's materials yourself."
        raise HeatError(str(path), expected="an audit from outside that found heat flows", got=got, remedy=remedy)
    unclear = sorted(set(loss) - set(clear))
    if unclear:
        say(f"Warning: of {', '.join(unclear)} the audit knows no more than an upper bound; they get no layer.")
    return found


def answers_of(options: Heat, run: HeatRun) -> dict[str, Any]:
    """Return the content of answers.json for a heat run."""
    solution, accuracy = run.solution, run.accuracy
    error, time_error_k = getattr(solution, "error", None), getattr(solution, "time_error_k", math.nan)
    return {
        "mesh": options.mesh,
        "scene": options.scene,
        "description": run.scene.description,
        "steady": run.scene.steady,
        "warnings": list(run.warnings),
        "accuracy": None
        if accuracy is None
        else {
            "tolerance_k": accuracy.goals.tolerance_k,
            "flow_tolerance": accuracy.goals.flow_tolerance,
            "met": accuracy.met,
            "estimated_k": accuracy.settings.error.temperature_k,
            "estimated_flow": accuracy.settings.error.heat_flow,
            "order": accuracy.settings.order,
            "refinements": accuracy.settings.refinements,
            "step_tolerance_k": accuracy.settings.step_tolerance_k,
            "seconds": accuracy.seconds,
            "status": accuracy.status,
            "levels": [asdict(level) for level in accuracy.levels],
        },
        "mesh_error": None if error is None else asdict(error),
        "solved": {
            "tets": len(run.solved.mesh.tets),
            "nodes": len(run.solved.mesh.points_m),
            "unknowns": run.nodes.states_c.shape[1],
        },
        **asdict(run.results),
        "wall": None if run.wall is None else asdict(run.wall),
        "no_wall": run.no_wall,
        "unfit": list(run.unfit),
        "layers": [asdict(one) for one in run.layers],
        "probes": [{"point_m": point, "temperature_c": values} for point, values in zip(run.probes_m, run.probes_c.T)],
        "built": [heat.effect for heat in solution.effects],
        "left_out": [asdict(entry) for entry in run.left_out],
        "newton_iterations": int(np.sum(solution.newton_iterations)),
        "linear_iterations": int(np.sum(solution.iterations)),
        "steps": getattr(solution, "steps", 0),
        "time_error_k": time_error_k if math.isfinite(time_error_k) else None,
        "seconds": dict(run.seconds),
    }


def write_heat_files(folder: Path, options: Heat, run: HeatRun, say: Say) -> None:
    """Write all files of a run into an existing folder, answers.json last; raises `OutputError` if that fails."""
    from thermoxels_ns.fem.solution import SteadySolution
    from thermoxels_ns.mesh.files.vtu import body_grid, write_vtk
    from thermoxels_ns.reports.heat_page import heat_page
    from thermoxels_ns.reports.mesh_pictures import HEAT_PICTURES, draw_surface
    from thermoxels_ns.reports.page import identify, write_page

    answers = plain_values(answers_of(options, run), "answers", HeatError)  # raises if json cannot hold the answers
    shown, pictures = run.nodes, HEAT_PICTURES if options.pictures else ()
    remove_file(folder / ANSWERS)
    _write_series(folder / SERIES, run)  # first: marks the folder as a heat run's for `result_folder`
    for name in (PAGE, STEADY, *HEAT_PICTURES):
        remove_file(folder / name)
    if isinstance(run.solution, SteadySolution):
        remove_heat_series(folder / THROUGH_TIME)
        write_vtk(folder / STEADY, body_grid(replace(shown.mesh, temperature_c=shown.states_c[-1])))
    else:
        states = shown_states(run.solution.times_s, options.vtk_times)
        write_heat_series(folder / THROUGH_TIME, shown.mesh, run.solution, states)
    if options.pictures:
        draw_surface(folder, shown.mesh, shown.states_c, shown.times_s, run.problem.up)
    drawn = {name: (folder / name).read_bytes() for name in pictures}
    shown_in = STEADY if isinstance(run.solution, SteadySolution) else THROUGH_TIME
    files = [PAGE, ANSWERS, SERIES, shown_in, *pictures]
    mesh, scene = options.mesh, options.scene
    assert mesh is not None and scene is not None
    inputs = [mesh, mesh.with_name(f"{mesh.stem}-boundary.vtp"), Path(scene), *filter(None, [options.from_audit])]
    goals = options.tolerance, options.flow_tolerance, options.leave_out_below, options.memory_gb, options.allow_unmet
    report = identify(inputs, scene, options.probes, options.up, options.engine, *goals)
    write_page(folder / PAGE, heat_page(run, drawn, mesh.name, command_of("heat", options), files, report))
    write_json(folder / ANSWERS, answers)
    say(f"Written to {folder}: {', '.join(files)}")


def _write_series(path: Path, run: HeatRun) -> None:
    """Write a csv file with a line for each time: temperatures, and mean heat flows since the time before it."""
    lines = run.tables()["times"]
    with replace_when_done(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(lines[0])
        writer.writerows(["" if value is None else repr(value) for value in line.values()] for line in lines)


def shown_states(times_s: FloatArray, wanted_s: Literal["all"] | tuple[float, ...]) -> list[int]:
    """Return places in `times_s` of the times to write: the first, the last, and the nearest to each of `wanted_s`.

    >>> shown_states(np.array([0.0, 60.0, 120.0, 180.0]), (70.0,))
    [0, 1, 3]
    """
    near = times_s if wanted_s == "all" else (times_s[0], *wanted_s, times_s[-1])
    return np.unique([np.abs(times_s - time_s).argmin() for time_s in near]).tolist()


def write_heat_series(pvd: Path, mesh: TetMesh, solution: HeatSolution, states: list[int]) -> None:
    """Write ``NAME.pvd`` and ``NAME/step-0000.vtu`` and so on, which ParaView and pyvista open as one series.

    `pvd` is the path of ``NAME.pvd``, which is written last, so that all files it lists exist; `states` are places in
    `solution.times_s`. An earlier series is deleted first. Raises `OutputError` if writing fails.
    """
    from xml.etree import ElementTree

    from thermoxels_ns.mesh.files.vtu import body_grid, write_vtk

    remove_heat_series(pvd)
    folder = writable_folder(pvd.with_suffix(""))
    root = ElementTree.Element("VTKFile", type="Collection", version="0.1", byte_order="LittleEndian")
    collection = ElementTree.SubElement(root, "Collection")
    for number, state in enumerate(states):
        path, time_s = folder / f"step-{number:04d}.vtu", float(solution.times_s[state])
        write_vtk(path, body_grid(replace(mesh, temperature_c=solution.temperature_c[state])))
        name = path.relative_to(pvd.parent).as_posix()
        ElementTree.SubElement(collection, "DataSet", timestep=repr(time_s), part="0", file=name)
    ElementTree.indent(root)
    with replace_when_done(pvd) as temporary:
        ElementTree.ElementTree(root).write(temporary, encoding="utf-8", xml_declaration=True)


def remove_heat_series(pvd: Path) -> None:
    """Delete a series that `write_heat_series` wrote, if there is one; `OutputError` if a file cannot be deleted."""
    folder = pvd.with_suffix("")
    for path in (pvd, *folder.glob(STEP_PATTERN)):
        remove_file(path)
    with suppress(OSError):  # it holds files of others, or there is none
        folder.rmdir()
