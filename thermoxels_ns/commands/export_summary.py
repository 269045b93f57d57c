"""What summary.json says about an export."""

from __future__ import annotations

import platform
from dataclasses import asdict
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import numpy as np

from thermoxels_ns import __version__
from thermoxels_ns.mesh.boundary.tags import SUPPORT, support_of_facets
from thermoxels_ns.mesh.quality.checks import facet_areas
from thermoxels_ns.mesh.quality.tet_shapes import signed_volumes

if TYPE_CHECKING:
    from thermoxels_ns.data.scene_scale import SceneScale
    from thermoxels_ns.fem.problem import TimeSteps
    from thermoxels_ns.fem.solution import HeatSolution
    from thermoxels_ns.heat.materials import Material
    from thermoxels_ns.mesh.build import BuiltMesh
    from thermoxels_ns.mesh.quality.report import QualityReport
    from thermoxels_ns.mesh.solid.voxels import SolidCells, SolidSelection
    from thermoxels_ns.mesh.tetrahedra import TetMesh

NO_SCALE = (
    "The size of the scene is not known. Pass --metres-per-unit, the length in metres of one unit of the input poses "
    "(1 if they are in metres), or --known-distance."
)
"""What an export without a scale says."""

HEAT_SKIPPED = f"Heat step skipped: {NO_SCALE[0].lower()}{NO_SCALE[1:]}"  # The same, where the heat balance would be

ONLY_THE_SHELL = (
    "Space that no camera saw and that the mesh leaves empty, such as the inside of a building seen from outside with "
    "--interior hollow or --wall-thickness. The heat content is that of the mesh."
)
"""What the heat balance of a reconstruction leaves out."""

INNER_SIDE = (
    "The exact scene is filled, so the inner side of a shell or a wall counts as wrong surface in precision, fscore "
    "and mean distance; precision_seen and fscore_seen are those of the side that photographs show."
)
"""What to know of the figures beside the truth if the mesh is not filled: hollow, or a wall of a given thickness."""


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
    boundary = mesh.boundary
    assert boundary is not None
    area = facet_areas(mesh.points_m, mesh.facets)
    number = len(boundary.patch_names)
    total = np.bincount(boundary.patch, weights=area * boundary.area_factor, minlength=number)
    used = np.bincount(boundary.patch, minlength=number) > 0
    return {name: float(total[n]) for n, name in enumerate(boundary.patch_names) if used[n]}


def region_volumes(mesh: TetMesh) -> dict[str, float]:
    """Volume of each region that has a tetrahedron, [unit^3]."""
    total = np.bincount(mesh.region, weights=signed_volumes(mesh.points_m, mesh.tets), minlength=len(mesh.region_names))
    used = np.bincount(mesh.region, minlength=len(mesh.region_names)) > 0
    return {name: float(total[n]) for n, name in enumerate(mesh.region_names) if used[n]}


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
        "skipped_effects": [*solution.skipped_effects, ONLY_THE_SHELL],
    }


def versions() -> dict[str, str]:
    """Versions of what made the export."""
    packages = ("numpy", "scipy", "torch", "nerfstudio", "pyvista", "scikit-fem")
    return {"thermoxels": __version__, "python": platform.python_version()} | {name: version(name) for name in packages}
