"""From a trained field to the files of an export."""

from __future__ import annotations

# Imports at the top are light; the mesher, the solver and pyvista load when they run.
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from thermoxels_ns.commands.export_options import ExportOptions, Viewpoint, check_options, scale_of, up_of
from thermoxels_ns.core.checks import (
    refuse_files_of_others,
    refuse_what_is_in_the_way,
    remove_file,
    remove_stale_temporaries,
    writable_folder,
)
from thermoxels_ns.core.errors import ThermoxelsError

if TYPE_CHECKING:
    from thermoxels_ns.core.feature_rays import FeatureRays
    from thermoxels_ns.core.lattice import Lattice
    from thermoxels_ns.core.snapshot import GridSnapshot
    from thermoxels_ns.mesh.build import BuiltMesh
    from thermoxels_ns.mesh.solid.voxels import SolidCells
    from thermoxels_ns.mesh.tetrahedra import TetMesh
    from thermoxels_ns.multiview.stereo import Depths

Say = Callable[[str], None]

OBLIQUE = Viewpoint()  # Obliquely from above, z up

_SUMMARY, _HEAT, _QUALITY = "summary.json", "heat.pvd", "quality.json"
_MESH_STEM = "mesh"
_MESH_PICTURES = ("mesh.png", "mesh-measured.png", "quality.png", "region.png")
_HEAT_PICTURE = "heat.png"


def prepare_folder(output_dir: Path | str, *, heat: bool) -> Path:
    """Make the folder of an export, refuse what is in the way, and remove what killed exports left half-written."""
    from thermoxels_ns.heat.vtk_series import STEP_PATTERN
    from thermoxels_ns.mesh.files.formats import MESH_FORMATS

    folder = writable_folder(output_dir)
    names = (*_mesh_files(MESH_FORMATS), *_MESH_PICTURES, _HEAT, _HEAT_PICTURE, _QUALITY, _SUMMARY)
    series = folder / Path(_HEAT).stem
    refuse_what_is_in_the_way(folder, names, [series.name] if heat else [])
    steps = f"{series.name}/{STEP_PATTERN}"
    refuse_files_of_others(folder, (*names, steps), (_QUALITY, _SUMMARY), ("answers.json", "series.csv"))
    remove_stale_temporaries(folder, names)
    remove_stale_temporaries(series, [STEP_PATTERN])
    return folder


def export_snapshot(
    snapshot: GridSnapshot,
    world_to_input: npt.NDArray[np.float64],
    options: ExportOptions,
    output_dir: Path | str,
    say: Say = lambda _: None,
    viewpoint: Viewpoint = OBLIQUE,
    compare: Callable[[SolidCells, TetMesh, float], dict[str, Any] | None] | None = None,
    scene_file: Mapping[str, Any] | None = None,
    depths: Depths | None = None,
    tracks: FeatureRays | None = None,
    corrections: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Write the mesh in the formats asked for, quality.json, summary.json, and as asked pictures and the heat series.

    All of it is computed before anything is written. Then the summary of an earlier export goes first and the
    new one comes last, so the files in a folder with a summary.json belong together; what this export does not
    make is removed.

    `world_to_input`, shape (4, 4), takes the trained scene to the input poses; the up of `viewpoint` is the mesh's
    unless the scene's json has one. If the scale is known, `compare` compares solid voxels and mesh in metres (last:
    metres per unit) with a known truth; its `ThermoxelsError` goes into the summary. All other errors are raised.
    `depths` of photographs and `tracks`, lines from them to points that they see, say which boundary triangles are
    supported. `corrections` are what training corrected in photographs; they go into the summary.
    """
    from thermoxels_ns.commands.export_summary import HEAT_SKIPPED, heat_summary, mesh_summary, region_summary, versions
    from thermoxels_ns.fem.solution import HeatSolution
    from thermoxels_ns.heat.solving import Goals, solve_problem
    from thermoxels_ns.heat.vtk_series import heat_series_paths, remove_heat_series, write_heat_series
    from thermoxels_ns.mesh.boundary.tags import support_of_facets
    from thermoxels_ns.mesh.build import MeshOptions, build_mesh
    from thermoxels_ns.mesh.files.abaqus import HeatStep
    from thermoxels_ns.mesh.files.formats import MESH_FORMATS, check_format, write_mesh
    from thermoxels_ns.mesh.files.vtu import summary_text, write_summary
    from thermoxels_ns.mesh.quality.picture import picture_of_quality
    from thermoxels_ns.mesh.quality.report import check_mesh
    from thermoxels_ns.reports.mesh_pictures import add_support, draw_heat, draw_mesh, picture_of_mesh

    checked = check_options(options)
    scale = scale_of(options, checked, scene_file)
    metres = 1.0 if scale is None else scale.metres_per_unit
    up, up_source = up_of(options, scene_file, viewpoint)
    folder = prepare_folder(output_dir, heat=scale is not None)
    to_mesh = np.diag([metres, metres, metres, 1.0]) @ world_to_input
    mesh_options = MeshOptions(options.boundary, options.coarsest_cell, up=up, rules=checked.rules)
    built = build_mesh(snapshot, checked.selection, to_mesh, mesh_options, metres)
    if depths is not None:
        built = _with_support(built, depths, tracks, snapshot.lattice, to_mesh)
    mesh = built.mesh
    suffixes = [f".{name}" for name in options.formats]
    for suffix in suffixes:
        check_format(f"{_MESH_STEM}{suffix}", mesh)
    voxel_size = snapshot.lattice.voxel_size * float(np.cbrt(abs(np.linalg.det(to_mesh[:3, :3]))))
    unit = "input unit" if scale is None else "m"
    report = check_mesh(mesh, options.boundary, built.observed_range_c, length_unit=unit)
    say(f"Up: {', '.join(f'{value:.3g}' for value in up)}. {up_source}")
    region = region_summary(built, checked.selection)
    _tell(built, region, report.volume_m3, unit, None if scale is None else voxel_size, say)

    scene, material, time = checked.scene, checked.material, checked.time
    solution: HeatSolution | None = None
    truth = None
    if scale is not None:
        say(f"Heat: {time.steps} steps of {time.step_seconds:g} s through {material.name}")
        everything = Goals(leave_out_below_k=0.0, memory_gb=None)
        found = solve_problem(scene.problem(mesh, up=up), time, everything, say).solution
        assert isinstance(found, HeatSolution), "the scene has time steps"
        solution = found
        say(f"Heat: {solution.status} Energy conserved to {solution.energy_residual:.1e}.")
        inner_side = options.interior == "hollow" or options.wall_thickness is not None
        truth = None if compare is None else _compared(compare, built, metres, inner_side, say)
    else:
        say(HEAT_SKIPPED)

    files = [*_mesh_files(suffixes), _QUALITY]
    if solution is not None:
        files += [p.relative_to(folder).as_posix() for p in heat_series_paths(folder / _HEAT, len(solution.times_s))]
    if options.pictures:
        files += [*_MESH_PICTURES, *([] if solution is None else [_HEAT_PICTURE])]
    skipped = {"computed": False, "reason": HEAT_SKIPPED}
    summary = {
        "options": {field.name: getattr(options, field.name) for field in fields(options)},
        "versions": versions(),
        "length_unit": unit,
        "scale": None if scale is None else scale.as_mapping(),
        "up": up,
        "up_source": up_source,
        "region": region,
        "mesh": mesh_summary(built, report, checked.selection, scale, voxel_size),
        "heat": skipped if solution is None else heat_summary(material, time, solution),
        "corrections": dict(corrections or {}),
        **({} if truth is None else {"truth": truth}),
        "files": [*files, _SUMMARY],
    }
    summary_text(summary)  # raises if json cannot hold it

    remove_file(folder / _SUMMARY)
    write_summary(folder / _QUALITY, report.as_mapping())  # first: it tells the next export that the rest is one's, too
    for name in {*_mesh_files(MESH_FORMATS), *_MESH_PICTURES, _HEAT_PICTURE} - set(files):
        remove_file(folder / name)
    if solution is None:
        remove_heat_series(folder / _HEAT)
    heat_step = HeatStep(
        material.conductivity_w_mk, material.density_kg_m3, material.specific_heat_j_kgk, time.steps, time.step_seconds
    )
    for suffix in suffixes:
        write_mesh(folder / f"{_MESH_STEM}{suffix}", mesh, heat_step=heat_step, up=up)
    if solution is not None:
        write_heat_series(folder / _HEAT, mesh, solution)
    if options.pictures:
        look = {"up": up, "view_direction": viewpoint.view_direction}
        draw_mesh([folder / name for name in _MESH_PICTURES[:2]], mesh, look, unit)
        picture_of_quality(folder / _MESH_PICTURES[2], report)
        if support_of_facets(mesh) is not None:
            add_support(folder / _MESH_PICTURES[2], mesh, look)
        beside: Any = {"title": "Region", "length_unit": unit, **_left_out(built, snapshot.lattice, to_mesh)}
        picture_of_mesh(folder / _MESH_PICTURES[3], mesh, **beside, **look)
        if solution is not None:
            draw_heat(folder / _HEAT_PICTURE, mesh, solution, look)
    write_summary(folder / _SUMMARY, summary)
    say(f"Written to {folder}: {', '.join(name for name in summary['files'] if '/' not in name)}")
    return summary


def _mesh_files(suffixes: Iterable[str]) -> list[str]:
    """Names of the files that the mesh is written to in these formats."""
    from thermoxels_ns.mesh.files.formats import mesh_file_paths

    return [path.name for suffix in suffixes for path in mesh_file_paths(f"{_MESH_STEM}{suffix}")]


def volume_in_words(volume_m3: float) -> str:
    """Write a volume in cubic metres, below one in litres.

    >>> volume_in_words(13.49), volume_in_words(0.0461)
    ('13.5 m^3', '46.1 l')
    """
    if volume_m3 < 1.0:
        return f"{1e3 * volume_m3:.3g} l"
    return f"{volume_m3:.3g} m^3" if volume_m3 < 1e3 else f"{volume_m3:,.0f} m^3"


def _with_support(
    built: BuiltMesh,
    depths: Depths,
    tracks: FeatureRays | None,
    lattice: Lattice,
    to_mesh: npt.NDArray[np.float64],
) -> BuiltMesh:
    """Count for each boundary triangle the photographs that see it, and those that support it.

    See `facet_views` and `supporting_photographs`. `to_mesh` takes the trained scene to the mesh's coordinates.
    """
    from thermoxels_ns.mesh.boundary.visibility import facet_views
    from thermoxels_ns.mesh.build import apply_transform
    from thermoxels_ns.multiview.votes import supporting_photographs

    mesh = built.mesh
    assert mesh.boundary is not None
    middle = apply_transform(np.linalg.inv(to_mesh), mesh.points_m[mesh.facets].mean(axis=1))
    normal = mesh.boundary.normal @ to_mesh[:3, :3] / np.cbrt(abs(np.linalg.det(to_mesh[:3, :3])))
    photographs = depths.photographs
    cameras = photographs.matrices, photographs.centres, photographs.sizes
    views = facet_views(built.solid.cells, lattice, *cameras, middle, normal)
    found = supporting_photographs(depths, views.middle, views.seen, lattice.voxel_size, tracks)
    count = np.stack((views.seen.sum(axis=1), found.sum(axis=1)), axis=1)[views.group]
    return replace(built, mesh=replace(mesh, boundary=replace(mesh.boundary, photographs=count)))


def _left_out(built: BuiltMesh, lattice: Lattice, to_mesh: npt.NDArray[np.float64]) -> dict[str, Any]:
    """What the picture of the region shows in grey: the voxel faces around what is not exported."""
    from thermoxels_ns.mesh.build import apply_transform
    from thermoxels_ns.mesh.voxel_tets import used_corners, voxel_facets

    points = apply_transform(to_mesh, lattice.index_to_world(used_corners(built.solid.left_out)))
    note = "grey: left out of the region" if len(points) else "nothing is left out"
    return {"ghost": (points, voxel_facets(built.solid.left_out)), "note": note}


def _tell(
    built: BuiltMesh, region: Mapping[str, Any], volume: float, unit: str, voxel_size: float | None, say: Say
) -> None:
    """Say how the solid was found, step by step, and what the mesh has."""
    from thermoxels_ns.commands.export_summary import support_shares

    for step in built.solid.steps:
        amounts = []
        for sign, voxels in (("+", step.added), ("-", step.removed)):
            size = "" if voxel_size is None else f" ({volume_in_words(voxels * voxel_size**3)})"
            if voxels:
                amounts.append(f"{sign}{voxels} voxels{size}")
        changed = ", ".join(amounts) or "nothing changed"
        if step.name == "region":
            size = " x ".join(f"{side:.3g}" for side in region["size"])
            share, name = region["share_of_solid_taken"], region["asked_for"]
            say(f"Region, {name}: {size} {unit}, {share:.1%} of the solid; {changed}. {step.remark}")
        else:
            say(f"Solid, {step.name}: {changed}. {step.remark}")
    mesh = built.mesh
    say(f"Mesh: {len(mesh.tets)} tetrahedra, {len(mesh.points_m)} nodes, volume {volume:.6g} {unit}^3")
    if built.unobserved_parts:
        say(
            f"Left out because no thermal ray saw them: {built.unobserved_parts} parts of the mesh, "
            f"{built.unobserved_voxels} voxels in all."
        )
    shares = support_shares(mesh)
    if shares is not None:
        supported, weak, smooth, filled = shares.values()
        say(
            f"{supported:.0%} of the surface is supported by three photographs or more, {weak:.0%} by one or two; "
            f"{smooth:.0%} is seen, but placed by smoothness alone; {filled:.0%} is seen by no photograph."
        )
    for rule in built.idle_rules:
        say(
            f"Rule without effect: {rule}. Nothing in the mesh meets its conditions, or later rules take all that does."
        )


def _compared(
    compare: Callable[[SolidCells, TetMesh, float], dict[str, Any] | None],
    built: BuiltMesh,
    metres: float,
    inner_side: bool,
    say: Say,
) -> dict[str, Any] | None:
    """Compare with the truth; a truth that cannot be used costs the comparison, not the export.

    A mesh with an inner side, of a shell or of a wall, gets a note on what that does to the figures.
    """
    from thermoxels_ns.commands.export_summary import INNER_SIDE

    try:
        truth = compare(built.solid, built.mesh, metres)
    except ThermoxelsError as problem:
        say(f"Not compared with the truth: {problem}")
        return {"error": str(problem)}
    if truth is None:
        return None
    say("Against the truth: " + ", ".join(f"{name} {_short(value)}" for name, value in truth.items()))
    if not inner_side:
        return truth
    say(INNER_SIDE)
    return {**truth, "note": INNER_SIDE}


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
