"""Thermal bridges and defects: places where a surface departs from the undisturbed temperature of its patch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial import KDTree

from thermoxels_ns.audit.surface import AuditedSurface
from thermoxels_ns.core.arrays import BoolArray, FloatArray, IntArray
from thermoxels_ns.mesh.quality.checks import component_of, group_sides

DefectKind = Literal["line", "point", "area"]

LEAST_DEPARTURE_K = 0.1  # Smallest departure that any camera tells from noise, [K]
_DEVIATIONS = 3.0  # Least departure of a triangle, in standard deviations of the undisturbed surface
_CELL_M, _AROUND_M = 0.25, 1.25
"""Edge of the cells whose mean temperatures are taken, and radius within which their median is the background, [m]."""
_SHORTH = 1.349  # Width of the shortest half of a normal distribution, in standard deviations
_SURE = 2.0  # A triangle of each defect must depart by more than this many times the least departure that counts
LEAST_AREA_M2 = 0.01  # Smallest area of the triangles of a defect that depart: a square decimetre
_LEAST_TRIANGLES = 4  # Smallest number of the triangles of a defect that depart
_STRAIGHT = 3.0  # Least ratio of length to width of a straight line
_BENT = 6.0  # Least ratio of length to width of a line that bends or closes, as around a window
_POINT_M = 0.5  # Largest extent of a point, [m]
_NARROWEST_ZONE_M = 0.3  # About a wall's thickness, over which heat spreads sideways
_WIDEST_ZONE_M = {"line": 0.5, "point": 0.5, "area": 0.3}  # Largest reach of a zone around its core, [m]
_FARTHEST_OUT_M = 2.0  # Triangles farther than this from the core never belong to its zone, [m]
_GAP_M = 0.3  # Sets of triangles no farther apart than this belong to one defect, [m]
_BLURRED_EDGES, _OWN_SHARE = 3.0, 0.2
"""Within this many triangle edges of another patch a reconstruction mixes the temperatures of both; a departure up to
this share of the temperature step between both patches is an error of the reconstruction. Chosen on the drawn house,
where 1.5 edges from the border bridges depart by a third of the step, and false bridges by a tenth."""
_NEIGHBOURS = 64  # Number of undisturbed triangles whose mean normal stands for the undisturbed surface


@dataclass(frozen=True)
class FoundDefect:
    """One thermal bridge or other defect; integer arrays hold the indices of its boundary triangles."""

    kind: DefectKind
    patch: int  # Place in `Selection.patch_names`
    core: IntArray  # Triangles that depart by more than noise
    zone: IntArray  # The core and the triangles around, from which heat flows sideways to the core
    reference: IntArray  # Undisturbed triangles near by, which the zone is compared with
    base_area_m2: float  # Area that the undisturbed surface would have in place of the zone
    length_m: float  # Length of a line; largest extent of a point or an area
    spot: IntArray  # Triangles of the core that depart most, together at least a square decimetre
    not_counted: str  # Sentence that says why the defect does not count; empty if the defect counts


def find_defects(surface: AuditedSurface, surface_c: FloatArray, warm: bool, least_k: float) -> list[FoundDefect]:
    """Return defects: connected triangles whose temperature departs from the undisturbed temperature of their patch.

    A triangle departs if its temperature differs from the patch's `undisturbed_temperature` by the least departure: the
    largest of three standard deviations, `least_k` and 0.1 K. A triangle also departs if its difference from its
    `background_c` passes the same test: this finds defects weaker than slow changes over a wall. At least one triangle
    of a defect departs by twice the least departure. Triangles of `AuditedSurface.rim` never belong to a defect's core.

    `surface_c` is the corrected temperature of each triangle, shape (f,), [degrees Celsius]. `warm`: search for warmer
    triangles (True: seen from outside) or for colder ones (False: seen from inside).
    """
    sure = surface.counted & ~surface.rim
    sign = 1.0 if warm else -1.0
    away, share, calm = np.zeros(len(surface_c)), np.zeros(len(surface_c)), np.ones(len(surface_c), dtype=bool)
    for patch in np.unique(surface.selection.facet_patch[sure]):
        on_patch = np.flatnonzero(sure & (surface.selection.facet_patch == patch))
        values, area = surface_c[on_patch], surface.area_m2[on_patch]
        beside = values - background_c(surface.centroid_m[on_patch], values, area)
        undisturbed = [undisturbed_temperature(one, area, least_k) for one in (values, beside)]
        differs = np.stack([one - most_c for one, (most_c, _) in zip((values, beside), undisturbed)])
        away[on_patch] = (sign * differs).max(axis=0)
        parts = differs / [[least] for _, least in undisturbed]
        share[on_patch] = (sign * parts).max(axis=0)
        calm[on_patch] = (np.abs(parts) < 1.0).all(axis=0)
    cores = _cores(surface, share)
    zones = _Zones(surface, sure, ~calm, cores)
    return [zones.around(core, away) for core in cores]


def background_c(points_m: FloatArray, surface_c: FloatArray, area_m2: FloatArray) -> FloatArray:
    """Return the temperature typical of the surface around each triangle, shape (k,), [degrees Celsius].

    Triangles, given by centroids (k, 3), are grouped into cubes of 0.25 m. The result is the median, weighted by area,
    of the cubes' mean temperatures within 1.25 m; a strip or spot on less than half of that area hardly changes it.
    """
    _, cell = np.unique(np.floor(points_m / _CELL_M).astype(np.int64), axis=0, return_inverse=True)
    cell = cell.ravel()
    weight = np.bincount(cell, area_m2).astype(np.float64)
    mean = np.bincount(cell, area_m2 * surface_c) / weight
    middle = np.stack([np.bincount(cell, area_m2 * axis) / weight for axis in points_m.T], axis=1)
    around: list[list[int]] = KDTree(middle).query_ball_point(middle, _AROUND_M).tolist()
    return np.array([_weighted_median(mean[near], weight[near]) for near in around])[cell]


def undisturbed_temperature(surface_c: FloatArray, area_m2: FloatArray, least_k: float = 0.0) -> tuple[float, float]:
    """Return the temperature of most of a patch, [degrees Celsius], and the least departure of a triangle, [K].

    The temperature is the mean of the shortest range that holds half of the area. For normally distributed values this
    range is 1.349 standard deviations wide (Rousseeuw and Leroy 1988, the shorth); the other half has no influence.
    The least departure is three standard deviations, but not below `least_k` or 0.1 K.

    >>> undisturbed_temperature(np.array([1.0, 1.1, 1.05, 4.0]), np.ones(4))[0]
    1.025
    """
    order = np.argsort(surface_c, kind="stable")
    values, weights = surface_c[order], area_m2[order]
    reach = np.cumsum(weights)
    last = np.searchsorted(reach, reach - weights + 0.5 * reach[-1] * (1.0 - 1e-12))
    fits = np.flatnonzero(last < len(values))
    start = fits[np.argmin(values[last[fits]] - values[fits])]
    inside = slice(start, last[start] + 1)
    scatter = float(values[last[start]] - values[start]) / _SHORTH
    middle = float(np.average(values[inside], weights=weights[inside]))
    return middle, max(_DEVIATIONS * scatter, least_k, LEAST_DEPARTURE_K)


def _weighted_median(values: FloatArray, weights: FloatArray) -> float:
    order = np.argsort(values, kind="stable")
    reach = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(reach, 0.5 * reach[-1])])


def _cores(surface: AuditedSurface, share: FloatArray) -> list[IntArray]:
    """Return the core of each defect: triangles of one patch that depart, connected by edges or across `_GAP_M`.

    `share` is the departure of each triangle over the least departure, (f,). Too small or too weak cores are left out.
    """
    which = np.flatnonzero(share > 1.0)
    pairs, patch = _neighbours(surface, which), surface.selection.facet_patch
    component = component_of(len(which), pairs[:, 0], pairs[:, 1])
    sure = np.bincount(component, share[which] > _SURE) > 0
    kept = sure[component] if len(which) else np.zeros(0, dtype=bool)
    which = which[kept]
    if not len(which):
        return []
    pairs = _neighbours(surface, which)
    edge = np.flatnonzero(np.bincount(pairs.ravel(), minlength=len(which)) < 3)  # a neighbour is missing: at the border
    gaps = edge[KDTree(surface.centroid_m[which[edge]]).query_pairs(_GAP_M, output_type="ndarray")].reshape(-1, 2)
    gaps = gaps[patch[which[gaps[:, 0]]] == patch[which[gaps[:, 1]]]]
    pairs = np.concatenate([pairs, gaps])
    component = component_of(len(which), pairs[:, 0], pairs[:, 1])
    size = np.bincount(component, surface.area_m2[which])
    enough = (size >= LEAST_AREA_M2) & (np.bincount(component) >= _LEAST_TRIANGLES)
    order = np.argsort(component, kind="stable")
    sets = np.split(which[order], np.cumsum(np.bincount(component))[:-1])
    return [sets[number] for number in np.flatnonzero(enough)]


def _neighbours(surface: AuditedSurface, which: IntArray) -> IntArray:
    """Return the pairs of triangles in `which` that share an edge and a patch, as indices into `which`, (p, 2)."""
    pairs = np.stack(group_sides(surface.mesh.facets[which]).pairs(), axis=1) // 3
    patch = surface.selection.facet_patch[which]
    return pairs[patch[pairs[:, 0]] == patch[pairs[:, 1]]]


class _Zones:
    """The surface around cores; finds the zone, the reference, the kind and the length of each core."""

    def __init__(self, surface: AuditedSurface, sure: BoolArray, departs: BoolArray, cores: list[IntArray]) -> None:
        self.surface, self.departs = surface, departs
        self.patch, self.at = surface.selection.facet_patch, surface.centroid_m
        self.normal = surface.selection.facet_normal
        self.edge_m = np.sqrt(2.0 * np.maximum(surface.area_m2, 0.0))
        self.of_patch = {int(n): np.flatnonzero(sure & (self.patch == n)) for n in np.unique(self.patch[sure])}
        self.core_of = np.full(len(self.patch), -1)
        for number, core in enumerate(cores):
            self.core_of[core] = number

    def around(self, core: IntArray, away: FloatArray) -> FoundDefect:
        """Return the defect of a core; `away` is how far each triangle departs, shape (f,), [K]."""
        surface, patch = self.surface, int(self.patch[core[0]])
        area = surface.area_m2[core]
        edge = float(np.average(self.edge_m[core], weights=area))
        same = self.of_patch[patch]  # next reduced to a box around the core that holds all of its zone
        at, ends = self.at[same], self.at[core]
        beside = (at > ends.min(axis=0) - _FARTHEST_OUT_M) & (at < ends.max(axis=0) + _FARTHEST_OUT_M)
        same = same[beside.all(axis=1)]
        width = max(self._width(core), edge)
        reach = float(np.clip(0.5 * width, _NARROWEST_ZONE_M, _WIDEST_ZONE_M["line"]))
        distance, _ = KDTree(self.at[core]).query(self.at[same], distance_upper_bound=_FARTHEST_OUT_M)  # [m]
        near = self._nearest(core, same, distance, distance <= reach)
        axes = self._plane(core, self._calm(same, near, distance, reach))
        kind, length = _kind(self.at[core] @ axes, area, width, edge)
        reach = min(reach, _WIDEST_ZONE_M[kind])
        # The zone holds all sides of what stands out, such as a balcony: distance along the surface's plane decides.
        beside, _ = KDTree(self.at[core] @ axes).query(self.at[same] @ axes, distance_upper_bound=reach)
        near = self._nearest(core, same, distance, (beside <= reach) & (distance <= _FARTHEST_OUT_M))
        near = self._hangs_together(core, same, near)
        zone, reference = same[near], self._calm(same, near, distance, reach)
        # Reconstructed walls wrinkle, so even undisturbed triangles have more area than the plane that they cover.
        flat = self._base(reference, reference)
        wrinkled = float(surface.area_m2[reference].sum()) / flat if flat > 0.0 else 1.0
        base = wrinkled * self._base(zone, reference)
        unsupported = float(area @ surface.unsupported[core]) / float(area.sum())
        spot, why = surface.spot(core, away[core]), ""
        if unsupported > 0.5:
            why = "No photograph says that the surface lies there."
        elif self._is_blurred(core, spot, reference, edge):
            why = (
                "It lies at the edge of its element, and departs by no more than the model mixes in from the next one."
            )
        return FoundDefect(
            kind=kind,
            patch=patch,
            core=core,
            zone=zone,
            reference=reference,
            base_area_m2=max(base, 0.0),
            length_m=length,
            spot=spot,
            not_counted=why,
        )

    def _is_blurred(self, core: IntArray, spot: IntArray, reference: IntArray, edge_m: float) -> bool:
        """Return whether a reconstruction may have mixed a core's departure in from a patch of another temperature.

        True if the core lies on average within `_BLURRED_EDGES` edges (length `edge_m`) of another patch, and its spot
        departs from the reference by at most `_OWN_SHARE` of the step from the reference to the readings next to the
        core on that patch; if that patch departs the other way, by at most half of this share.
        """
        surface, reach = self.surface, _BLURRED_EDGES * edge_m
        others = np.flatnonzero(surface.read & (self.patch != self.patch[core[0]]))
        if not len(others) or not len(reference):
            return False
        beside = KDTree(self.at[others])
        distance, _ = beside.query(self.at[core])
        if float(np.average(distance, weights=surface.area_m2[core])) > reach:
            return False
        near = others[np.unique(np.concatenate(beside.query_ball_point(self.at[core], 2.0 * reach)).astype(np.int64))]
        calm, top = (float(np.average(surface.reading_c[n], weights=surface.area_m2[n])) for n in (reference, spot))
        step = np.sign(top - calm) * (surface.reading_c[near] - calm)
        # Half for a patch that departs the other way: on the drawn house errors there are below a tenth of the step.
        return abs(top - calm) <= _OWN_SHARE * float(np.maximum(step, -0.5 * step).max(initial=0.0))

    def _nearest(self, core: IntArray, same: IntArray, distance: FloatArray, near: BoolArray) -> BoolArray:
        """Return `near`, whether triangles `same` are chosen, with the core and without those nearer to another core.

        `same`, `near` and `distance`, [m], to the core have the shape (s,); all of `same` are on the core's patch.
        """
        own, near = self.core_of[core[0]], near.copy()
        others = same[(self.core_of[same] >= 0) & (self.core_of[same] != own)]
        candidates = np.flatnonzero(near)
        if len(others) and len(candidates):
            nearest, _ = KDTree(self.at[others]).query(self.at[same[candidates]])
            near[candidates[nearest < distance[candidates]]] = False
        return near | (self.core_of[same] == own)

    def _hangs_together(self, core: IntArray, same: IntArray, near: BoolArray) -> BoolArray:
        """Return `near`, (s,), only where a chain of shared edges within `near` connects a triangle to the core."""
        chosen = np.flatnonzero(near)
        pairs = _neighbours(self.surface, same[chosen])
        component = component_of(len(chosen), pairs[:, 0], pairs[:, 1])
        kept = np.isin(component, np.unique(component[self.core_of[same[chosen]] == self.core_of[core[0]]]))
        found = np.zeros(len(same), dtype=bool)
        found[chosen[kept]] = True
        return found

    def _calm(self, same: IntArray, near: BoolArray, distance: FloatArray, reach: float) -> IntArray:
        """Return undisturbed triangles of the patch in a ring around the zone `near` (arguments as in `_nearest`).

        If their area is below half of the zone's, the ring becomes the whole patch outside the zone. If no triangle
        there is undisturbed, all of them are returned.
        """
        calm = ~near & ~self.departs[same]
        ring = calm & (distance <= 2.0 * reach + 0.5)
        wanted = 0.5 * float(self.surface.area_m2[same[near]].sum())
        if float(self.surface.area_m2[same[ring]].sum()) >= wanted:
            return same[ring]
        whole = self.of_patch[int(self.patch[same[0]])]
        whole = whole[~np.isin(whole, same[near])]
        calm = whole[~self.departs[whole]]
        return calm if len(calm) else whole

    def _plane(self, core: IntArray, reference: IntArray) -> FloatArray:
        """Return two unit axes at right angles to the mean normal of the undisturbed surface, shape (3, 2)."""
        normal = self.surface.area_m2[core] @ self._reference_normal(core, reference)
        normal /= max(float(np.linalg.norm(normal)), 1e-12)
        first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
        first /= np.linalg.norm(first)
        return np.stack([first, np.cross(normal, first)], axis=1)

    def _base(self, which: IntArray, reference: IntArray) -> float:
        """Return the area of triangles projected onto the undisturbed surface next to them, [m2]."""
        towards = self._reference_normal(which, reference)
        return float(self.surface.area_m2[which] @ np.einsum("ij,ij->i", self.normal[which], towards))

    def _reference_normal(self, which: IntArray, reference: IntArray) -> FloatArray:
        """Return the mean normal of the reference next to each triangle, (k, 3); its own normal without a reference."""
        if not len(reference):
            return self.normal[which]
        count = min(_NEIGHBOURS, len(reference))
        _, nearest = KDTree(self.at[reference]).query(self.at[which], k=count)
        mean = self.normal[reference[np.reshape(nearest, (len(which), count))]].mean(axis=1)
        length = np.linalg.norm(mean, axis=1, keepdims=True)
        return np.where(length > 0.1, mean / np.maximum(length, 0.1), self.normal[which])

    def _width(self, core: IntArray) -> float:
        """Return the width of a core, [m]: four times the mean distance from its edge, which is exact for a strip."""
        facets, points = self.surface.mesh.facets[core], self.surface.mesh.points_m
        sides = group_sides(facets)
        alone = sides.order[sides.start[sides.sizes == 1]]
        start, end = facets.ravel()[alone], np.roll(facets, -1, axis=1).ravel()[alone]
        middles = 0.5 * (points[start] + points[end])
        if not len(middles):
            return float(np.sqrt(self.surface.area_m2[core].sum()))
        distance, _ = KDTree(middles).query(self.at[core])
        return 4.0 * float(np.average(distance, weights=self.surface.area_m2[core]))


def _kind(footprint: FloatArray, area_m2: FloatArray, width_m: float, edge_m: float) -> tuple[DefectKind, float]:
    """Return the kind of a defect and its length, [m] (the largest extent, or area over width of a bent line).

    `footprint` are the centroids of the core's triangles in the plane of the surface, (k, 2), [m].
    """
    centred = footprint - np.average(footprint, axis=0, weights=area_m2)
    _, axes = np.linalg.eigh((centred * area_m2[:, None]).T @ centred)
    along = centred @ axes[:, ::-1]
    long, wide = (float(np.ptp(side)) + 0.5 * edge_m for side in along.T)
    if long >= _STRAIGHT * wide and long > _POINT_M:
        return "line", long
    bent = float(area_m2.sum()) / width_m
    if bent >= _BENT * width_m and bent > 2.0 * _POINT_M:
        return "line", bent
    return ("point", long) if max(long, wide) <= _POINT_M else ("area", max(long, wide))
