"""From a trained field to the files of an export, and what its summary.json says."""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, fields, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from thermoxels_ns import __version__
from thermoxels_ns.commands.export_options import ExportOptions, Viewpoint, check_options, scale_of, up_of
from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.core.checks import remove_file, result_folder
from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.core.feature_rays import FeatureRays
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import GridSnapshot
from thermoxels_ns.data.scene_scale import SceneScale
from thermoxels_ns.fem.problem import TimeSteps
from thermoxels_ns.fem.solution import HeatSolution
from thermoxels_ns.heat.materials import Material
from thermoxels_ns.heat.solving import Goals, solve_problem
from thermoxels_ns.heat.vtk_series import STEP_PATTERN, heat_series_paths, remove_heat_series, write_heat_series
from thermoxels_ns.mesh.boundary.visibility import facet_views
from thermoxels_ns.mesh.build import BuiltMesh, MeshOptions, apply_transform, build_mesh
from thermoxels_ns.mesh.files.abaqus import HeatStep
from thermoxels_ns.mesh.files.formats import MESH_FORMATS, check_format, mesh_file_paths, write_mesh
from thermoxels_ns.mesh.files.vtu import summary_text, write_summary
from thermoxels_ns.mesh.quality.checks import facet_areas
from thermoxels_ns.mesh.quality.picture import picture_of_quality
from thermoxels_ns.mesh.quality.report import QualityReport, check_mesh
from thermoxels_ns.mesh.quality.tet_shapes import signed_volumes
from thermoxels_ns.mesh.solid.voxels import SolidCells, SolidSelection
from thermoxels_ns.mesh.tetrahedra import SUPPORT, TetMesh, support_of_facets
from thermoxels_ns.mesh.voxel_tets import used_corners, voxel_facets
from thermoxels_ns.multiview.stereo import Depths
from thermoxels_ns.multiview.votes import supporting_photographs
from thermoxels_ns.reports import mesh_pictures

Say = Callable[[str], None]

OBLIQUE = Viewpoint()  # Obliquely from above, z up

_SUMMARY, _HEAT, _QUALITY = "summary.json", "heat.pvd", "quality.json"
_MESH_STEM = "mesh"
_MESH_PICTURES = ("mesh.png", "mesh-measured.png", "quality.png", "region.png")
_HEAT_PICTURE = "heat.png"


NO_SCALE = (
    "The size of the scene is not known. Pass --metres-per-unit, the length in metres of one unit of the input poses "
    "(1 if they are in metres), or --known-distance."
)
"""What an export without a scale says."""

HEAT_SKIPPED = f"Heat step skipped: {NO_SCALE[0].lower()}{NO_SCALE[1:]}"  # The same, where the heat balance would be

SKIPPED_EFFECTS = (
    "Convection: not modelled, the boundary is insulated.",
    "Thermal radiation: not modelled, the boundary is insulated.",
    "Solar gain and internal sources: not modelled.",
    "Space that no camera saw and that the mesh leaves empty, such as the inside of a building seen from outside with "
    "--interior hollow or --wall-thickness. The heat content is that of the mesh.",
)
"""What the heat balance of a reconstruction leaves out."""

INNER_SIDE = (
    "The exact scene is filled, so the inner side of a shell or a wall counts as wrong surface in precision, fscore "
    "and mean distance; precision_seen and fscore_seen are those of the side that photographs show."
)
"""What to know of the figures beside the truth if the mesh is not filled: hollow, or a wall of a given thickness."""


def prepare_folder(output_dir: Path | str) -> Path:
    """Make the folder of an export, refuse what is in the way, and remove what killed exports left half-written."""
    names = (*_mesh_files(MESH_FORMATS), *_MESH_PICTURES, _HEAT, _HEAT_PICTURE, _QUALITY, _SUMMARY)
    others = ("answers.json", "series.csv")
    return result_folder(output_dir, names, (_QUALITY, _SUMMARY), others, f"{Path(_HEAT).stem}/{STEP_PATTERN}")


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
    checked = check_options(options)
    scale = scale_of(options, checked, scene_file)
    metres = 1.0 if scale is None else scale.metres_per_unit
    up, up_source = up_of(options, scene_file, viewpoint)
    folder = prepare_folder(output_dir)
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
        everything = Goals(leave_out_below=0.0, memory_gb=None)
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
        mesh_pictures.draw_mesh([folder / name for name in _MESH_PICTURES[:2]], mesh, look, unit)
        picture_of_quality(folder / _MESH_PICTURES[2], report)
        if support_of_facets(mesh) is not None:
            mesh_pictures.add_support(folder / _MESH_PICTURES[2], mesh, look)
        beside: Any = {"title": "Region", "length_unit": unit, **_left_out(built, snapshot.lattice, to_mesh)}
        mesh_pictures.picture_of_mesh(folder / _MESH_PICTURES[3], mesh, **beside, **look)
        if solution is not None:
            mesh_pictures.draw_heat(folder / _HEAT_PICTURE, mesh, solution, look)
    write_summary(folder / _SUMMARY, summary)
    say(f"Written to {folder}: {', '.join(name for name in summary['files'] if '/' not in name)}")
    return summary


def _mesh_files(suffixes: Iterable[str]) -> list[str]:
    """Names of the files that the mesh is written to in these formats."""
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
    points = apply_transform(to_mesh, lattice.index_to_world(used_corners(built.solid.left_out)))
    note = "grey: left out of the region" if len(points) else "nothing is left out"
    return {"ghost": (points, voxel_facets(built.solid.left_out)), "note": note}


def _tell(
    built: BuiltMesh, region: Mapping[str, Any], volume: float, unit: str, voxel_size: float | None, say: Say
) -> None:
    """Say how the solid was found, step by step, and what the mesh has."""
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


def mesh_summary(
    built: BuiltMesh, report: QualityReport, selection: SolidSelection, scale: SceneScale | None, voxel_size: float
) -> dict[str, Any]:
    """Counts, sizes, and how the solid was found; lengths, and the voxel size, in the unit that the summary names."""
    mesh, solid = built.mesh, built.solid
    temperature = mesh.temperature_c
    area = report.area_m2 if report.true_area_m2 is None else report.true_area_m2
    return {
        "boundary": report.boundary_mode,
        "nodes": report.num_nodes,
        "tets": report.num_tets,
        "voxels": int(np.count_nonzero(solid.cells)),
        "boundary_triangles": report.num_facets,
        "boundary_triangles_on_box": report.num_box_facets,
        "non_manifold_edges": report.num_non_manifold_edges,
        "volume": report.volume_m3,
        "volume_standard_error": None if scale is None else scale.volume_standard_error(report.volume_m3),
        "area": area,
        "area_standard_error": None if scale is None else scale.area_standard_error(area),
        "area_of_triangles": report.area_m2,
        "bounds": {"lower": mesh.points_m.min(axis=0), "upper": mesh.points_m.max(axis=0)},
        "dihedral_angles_deg": {"min": report.dihedral_range_deg[0], "max": report.dihedral_range_deg[1]},
        "density_threshold_used": solid.threshold,
        "density_threshold_why": solid.explanation,
        **_percentile_summary(solid, selection),
        "solid_steps": [
            {
                "step": step.name,
                "voxels_added": step.added,
                "voxels_removed": step.removed,
                **(
                    {}
                    if scale is None
                    else {
                        "litres_added": 1e3 * step.added * voxel_size**3,
                        "litres_removed": 1e3 * step.removed * voxel_size**3,
                    }
                ),
                "remark": step.remark,
            }
            for step in solid.steps
        ],
        "component_sizes_voxels": solid.component_sizes,
        "parts_without_thermal_rays_left_out": built.unobserved_parts,
        "voxels_without_thermal_rays_left_out": built.unobserved_voxels,
        "share_of_nodes_observed": float(np.mean(mesh.observed)),
        "share_of_area_not_fully_observed": _share_of_area_unobserved(mesh),
        "share_of_area_by_support": support_shares(mesh),
        "rules_without_effect": built.idle_rules,
        "patches": patch_areas(mesh),
        "regions": region_volumes(mesh),
        "temperature_c": {
            "min": float(temperature.min()),
            "max": float(temperature.max()),
            "mean_of_nodes": float(temperature.mean()),
        },
        "promises": {criterion.name: criterion.kept for criterion in report.criteria},
    }


def region_summary(built: BuiltMesh, selection: SolidSelection) -> dict[str, Any]:
    """Which part is exported, how large the mesh is [unit], and what share of the solid it was made from."""
    near, box, points = selection.region_near, selection.region_box, built.mesh.points_m
    left_out, found = int(built.solid.left_out.sum()), _voxels_found(built.solid)
    return {
        "asked_for": "near a point" if near else "a box" if box else selection.region,
        "size": points.max(axis=0) - points.min(axis=0),
        "voxels_taken": found - left_out,
        "voxels_left_out": left_out,
        "share_of_solid_taken": 1.0 - left_out / found,
    }


def _voxels_found(solid: SolidCells) -> int:
    """Voxels that are solid in the whole lattice, before anything is left out or filled."""
    return sum(step.added for step in solid.steps if step.name in ("threshold", "close gaps"))


def patch_areas(mesh: TetMesh) -> dict[str, float]:
    """True area of each patch that has a triangle, [unit^2]."""
    assert mesh.boundary is not None
    area = facet_areas(mesh.points_m, mesh.facets) * mesh.boundary.area_factor
    return _sums(mesh.boundary.patch_names, mesh.boundary.patch, area)


def region_volumes(mesh: TetMesh) -> dict[str, float]:
    """Volume of each region that has a tetrahedron, [unit^3]."""
    return _sums(mesh.region_names, mesh.region, signed_volumes(mesh.points_m, mesh.tets))


def _sums(names: tuple[str, ...], number: IntArray, amount: FloatArray) -> dict[str, float]:
    """The sum of the amounts of each number, by its name; without those that no amount has."""
    total = np.bincount(number, weights=amount, minlength=len(names))
    return {names[n]: float(total[n]) for n in np.unique(number)}


def support_shares(mesh: TetMesh) -> dict[str, float] | None:
    """Share of the true area, without what the scene box cuts, in each class of `SUPPORT`; None if not known."""
    support = support_of_facets(mesh)
    if support is None or not (support >= 0).any():
        return None
    assert mesh.boundary is not None
    area = facet_areas(mesh.points_m, mesh.facets) * mesh.boundary.area_factor
    total = np.bincount(support + 1, weights=area, minlength=len(SUPPORT) + 1)[1:]
    return dict(zip(SUPPORT, (total / total.sum()).tolist()))


def _percentile_summary(solid: SolidCells, selection: SolidSelection) -> dict[str, float]:
    """What a percentile asked for, and got before a region was chosen (what has no density never counts)."""
    if selection.density_percentile is None or selection.density_threshold is not None:
        return {}
    return {
        "share_of_voxels_asked_for": 1.0 - selection.density_percentile / 100.0,
        "share_of_voxels_kept": _voxels_found(solid) / solid.cells.size,
    }


def _share_of_area_unobserved(mesh: TetMesh) -> float:
    """Share of the boundary's area whose triangles have a node that no thermal ray saw, 0 to 1."""
    area = facet_areas(mesh.points_m, mesh.facets)
    return float(area[~mesh.observed[mesh.facets].all(axis=1)].sum() / area.sum())


def heat_summary(material: Material, time: TimeSteps, solution: HeatSolution) -> dict[str, Any]:
    """The heat balance and how it was computed."""
    return {
        "computed": True,
        "material": asdict(material),
        "time": asdict(time),
        "scheme": "P1 tetrahedra, lumped mass, backward Euler, conjugate gradients",
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
        "skipped_effects": list(SKIPPED_EFFECTS),
    }


def versions() -> dict[str, str]:
    """Versions of what made the export."""
    packages = ("numpy", "scipy", "torch", "nerfstudio", "pyvista", "scikit-fem")
    return {"thermoxels": __version__, "python": platform.python_version()} | {name: version(name) for name in packages}
