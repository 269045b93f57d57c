"""Describe the mesh of an export, in lines of progress and in the parts of summary.json."""

from __future__ import annotations

import platform
from collections.abc import Iterator, Mapping
from importlib.metadata import version
from typing import Any

import numpy as np

from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.core.version import __version__
from thermoxels_ns.data.scene_scale import SceneScale
from thermoxels_ns.mesh.build import BuiltMesh
from thermoxels_ns.mesh.quality.checks import MeshFigures
from thermoxels_ns.mesh.quality.tet_shapes import signed_volumes
from thermoxels_ns.mesh.tetrahedra import SUPPORT, TetMesh, facet_areas, support_of_facets


def lines_on_mesh(
    built: BuiltMesh, region: Mapping[str, Any], volume: float, unit: str, voxel_size: float
) -> Iterator[str]:
    """Yield lines on each step to the solid, and on the mesh; `region` is `region_summary`, lengths are in `unit`."""
    for step in built.solid.steps:
        amounts = []
        for sign, voxels in (("+", step.added), ("-", step.removed)):
            volume_m3 = voxels * voxel_size**3
            told = f"{1e3 * volume_m3:.3g} l" if volume_m3 < 1.0 else f"{volume_m3:.3g} m^3"
            size = f" ({told})" if unit == "m" else ""
            if voxels:
                amounts.append(f"{sign}{voxels} voxels{size}")
        changed = ", ".join(amounts) or "nothing changed"
        if step.name == "region":
            size = " x ".join(f"{side:.3g}" for side in region["size"])
            share, name = region["share_of_solid_taken"], region["asked_for"]
            yield f"Region, {name}: {size} {unit}, {share:.1%} of the solid; {changed}. {step.remark}"
        else:
            yield f"Solid, {step.name}: {changed}. {step.remark}"
    mesh = built.mesh
    yield f"Mesh: {len(mesh.tets)} tetrahedra, {len(mesh.points_m)} nodes, volume {volume:.6g} {unit}^3"
    if built.unobserved_parts:
        yield (
            f"Left out because no thermal ray saw them: {built.unobserved_parts} parts of the mesh, "
            f"{built.unobserved_voxels} voxels in all."
        )
    shares = support_shares(mesh)
    if shares is not None:
        supported, weak, smooth, filled = shares.values()
        yield (
            f"{supported:.0%} of the surface is supported by three photographs or more, {weak:.0%} by one or two; "
            f"{smooth:.0%} is seen, but placed by smoothness alone; {filled:.0%} is seen by no photograph."
        )
    for rule in built.idle_rules:
        yield (
            f"Rule without effect: {rule}. Nothing in the mesh meets its conditions, or later rules take all that does."
        )


def mesh_summary(built: BuiltMesh, figures: MeshFigures, scale: SceneScale | None) -> dict[str, Any]:
    """Return the entry "mesh" of summary.json: counts, sizes and steps; lengths are in the summary's length_unit."""
    mesh, solid = built.mesh, built.solid
    temperature = mesh.temperature_c
    of_triangles = facet_areas(mesh.points_m, mesh.facets)
    unobserved = of_triangles @ ~mesh.observed[mesh.facets].all(axis=1)
    return {
        "nodes": len(mesh.points_m),
        "tets": len(mesh.tets),
        "voxels": int(np.count_nonzero(solid.cells)),
        "boundary_triangles": len(mesh.facets),
        "non_manifold_edges": figures.num_non_manifold_edges,
        "volume": figures.volume_m3,
        "volume_standard_error": None if scale is None else scale.standard_error_of(figures.volume_m3, 3),
        "area": figures.area_m2,
        "area_standard_error": None if scale is None else scale.standard_error_of(figures.area_m2, 2),
        "bounds": {"lower": mesh.points_m.min(axis=0), "upper": mesh.points_m.max(axis=0)},
        "dihedral_angles_deg": {"min": figures.dihedral_range_deg[0], "max": figures.dihedral_range_deg[1]},
        "density_threshold_used": solid.threshold,
        "solid_steps": [
            {"step": step.name, "voxels_added": step.added, "voxels_removed": step.removed, "remark": step.remark}
            for step in solid.steps
        ],
        "parts_without_thermal_rays_left_out": built.unobserved_parts,
        "voxels_without_thermal_rays_left_out": built.unobserved_voxels,
        "share_of_nodes_observed": float(np.mean(mesh.observed)),
        "share_of_area_not_fully_observed": float(unobserved / of_triangles.sum()),
        "share_of_area_by_support": support_shares(mesh),
        "rules_without_effect": built.idle_rules,
        "patches": _sums(mesh.boundary.patch_names, mesh.boundary.patch, of_triangles),
        "regions": _sums(mesh.region_names, mesh.region, signed_volumes(mesh.points_m, mesh.tets)),
        "temperature_c": None
        if not mesh.has_temperatures
        else {
            "min": float(temperature.min()),
            "max": float(temperature.max()),
            "mean_of_nodes": float(temperature.mean()),
        },
    }


def region_summary(built: BuiltMesh, asked_for: str) -> dict[str, Any]:
    """Return the entry "region" of summary.json: the exported part, the mesh's extents, and the share of the solid."""
    points, left_out = built.mesh.points_m, int(built.solid.left_out.sum())
    # Solid voxels in the whole lattice, before regions are left out and interiors are filled.
    found = sum(step.added for step in built.solid.steps if step.name in ("threshold", "close gaps"))
    return {
        "asked_for": asked_for,
        "size": points.max(axis=0) - points.min(axis=0),
        "voxels_taken": found - left_out,
        "voxels_left_out": left_out,
        "share_of_solid_taken": 1.0 - left_out / found,
    }


def _sums(names: tuple[str, ...], number: IntArray, amount: FloatArray) -> dict[str, float]:
    """Return the sum of `amount`, (k,), over entries with equal `number`, (k,), by name; unused names are left out."""
    total = np.bincount(number, weights=amount, minlength=len(names))
    return {names[n]: float(total[n]) for n in np.unique(number)}


def support_shares(mesh: TetMesh) -> dict[str, float] | None:
    """Return the share of the area in each class of `SUPPORT`, without cut triangles; None if support is unknown."""
    support = support_of_facets(mesh)
    if support is None or not (support >= 0).any():
        return None
    area = facet_areas(mesh.points_m, mesh.facets)
    total = np.bincount(support + 1, weights=area, minlength=len(SUPPORT) + 1)[1:]
    return dict(zip(SUPPORT, (total / total.sum()).tolist()))


def versions() -> dict[str, str]:
    """Return the versions of this package, of Python and of the packages that an export depends on."""
    packages = ("numpy", "scipy", "torch", "nerfstudio", "pyvista", "scikit-fem")
    return {"thermoxels": __version__, "python": platform.python_version()} | {name: version(name) for name in packages}
