"""Synthetic scenes that were drawn by hand: `hot-object`, `house-corner`, `sphere`, `courtyard` and `pipes`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import Float32Array, FloatArray, IntArray
from thermoxels_ns.synthetic.appearance import (
    Paint,
    SolidTexture,
    SunLight,
    painted,
    plain,
    room_rgb,
    sky_rgb,
    sky_temperature_c,
)
from thermoxels_ns.synthetic.camera_rings import CameraRing
from thermoxels_ns.synthetic.scene_truth import SyntheticScene
from thermoxels_ns.synthetic.solids import (
    Box,
    BoxSolid,
    Cylinder,
    Solid,
    SolidUnion,
    Sphere,
    box_beside,
    distance_to_box,
    fade_towards,
)

HOUSE = "house-corner"
_HOUSE_AIR_C, _HOUSE_ROOM_C, _HOUSE_COEFFICIENT = 0.0, 20.0, 8.0
"""The coefficient is that between surface and air, [W/(m2 K)]: 5.8 + 3.8054 v (Dall'O, Sarto and Panza 2013) in a wind
of 0.578 m/s. A surface is warmer than the air by U (Ti - Te) / h."""
_KELVIN_PER_U = (_HOUSE_ROOM_C - _HOUSE_AIR_C) / _HOUSE_COEFFICIENT
_HOUSE_WALL_U, _BRIDGE_U, _BRIDGE_WIDTH_M = 2.0, 1.2, 0.35  # Of the wall, and what the slab's band adds, [W/(m2 K)]
BRIDGE_PSI_W_MK = _BRIDGE_U * _BRIDGE_WIDTH_M * float(np.sqrt(np.pi))
"""Extra loss of the band, 1.2 exp(-(z / 0.35 m)^2) W/(m2 K) over the height, per metre and kelvin, [W/(m K)]."""

_GLASS_PAINT, _DOOR_PAINT = Paint((0.22, 0.30, 0.40), 0.16), Paint((0.42, 0.22, 0.14), 0.18)


def hot_object() -> SyntheticScene:
    """Build a stepped hot block and a hot ball on a table, in a room of even temperature."""
    table: Box = ((-0.5, -0.4, -0.08), (0.5, 0.4, 0.0))
    lower: Box = ((-0.36, -0.2, 0.0), (-0.02, 0.12, 0.14))
    upper: Box = ((-0.36, -0.2, 0.14), (-0.18, 0.12, 0.28))
    ball = Sphere((0.24, -0.04, 0.12), 0.12)
    bodies = ([table], [lower, upper], [ball])

    def temperature_c(points: npt.ArrayLike) -> FloatArray:
        x, y, z = np.asarray(points, dtype=np.float64).T
        from_block = distance_to_box(points, *lower) / 0.10
        from_contact = (np.hypot(x - ball.centre[0], y - ball.centre[1])) / 0.09
        table_c = 20.5 - 3.0 * x + 10.0 * np.exp(-from_block * from_block) + 7.0 * np.exp(-(from_contact**2))
        return np.choose(_nearest(points, bodies), [table_c, 68.0 - 25.0 * z, 52.0 - 40.0 * (z - ball.centre[2])])

    return _scene(
        name="hot-object",
        solid=SolidUnion((BoxSolid((table, lower, upper)), ball)),
        scene_box=((-0.55, -0.45, -0.14), (0.55, 0.45, 0.34)),
        temperature_bounds_c=(18.0, 70.0),
        paints=(Paint((0.62, 0.47, 0.31), 0.26), Paint((0.30, 0.50, 0.62), 0.28), Paint((0.78, 0.34, 0.28), 0.26)),
        part=lambda points, normals: _nearest(points, bodies),
        texture_seed=11,
        surface_temperature_c=temperature_c,
        rings=tuple(
            CameraRing((0.0, 0.0, aim), radius, height)
            for aim, radius, height in ((0.05, 1.45, 0.36), (-0.02, 1.34, 0.80), (-0.07, 1.03, 1.38))
        ),
        focal_share=1.0,
    )


def sphere() -> SyntheticScene:
    """Build one textured ball whose temperature is linear in height, before a uniform background."""
    return _scene(
        name="sphere",
        solid=Sphere((0.0, 0.0, 0.0), 0.5),
        scene_box=((-0.6, -0.6, -0.6), (0.6, 0.6, 0.6)),
        temperature_bounds_c=(10.0, 40.0),
        paints=(Paint((0.66, 0.60, 0.50), 0.32),),
        part=lambda points, normals: np.zeros(len(np.asarray(points)), dtype=np.int64),
        texture_seed=23,
        light=SunLight(ambient=0.75),
        surface_temperature_c=lambda points: np.clip(30.0 + 20.0 * np.asarray(points)[:, 2], 20.0, 40.0),
        background_rgb=plain((0.75, 0.75, 0.75)),
        rings=tuple(CameraRing((0.0, 0.0, 0.0), *ring) for ring in ((1.75, -0.75), (1.90, 0.15), (1.60, 1.05))),
        focal_share=1.15,
    )


def pipes() -> SyntheticScene:
    """Build the pipes: two stand before the wall, a third crosses in front of both; the wall shows little texture.

    The room is 16 C everywhere. The thick pipe falls from 65 to 59 C along its height, the crossing one from 50 to
    38 C along its length, the thin one rises from 26 to 34 C, and the wall glows behind the two that stand near it.
    """
    room_c, wall = 16.0, BoxSolid((((-1.3, 0.0, -0.9), (1.3, 0.16, 0.9)),))
    thick = Cylinder((-0.55, -0.28, 0.0), radius=0.13, length=1.6, axis=2)
    middle = Cylinder((0.05, -0.60, 0.3), radius=0.075, length=2.3, axis=0)
    thin = Cylinder((0.5, -0.2, 0.0), radius=0.04, length=1.7, axis=2)
    solid = SolidUnion((wall, thick, middle, thin))

    def part(points: npt.ArrayLike, normals: npt.ArrayLike = ()) -> IntArray:
        return np.argmin([one.signed_distance(points) for one in solid.parts], axis=0)

    def temperature_c(points: npt.ArrayLike) -> FloatArray:
        x, y, z = np.asarray(points, dtype=np.float64).T
        front = np.exp(-np.maximum(y, 0.0) / 0.08)
        by_thick, by_thin = (x - thick.centre[0]) / 0.28, (x - thin.centre[0]) / 0.16
        wall_c = room_c + 1.0 + front * (9.0 * np.exp(-by_thick * by_thick) + 2.5 * np.exp(-by_thin * by_thin))
        return np.choose(part(points), [wall_c, 62.0 + 3.75 * z, 44.0 - 5.2 * (x - 0.05), 30.0 + 4.7 * z])

    return _scene(
        name="pipes",
        solid=solid,
        scene_box=((-1.42, -0.85, -1.05), (1.42, 0.30, 1.05)),
        temperature_bounds_c=(room_c, 66.0),
        paints=(
            Paint((0.62, 0.61, 0.57), 0.10),  # wall
            Paint((0.58, 0.36, 0.26), 0.24),
            Paint((0.42, 0.50, 0.56), 0.24),
            Paint((0.66, 0.55, 0.30), 0.22),
        ),
        part=part,
        texture_seed=41,
        light=SunLight(towards=(0.4, -0.8, 0.5), ambient=0.6),
        surface_temperature_c=temperature_c,
        rings=tuple(
            CameraRing((0.0, -0.15, aim), radius, height, start_deg=-160.0, span_deg=140.0)
            for aim, radius, height in ((0.13, 3.5, -0.7), (-0.04, 3.6, 0.25), (-0.15, 3.35, 1.4))
        ),
        focal_share=0.87,
    )


def house_corner(white: bool = False) -> SyntheticScene:
    """Build the house: recessed warm windows, a door, a balcony slab, a roof, ground around, sky above.

    `white`: walls of white plaster without texture, in the even light of a white sky.

    20 C inside and 0 C outside: walls of U = 2.0, single panes of 4.8 to 5.8 and a door of 3.6 W/(m2 K) are as warm as
    8 W/(m2 K) between surface and air make them, 5 C and 9 to 14.5 C, with a smooth fall over the reveals. The storey
    slab shows as a band 3 K warmer, the balcony cools like a fin towards the air, and the sky falls from 0 C at the
    horizon to -20 C at the zenith.
    """
    building: Box = ((-3.0, -2.5, 0.0), (3.0, 2.5, 5.0))
    ground: Box = ((-3.3, -4.2, -0.45), (4.3, 2.9, 0.0))
    roof: Box = ((-3.3, -2.8, 5.0), (3.3, 2.8, 5.35))
    balcony: Box = ((-1.6, -3.8, 2.45), (1.4, -2.5, 2.8))
    paints = (
        Paint((0.93, 0.93, 0.92), 0.0) if white else Paint((0.74, 0.64, 0.47), 0.22),  # plaster
        Paint((0.36, 0.42, 0.27), 0.24),  # grass
        Paint((0.45, 0.27, 0.24), 0.20),  # roof
        Paint((0.58, 0.58, 0.57), 0.22),  # balcony
        _GLASS_PAINT,
        _DOOR_PAINT,
    )
    front, side, glass, door, recess_m = building[0][1], building[1][0], 4, 5, 0.35
    openings = (  # plane's axis, outward sign and position; (along the wall from, to); (z from, to); U; paint
        (1, -1, front, (-2.4, -1.2), (0.9, 2.0), 5.6, glass),
        (1, -1, front, (0.9, 2.3), (0.9, 2.0), 5.2, glass),
        (1, -1, front, (-1.1, 0.0), (2.8, 4.5), 5.8, glass),
        (1, -1, front, (1.6, 2.5), (3.3, 4.4), 4.8, glass),
        (0, +1, side, (-1.7, -0.6), (0.0, 2.1), 3.6, door),
        (0, +1, side, (0.5, 1.8), (0.9, 2.0), 5.4, glass),
        (0, +1, side, (-1.6, 0.2), (3.2, 4.4), 5.6, glass),
        (0, +1, side, (1.0, 1.9), (3.2, 4.4), 5.0, glass),
    )
    cut, panes = _recesses(openings, recess_m)
    wall_c, bridge_k = _HOUSE_AIR_C + _KELVIN_PER_U * _HOUSE_WALL_U, _KELVIN_PER_U * _BRIDGE_U

    def temperature_c(points: npt.ArrayLike) -> FloatArray:
        points = np.asarray(points, dtype=np.float64)
        z = points[:, 2]
        lift = (z - 0.5 * (balcony[0][2] + balcony[1][2])) / _BRIDGE_WIDTH_M
        degrees = wall_c + 0.3 * (z - 2.5) / 2.5 + bridge_k * np.exp(-lift * lift)
        for pane, opening in zip(panes, openings):
            fade_towards(degrees, points, pane, _HOUSE_AIR_C + _KELVIN_PER_U * opening[5], recess_m)
        from_house = distance_to_box(points, *building)
        fin_c = _HOUSE_AIR_C + 1.0 + (wall_c + bridge_k - 1.0) * np.exp(-from_house / 0.6)
        ground_c = _HOUSE_AIR_C + 1.5 + 2.5 * np.exp(-from_house / 0.7)
        roof_c = 3.0 - 2.0 * np.minimum(from_house / 0.6, 1.0)
        nearest = 1 + _nearest(points, ([balcony], [ground], [roof]))
        return np.choose(np.where(from_house > 1e-6, nearest, 0), [degrees, fin_c, ground_c, roof_c])

    return _scene(
        name=HOUSE,
        solid=BoxSolid((ground, building, roof, balcony), removed=cut),
        scene_box=((-3.7, -4.6, -0.8), (4.7, 3.3, 5.8)),
        temperature_bounds_c=(-20.0, 15.0),
        paints=paints,
        part=_last_of([(ground, 1), (roof, 2), (balcony, 3), *((p, o[6]) for p, o in zip(panes, openings))]),
        texture_seed=7,
        light=SunLight(towards=(0.75, -0.45, 0.5), ambient=0.88 if white else SunLight.ambient),
        surface_temperature_c=temperature_c,
        background_rgb=plain((0.94, 0.94, 0.94)) if white else sky_rgb,
        background_temperature_c=lambda directions: sky_temperature_c(directions, _HOUSE_AIR_C, 20.0),
        rings=tuple(
            CameraRing((0.4, -0.7, aim), radius, height, start_deg=-145.0, span_deg=200.0)
            for aim, radius, height in ((2.4, 11.8, 1.7), (1.7, 12.1, 4.8), (1.3, 11.6, 9.0))
        ),
        focal_share=0.86,
    )


def true_u_w_m2k(points: npt.ArrayLike) -> FloatArray:
    """U-value that the temperature of the house's walls and panes at points (n, 3) follows from, (n,), [W/(m2 K)]."""
    return (house_corner().surface_temperature_c(points) - _HOUSE_AIR_C) / _KELVIN_PER_U


def courtyard() -> SyntheticScene:
    """Build the courtyard: a U of three wings, a pergola, a thin garden wall, roofs that stand out, ground and sky.

    The west wing is nearly without texture, the north and the east wing beside it are not. Walls run from 5.5 to 11 C
    along the building, panes lie at 16 to 22 C, the roofs at -2.5 to 1 C, the garden wall is 15 C on its sunny and 5 C
    on its other side, the chimney rises to 30 C and a flue in the east wall, 0.35 m wide, is 39.5 C hot. The sky falls
    from 2 C at the horizon to -10 C at the zenith.
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
    columns: list[Box] = [((at, y, 0.0), (at + thick, y + thick, top)) for at in x]
    pergola: list[Box] = [*columns, ((west[1][0], y, top), (x[-1] + thick, y + thick, top + thick))]
    # A free-standing wall, 1.8 voxels thick where 128 of them span the scene.
    garden_wall: Box = ((1.2, -4.4, 0.0), (4.8, -4.24, 1.6))
    flue: Box = ((3.9, 0.3, 1.2), (4.25, 0.65, 1.55))
    flue_c, recess_m, glass, door = 39.5, 0.3, 7, 8
    openings = (  # plane's axis, outward sign and position; (along the wall from, to); (z from, to); pane [C]; paint
        (1, -1, 2.0, (-1.1, -0.1), (0.0, 2.1), 22.0, door),
        (1, -1, 2.0, (0.5, 1.3), (1.0, 2.2), 17.0, glass),
        (0, +1, -1.7, (-1.2, 0.3), (0.9, 2.2), 18.0, glass),
        (0, +1, 3.9, (2.4, 3.6), (1.1, 2.3), 16.0, glass),
        (1, +1, 4.2, (-2.6, -1.2), (1.1, 2.3), 17.0, glass),
        (1, -1, -0.9, (2.3, 3.4), (0.9, 2.0), 19.0, glass),
    )
    cut, panes = _recesses(openings, recess_m)
    wings = (west, north, east)
    painted_boxes = [(west, 1), (north, 2), (east, 3), *((roof, 4) for roof in roofs), *((box, 5) for box in pergola)]
    painted_boxes += [(garden_wall, 6), (chimney, 9), (flue, 9), *((p, o[6]) for p, o in zip(panes, openings))]

    def temperature_c(points: npt.ArrayLike) -> FloatArray:
        points = np.asarray(points, dtype=np.float64)
        x, y, z = points.T
        house_c = 8.0 + 0.6 * np.clip(x, -3.9, 3.9) + 0.3 * (np.clip(z, 0.0, 3.4) - 1.7)
        for pane, opening in zip(panes, openings):
            fade_towards(house_c, points, pane, opening[5], recess_m)
        from_flue = distance_to_box(points, *flue) / 0.35
        house_c += (flue_c - house_c) * np.exp(-from_flue * from_flue)
        from_house = np.min([distance_to_box(points, *box) for box in wings], axis=0)
        sunny = np.clip((garden_wall[1][1] - y) / (garden_wall[1][1] - garden_wall[0][1]), 0.0, 1.0)
        temperatures = [
            house_c,
            2.5 + 0.25 * x + 3.0 * np.exp(-from_house / 0.7),  # ground
            -1.0 + 0.45 * np.clip(y, -3.3, 4.6),  # roofs
            3.0 + 1.5 * np.clip(z, 0.0, 2.7),  # pergola
            5.0 + 10.0 * sunny + 0.4 * (np.clip(x, 1.2, 4.8) - 3.0),  # garden wall
            np.full_like(x, flue_c),
            12.0 + 20.0 * (np.clip(z, 3.7, 4.6) - 3.7),  # chimney
        ]
        groups = (wings, [ground], roofs, pergola, [garden_wall], [flue], [chimney])
        return np.choose(_nearest(points, groups), temperatures)

    return _scene(
        name="courtyard",
        solid=BoxSolid((ground, *wings, *roofs, chimney, *pergola, garden_wall, flue), removed=cut),
        scene_box=((-5.7, -5.7, -0.8), (5.7, 5.7, 5.1)),
        temperature_bounds_c=(-10.0, 40.0),
        paints=(
            Paint((0.52, 0.50, 0.44), 0.24),  # ground
            Paint((0.78, 0.74, 0.66), 0.025),  # west wing, nearly plain
            Paint((0.60, 0.38, 0.29), 0.24),  # north wing
            Paint((0.70, 0.62, 0.42), 0.22),  # east wing
            Paint((0.36, 0.33, 0.34), 0.20),  # roofs
            Paint((0.72, 0.70, 0.67), 0.16),  # pergola
            Paint((0.62, 0.56, 0.50), 0.20),  # garden wall
            _GLASS_PAINT,
            _DOOR_PAINT,
            Paint((0.34, 0.34, 0.38), 0.16),  # chimney and flue
        ),
        part=_last_of(painted_boxes),
        texture_seed=31,
        light=SunLight(towards=(0.5, -0.7, 0.6)),
        surface_temperature_c=temperature_c,
        background_rgb=sky_rgb,
        background_temperature_c=lambda directions: sky_temperature_c(directions, 2.0, 12.0),
        rings=(
            CameraRing((0.0, -0.3, 1.5), 15.0, 1.9, start_deg=-200.0, span_deg=220.0),
            CameraRing((0.0, 0.0, 0.1), 14.0, 7.2),
            CameraRing((0.0, 0.0, -0.4), 11.0, 12.6),
        ),
        focal_share=0.79,
    )


def _scene(
    *,
    scene_box: Box,
    temperature_bounds_c: tuple[float, float],
    paints: Sequence[Paint],
    part: Callable[[npt.ArrayLike, npt.ArrayLike], IntArray],
    texture_seed: int,
    light: SunLight = SunLight(),  # noqa: B008 - frozen
    **rest: Any,
) -> SyntheticScene:
    """Make a scene whose parts are painted, by default in a room as cold as its coldest surface."""
    texture, coldest = SolidTexture(scene_box, texture_seed), temperature_bounds_c[0]

    def colour(points: npt.ArrayLike, normals: npt.ArrayLike) -> Float32Array:
        return painted(points, normals, part(points, normals), paints, texture, light)

    room = {"background_rgb": room_rgb, "background_temperature_c": lambda d: np.full(len(np.asarray(d)), coldest)}
    return SyntheticScene(
        scene_box=scene_box, temperature_bounds_c=temperature_bounds_c, colour=colour, **(room | rest)
    )


def _nearest(points: npt.ArrayLike, bodies: Sequence[Sequence[Box | Solid]]) -> IntArray:
    """Number of the body, made of boxes or solids, that is nearest to each point (n, 3), shape (n,)."""
    distances = [
        np.min(
            [
                distance_to_box(points, *one) if isinstance(one, tuple) else np.maximum(one.signed_distance(points), 0)
                for one in body
            ],
            axis=0,
        )
        for body in bodies
    ]
    return np.argmin(distances, axis=0)


def _last_of(painted_boxes: Sequence[tuple[Box, int]]) -> Callable[[npt.ArrayLike, npt.ArrayLike], IntArray]:
    """The paint of the last box that holds the point just below a surface, (points, normals) to (n,); 0 where none."""

    def part(points: npt.ArrayLike, normals: npt.ArrayLike) -> IntArray:
        inner = np.asarray(points) - 1e-4 * np.asarray(normals)
        number = np.zeros(len(inner), dtype=np.int64)
        for (lo, hi), paint in painted_boxes:
            number[np.all((inner > lo) & (inner < hi), axis=1)] = paint
        return number

    return part


def _recesses(openings: Sequence[tuple[Any, ...]], depth_m: float) -> tuple[list[Box], list[Box]]:
    """Boxes cut out of walls for openings, and the boxes of the panes, 0.1 m thick, behind them."""
    cut, panes = [], []
    for axis, sign, plane, along, height, *_ in openings:
        back = plane - sign * depth_m
        cut.append(box_beside(axis, (plane, back), along, height))
        panes.append(box_beside(axis, (back, back - sign * 0.1), along, height))
    return cut, panes
