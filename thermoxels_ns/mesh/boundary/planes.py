"""Flat elements of a building: planes through a mesh's boundary, trimmed where they meet, with windows and doors."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import shapely
from scipy import ndimage
from scipy.spatial import ConvexHull, HalfspaceIntersection, KDTree
from shapely.geometry import MultiPoint, Polygon, polygon

from thermoxels_ns.core.arrays import BoolArray, FloatArray, IntArray
from thermoxels_ns.core.checks import check_direction
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.boundary.patches import Box, PatchRule, PatchRules, Plane, Vector
from thermoxels_ns.mesh.quality.checks import component_of
from thermoxels_ns.mesh.tetrahedra import TetMesh, facet_area_vectors

LEAST_PLANE_M2 = 2.0  # Smallest area of a plane that bounds the body
_MOST_TRIED = 48  # Largest number of directions in which planes are looked for
_CUBE_M = 0.25  # Edge of cubes over which normals are averaged; normals of single triangles are up to 20 degrees off
_WRINKLE_M = 0.15  # A triangle belongs to a plane if its centroid is nearer to the plane than this
_COVER_M = 0.25  # Least thickness of a part that covers a wall, such as a balcony
_RECESS_M = 0.6  # Largest depth of a pane behind its wall; also least width of a plane
_FACES = 0.7  # Least cosine between the normals of a triangle and of its element
_SAME_M = 1e-5  # Points nearer to each other than this are one point
_COMPASS = ("north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west")

_PIXEL_M = 0.025  # Size of a pixel in the pictures of walls in which windows are looked for
_RECESSED_M, _OTHER_COLOUR, _OTHER_K = 0.12, 0.15, 1.0
"""Least differences between an opening and its wall in depth, colour in [0, 1] and temperature. The last two rise to
three times the median colour distance, and three standard deviations of the temperature, within the wall."""
_LEAST_SIDE_M, _LEAST_FILL = 0.4, 0.75  # Least side of an opening, and least share of its rectangle that it fills
_DOOR_M, _THRESHOLD_M = 1.7, 0.35  # Least height of a door, and largest height of its foot above the wall's foot


@dataclass(frozen=True)
class FlatElement:
    """A wall, roof, floor, window or door; x points east, y north and z up, see `Building.origin_m`."""

    name: str
    kind: str  # wall, roof, floor, window or door
    outline_m: FloatArray  # Corners, shape (k, 3), counter-clockwise as seen from outside
    normal: FloatArray  # Unit vector out of the building, shape (3,)
    azimuth_deg: float  # Direction of the normal, clockwise from north; 0 within 10 degrees of up or down
    tilt_deg: float  # Angle between normal and up: 0 a flat roof, 90 a wall, 180 a floor
    behind: str  # What touches it outside: air, ground, or cover (a part that stands out, such as an overhang)
    facets: IntArray  # Boundary triangles on the element outside its openings; none if no air touches the element
    openings: tuple[FlatElement, ...] = ()  # Windows and doors, their outlines in the plane of the wall
    depth_m: float = 0.0  # Distance by which the triangles of an opening lie behind its outline

    @property
    def net_area_m2(self) -> float:
        """Area without openings, [m2]."""
        return self.flat().area - sum(one.net_area_m2 for one in self.openings)

    def flat(self) -> Polygon:
        """Return the outline in the element's plane, [m], in the two axes that `plane_axes` gives."""
        return Polygon(self.outline_m @ plane_axes(self.normal))


@dataclass(frozen=True)
class Building:
    """The closed body that the planes of a mesh bound."""

    elements: tuple[FlatElement, ...]
    volume_m3: float
    left_out: float  # Share of the mesh's volume above the ground that is not in the body, such as balconies
    ground_m: float | None  # Height of the ground; None: no ground was found
    axes: FloatArray  # East, north and up in the mesh's coordinates, unit vectors as columns, shape (3, 3)
    origin_m: FloatArray
    """Origin of the elements' coordinates in mesh coordinates, (3,), [m]; 0 along axes below 10 km in the mesh."""

    def every(self) -> list[FlatElement]:
        """Return all elements and their openings."""
        return [*self.elements, *(opening for one in self.elements for opening in one.openings)]


class _Plane(NamedTuple):
    normal: FloatArray  # Unit vector out of the body, shape (3,)
    middle_m: FloatArray  # Mean position of the triangles on the plane, shape (3,)
    area_m2: float

    def above(self, points_m: FloatArray) -> FloatArray:
        """Return the distances (n,) of points (n, 3) from the plane, [m], positive on the side of the normal."""
        return (points_m - self.middle_m) @ self.normal


class _Surface(NamedTuple):
    """Boundary triangles of a mesh, one entry each."""

    corners_m: FloatArray  # Shape (f, 3, 3)
    middle_m: FloatArray
    normal: FloatArray
    area_m2: FloatArray
    temperature_c: FloatArray
    colour: npt.NDArray | None


def find_building(mesh: TetMesh, up: npt.ArrayLike, north: npt.ArrayLike) -> Building:
    """Return the closed body between planes through a mesh's boundary; its faces are the building's flat elements.

    The planes cut space into convex cells. The body is the largest connected group of cells of which the mesh fills
    more than half. An element is a face between a cell of the body and another cell, so elements close exactly at the
    lines where planes meet. Parts that stand out from walls, such as balconies, or that no plane bounds are left out.

    Args:
        mesh: Mesh in metres of a building seen from outside, with the ground around it or without.
        up: Direction that points up, shape (3,).
        north: Direction that points north, shape (3,); its part along `up` is removed.

    Raises:
        MeshError: A direction is zero or not finite, `north` is parallel to `up`, or the planes enclose no body.
    """
    upwards = _unit(check_direction("up", up, "Pass --up 0 0 1.", MeshError))
    east = np.cross(_unit(check_direction("north", north, "Pass --north 0 1 0.", MeshError)), upwards)
    if np.linalg.norm(east) < 0.02:
        remedy = "Pass --north 0 1 0, or another level direction in the coordinates of the mesh."
        raise MeshError("north", expected="a direction that is not up or down", got=north, remedy=remedy)
    frame = np.stack([_unit(east), _unit(np.cross(upwards, east)), upwards], axis=1)
    origin = np.where(np.abs(mesh.points_m).max(axis=0) > 1e4, np.rint(mesh.points_m.mean(axis=0)), 0.0)
    points = (mesh.points_m - origin) @ frame
    vectors, corners, tets = facet_area_vectors(points, mesh.facets), points[mesh.facets], points[mesh.tets]
    area = np.maximum(np.linalg.norm(vectors, axis=1), 1e-300)
    colour = None if mesh.colour is None else mesh.colour[mesh.facets].mean(axis=1)
    warm = mesh.temperature_c[mesh.facets].mean(axis=1)
    surface = _Surface(corners, corners.mean(axis=1), vectors / area[:, None], area, warm, colour)
    volume, middle = np.abs(np.linalg.det(tets[:, 1:] - tets[:, :1])) / 6.0, tets.mean(axis=1)
    planes = _planes(surface)
    half = 0.5 * volume.sum()
    under = [one for one in planes if one.normal[2] > 0.95 and volume[one.above(middle) > 0.0].sum() > half]
    ground = max(under, key=lambda one: one.area_m2, default=None)
    if ground is not None:  # the sides of the ground are no walls
        over = ground.above(middle) > 0.0
        middle, volume = middle[over], volume[over]
        planes = [one for one in planes if one is not ground and ground.above(one.middle_m) > _WRINKLE_M]
    planes = [one for one in planes if not any(_is_detail(one, other) for other in planes)]
    faces, body_m3, mesh_m3 = _closed_body(planes, ground, middle, volume) if len(planes) > 2 else ([], 0.0, 0.0)
    if not faces:
        got, remedy = (
            f"{len(planes)} planes of {LEAST_PLANE_M2:g} m2 or more that do not",
            "Export all of the building, with --interior solid.",
        )
        raise MeshError("mesh", expected="flat walls and roofs that enclose a body", got=got, remedy=remedy)
    height = None if ground is None else float(ground.middle_m[2])
    return Building(_named(surface, faces), body_m3, 1.0 - mesh_m3 / float(volume.sum()), height, frame, origin)


def _planes(surface: _Surface) -> list[_Plane]:
    """Return the planes of a surface, found one after the other in the triangles that are left. Each plane is looked
    for in the direction that most area faces, or opposite to the plane that was found just before."""
    at, normal, area = surface[1:4]
    cells = np.floor((at - at.min(axis=0)) / _CUBE_M).astype(np.int64)
    cube = np.unique(np.ravel_multi_index(tuple(cells.T), tuple(cells.max(axis=0) + 1)), return_inverse=True)[1]
    found, left, opposite = list[_Plane](), np.arange(len(at)), None
    for _ in range(_MOST_TRIED):
        if area[left].sum() < LEAST_PLANE_M2:
            break
        best = opposite
        if best is None:
            total = np.stack([np.bincount(cube[left], area[left] * axis) for axis in normal[left].T], axis=1)
            votes = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)
            alike = np.unique(np.rint(votes / 0.1), axis=0, return_inverse=True)[1].ravel()
            total = np.stack([np.bincount(alike, axis) for axis in total.T], axis=1)
            weight = np.linalg.norm(total, axis=1)
            near = KDTree(total / np.maximum(weight, 1e-12)[:, None])
            around = near.query_ball_point(near.data, 0.2)
            best = _unit(total[around[int(np.argmax([weight[one].sum() for one in around]))]].sum(axis=0))
        plane, on = _fitted(surface, left, best, found)
        if plane is not None or opposite is None:
            left = np.setdiff1d(left, on)
        opposite = None
        if plane is not None:
            found.append(plane)
            opposite = -plane.normal
    return found


def _fitted(
    surface: _Surface, left: IntArray, best: FloatArray, found: Sequence[_Plane]
) -> tuple[_Plane | None, IntArray]:
    """Return the plane with most area of triangles that face `best`, out of the triangles `left`, and its triangles.

    `best` is a unit vector, `left` holds indices. The plane is None if it is too small or its direction is uncertain:
    it is narrow, or its triangles are scattered (as on two distant ledges) and no plane in `found` is parallel.
    """
    corners, at, normal, area = surface[:4]
    faces = left[normal[left] @ best > 0.87]
    if not len(faces):
        return None, faces
    along = at[faces] @ best
    edges = np.arange(along.min() - 0.3, along.max() + 0.3, 0.02)
    counts = np.histogram(along, edges, weights=area[faces])[0]
    middle, on = best * (edges[np.argmax(ndimage.gaussian_filter1d(counts, 2.5, mode="constant"))] + 0.01), faces
    for _ in range(4):  # least squares through the triangles near by
        on = faces[np.abs((at[faces] - middle) @ best) < _WRINKLE_M]
        middle = np.average(at[on], axis=0, weights=area[on])
        apart = corners[on] - middle
        spread, axes = np.linalg.eigh(np.einsum("f,fij,fik->jk", area[on], apart, apart) / (3.0 * area[on].sum()))
        turned: FloatArray = axes[:, 0] * float(np.sign(axes[:, 0] @ best))
        if np.sqrt(12.0 * spread[1]) < _RECESS_M or turned @ best < 0.98:
            return None, on
        best = turned
    size, parallel = float(area[on] @ (normal[on] @ best)), any(abs(one.normal @ best) > 0.999 for one in found)
    good = size >= LEAST_PLANE_M2 and (parallel or size > 0.25 * 12.0 * np.sqrt(spread[1] * spread[2]))
    return (_Plane(best, middle, size) if good else None), on


def _is_detail(one: _Plane, other: _Plane) -> bool:
    """Return whether `one` is a recess or ledge of the larger plane `other`, as window panes are of their wall."""
    alike = float(one.normal @ other.normal) > 0.95 and abs(float(other.above(one.middle_m))) < _RECESS_M
    return alike and one.area_m2 < other.area_m2


def _closed_body(
    planes: Sequence[_Plane], ground: _Plane | None, middle: FloatArray, volume: FloatArray
) -> tuple[list[FlatElement], float, float]:
    """Return the faces of the body between planes, without names, the body's volume, and the mesh's volume in it, [m3].
    `middle` (t, 3) and `volume` (t,) are the centroids and volumes of the mesh's tetrahedra above the ground."""
    every = [*planes, *([] if ground is None else [ground])]
    normals, offsets = np.array([one.normal for one in every]), np.array([one.normal @ one.middle_m for one in every])
    side = sum((one.above(middle) > 0.0).astype(np.int64) << n for n, one in enumerate(every))
    keys, place = np.unique(side, return_inverse=True)
    inside = np.stack([np.bincount(place.ravel(), volume * axis) for axis in middle.T], axis=1)
    fill = np.bincount(place.ravel(), volume)
    far = float(np.ptp(middle, axis=0).max())  # cells that no plane bounds get so large that the mesh hardly fills them
    box = np.column_stack([np.concatenate([np.eye(3), -np.eye(3)]), np.zeros(6)])
    box[:, 3] = -far - np.concatenate([middle.max(axis=0), -middle.min(axis=0)])
    cells = dict[int, tuple[float, float, FloatArray]]()  # Volumes of a cell and of the mesh in it, and its corners
    for key, filled, point in zip(keys.tolist(), fill.tolist(), inside / fill[:, None]):
        sign = np.where(key >> np.arange(len(every)) & 1, -1.0, 1.0)
        bounds = np.concatenate([box, np.column_stack([sign[:, None] * normals, -sign * offsets])])
        if (bounds[:, :3] @ point + bounds[:, 3]).max() < -1e-6:
            corners = HalfspaceIntersection(bounds, point).intersections
            size = ConvexHull(corners).volume
            if filled > 0.5 * size:
                cells[key] = size, filled, corners
    number = {key: n for n, key in enumerate(cells)}
    beside = [
        (n, number[key ^ 1 << i]) for key, n in number.items() for i in range(len(every)) if key ^ 1 << i in number
    ]
    part = component_of(len(cells), *np.array(beside, dtype=np.int64).reshape(-1, 2).T)
    largest = np.argmax(np.bincount(part, [cell[0] for cell in cells.values()])) if cells else 0
    body = {key: cells[key] for key, n in number.items() if part[n] == largest}
    rings = defaultdict[tuple[int, int, str], list[Polygon]](list)
    for key, (_, _, corners) in body.items():
        for n, plane in enumerate(every):
            ring = MultiPoint(corners[np.abs(plane.above(corners)) < _SAME_M] @ plane_axes(plane.normal)).convex_hull
            across = key ^ 1 << n
            if isinstance(ring, Polygon) and across not in body:
                close = np.flatnonzero(side == across)
                close = close[np.abs(plane.above(middle[close])) < _COVER_M]
                covered = volume[close].sum() > 0.6 * _COVER_M * ring.area
                rings[n, key >> n & 1, "ground" if plane is ground else "cover" if covered else "air"].append(ring)
    faces = list[FlatElement]()
    for (n, flipped, behind), flat in rings.items():
        normal = every[n].normal * (-1.0 if flipped else 1.0)
        tilt = float(np.degrees(np.arccos(np.clip(normal[2], -1.0, 1.0))))
        azimuth = float(np.degrees(np.arctan2(normal[0], normal[1])) % 360.0)
        kind = "roof" if tilt < 60.0 else "floor" if tilt > 120.0 else "wall"
        where = normal, azimuth if 10.0 < tilt < 170.0 else 0.0, tilt, behind
        union = shapely.union_all(flat, grid_size=0.1 * _SAME_M).normalize().simplify(_SAME_M)
        parts = shapely.get_parts(union)
        for one in flat if any(len(one.interiors) for one in parts) else parts:  # gbXML knows no holes
            around = np.array(polygon.orient(one, -1.0 if flipped else 1.0).exterior.coords)[:-1]
            outline = around @ plane_axes(every[n].normal).T + offsets[n] * every[n].normal
            faces.append(FlatElement("", kind, outline, *where, np.zeros(0, dtype=np.int64)))
    return faces, sum(one[0] for one in body.values()), sum(one[1] for one in body.values())


def _named(surface: _Surface, faces: list[FlatElement]) -> tuple[FlatElement, ...]:
    """Return the faces, the largest first, with names, boundary triangles and openings filled in."""
    elements, taken = list[FlatElement](), defaultdict[str, int](int)
    for face in sorted(faces, key=lambda one: -one.net_area_m2):
        level = not 10.0 < face.tilt_deg < 170.0
        name = face.kind if level else f"{face.kind}-{_COMPASS[round(face.azimuth_deg / 45.0) % 8]}"
        name += "-covered" if face.behind == "cover" else ""
        taken[name] += 1
        face = replace(face, name=name if taken[name] == 1 else f"{name}-{taken[name]}")
        if face.behind == "air":
            beside = np.flatnonzero(surface.normal @ face.normal > _FACES)
            beside = beside[np.abs((surface.middle_m[beside] - face.outline_m[0]) @ face.normal) < _WRINKLE_M]
            inside = shapely.contains_xy(face.flat(), surface.middle_m[beside] @ plane_axes(face.normal))
            face = replace(face, facets=beside[inside])
        elements.append(_with_openings(surface, face) if face.kind == "wall" and len(face.facets) else face)
    return tuple(elements)


def _with_openings(surface: _Surface, wall: FlatElement) -> FlatElement:
    """Return a wall with its windows and doors: rectangles with another temperature than most of the wall, which also
    lie deeper or have another colour. In a mesh without colours, a temperature difference of more than half of the
    largest (the 99 % quantile) stands for another colour."""
    axes, flat, foot = plane_axes(wall.normal), wall.flat(), float(wall.outline_m[0] @ wall.normal)
    at, deep = surface.middle_m @ axes, foot - surface.middle_m @ wall.normal
    low, high = np.array(flat.bounds).reshape(2, 2)
    near = (surface.normal @ wall.normal > _FACES) & (deep < _RECESS_M) & (deep > -_WRINKLE_M)
    near = np.flatnonzero(near & ((at > low) & (at < high)).all(axis=1))
    u, v = (np.arange(start + 0.5 * _PIXEL_M, end, _PIXEL_M) for start, end in zip(low, high))
    pixels = np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1)
    distance, nearest = KDTree(at[near]).query(pixels)
    shown = near[nearest]
    coarse = 2.0 * float(np.sqrt(np.median(surface.area_m2[near])))
    known = shapely.contains_xy(flat, pixels[..., 0], pixels[..., 1]) & (distance < max(_WRINKLE_M, coarse))
    if not known.any():
        return wall
    # The wall's own temperature is that of the narrowest range that holds half of it (Rousseeuw and Leroy 1988).
    values = np.sort(surface.temperature_c[shown[known]])
    ranges = values[len(values) // 2 :] - values[: len(values) - len(values) // 2]
    narrow = int(np.argmin(ranges))
    warmer = np.abs(surface.temperature_c[shown] - values[narrow] - 0.5 * ranges[narrow])
    chosen = known & (warmer > max(_OTHER_K, 3.0 * float(ranges[narrow]) / 1.349))
    off, least = warmer, 0.5 * float(np.quantile(warmer[known], 0.99))
    if surface.colour is not None:
        off = np.linalg.norm(surface.colour[shown] - np.median(surface.colour[shown[known]], axis=0), axis=-1)
        least = max(_OTHER_COLOUR, 3.0 * float(np.median(off[known])))
    chosen &= (deep[shown] > _RECESSED_M) | (off > least)
    labels, _ = ndimage.label(ndimage.binary_opening(ndimage.binary_closing(chosen, iterations=2), iterations=3))  # type: ignore[misc]
    openings, inside, taken = list[FlatElement](), np.zeros(len(deep), dtype=bool), defaultdict[str, int](int)
    for number, window in enumerate(ndimage.find_objects(labels), start=1):
        mask = labels[window] == number
        left, right = low[0] + (window[0].start + _ends(mask)) * _PIXEL_M
        bottom, top = low[1] + (window[1].start + _ends(mask.T)) * _PIXEL_M
        across = surface.colour is None and right - left > 0.8 * (high[0] - low[0])  # as the edge of a floor slab shows
        if across or min(right - left, top - bottom) < _LEAST_SIDE_M or mask.mean() < _LEAST_FILL:
            continue
        kind = "door" if bottom - low[1] < _THRESHOLD_M and top - bottom > _DOOR_M else "window"
        bottom = low[1] if kind == "door" else bottom
        rectangle = shapely.box(left, bottom, right, top).intersection(flat)
        if not isinstance(rectangle, Polygon):  # around a corner of the wall's outline
            continue
        taken[kind] += 1
        name = f"{kind}{wall.name.removeprefix('wall')}-{taken[kind]}"
        depth = float(np.median(deep[shown[window][mask]]))
        within = near[shapely.contains_xy(rectangle, at[near])]
        inside[within] = True
        outline = np.array(polygon.orient(rectangle).exterior.coords)[:-1]
        facets, drawn = within[np.abs(deep[within] - depth) < _WRINKLE_M], outline @ axes.T + foot * wall.normal
        openings.append(replace(wall, name=name, kind=kind, outline_m=drawn, facets=facets, depth_m=depth))
    return replace(wall, openings=tuple(openings), facets=wall.facets[~inside[wall.facets]])


def _ends(mask: BoolArray) -> FloatArray:
    """Return the medians, over the columns of a mask, of the first True row and of the row behind the last, (2,)."""
    columns = mask[:, mask.any(axis=0)]
    return np.array([np.median(columns.argmax(axis=0)), len(mask) - np.median(columns[::-1].argmax(axis=0))])


def _unit(vector: FloatArray) -> FloatArray:
    return vector / np.linalg.norm(vector)


def plane_axes(normal: FloatArray) -> FloatArray:
    """Return two unit axes across a unit normal, as columns (3, 2): level to the right as seen from outside, and up."""
    level = np.cross((0.0, 0.0, 1.0), normal)
    level = np.cross(np.eye(3)[np.argmin(np.abs(normal))], normal) if np.linalg.norm(level) < 1e-3 else level
    return np.stack([_unit(level), np.cross(normal, _unit(level))], axis=1)


def proposed_rules(building: Building) -> PatchRules:
    """Return rules for one patch per element or opening with triangles, by its name, and for a patch "ground" if any.
    The rules are in the coordinates of the mesh, rounded to 1 mm."""
    rules, axes, origin = list[PatchRule](), building.axes, building.origin_m
    if building.ground_m is not None:
        foot = _vector(origin + (building.ground_m - 0.2) * axes[:, 2])
        rules.append(PatchRule("ground", plane=Plane(foot, _vector(axes[:, 2]), 0.4), only="exterior", facing="up"))
    for one in (one for one in building.every() if len(one.facets)):
        on, normal = (one.outline_m - one.depth_m * one.normal) @ axes.T + origin, axes @ one.normal
        reach, oblique = _WRINKLE_M * np.abs(normal), np.abs(normal).max() < 0.999
        box = Box(_vector(on.min(axis=0) - reach), _vector(on.max(axis=0) + reach))
        slab = Plane(_vector(on[0] - _WRINKLE_M * normal), _vector(normal), 2.0 * _WRINKLE_M)
        # The box around an oblique element holds more than the element; the slab cuts that off.
        rules.append(PatchRule(one.name, box, slab if oblique else None, None, "exterior", _vector(normal)))
    return PatchRules(tuple(rules))


def _vector(values: FloatArray) -> Vector:
    x, y, z = (round(float(value), 3) + 0.0 for value in values)
    return x, y, z
