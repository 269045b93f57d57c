"""Choose the boundary triangles that count, and group those so alike that one heat flow is computed for each group."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np

from thermoxels_ns.audit.conditions import Conditions
from thermoxels_ns.core.arrays import BoolArray, FloatArray, IntArray
from thermoxels_ns.core.errors import AuditError
from thermoxels_ns.fem.selection import Selection
from thermoxels_ns.fem.selection import chosen_names as names_chosen
from thermoxels_ns.mesh.quality.checks import group_sides
from thermoxels_ns.mesh.tetrahedra import FACET_BOX, TetMesh

_STEP_K, _STEP_COSINE = 0.2, 0.05
"""Widths of the bins within which triangles are alike: of readings, [K], and of the cosine between normal and up."""

_SUPPORTED = 3  # Photographs that support a triangle well, see `SUPPORT`
SPOT_M2 = 0.01  # Area over which the coldest or hottest spot is averaged

WHY_NOT = {
    "cut": "that the scene box or the region of the export cuts",
    "unseen": "that no photograph shows",
    "no reading": "that no thermal ray measured, or not on all of a triangle",
    "left out": "that the conditions leave out",
}
"""Reasons why a triangle does not count; the texts complete a sentence that begins with "triangles"."""

chosen_names = partial(names_chosen, error=AuditError)  # `AuditError` if a pattern matches no name


class Readings(NamedTuple):
    """Readings of the thermal camera on n pieces of surface, which are triangles or groups of triangles."""

    reading_c: FloatArray  # Mean reading, not corrected, shape (n,), [degrees Celsius]
    upward: FloatArray  # Upward part of the outward unit normal, shape (n,)
    surface_entry: IntArray  # Place in `Conditions.surfaces` of the emissivity, shape (n,)


@dataclass(frozen=True)
class AuditedSurface:
    """The boundary of a mesh with the thermal readings on it; arrays have one entry per boundary triangle."""

    selection: Selection
    reading_c: FloatArray  # Mean reading of the thermal camera, not corrected, shape (f,), [degrees Celsius]
    area_m2: FloatArray  # Shape (f,)
    centroid_m: FloatArray  # Shape (f, 3)
    counted: BoolArray  # True where a triangle counts, which means that `why_not` is -1, shape (f,)
    why_not: IntArray  # Place in `WHY_NOT` of the reason why a triangle does not count, shape (f,); -1 if it counts
    unsupported: BoolArray  # True for triangles that count but whose position no photograph supports, shape (f,)
    surface_entry: IntArray  # Place in `Conditions.surfaces` of the triangle's emissivity, shape (f,); -1: none

    @property
    def mesh(self) -> TetMesh:
        """Mesh whose boundary this is."""
        return self.selection.mesh

    @property
    def upward(self) -> FloatArray:
        """Upward part of each triangle's unit normal, shape (f,)."""
        return self.selection.facet_normal @ np.array(self.selection.up)

    @cached_property
    def height_m(self) -> FloatArray:
        """Height of each triangle above the lowest node of the mesh, shape (f,), [m]."""
        up = np.array(self.selection.up)
        return self.centroid_m @ up - (self.mesh.points_m @ up).min()

    @property
    def read(self) -> BoolArray:
        """True where a triangle counts or would count if the conditions did not leave it out, shape (f,)."""
        return self.counted | (self.why_not == list(WHY_NOT).index("left out"))

    @property
    def range_c(self) -> tuple[float, float]:
        """The 0.5 % and 99.5 % quantiles of the readings of `read` triangles, at least 0.1 K apart, [C]."""
        low, high = np.quantile(self.reading_c[self.read], (0.005, 0.995)).tolist()
        return low, max(high, low + 0.1)

    @property
    def rim(self) -> BoolArray:
        """True where a triangle counts but shares a node with one that is cut, unseen or without reading, (f,)."""
        facets = self.mesh.facets
        unknown = np.zeros(len(self.mesh.points_m), dtype=bool)
        unknown[facets[~self.read]] = True
        return self.counted & unknown[facets].any(axis=1)

    @cached_property
    def border_m2(self) -> FloatArray:
        """Largest error of each triangle's area because the true border of its patch is uncertain, (f,), [m2].

        It is half a triangle's edge times pi / 4 of the length of its sides on the border, which zigzag about a line;
        twice that where less than three photographs support the triangle; 0 on a mesh not made of photographs. On the
        drawn house the surface is off by 0.6 edges (root mean square), and 1.2 with less support; borders by a third.
        """
        facets, tags = self.mesh.facets, self.mesh.boundary
        if tags.photographs is None:
            return np.zeros(len(facets))
        sides = np.stack(group_sides(facets).pairs(), axis=1)
        inner, patch = sides // 3, self.selection.facet_patch
        first, second = inner.T
        sides = sides[(patch[first] != patch[second]) | (self.counted[first] != self.counted[second])].ravel()
        ends = facets.ravel()[sides], np.roll(facets, -1, axis=1).ravel()[sides]
        length = np.linalg.norm(self.mesh.points_m[ends[0]] - self.mesh.points_m[ends[1]], axis=1)
        half_edge = 0.5 * np.sqrt(2.0 * self.area_m2) * np.where(tags.photographs[:, 1] < _SUPPORTED, 2.0, 1.0)
        return 0.25 * np.pi * half_edge * np.bincount(sides // 3, length, len(facets))

    @cached_property
    def alike(self) -> tuple[Readings, IntArray]:
        """Area-weighted means of groups of triangles, and the group of each triangle, (f,); -1: does not count.

        The triangles of a group have the same patch and nearly the same reading and inclination.
        """
        which = np.flatnonzero(self.counted)
        area, reading, upward = np.maximum(self.area_m2[which], 1e-300), self.reading_c[which], self.upward[which]
        # All film and sky models depend on the inclination of a normal alone, not on its azimuth.
        key, tilt = np.rint(reading / _STEP_K).astype(np.int64), np.rint((upward + 1.0) / _STEP_COSINE).astype(np.int64)
        key = (key - key.min()) * (2 + round(2.0 / _STEP_COSINE)) + tilt
        key = key * len(self.selection.patch_names) + self.selection.facet_patch[which]
        _, first, group = np.unique(key, return_index=True, return_inverse=True)
        total = np.bincount(group, area)
        mean_c, mean_upward = (np.bincount(group, area * values) / total for values in (reading, upward))
        of_triangle = np.full(len(self.counted), -1)
        of_triangle[which] = group
        return Readings(mean_c, mean_upward, self.surface_entry[which[first]]), of_triangle

    def spot(self, which: IntArray, amount: FloatArray) -> IntArray:
        """Return the fewest triangles of `which`, (k,), by falling `amount`, (k,), with an area of `SPOT_M2` in all."""
        ranked = which[np.argsort(-amount, kind="stable")]
        return ranked[: int(np.searchsorted(np.cumsum(self.area_m2[ranked]), SPOT_M2 * (1.0 - 1e-9))) + 1]


def audited_surface(mesh: TetMesh, conditions: Conditions, up: tuple[float, float, float]) -> AuditedSurface:
    """Return the boundary of a mesh; triangles count if seen, measured at all three nodes, not cut, not left out.

    `up` is the unit vector that points up. Raises `AuditError` if the conditions name a patch that the mesh does not
    have, a patch with readings has no emissivity, or no triangle counts.
    """
    selection, tags = Selection(mesh, up), mesh.boundary
    names = selection.patch_names
    entry_of_patch = np.full(len(names), -1)
    for number, surface in enumerate(conditions.surfaces):
        chosen = chosen_names(f"surfaces entry {number + 1}: patches", names, surface.patches)
        entry_of_patch[np.isin(names, [*chosen])] = number
    left_out = np.isin(names, [*chosen_names("leave_out", names, conditions.leave_out)])
    chosen_names("limits: u", names, conditions.limits.u)

    patch = tags.patch
    unseen = ~tags.seen
    unsupported = np.zeros(len(patch), dtype=bool)
    if tags.photographs is not None:
        unseen = unseen | (tags.photographs[:, 0] == 0)
        unsupported = tags.photographs[:, 1] == 0
    cut = (mesh.facet_tags == FACET_BOX) | np.array([name == "cut" for name in names])[patch]
    no_reading = ~mesh.observed[mesh.facets].all(axis=1)
    why_not = np.select([cut, unseen, no_reading, left_out[patch]], [0, 1, 2, 3], default=-1)
    counted = why_not < 0
    if not counted.any():
        counts = "; ".join(f"{np.count_nonzero(why_not == n)} {why}" for n, why in enumerate(WHY_NOT.values()))
        remedy = "Export again, of a training with thermal images that show the surface."
        if (why_not == list(WHY_NOT).index("left out")).any():
            remedy = "Leave out fewer patches (leave_out)."
        raise AuditError("mesh", expected="boundary triangles with a reading", got=f"none: {counts}", remedy=remedy)
    bare = sorted({names[number] for number in np.unique(patch[counted]) if entry_of_patch[number] < 0})
    if bare:
        remedy = f"Add {{patches: [{bare[0]}], emissivity: 0.93 +- 0.02}} to surfaces."
        got = f"none for {', '.join(bare)}"
        raise AuditError("surfaces", expected="an emissivity for every patch with readings", got=got, remedy=remedy)
    return AuditedSurface(
        selection=selection,
        reading_c=mesh.temperature_c[mesh.facets].mean(axis=1),
        area_m2=selection.facet_area_m2,
        centroid_m=mesh.points_m[mesh.facets].mean(axis=1),
        counted=counted,
        why_not=why_not,
        unsupported=unsupported & counted,
        surface_entry=entry_of_patch[patch],
    )
