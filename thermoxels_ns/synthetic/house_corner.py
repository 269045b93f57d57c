"""The synthetic scene `house-corner`: a heated building seen from outside under a cold sky."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from thermoxels_ns.synthetic.appearance import Paint, SolidTexture, SunLight, painted, sky_rgb, sky_temperature_c
from thermoxels_ns.synthetic.box_solid import BoxSolid, distance_to_box, recesses
from thermoxels_ns.synthetic.camera_rings import CameraRing
from thermoxels_ns.synthetic.scene_truth import SyntheticScene
from thermoxels_ns.synthetic.solids import Box
from thermoxels_ns.synthetic.surroundings import plain

FloatArray = npt.NDArray[np.float64]

_BOX: Box = ((-3.7, -4.6, -0.8), (4.7, 3.3, 5.8))
_GROUND: Box = ((-3.3, -4.2, -0.45), (4.3, 2.9, 0.0))
_BUILDING: Box = ((-3.0, -2.5, 0.0), (3.0, 2.5, 5.0))
_ROOF: Box = ((-3.3, -2.8, 5.0), (3.3, 2.8, 5.35))
_BALCONY: Box = ((-1.6, -3.8, 2.45), (1.4, -2.5, 2.8))

_FRONT_Y, _SIDE_X = _BUILDING[0][1], _BUILDING[1][0]
_RECESS_M = 0.35
_PANE_M = 0.10

_GLASS, _DOOR = 4, 5
# Openings: plane's axis, outward sign and position; (along the wall from, to); (z from, to); U [W/(m2 K)]; paint.
_OPENINGS = (
    (1, -1, _FRONT_Y, (-2.4, -1.2), (0.9, 2.0), 5.6, _GLASS),
    (1, -1, _FRONT_Y, (0.9, 2.3), (0.9, 2.0), 5.2, _GLASS),
    (1, -1, _FRONT_Y, (-1.1, 0.0), (2.8, 4.5), 5.8, _GLASS),
    (1, -1, _FRONT_Y, (1.6, 2.5), (3.3, 4.4), 4.8, _GLASS),
    (0, +1, _SIDE_X, (-1.7, -0.6), (0.0, 2.1), 3.6, _DOOR),
    (0, +1, _SIDE_X, (0.5, 1.8), (0.9, 2.0), 5.4, _GLASS),
    (0, +1, _SIDE_X, (-1.6, 0.2), (3.2, 4.4), 5.6, _GLASS),
    (0, +1, _SIDE_X, (1.0, 1.9), (3.2, 4.4), 5.0, _GLASS),
)

HOUSE = "house-corner"
_AIR_C, _ROOM_C, _SKY_DROP_K = 0.0, 20.0, 20.0
_COEFFICIENT = 8.0
"""Between surface and air, [W/(m2 K)]: 5.8 + 3.8054 v (Dall'O, Sarto and Panza 2013) in a wind of 0.578 m/s."""
_KELVIN_PER_U = (_ROOM_C - _AIR_C) / _COEFFICIENT  # A surface is warmer than the air by U (Ti - Te) / h
_WALL_C, _BRIDGE_K = _AIR_C + _KELVIN_PER_U * 2.0, _KELVIN_PER_U * 1.2  # U of the wall, and what the slab's band adds
_BRIDGE_Z, _BRIDGE_WIDTH_M = 0.5 * (_BALCONY[0][2] + _BALCONY[1][2]), 0.35
BRIDGE_PSI_W_MK = _BRIDGE_K / _KELVIN_PER_U * _BRIDGE_WIDTH_M * float(np.sqrt(np.pi))
"""Extra loss of the band, 1.2 exp(-(z / 0.35 m)^2) W/(m2 K) over the height, per metre and kelvin, [W/(m K)]."""
_WHITE_SKY = (0.94, 0.94, 0.94)


def house_corner(white: bool = False) -> SyntheticScene:
    """Build the house: recessed warm windows, a door, a balcony slab, a roof, ground around, sky above.

    `white`: walls of white plaster without texture, in the even light of a white sky.

    20 C inside and 0 C outside: walls of U = 2.0, single panes of 4.8 to 5.8 and a door of 3.6 W/(m2 K) are as warm as
    8 W/(m2 K) between surface and air make them, 5 C and 9 to 14.5 C, with a smooth fall over the reveals. The storey
    slab shows as a band 3 K warmer, the balcony cools like a fin towards the air, and the sky falls from 0 C at the
    horizon to -20 C at the zenith.
    """
    cut, panes = recesses(_OPENINGS, _RECESS_M, _PANE_M)
    panes_c = [_AIR_C + _KELVIN_PER_U * opening[5] for opening in _OPENINGS]
    pane_paints = [opening[6] for opening in _OPENINGS]
    texture = SolidTexture(_BOX, seed=7)
    light = SunLight(towards=(0.75, -0.45, 0.5), ambient=0.88 if white else SunLight.ambient)
    paints = (
        Paint((0.93, 0.93, 0.92), 0.0) if white else Paint((0.74, 0.64, 0.47), 0.22),  # plaster
        Paint((0.36, 0.42, 0.27), 0.24),  # grass
        Paint((0.45, 0.27, 0.24), 0.20),  # roof
        Paint((0.58, 0.58, 0.57), 0.22),  # balcony
        Paint((0.22, 0.30, 0.40), 0.16),  # glass
        Paint((0.42, 0.22, 0.14), 0.18),  # door
    )

    def part(points: npt.ArrayLike, normals: npt.ArrayLike) -> npt.NDArray[np.int64]:
        inner = np.asarray(points) - 1e-4 * np.asarray(normals)
        x, y, z = np.ascontiguousarray(inner.T)
        number = np.zeros(len(x), dtype=np.int64)
        number[z < 0.0] = 1
        number[z > _BUILDING[1][2]] = 2
        number[(y < _FRONT_Y) & (z > 0.0) & (z < _BUILDING[1][2])] = 3
        for (lo, hi), kind in zip(panes, pane_paints):
            inside = (x > lo[0]) & (x < hi[0]) & (y > lo[1]) & (y < hi[1]) & (z > lo[2]) & (z < hi[2])
            number[inside] = kind
        return number

    def temperature_c(points: npt.ArrayLike) -> FloatArray:
        points = np.asarray(points, dtype=np.float64)
        z = points[:, 2]
        lift = (z - _BRIDGE_Z) / _BRIDGE_WIDTH_M
        degrees = _WALL_C + 0.3 * (z - 2.5) / 2.5 + _BRIDGE_K * np.exp(-lift * lift)
        for (lo, hi), pane_c in zip(panes, panes_c):
            near = np.ones(len(points), dtype=bool)
            for axis in range(3):
                near &= np.abs(points[:, axis] - 0.5 * (lo[axis] + hi[axis])) < 0.5 * (hi[axis] - lo[axis]) + _RECESS_M
            share = np.maximum(1.0 - distance_to_box(points[near], lo, hi) / _RECESS_M, 0.0)
            degrees[near] += (pane_c - degrees[near]) * share * share * (3.0 - 2.0 * share)
        from_house = distance_to_box(points, *_BUILDING)
        fin_c = _AIR_C + 1.0 + (_WALL_C + _BRIDGE_K - 1.0) * np.exp(-from_house / 0.6)
        ground_c = _AIR_C + 1.5 + 2.5 * np.exp(-from_house / 0.7)
        roof_c = 3.0 - 2.0 * np.minimum(from_house / 0.6, 1.0)
        outside = from_house > 1e-6
        distances = [np.where(outside, distance_to_box(points, *b), np.inf) for b in (_BALCONY, _GROUND, _ROOF)]
        nearest = np.argmin([from_house, *distances], axis=0)
        return np.choose(nearest, [degrees, fin_c, ground_c, roof_c])

    return SyntheticScene(
        name=HOUSE,
        solid=BoxSolid((_GROUND, _BUILDING, _ROOF, _BALCONY), removed=cut),
        scene_box=_BOX,
        temperature_bounds_c=(_AIR_C - _SKY_DROP_K, 15.0),
        colour=lambda points, normals: painted(points, normals, part(points, normals), paints, texture, light),
        surface_temperature_c=temperature_c,
        background_rgb=plain(_WHITE_SKY) if white else sky_rgb,
        background_temperature_c=lambda directions: sky_temperature_c(directions, _AIR_C, _SKY_DROP_K),
        rings=tuple(
            CameraRing((0.4, -0.7, aim), radius, height, start_deg=-145.0, span_deg=200.0)
            for aim, radius, height in ((2.4, 11.8, 1.7), (1.7, 12.1, 4.8), (1.3, 11.6, 9.0))
        ),
        focal_share=0.86,
    )


def true_u_w_m2k(points: npt.ArrayLike) -> FloatArray:
    """U-value that the surface temperature of walls and panes follows from at points (n, 3), shape (n,), [W/(m2 K)]."""
    return (house_corner().surface_temperature_c(points) - _AIR_C) / _KELVIN_PER_U
