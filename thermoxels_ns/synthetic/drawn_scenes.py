"""Synthetic scenes that were drawn by hand, some of them hard, for development; and the scene of each name."""

from __future__ import annotations

import dataclasses
import re
import zlib
from collections.abc import Callable
from functools import cache, partial
from typing import Any

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.synthetic.appearance import Paint, SunLight, plain, sky_rgb, sky_temperature_c
from thermoxels_ns.synthetic.random_plan import HAIR, Plan, Range, Wall, distance_to
from thermoxels_ns.synthetic.random_scene import (
    painted_scene,
    random_scene,
    random_seed,
    surrounded,
    warm_scene,
    with_room,
    with_street,
)
from thermoxels_ns.synthetic.scene_truth import CameraRing, CameraWalk, SyntheticScene, rings_around
from thermoxels_ns.synthetic.solids import Box, Cylinder, Sphere

HOUSE = "house-corner"
_HOUSE_AIR_C, _HOUSE_ROOM_C, _HOUSE_COEFFICIENT = 0.0, 20.0, 8.0
"""Air outside and room inside, [C], and the coefficient h between surface and air, [W/(m2 K)]: h = 5.8 + 3.8054 v
(Dall'O, Sarto and Panza 2013) in a wind v of 0.578 m/s. A surface is warmer than the air by U (Ti - Te) / h."""
_KELVIN_PER_U = (_HOUSE_ROOM_C - _HOUSE_AIR_C) / _HOUSE_COEFFICIENT
_HOUSE_WALL_U, _BRIDGE_U, _BRIDGE_WIDTH_M = 2.0, 1.2, 0.35  # U of the wall, and what the slab's band adds to it
BRIDGE_PSI_W_MK = _BRIDGE_U * _BRIDGE_WIDTH_M * float(np.sqrt(np.pi))
"""Extra loss of the slab's band per metre of its length, [W/(m K)]: 1.2 exp(-(z / 0.35 m)^2) W/(m2 K) over height z."""

_GLASS, _DOOR = Paint((0.22, 0.30, 0.40), 0.16), Paint((0.42, 0.22, 0.14), 0.18)
_PANE_M = 0.1
_Openings = tuple[tuple[Wall, Range, Range, float, Paint], ...]
"""For each opening: the wall, extents along the wall and in z [m], temperature [C] and paint of the pane."""


def hot_object() -> SyntheticScene:
    """Build a stepped hot block and a hot ball on a table, in a room of even temperature."""
    table: Box = ((-0.5, -0.4, -0.08), (0.5, 0.4, 0.0))
    lower: Box = ((-0.36, -0.2, 0.0), (-0.02, 0.12, 0.14))
    upper: Box = ((-0.36, -0.2, 0.14), (-0.18, 0.12, 0.28))
    ball = Sphere((0.24, -0.04, 0.12), 0.12)
    plan = _plan(
        (Paint((0.62, 0.47, 0.31), 0.26), table),
        (Paint((0.30, 0.50, 0.62), 0.28), lower, upper),
        (Paint((0.78, 0.34, 0.28), 0.26), ball),
    )

    def temperature_c(points: npt.ArrayLike) -> FloatArray:
        x, y, z = np.asarray(points, dtype=np.float64).T
        from_block = distance_to(lower, points) / 0.10
        from_contact = (np.hypot(x - ball.centre[0], y - ball.centre[1])) / 0.09
        table_c = 20.5 - 3.0 * x + 10.0 * np.exp(-from_block * from_block) + 7.0 * np.exp(-(from_contact**2))
        block_c, ball_c = 68.0 - 25.0 * z, 52.0 - 40.0 * (z - ball.centre[2])
        return _of_nearest(points, (table_c, table), (block_c, lower, upper), (ball_c, ball))

    return painted_scene(
        plan,
        texture_seed=11,
        scene_box=((-0.55, -0.45, -0.14), (0.55, 0.45, 0.34)),
        temperature_bounds_c=(18.0, 70.0),
        surface_temperature_c=temperature_c,
        rings=rings_around((0.0, 0.0), (0.05, 1.45, 0.36), (-0.02, 1.34, 0.80), (-0.07, 1.03, 1.38)),
        focal_share=1.0,
    )


def sphere() -> SyntheticScene:
    """Build one textured ball whose temperature is linear in height, before a uniform background."""
    return painted_scene(
        _plan((Paint((0.66, 0.60, 0.50), 0.32), Sphere((0.0, 0.0, 0.0), 0.5))),
        texture_seed=23,
        light=SunLight(ambient=0.75),
        scene_box=((-0.6, -0.6, -0.6), (0.6, 0.6, 0.6)),
        temperature_bounds_c=(10.0, 40.0),
        surface_temperature_c=lambda points: np.clip(30.0 + 20.0 * np.asarray(points)[:, 2], 20.0, 40.0),
        background_rgb=plain((0.75, 0.75, 0.75)),
        rings=rings_around((0.0, 0.0), (0.0, 1.75, -0.75), (0.0, 1.90, 0.15), (0.0, 1.60, 1.05)),
        focal_share=1.15,
    )


def pipes() -> SyntheticScene:
    """Build three pipes: two stand before a wall of little texture, a third crosses in front of both.

    The room is 16 C everywhere. The thick pipe is 59 C at its foot and 65 C at its top, the thin pipe 26 and 34 C. The
    crossing pipe falls from 50 to 38 C along x. The wall is warmer behind the two pipes that stand near it.
    """
    room_c, wall = 16.0, ((-1.3, 0.0, -0.9), (1.3, 0.16, 0.9))
    thick = Cylinder((-0.55, -0.28, 0.0), radius=0.13, length=1.6, axis=2)
    middle = Cylinder((0.05, -0.60, 0.3), radius=0.075, length=2.3, axis=0)
    thin = Cylinder((0.5, -0.2, 0.0), radius=0.04, length=1.7, axis=2)
    plan = _plan(
        (Paint((0.62, 0.61, 0.57), 0.10), wall),
        (Paint((0.58, 0.36, 0.26), 0.24), thick),
        (Paint((0.42, 0.50, 0.56), 0.24), middle),
        (Paint((0.66, 0.55, 0.30), 0.22), thin),
    )

    def temperature_c(points: npt.ArrayLike) -> FloatArray:
        x, y, z = np.asarray(points, dtype=np.float64).T
        front = np.exp(-np.maximum(y, 0.0) / 0.08)
        by_thick, by_thin = (x - thick.centre[0]) / 0.28, (x - thin.centre[0]) / 0.16
        wall_c = room_c + 1.0 + front * (9.0 * np.exp(-by_thick * by_thick) + 2.5 * np.exp(-by_thin * by_thin))
        rods = ((62.0 + 3.75 * z, thick), (44.0 - 5.2 * (x - 0.05), middle), (30.0 + 4.7 * z, thin))
        return _of_nearest(points, (wall_c, wall), *rods)

    return painted_scene(
        plan,
        texture_seed=41,
        light=SunLight(towards=(0.4, -0.8, 0.5), ambient=0.6),
        scene_box=((-1.42, -0.85, -1.05), (1.42, 0.30, 1.05)),
        temperature_bounds_c=(room_c, 66.0),
        surface_temperature_c=temperature_c,
        rings=rings_around(
            (0.0, -0.15), (0.13, 3.5, -0.7), (-0.04, 3.6, 0.25), (-0.15, 3.35, 1.4), start_deg=-160.0, span_deg=140.0
        ),
        focal_share=0.87,
    )


def house_corner(white: bool = False) -> SyntheticScene:
    """Build a house: recessed warm windows, a door, a balcony slab, a roof, ground around, sky above.

    `white`: walls of white plaster without texture, in the even light of a white sky.

    The room is 20 C, the air 0 C, and the coefficient between surface and air 8 W/(m2 K). So walls (U = 2.0 W/(m2 K))
    are 5 C, the door (3.6) 9 C and single panes (4.8 to 5.8) 12 to 14.5 C warm; the warmth of panes fades over the
    reveals. The storey slab shows as a band 3 K warmer, the balcony cools like a fin towards the air, and the sky falls
    from 0 C at the horizon to -20 C at the zenith.
    """
    building: Box = ((-3.0, -2.5, 0.0), (3.0, 2.5, 5.0))
    ground: Box = ((-3.3, -4.2, -0.45), (4.3, 2.9, 0.0))
    roof: Box = ((-3.3, -2.8, 5.0), (3.3, 2.8, 5.35))
    balcony: Box = ((-1.6, -3.8, 2.45), (1.4, -2.5, 2.8))
    front: Wall = (1, -1, building[0][1])
    side: Wall = (0, +1, building[1][0])
    panes = (  # the last is the U-value
        (front, (-2.4, -1.2), (0.9, 2.0), 5.6),
        (front, (0.9, 2.3), (0.9, 2.0), 5.2),
        (front, (-1.1, 0.0), (2.8, 4.5), 5.8),
        (front, (1.6, 2.5), (3.3, 4.4), 4.8),
        (side, (0.5, 1.8), (0.9, 2.0), 5.4),
        (side, (-1.6, 0.2), (3.2, 4.4), 5.6),
        (side, (1.0, 1.9), (3.2, 4.4), 5.0),
    )
    door = (side, (-1.7, -0.6), (0.0, 2.1), _HOUSE_AIR_C + _KELVIN_PER_U * 3.6, _DOOR)
    plan = _plan(
        (Paint((0.93, 0.93, 0.92), 0.0) if white else Paint((0.74, 0.64, 0.47), 0.22), building),
        (Paint((0.36, 0.42, 0.27), 0.24), ground),
        (Paint((0.45, 0.27, 0.24), 0.20), roof),
        (Paint((0.58, 0.58, 0.57), 0.22), balcony),
        openings=(*((wall, along, z, _HOUSE_AIR_C + _KELVIN_PER_U * u, _GLASS) for wall, along, z, u in panes), door),
        recess_m=0.35,
    )
    wall_c, bridge_k = _HOUSE_AIR_C + _KELVIN_PER_U * _HOUSE_WALL_U, _KELVIN_PER_U * _BRIDGE_U

    def temperature_c(points: npt.ArrayLike) -> FloatArray:
        points = np.asarray(points, dtype=np.float64)
        z = points[:, 2]
        lift = (z - 0.5 * (balcony[0][2] + balcony[1][2])) / _BRIDGE_WIDTH_M
        house_c = wall_c + 0.3 * (z - 2.5) / 2.5 + bridge_k * np.exp(-lift * lift)
        plan.add_glows(house_c, points)
        from_house = distance_to(building, points)
        fin_c = _HOUSE_AIR_C + 1.0 + (wall_c + bridge_k - 1.0) * np.exp(-from_house / 0.6)
        ground_c = _HOUSE_AIR_C + 1.5 + 2.5 * np.exp(-from_house / 0.7)
        roof_c = 3.0 - 2.0 * np.minimum(from_house / 0.6, 1.0)
        others_c = _of_nearest(points, (fin_c, balcony), (ground_c, ground), (roof_c, roof))
        return np.where(from_house > 1e-6, others_c, house_c)

    return painted_scene(
        plan,
        texture_seed=7,
        light=SunLight(towards=(0.75, -0.45, 0.5), ambient=0.88 if white else SunLight.ambient),
        scene_box=((-3.7, -4.6, -0.8), (4.7, 3.3, 5.8)),
        temperature_bounds_c=(-20.0, 15.0),
        surface_temperature_c=temperature_c,
        background_rgb=plain((0.94, 0.94, 0.94)) if white else sky_rgb,
        background_temperature_c=lambda directions: sky_temperature_c(directions, _HOUSE_AIR_C, 20.0),
        rings=rings_around(
            (0.4, -0.7), (2.4, 11.8, 1.7), (1.7, 12.1, 4.8), (1.3, 11.6, 9.0), start_deg=-145.0, span_deg=200.0
        ),
        focal_share=0.86,
    )


def true_u_w_m2k(points: npt.ArrayLike) -> FloatArray:
    """Return the U-value [W/(m2 K)] (n,) that gives the house's walls and panes their temperature at points (n, 3)."""
    return (house_corner().surface_temperature_c(points) - _HOUSE_AIR_C) / _KELVIN_PER_U


def courtyard() -> SyntheticScene:
    """Build a courtyard: a U of three wings, a pergola, a thin garden wall, roofs that stand out, ground and sky.

    The west wing has nearly no texture; the north and the east wing have some. Walls are 5 to 11 C warm, panes and the
    door 16 to 22 C, roofs -2.5 to 1 C, the garden wall about 15 C on its sunny side and 5 C on the other. The chimney
    rises from 12 to 30 C, and a flue beside the east wall, 0.35 m wide, is 39.5 C hot. The sky falls from 2 C at the
    horizon to -10 C at the zenith.
    """
    ground: Box = ((-5.2, -5.2, -0.4), (5.2, 5.2, 0.0))
    # A U of three wings that opens towards -y; the east wing is lower and shorter.
    west: Box = ((-3.9, -2.4, 0.0), (-1.7, 2.0, 3.4))
    north: Box = ((-3.9, 2.0, 0.0), (3.9, 4.2, 3.4))
    east: Box = ((1.7, -0.9, 0.0), (3.9, 2.0, 2.7))
    roofs: tuple[Box, ...] = (
        ((-4.3, -2.8, 3.4), (-1.3, 2.0, 3.7)),
        ((-4.3, 1.6, 3.4), (4.3, 4.6, 3.7)),
        ((1.3, -1.3, 2.7), (4.3, 2.0, 3.0)),
    )
    chimney: Box = ((0.4, 2.9, 3.7), (0.9, 3.4, 4.6))
    # A pergola across the mouth of the yard: a beam on columns 2.5 % as thick as the scene is wide.
    x, y, thick, top = (-0.75, 0.25, 1.25, 2.25), -2.3, 0.28, 2.4
    pergola: list[Box] = [((at, y, 0.0), (at + thick, y + thick, top)) for at in x]
    pergola.append(((west[1][0], y, top), (x[-1] + thick, y + thick, top + thick)))
    # A free-standing wall. It is 1.8 voxels thick if 128 voxels span the scene.
    garden_wall: Box = ((1.2, -4.4, 0.0), (4.8, -4.24, 1.6))
    flue: Box = ((3.9, 0.3, 1.2), (4.25, 0.65, 1.55))
    plan = _plan(
        (Paint((0.52, 0.50, 0.44), 0.24), ground),
        (Paint((0.78, 0.74, 0.66), 0.025), west),
        (Paint((0.60, 0.38, 0.29), 0.24), north),
        (Paint((0.70, 0.62, 0.42), 0.22), east),
        (Paint((0.36, 0.33, 0.34), 0.20), *roofs),
        (Paint((0.72, 0.70, 0.67), 0.16), *pergola),
        (Paint((0.62, 0.56, 0.50), 0.20), garden_wall),
        (Paint((0.34, 0.34, 0.38), 0.16), chimney, flue),
        openings=(
            ((1, -1, 2.0), (-1.1, -0.1), (0.0, 2.1), 22.0, _DOOR),
            ((1, -1, 2.0), (0.5, 1.3), (1.0, 2.2), 17.0, _GLASS),
            ((0, +1, -1.7), (-1.2, 0.3), (0.9, 2.2), 18.0, _GLASS),
            ((0, +1, 3.9), (2.4, 3.6), (1.1, 2.3), 16.0, _GLASS),
            ((1, +1, 4.2), (-2.6, -1.2), (1.1, 2.3), 17.0, _GLASS),
            ((1, -1, -0.9), (2.3, 3.4), (0.9, 2.0), 19.0, _GLASS),
        ),
        recess_m=0.3,
    )

    def temperature_c(points: npt.ArrayLike) -> FloatArray:
        points = np.asarray(points, dtype=np.float64)
        x, y, z = points.T
        flue_c = np.full_like(x, 39.5)
        house_c = 8.0 + 0.6 * np.clip(x, -3.9, 3.9) + 0.3 * (np.clip(z, 0.0, 3.4) - 1.7)
        plan.add_glows(house_c, points)
        from_flue = distance_to(flue, points) / 0.35
        house_c += (flue_c - house_c) * np.exp(-from_flue * from_flue)
        from_house = np.min([distance_to(wing, points) for wing in (west, north, east)], axis=0)
        sunny = np.clip((garden_wall[1][1] - y) / (garden_wall[1][1] - garden_wall[0][1]), 0.0, 1.0)
        return _of_nearest(
            points,
            (house_c, west, north, east),
            (2.5 + 0.25 * x + 3.0 * np.exp(-from_house / 0.7), ground),
            (-1.0 + 0.45 * np.clip(y, -3.3, 4.6), *roofs),
            (3.0 + 1.5 * np.clip(z, 0.0, 2.7), *pergola),
            (5.0 + 10.0 * sunny + 0.4 * (np.clip(x, 1.2, 4.8) - 3.0), garden_wall),
            (flue_c, flue),
            (12.0 + 20.0 * (np.clip(z, 3.7, 4.6) - 3.7), chimney),
        )

    return painted_scene(
        plan,
        texture_seed=31,
        light=SunLight(towards=(0.5, -0.7, 0.6)),
        scene_box=((-5.7, -5.7, -0.8), (5.7, 5.7, 5.1)),
        temperature_bounds_c=(-10.0, 40.0),
        surface_temperature_c=temperature_c,
        background_rgb=sky_rgb,
        background_temperature_c=lambda directions: sky_temperature_c(directions, 2.0, 12.0),
        rings=(
            CameraRing((0.0, -0.3, 1.5), 15.0, 1.9, start_deg=-200.0, span_deg=220.0),
            *rings_around((0.0, 0.0), (0.1, 14.0, 7.2), (-0.4, 11.0, 12.6)),
        ),
        focal_share=0.79,
    )


def _plan(*painted: tuple[Any, ...], openings: _Openings = (), recess_m: float = 0.0) -> Plan:
    """Return a plan in metres with shapes `painted`, (paint, shape ...), and openings with panes `recess_m` deep."""
    plan = Plan(np.random.default_rng(0), unit=_PANE_M)
    for paint, *shapes in painted:
        number = plan.add_paint(paint)
        for shape in shapes:
            plan.put(shape, number)
    for wall, along, height, degrees_c, paint in openings:
        plan.recess(wall, along, height, recess_m, plan.add_paint(paint), degrees_c)
    return plan


def _of_nearest(points: npt.ArrayLike, *bodies: tuple[Any, ...]) -> FloatArray:
    """Return the temperature (n,) of the body nearest to each point (n, 3). A body is temperatures (n,) and shapes."""
    far = [np.min([distance_to(shape, points) for shape in shapes], axis=0) for _, *shapes in bodies]
    return np.choose(np.argmin(far, axis=0), [degrees for degrees, *_ in bodies])


_ROOM_C, _AIR_C, _SKY_DROP_K = 20.0, 4.0, 25.0


def wall_object() -> SyntheticScene:
    """Build an object of a few connected shapes on a small stand, before a plain grey wall.

    The object is textured and 22 to 45 C warm, the wall and the room are 20 C; cameras stand in a half ring in front.
    """
    plan = Plan(np.random.default_rng(5))
    stand, body, arm, metal = (
        plan.add_paint(Paint(base, 0.28))
        for base in ((0.50, 0.42, 0.34), (0.66, 0.40, 0.28), (0.36, 0.50, 0.58), (0.70, 0.60, 0.32))
    )
    trunk: Box = ((-24.0, -10.0, 20.0), (12.0, 10.0, 52.0))
    plan.put(((-28.0, -20.0, 0.0), (34.0, 20.0, 8.0)), stand, 0.0)
    plan.put(((-14.0, -12.0, 8.0), (10.0, 12.0, 20.0)), stand, 0.2)
    plan.put(trunk, body, 0.6)
    plan.put(((12.0, -6.0, 34.0), (32.0, 6.0, 44.0)), arm, 0.4)
    plan.put(Cylinder((22.0, 0.0, 53.0 + HAIR), 9.0, 16.0, 1), metal, 1.0)
    plan.put(Cylinder((-8.0, 0.0, 59.0 + HAIR), 7.0, 14.0, 2), arm, 0.5)
    plan.put(Sphere((-8.0, 0.0, 77.0 + 2.0 * HAIR), 11.0), metal, 0.9)
    plan.spot(trunk, 1.0, 14.0)
    scene = warm_scene(
        plan.scaled(0.012),
        texture_seed=23,
        light=SunLight((0.3, -0.8, 0.6), ambient=0.7),
        surface_c=(_ROOM_C + 2.0, 45.0),
        temperature_bounds_c=(_ROOM_C, 45.0),
        rings=rings_around(
            (0.04, 0.0), (0.52, 1.75, 0.25), (0.52, 1.85, 0.8), (0.5, 1.65, 1.45), start_deg=-160.0, span_deg=140.0
        ),
        focal_share=0.98,
    )
    # A large upright wall stands behind, at the temperature of the air; the background past its edges has its colour.
    behind_m, half_m = 0.7, 25.0
    wall = Plan(np.random.default_rng(0), paints=[Paint((0.55, 0.55, 0.55), 0.0)])
    wall.put(((-half_m, behind_m, -half_m), (half_m, behind_m + 0.1, half_m)), 0)
    scene = surrounded(scene, wall, seed=0, range_k=0.0)
    assert scene.around is not None
    seen = scene.around.colour([[0.0, behind_m, 0.0]], [[0.0, -1.0, 0.0]])[0]
    return dataclasses.replace(scene, background_rgb=plain(seen.tolist()))


def living_room(corner: bool = False) -> SyntheticScene:
    """Build a furnished room of 5.2 x 4.2 x 2.7 m, photographed from inside, with white walls and a plain ceiling.

    Walls are 17 to 19 C, and colder in the corners of the outer wall. Its window has 12 C and its radiator 45 C. With
    `corner`, walls cut one corner off, so that the room is L-shaped.
    """
    x, y, high, thick = 2.6, 2.1, 2.7, 0.25
    radiator: Box = ((x - 0.12, -1.0, 0.12), (x, 0.6, 0.75))
    outer: list[Box] = [((side - thick, -y - thick, 0.0), (side, y + thick, high)) for side in (-x, x + thick)]
    inner: list[Box] = [((-x, side - thick, 0.0), (x, side, high)) for side in (-y, y + thick)]
    inner += [((0.4, 0.3, 0.0), (x, y, high))] * corner
    legs: list[Box] = [((a, b, 0.0), (a + 0.06, b + 0.06, 0.7)) for a in (-0.48, 0.42) for b in (-0.33, 0.27)]
    wood = Paint((0.55, 0.42, 0.30), 0.2)
    plan = _plan(
        (Paint((0.52, 0.38, 0.26), 0.22), ((-x - thick, -y - thick, -thick), (x + thick, y + thick, 0.0))),
        (Paint((0.92, 0.92, 0.91), 0.0), ((-x - thick, -y - thick, high), (x + thick, y + thick, high + thick))),
        (Paint((0.90, 0.89, 0.86), 0.02), *outer, *inner),
        (wood, ((-0.5, -0.35, 0.7), (0.5, 0.35, 0.75)), *legs, ((0.9, y - 0.35, 0.0), (2.1, y, 1.9))),
        (Paint((0.35, 0.40, 0.46), 0.2), ((-x, -1.2, 0.0), (-1.8, 0.8, 0.42)), ((-x, -1.2, 0.42), (-2.3, 0.8, 0.85))),
        (Paint((0.93, 0.93, 0.93), 0.02), radiator),
        openings=(
            ((0, -1, x), (-1.0, 0.6), (0.95, 2.15), 12.0, _GLASS),
            ((1, +1, -y), (-1.9, -1.0), (0.0, 2.05), 18.5, _DOOR),
        ),
        recess_m=0.12,
    )

    along_arms = (
        CameraRing((-1.1, -0.9, 1.4), 0.9, 1.5),
        CameraWalk(((-1.2, 1.6, 1.6), (-0.6, -1.2, 1.5)), ((-0.8, -y, 1.3), (x, -1.0, 1.3))),
        CameraWalk(((2.0, -1.0, 1.5), (-0.8, -0.4, 1.6)), ((-x, -1.0, 1.3), (-1.2, y, 1.3))),
    )

    def temperature_c(points: npt.ArrayLike) -> FloatArray:
        points = np.asarray(points, dtype=np.float64)
        across, along, z = points.T
        degrees = 18.5 + 0.5 * (z - 1.3) - 2.0 * np.exp(-np.abs(x - across) / 0.3)
        degrees -= 2.5 * np.exp(-np.hypot(across - x, along - y) / 0.3)
        degrees -= 1.5 * np.exp(-np.hypot(across - x, z - high) / 0.25)
        plan.add_glows(degrees, points)
        return degrees + (45.0 - degrees) * np.exp(-np.square(distance_to(radiator, points) / 0.15))

    return painted_scene(
        plan,
        texture_seed=5,
        scene_box=((-x - 0.4, -y - 0.4, -0.4), (x + 0.4, y + 0.4, high + 0.4)),
        temperature_bounds_c=(5.0, 50.0),
        surface_temperature_c=temperature_c,
        background_rgb=sky_rgb,
        background_temperature_c=lambda directions: sky_temperature_c(directions, 10.0, 3.0),
        rings=along_arms if corner else rings_around((0.0, 0.0), (1.35, 1.6, 1.5), (0.9, 1.5, 1.9), (1.9, 1.45, 1.1)),
        focal_share=0.62,
    )


def facade(street: bool = False) -> SyntheticScene:
    """Build the textured front of a house, 10.4 m wide and 7.6 m high, with windows, ledges, a door and some ground.

    Three lines of cameras run along its front. The sky has one colour. With `street`, the sky is blue, the front has
    plain plaster, mirroring panes, no ledges, and a balcony with a railing of 2 cm bars; textured houses stand all
    round, and the panes mirror those behind the cameras.
    """
    plan = Plan(np.random.default_rng(8))
    paints = (
        Paint((0.80, 0.76, 0.68), 0.0) if street else Paint((0.70, 0.60, 0.46), 0.25),
        Paint((0.46, 0.45, 0.42), 0.26),
        Paint((0.58, 0.55, 0.50), 0.22),
        Paint((0.22, 0.30, 0.40), 0.0, mirror=0.6) if street else _GLASS,
        Paint((0.42, 0.24, 0.16), 0.2),
        Paint((0.30, 0.32, 0.34), 0.1),
    )
    plaster, ground, stone, glass, door, metal = map(plan.add_paint, paints)
    plan.put(((-60.0, -32.0, -4.0), (60.0, 14.0, 0.0)), ground, 0.0)
    plan.put(((-52.0, 0.0, 0.0), (52.0, 14.0, 76.0)), plaster, 0.35)
    for out, low, high in ((3.5, 0.0, 7.0), (5.0, 71.0, 76.0), (3.2, 36.0, 40.0)):
        plan.put(((-52.0, -out, low), (52.0, 0.0, high)), stone, 0.2)
    for column in range(5):
        for low in (12.0, 46.0):
            x = -40.0 + 20.0 * column
            if (column, low) == (2, 12.0):
                plan.recess((1, -1, 0.0), (-7.0, 7.0), (7.0, 31.0), 3.5, door, 0.6)
                continue
            plan.recess((1, -1, 0.0), (x - 6.0, x + 6.0), (low, low + 18.0), 3.5, glass, 0.7 + 0.05 * column)
            if not street:
                plan.put(((x - 8.0, -3.2, low - 3.2), (x + 8.0, 0.0, low)), stone, 0.25)
    if street:
        _balcony(plan, stone, metal)
    scene = warm_scene(
        plan.scaled(0.1),
        texture_seed=29,
        light=SunLight((0.4, -0.7, 0.6)),
        surface_c=(_AIR_C, 18.0),
        temperature_bounds_c=(_AIR_C - _SKY_DROP_K, 18.0),
        background_rgb=sky_rgb if street else plain((0.62, 0.72, 0.84)),
        background_temperature_c=lambda directions: sky_temperature_c(directions, _AIR_C, _SKY_DROP_K),
        rings=tuple(
            CameraWalk(((-x, y, z), (x, y, z)), ((-aim, 0.0, 3.4), (aim, 0.0, 3.4)))
            for x, y, z, aim in ((6.5, -12.0, 1.7, 1.0), (7.5, -11.0, 4.2, 2.0), (5.0, -9.5, 2.6, 2.8))
        ),
        focal_share=0.8,
    )
    return with_street(scene, seed=1) if street else scene


def _balcony(plan: Plan, stone: int, metal: int) -> None:
    """Add a balcony over the door to a plan in decimetres: a slab, bars (2 cm thick, 12 cm apart), a rail on top."""
    x, out, low, top, thick = 18.0, 13.0, 39.0, 50.0, 0.2
    plan.put(((-x, -out, low - 3.0), (x, 0.0, low)), stone, 0.3)
    across, along = np.arange(-x + 0.2, x - 0.2, 1.2).tolist(), np.arange(-out + 1.4, -1.0, 1.2).tolist()
    rails: list[Box] = [((-x, -out, top), (x, -out + thick, top + 0.4))]
    bars = [(at, -out) for at in across] + [(side, at) for side in (-x, x - thick) for at in along]
    rails += [((side, -out, top), (side + thick, 0.0, top + 0.4)) for side in (-x, x - thick)]
    for box in rails + [((bx, by, low), (bx + thick, by + thick, top)) for bx, by in bars]:
        plan.put(box, metal, 0.1)


_BUILDERS: dict[str, Callable[..., SyntheticScene]] = {
    "hot-object": hot_object,
    HOUSE: house_corner,
    "sphere": sphere,
    "courtyard": courtyard,
    "pipes": pipes,
    "wall-object": wall_object,
    "living-room": living_room,
    "l-room": partial(living_room, corner=True),
    "facade": facade,
    "street": partial(facade, street=True),
}
DEVELOPMENT_NAMES = ("wall-object", "living-room", "l-room", "facade", "street")
"""Names of hand-drawn scenes that are hard, for development."""
SCENE_NAMES = tuple(name for name in _BUILDERS if name not in DEVELOPMENT_NAMES)
"""Names of the other hand-drawn scenes; `make_scene` also knows `DEVELOPMENT_NAMES`, `random-N` and `wild-N`."""

VARIANTS = "+sky=R,G,B, +white, +street, +room"
"""Endings of a name, in any order: a sky of one colour (0 to 1); white plaster under a white sky (house-corner only);
houses and trees around the scene; a room around the scene. Street and room exclude each other."""
_SKY = re.compile(r"sky=((?:0?\.\d+|[01](?:\.0*)?)(?:,(?:0?\.\d+|[01](?:\.0*)?)){2})")


@cache
def make_scene(name: str) -> SyntheticScene:
    """Return the synthetic scene of a name.

    A name is one of `SCENE_NAMES` or `DEVELOPMENT_NAMES`, or ``random-`` or ``wild-`` and a seed without leading zeros.
    Some of `VARIANTS` may follow, such as ``sphere+sky=1,1,1`` or ``random-3+street``.

    Raises:
        SceneError: No scene has this name; the message lists the known names.

    >>> make_scene("sphere").temperature_bounds_c
    (10.0, 40.0)
    """
    base, *variants = name.split("+")
    kinds, seed = {variant.split("=")[0] for variant in variants}, random_seed(base)
    known = base in _BUILDERS or seed is not None
    known &= all(variant in ("white", "street", "room") or _SKY.fullmatch(variant) for variant in variants)
    if not known or len(kinds) < len(variants) or kinds >= {"street", "room"} or ("white" in kinds and base != HOUSE):
        every = ", ".join(_BUILDERS)
        expected = f"random-N or wild-N with a whole number N from 0 on, or one of {every}; with {VARIANTS} if you like"
        remedy = f"Choose one of these names, or write random-17 or {HOUSE}+sky=0.55,0.57,0.60."
        raise SceneError("synthetic scene", expected=expected, got=repr(name), remedy=remedy)
    if seed is None:
        scene = _BUILDERS[base](**({"white": True} if "white" in variants else {}))
    else:
        scene = random_scene(seed, wild=base.startswith("wild"))
    for variant in sorted(variants):
        if sky := _SKY.fullmatch(variant):
            scene = dataclasses.replace(scene, background_rgb=plain([float(c) for c in sky[1].split(",")]))
        elif variant != "white":
            scene = (with_street if variant == "street" else with_room)(scene, seed=zlib.crc32(base.encode()))
    return dataclasses.replace(scene, name=name)
