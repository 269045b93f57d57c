"""Pictures of an audit: the surface from fixed views, and a thermogram of each defect, drawn from the mesh."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from thermoxels_ns.audit.results import Audit
from thermoxels_ns.audit.surface import WHY_NOT
from thermoxels_ns.core.arrays import BoolArray, FloatArray
from thermoxels_ns.mesh.tetrahedra import TetMesh

MOST_DEFECTS = 12  # How many get a picture

_ALL_AROUND = 0.35  # Share of the area that normals add up to, below which a building was seen from all around
_AROUND_DEFECT_M = 0.8


@dataclass(frozen=True)
class AuditPictures:
    """PNG files."""

    temperature: tuple[bytes, ...]  # Surface temperature with the numbers of defects, from one or two sides
    u_value: tuple[bytes, ...]  # U-value, from the same sides; heat flow where the air outside is not known
    defects: tuple[bytes, ...]  # Surface temperature of each defect and what is around it
    misfit: tuple[bytes, ...]  # Measured minus computed temperature of a calibration, from the same sides


def draw_audit(audit: Audit) -> AuditPictures:
    """Draw all pictures; colours of all temperatures have one scale, what does not count is grey."""
    surface = audit.surface
    counted = surface.counted
    known = audit.conditions.outside_known
    shown, name = audit.triangle_u[:, 0] if known else audit.triangle_flow_w_m2, "U-value" if known else "Heat flow"
    surface_c, u = (_at_nodes(audit, values) for values in (audit.triangle_surface_c, shown))
    ends = np.quantile(surface_c[np.unique(surface.mesh.facets[counted])], (0.005, 0.995))
    u_ends = np.quantile(u[np.unique(surface.mesh.facets[counted])], (0.02, 0.98))
    same: dict[str, Any] = {"clim": (float(ends[0]), float(ends[1])), "up": surface.selection.up}
    temperature, u_value, misfit = [], [], []
    calibration = audit.calibration
    off_k = None if calibration is None else _at_nodes(audit, calibration.difference_k)
    for direction in _views(audit):
        view = {"view_direction": direction.tolist()}
        facing = surface.selection.facet_normal @ direction < 0.0
        labels = _labels(audit, direction)
        title = "Surface temperature, corrected for emissivity and reflection"
        temperature.append(_drawn(audit, facing, surface_c, title=title, labels=labels, **same, **view))
        look: dict[str, Any] = {"clim": (float(u_ends[0]), float(u_ends[1])), "colour_map": "viridis"}
        look |= {"bar_title": f"{name} [{'W/(m² K)' if known else 'W/m²'}]", "up": surface.selection.up}
        u_value.append(_drawn(audit, facing, u, title=f"{name} by the stated values", **look, **view))
        if off_k is not None:
            most = float(np.quantile(np.abs(off_k[np.unique(surface.mesh.facets[counted])]), 0.98)) or 1.0
            look |= {"clim": (-most, most), "colour_map": "coolwarm", "bar_title": "difference [K]"}
            misfit.append(_drawn(audit, facing, off_k, title="Measured minus computed", **look, **view))
    defects = [_defect(audit, number, surface_c, same) for number in range(min(len(audit.defects), MOST_DEFECTS))]
    return AuditPictures(tuple(temperature), tuple(u_value), tuple(defects), tuple(misfit))


def _at_nodes(audit: Audit, values: FloatArray) -> FloatArray:
    """Mean at each node of the triangles around it that count, by area; 0 where there are none."""
    surface = audit.surface
    facets, area = surface.mesh.facets[surface.counted], surface.area_m2[surface.counted]
    weight, count = np.repeat(area, 3), len(surface.mesh.points_m)
    known = np.nan_to_num(values[surface.counted])  # a calibration may leave out patches
    total = np.bincount(facets.ravel(), weight * np.repeat(known, 3), count)
    share = np.bincount(facets.ravel(), weight, count)
    return total / np.where(share > 0.0, share, 1.0)


def _labels(audit: Audit, direction: FloatArray) -> list[tuple[str, tuple[float, float, float]]]:
    """Numbers of the defects that face the camera, and where they are."""
    surface, labels = audit.surface, []
    for number, (one, found) in enumerate(zip(audit.defects, audit.found), start=1):
        normal = surface.area_m2[found.core] @ surface.selection.facet_normal[found.core]
        if not one.not_counted and normal @ direction < 0.0:
            labels.append((str(number), one.centre_m))
    return labels


def _views(audit: Audit) -> list[FloatArray]:
    """Directions to look in: at what was seen, or from two corners where it was seen from all around."""
    surface, up = audit.surface, np.array(audit.surface.selection.up)
    area = surface.area_m2 * surface.counted
    mean = area @ surface.selection.facet_normal / area.sum()
    level = mean - (mean @ up) * up
    if np.linalg.norm(level) > _ALL_AROUND:
        front = level / np.linalg.norm(level)
        return [-(front + 0.35 * np.cross(up, front) + 0.25 * up)]
    side = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    side /= np.linalg.norm(side)
    corner = side + 0.7 * np.cross(up, side)
    if audit.conditions.side == "inside":  # floor and walls, then ceiling and walls
        return [-(corner + 0.5 * up), corner + 0.5 * up]
    return [-(corner + 0.5 * up), corner - 0.5 * up]


def _defect(audit: Audit, number: int, surface_c: FloatArray, same: dict[str, Any]) -> bytes:
    """Draw a defect and what is around it, seen along the mean normal of both."""
    surface, found, defect = audit.surface, audit.found[number], audit.defects[number]
    low, high = surface.centroid_m[found.core].min(axis=0), surface.centroid_m[found.core].max(axis=0)
    margin = max(_AROUND_DEFECT_M, 0.25 * float(np.max(high - low)))
    near = np.all((surface.centroid_m > low - margin) & (surface.centroid_m < high + margin), axis=1)
    normal = surface.area_m2[found.zone] @ surface.selection.facet_normal[found.zone]
    if np.linalg.norm(normal) < 1e-9:
        normal = surface.selection.facet_normal[found.spot[0]]
    normal = normal / np.linalg.norm(normal)
    up = np.array(surface.selection.up)
    towards = normal + 0.2 * np.cross(up, normal) + 0.2 * up
    facing = near & (surface.selection.facet_normal @ towards > 0.0)
    return _drawn(
        audit,
        facing,
        surface_c,
        title=f"{number + 1}: surface temperature",
        view_direction=(-towards).tolist(),
        labels=[(str(number + 1), defect.centre_m)],
        size=False,
        window_size=(800, 600),
        **same,
    )


def _drawn(audit: Audit, chosen: BoolArray, values: FloatArray, **look: Any) -> bytes:
    """Draw some triangles, those that do not count in grey; of a room without what stands between it and the eye."""
    from thermoxels_ns.reports.mesh_pictures import picture_of_mesh

    mesh = audit.surface.mesh
    if audit.conditions.side == "inside":
        kinds = [number for number, name in enumerate(WHY_NOT) if name in ("cut", "unseen")]
        chosen = chosen & ~np.isin(audit.surface.why_not, kinds)
    part: TetMesh = replace(mesh, facets=mesh.facets[chosen], facet_tags=mesh.facet_tags[chosen])
    painted: Sequence[tuple[str, str, BoolArray]] = [("does not count", "lightgrey", ~audit.surface.counted[chosen])]
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "picture.png"
        picture_of_mesh(path, part, values, painted=painted, **{"size": False, **look})
        return path.read_bytes()
