"""From a trained field to the files of an export: mesh, heat series, pictures and summary.

Knows nothing of nerfstudio. Imports at the top are light; the mesher, the solver and pyvista load when they run.
"""

from __future__ import annotations

import platform
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import numpy.typing as npt

from thermoxels_ns import __version__
from thermoxels_ns.checks import (
    check_positive,
    remove_file,
    remove_stale_temporaries,
    writable_folder,
)
from thermoxels_ns.errors import MeshError, OutputError, ThermoxelsError, explain

if TYPE_CHECKING:
    from thermoxels_ns.fem.materials import Material
    from thermoxels_ns.fem.presets import HeatPreset
    from thermoxels_ns.fem.problem import TimeSteps
    from thermoxels_ns.fem.solution import HeatSolution
    from thermoxels_ns.mesh.build import MeshedCells
    from thermoxels_ns.mesh.quality import MeshQuality
    from thermoxels_ns.mesh.solid import SolidCells, SolidSelection
    from thermoxels_ns.mesh.tetrahedra import TetMesh
    from thermoxels_ns.snapshot import GridSnapshot

Say = Callable[[str], None]
Settings = TypeVar("Settings", "Material", "TimeSteps")

HEAT_SKIPPED = (
    "Heat step skipped: the size of the scene is not known. Pass --metres-per-unit, the length in metres of one unit "
    "of the input poses (1 if they are in metres)."
)
"""What an export without a scale says."""

ONLY_THE_SHELL = (
    "Space that no camera saw, such as the inside of a wall or of a building seen from outside: empty in the mesh. "
    "The heat content is that of the reconstructed shell, not of the whole building."
)
"""What the heat balance of a reconstruction leaves out."""

_MESH, _SUMMARY, _HEAT = "mesh.vtu", "summary.json", "heat.pvd"
_MESH_PICTURES = ("mesh.png", "mesh-measured.png")
_HEAT_PICTURE = "heat.png"


@dataclass
class ExportOptions:
    """Everything an export can be told."""

    voxel_optical_depth: float = 0.5
    """Voxels in which density times edge length is at least this are solid: at 0.5, light that crosses one loses 39 %.
    Lower it if walls have holes, raise it if empty space turns solid."""
    density_percentile: float | None = None
    """Voxels denser than this share of all voxels of the scene box are solid, [%], 0 to 100; the Thermoxels paper's
    way, where 90 keeps the densest tenth. Takes the place of the optical depth."""
    density_threshold: float | None = None
    """Voxels at least this dense are solid, [1 / world unit]. Takes the place of both."""
    close_gaps: int = 1
    """Fill gaps and pinholes up to twice this many voxels wide; thin walls are not continuous without it. 0: none."""
    smallest_body: float = 0.01
    """Drop bodies (voxels that touch, if only by corners) of less than this share of the largest; mostly floaters."""
    largest_component: bool = False
    """Keep only the largest body of voxels that touch by faces."""
    fill_cavities: bool = False
    """Make empty space solid where it has no way out through voxel faces. Off by default: a room is a cavity too."""
    metres_per_unit: float | None = None
    """Length of one unit of the input poses, [m]; 1 if the poses are in metres. Needed for heat: without it the mesh
    is written in units of the input and the heat step is skipped."""
    heat_preset: str = "concrete"
    """Material and time steps: the name of a preset, or the path of a yaml file like it."""
    steps: int | None = None
    """Number of time steps; the preset's by default (10 for concrete)."""
    step_seconds: float | None = None
    """Length of a time step, [s]; the preset's by default (60 for concrete)."""
    conductivity_w_mk: float | None = None
    """Thermal conductivity, [W / (m K)]; the preset's by default."""
    density_kg_m3: float | None = None
    """Mass density of the material, [kg / m3]; the preset's by default."""
    specific_heat_j_kgk: float | None = None
    """Specific heat capacity, [J / (kg K)]; the preset's by default."""
    pictures: bool = True
    """Write PNG pictures of the mesh coloured by temperature."""


@dataclass(frozen=True)
class Viewpoint:
    """How pictures look at the mesh, in the coordinates of the input poses."""

    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Direction that points up."""
    view_direction: tuple[float, float, float] | None = None
    """Direction from the camera to the mesh; None: obliquely from above."""


def check_options(options: ExportOptions) -> tuple[SolidSelection, HeatPreset]:
    """Check every option, so that a wrong one is refused before anything slow runs.

    Returns:
        Which voxels are solid, and the heat settings with the options' changes applied.

    Raises:
        ThermoxelsError: An option is out of range.
    """
    from thermoxels_ns.fem.presets import load_heat_preset
    from thermoxels_ns.mesh.solid import SolidSelection

    if options.metres_per_unit is not None:
        remedy = "Pass --metres-per-unit 1 if the input poses are in metres, or leave it out to skip heat."
        check_positive("metres_per_unit", options.metres_per_unit, remedy, MeshError)
    selection = SolidSelection(**{field.name: getattr(options, field.name) for field in fields(SolidSelection)})
    preset = load_heat_preset(options.heat_preset)
    material = _with_options(preset.material, options)
    if material != preset.material:
        material = replace(material, name=f"{material.name} (changed)")
    return selection, replace(preset, material=material, time=_with_options(preset.time, options))


def prepare_folder(output_dir: Path | str, *, heat: bool) -> Path:
    """Make the folder of an export, find out what is in the way, and remove what killed exports left half-written.

    Args:
        output_dir: The folder.
        heat: Whether the heat step will be written.

    Raises:
        OutputError: The folder cannot be written to, or a folder has the name of a file of the export.
    """
    from thermoxels_ns.fem.files import STEP_PATTERN

    folder = writable_folder(output_dir)
    names = (_MESH, *_MESH_PICTURES, _HEAT, _HEAT_PICTURE, _SUMMARY)
    series = folder / Path(_HEAT).stem
    blocked = [name for name in names if (folder / name).is_dir()]
    if heat and series.exists() and not series.is_dir():
        blocked.append(series.name)
    if blocked:
        raise OutputError(
            explain(
                "output folder",
                expected=f"no folder in the place of a file, and no file in the place of a folder, in {folder}",
                got=", ".join(blocked),
                remedy="Move it away, or choose another folder.",
            )
        )
    remove_stale_temporaries(folder, names)
    remove_stale_temporaries(series, [STEP_PATTERN])
    return folder


def export_snapshot(
    snapshot: GridSnapshot,
    world_to_input: npt.NDArray[np.float64],
    options: ExportOptions,
    output_dir: Path | str,
    say: Say = lambda _: None,
    viewpoint: Viewpoint = Viewpoint(),
    compare: Callable[[SolidCells, TetMesh], dict[str, Any] | None] | None = None,
) -> dict[str, Any]:
    """Write mesh.vtu, summary.json, and as asked mesh.png, heat.pvd, heat/*.vtu and heat.png.

    All of it is computed before anything is written. Then the summary of an earlier export goes first and the new one
    comes last, so the files in a folder with a summary.json belong together.

    Args:
        snapshot: The trained field.
        world_to_input: Takes homogeneous column vectors of the trained scene to the coordinates of the input poses,
            shape (4, 4). `options.metres_per_unit` takes those to metres.
        options: What to make.
        output_dir: Folder for the results; made if it does not exist. Files of an earlier export are replaced, or
            removed if this one does not make them.
        say: Called with one line of progress at a time.
        viewpoint: How pictures look at the mesh.
        compare: Compares solid voxels and mesh (in metres) with the truth of a scene that knows it; its answer goes
            into the summary under "truth", or its error if it raises a `ThermoxelsError`. Asked only if the scale is
            known.

    Returns:
        The summary that summary.json holds.

    Raises:
        ThermoxelsError: An option is out of range, nothing is solid, the folder cannot be written to, or heat fails.
    """
    from thermoxels_ns.export_pictures import draw_heat, draw_mesh
    from thermoxels_ns.fem.files import heat_series_paths, remove_heat_series, write_heat_series
    from thermoxels_ns.fem.problem import HeatProblem
    from thermoxels_ns.fem.stepping import solve_heat
    from thermoxels_ns.mesh.build import build_voxel_mesh
    from thermoxels_ns.mesh.files import summary_text, write_summary, write_vtu
    from thermoxels_ns.mesh.quality import check_mesh

    selection, preset = check_options(options)
    scaled = options.metres_per_unit is not None
    folder = prepare_folder(output_dir, heat=scaled)
    scale = np.diag([*[options.metres_per_unit or 1.0] * 3, 1.0])
    mesh, solid = build_voxel_mesh(snapshot, selection, scale @ world_to_input)
    quality = check_mesh(mesh)
    unit = "m" if scaled else "input unit"
    say(f"Mesh: {quality.num_tets} tetrahedra, {quality.num_nodes} nodes, volume {quality.volume_m3:.6g} {unit}^3")
    if solid.num_unobserved_parts:
        parts, voxels = solid.num_unobserved_parts, solid.num_unobserved_voxels
        say(f"Left out because no thermal ray saw them: {parts} parts of the mesh, {voxels} voxels in all.")

    solution = truth = None
    if scaled:
        time = preset.time
        say(f"Heat: {time.steps} steps of {time.step_seconds:g} s through {preset.material.name}")
        solution = solve_heat(HeatProblem(mesh, preset.material), time)
        say(f"Heat: {solution.status} Energy conserved to {solution.energy_residual:.1e}.")
        truth = None if compare is None else _compared(compare, solid, mesh, say)
    else:
        say(HEAT_SKIPPED)

    files = [_MESH]
    if solution is not None:
        files += [p.relative_to(folder).as_posix() for p in heat_series_paths(folder / _HEAT, len(solution.times_s))]
    if options.pictures:
        files += [*_MESH_PICTURES, *([] if solution is None else [_HEAT_PICTURE])]
    skipped = {"computed": False, "reason": HEAT_SKIPPED}
    summary = {
        "options": {field.name: getattr(options, field.name) for field in fields(options)},
        "versions": _versions(),
        "length_unit": unit,
        "mesh": _mesh_summary(mesh, solid, quality, selection),
        "heat": skipped if solution is None else _heat_summary(preset, solution),
        **({} if truth is None else {"truth": truth}),
        "files": [*files, _SUMMARY],
    }
    summary_text(summary)  # raises if json cannot hold it

    remove_file(folder / _SUMMARY)
    for name in {*_MESH_PICTURES, _HEAT_PICTURE} - set(files):
        remove_file(folder / name)
    if solution is None:
        remove_heat_series(folder / _HEAT)
    write_vtu(folder / _MESH, mesh)
    if solution is not None:
        write_heat_series(folder / _HEAT, mesh, solution)
    if options.pictures:
        look = {"up": viewpoint.up, "view_direction": viewpoint.view_direction}
        draw_mesh([folder / name for name in _MESH_PICTURES], mesh, look, unit)
        if solution is not None:
            draw_heat(folder / _HEAT_PICTURE, mesh, solution, look)
    write_summary(folder / _SUMMARY, summary)
    say(f"Written to {folder}: {', '.join(name for name in summary['files'] if '/' not in name)}")
    return summary


def _compared(
    compare: Callable[[SolidCells, TetMesh], dict[str, Any] | None], solid: SolidCells, mesh: TetMesh, say: Say
) -> dict[str, Any] | None:
    """Compare with the truth; a truth that cannot be used costs the comparison, not the export."""
    try:
        truth = compare(solid, mesh)
    except ThermoxelsError as problem:
        say(f"Not compared with the truth: {problem}")
        return {"error": str(problem)}
    if truth is not None:
        say("Against the truth: " + ", ".join(f"{name} {_short(value)}" for name, value in truth.items()))
    return truth


def _with_options(preset: Settings, options: ExportOptions) -> Settings:
    """Replace a preset's values by the options of the same name that were given."""
    given = {field.name: getattr(options, field.name, None) for field in fields(preset)}
    return replace(preset, **{name: value for name, value in given.items() if value is not None})


def _mesh_summary(mesh: TetMesh, solid: MeshedCells, quality: MeshQuality, selection: SolidSelection) -> dict[str, Any]:
    """Counts and sizes, lengths in the unit that the summary names."""
    temperature = mesh.temperature_c
    return {
        "nodes": quality.num_nodes,
        "tets": quality.num_tets,
        "voxels": int(np.count_nonzero(solid.cells)),
        "boundary_triangles": quality.num_facets,
        "boundary_triangles_on_box": quality.num_box_facets,
        "non_manifold_edges": quality.num_non_manifold_edges,
        "volume": quality.volume_m3,
        "area": quality.area_m2,
        "bounds": {"lower": mesh.points_m.min(axis=0), "upper": mesh.points_m.max(axis=0)},
        "dihedral_angles_deg": {"min": quality.min_dihedral_deg, "max": quality.max_dihedral_deg},
        "density_threshold_used": solid.threshold,
        **_percentile_summary(solid, selection),
        "component_sizes_voxels": solid.component_sizes,
        "voxels_closed": solid.num_closed,
        "voxels_removed": solid.num_removed,
        "parts_without_thermal_rays_left_out": solid.num_unobserved_parts,
        "voxels_without_thermal_rays_left_out": solid.num_unobserved_voxels,
        "share_of_nodes_observed": float(np.mean(mesh.observed)),
        "share_of_area_not_fully_observed": _share_of_area_unobserved(mesh),
        "temperature_c": {
            "min": float(temperature.min()),
            "max": float(temperature.max()),
            "mean_of_nodes": float(temperature.mean()),
        },
    }


def _percentile_summary(solid: MeshedCells, selection: SolidSelection) -> dict[str, float]:
    """What a percentile asked for and what it got before small bodies were dropped: voxels without density, such as
    pruned ones, are never solid.
    """
    if selection.density_percentile is None or selection.density_threshold is not None:
        return {}
    return {
        "share_of_voxels_asked_for": 1.0 - selection.density_percentile / 100.0,
        "share_of_voxels_kept": float(solid.component_sizes.sum()) / solid.cells.size,
    }


def _share_of_area_unobserved(mesh: TetMesh) -> float:
    """Share of the boundary's area whose triangles have a node that no thermal ray saw, 0 to 1."""
    corner = mesh.points_m[mesh.facets]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    return float(area[~mesh.observed[mesh.facets].all(axis=1)].sum() / area.sum())


def _heat_summary(preset: HeatPreset, solution: HeatSolution) -> dict[str, Any]:
    """The heat balance and how it was computed."""
    return {
        "computed": True,
        **preset.as_mapping(),
        "scheme": "P1 tetrahedra, lumped mass, backward Euler, conjugate gradients with Jacobi preconditioner",
        "energy_before_j": float(solution.heat_content_j[0]),
        "energy_after_j": float(solution.heat_content_j[-1]),
        "energy_residual": solution.energy_residual,
        "energy_residual_of_spread": solution.energy_residual_of_spread,
        "largest_net_heat_flow_w": float(np.abs(solution.heat_w).max()),
        "temperature_c": {
            name: {"min": float(state.min()), "max": float(state.max())}
            for name, state in (("before", solution.temperature_c[0]), ("after", solution.temperature_c[-1]))
        },
        "status": solution.status,
        "iterations": solution.iterations,
        "skipped_effects": [*solution.skipped_effects, ONLY_THE_SHELL],
    }


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _versions() -> dict[str, str]:
    packages = ("numpy", "scipy", "torch", "nerfstudio", "pyvista", "scikit-fem")
    return {"thermoxels": __version__, "python": platform.python_version()} | {name: version(name) for name in packages}
