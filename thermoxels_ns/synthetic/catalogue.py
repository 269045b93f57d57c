"""The synthetic scenes by name."""

from __future__ import annotations

import dataclasses
import re
import zlib
from collections.abc import Callable
from functools import cache
from typing import Annotated

import numpy as np
import numpy.typing as npt
from tyro.constructors import PrimitiveConstructorSpec

from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.synthetic.appearance import Paint, SolidTexture, SunLight, painted, room_rgb
from thermoxels_ns.synthetic.box_solid import BoxSolid, distance_to_box
from thermoxels_ns.synthetic.camera_rings import CameraRing
from thermoxels_ns.synthetic.courtyard import courtyard
from thermoxels_ns.synthetic.development_scenes import facade, street, wall_object
from thermoxels_ns.synthetic.house_corner import HOUSE, house_corner
from thermoxels_ns.synthetic.random_scene import RANDOM_NAMES, random_scene, random_seed
from thermoxels_ns.synthetic.scene_truth import SyntheticScene
from thermoxels_ns.synthetic.solid_union import SolidUnion
from thermoxels_ns.synthetic.solids import Box, Cylinder, Sphere
from thermoxels_ns.synthetic.surroundings import plain, with_room, with_street

FloatArray = npt.NDArray[np.float64]

_BOX: Box = ((-1.42, -0.85, -1.05), (1.42, 0.30, 1.05))
_WALL: Box = ((-1.3, 0.0, -0.9), (1.3, 0.16, 0.9))
_THICK = Cylinder((-0.55, -0.28, 0.0), radius=0.13, length=1.6, axis=2)
_MIDDLE = Cylinder((0.05, -0.60, 0.3), radius=0.075, length=2.3, axis=0)
_THIN = Cylinder((0.5, -0.2, 0.0), radius=0.04, length=1.7, axis=2)
_ROOM_C = 16.0


def pipes() -> SyntheticScene:
    """Build the pipes: two stand before the wall, a third crosses in front of both; the wall shows little texture.

    The room is 16 C everywhere. The thick pipe falls from 65 to 59 C along its height, the crossing one from 50 to
    38 C along its length, the thin one rises from 26 to 34 C, and the wall glows behind the two that stand near it.
    """
    solid = SolidUnion((BoxSolid((_WALL,)), _THICK, _MIDDLE, _THIN))
    texture, light = SolidTexture(_BOX, seed=41), SunLight(towards=(0.4, -0.8, 0.5), ambient=0.6)
    paints = (
        Paint((0.62, 0.61, 0.57), 0.10),  # wall
        Paint((0.58, 0.36, 0.26), 0.24),
        Paint((0.42, 0.50, 0.56), 0.24),
        Paint((0.66, 0.55, 0.30), 0.22),
    )

    def part(points: npt.ArrayLike) -> npt.NDArray[np.int64]:
        """Number of the nearest part: 0 wall, 1 thick, 2 crossing, 3 thin pipe."""
        return np.argmin([solid_part.signed_distance(points) for solid_part in solid.parts], axis=0)

    def temperature_c(points: npt.ArrayLike) -> FloatArray:
        points = np.asarray(points, dtype=np.float64)
        x, y, z = points.T
        front = np.exp(-np.maximum(y, 0.0) / 0.08)
        by_thick, by_thin = (x - _THICK.centre[0]) / 0.28, (x - _THIN.centre[0]) / 0.16
        wall_c = _ROOM_C + 1.0 + front * (9.0 * np.exp(-by_thick * by_thick) + 2.5 * np.exp(-by_thin * by_thin))
        return np.choose(part(points), [wall_c, 62.0 + 3.75 * z, 44.0 - 5.2 * (x - 0.05), 30.0 + 4.7 * z])

    return SyntheticScene(
        name="pipes",
        solid=solid,
        scene_box=_BOX,
        temperature_bounds_c=(_ROOM_C, 66.0),
        colour=lambda points, normals: painted(points, normals, part(points), paints, texture, light),
        surface_temperature_c=temperature_c,
        background_rgb=room_rgb,
        background_temperature_c=lambda directions: np.full(len(np.asarray(directions)), _ROOM_C),
        rings=tuple(
            CameraRing((0.0, -0.15, aim), radius, height, start_deg=-160.0, span_deg=140.0)
            for aim, radius, height in ((0.13, 3.5, -0.7), (-0.04, 3.6, 0.25), (-0.15, 3.35, 1.4))
        ),
        focal_share=0.87,
    )


def _hot_object() -> SyntheticScene:
    """Build a stepped hot block and a hot ball on a table, in a room of even temperature."""
    table: Box = ((-0.5, -0.4, -0.08), (0.5, 0.4, 0.0))
    lower: Box = ((-0.36, -0.2, 0.0), (-0.02, 0.12, 0.14))
    upper: Box = ((-0.36, -0.2, 0.14), (-0.18, 0.12, 0.28))
    ball = Sphere((0.24, -0.04, 0.12), 0.12)
    box: Box = ((-0.55, -0.45, -0.14), (0.55, 0.45, 0.34))
    room_c = 18.0
    texture, light = SolidTexture(box, seed=11), SunLight()
    paints = (Paint((0.62, 0.47, 0.31), 0.26), Paint((0.30, 0.50, 0.62), 0.28), Paint((0.78, 0.34, 0.28), 0.26))

    def part(points: npt.ArrayLike) -> npt.NDArray[np.int64]:
        """Number of the nearest part: 0 table, 1 block, 2 ball."""
        block = np.minimum(distance_to_box(points, *lower), distance_to_box(points, *upper))
        ball_distance = np.maximum(ball.signed_distance(points), 0.0)
        return np.argmin([distance_to_box(points, *table), block, ball_distance], axis=0)

    def temperature_c(points: npt.ArrayLike) -> FloatArray:
        points = np.asarray(points, dtype=np.float64)
        x, z = points[:, 0], points[:, 2]
        which = part(points)
        from_block = distance_to_box(points, *lower) / 0.10
        from_contact = (np.hypot(x - ball.centre[0], points[:, 1] - ball.centre[1])) / 0.09
        table_c = 20.5 - 3.0 * x + 10.0 * np.exp(-from_block * from_block) + 7.0 * np.exp(-(from_contact**2))
        block_c = 68.0 - 25.0 * z
        ball_c = 52.0 - 40.0 * (z - ball.centre[2])
        return np.choose(which, [table_c, block_c, ball_c])

    return SyntheticScene(
        name="hot-object",
        solid=SolidUnion((BoxSolid((table, lower, upper)), ball)),
        scene_box=box,
        temperature_bounds_c=(room_c, 70.0),
        colour=lambda points, normals: painted(points, normals, part(points), paints, texture, light),
        surface_temperature_c=temperature_c,
        background_rgb=room_rgb,
        background_temperature_c=lambda directions: np.full(len(np.asarray(directions)), room_c),
        rings=tuple(
            CameraRing((0.0, 0.0, aim), radius, height)
            for aim, radius, height in ((0.05, 1.45, 0.36), (-0.02, 1.34, 0.80), (-0.07, 1.03, 1.38))
        ),
        focal_share=1.0,
    )


def _sphere() -> SyntheticScene:
    """Build one textured ball whose temperature is linear in height, before a uniform background."""
    ball = Sphere((0.0, 0.0, 0.0), 0.5)
    box: Box = ((-0.6, -0.6, -0.6), (0.6, 0.6, 0.6))
    texture, light = SolidTexture(box, seed=23), SunLight(ambient=0.75)
    paints = (Paint((0.66, 0.60, 0.50), 0.32),)

    def colour(points: npt.ArrayLike, normals: npt.ArrayLike) -> npt.NDArray[np.float32]:
        part = np.zeros(len(np.asarray(points)), dtype=np.int64)
        return painted(points, normals, part, paints, texture, light)

    return SyntheticScene(
        name="sphere",
        solid=ball,
        scene_box=box,
        temperature_bounds_c=(10.0, 40.0),
        colour=colour,
        surface_temperature_c=lambda points: np.clip(30.0 + 20.0 * np.asarray(points)[:, 2], 20.0, 40.0),
        background_rgb=lambda directions: np.full((len(np.asarray(directions)), 3), 0.75, dtype=np.float32),
        background_temperature_c=lambda directions: np.full(len(np.asarray(directions)), 10.0),
        rings=tuple(CameraRing((0.0, 0.0, 0.0), *ring) for ring in ((1.75, -0.75), (1.90, 0.15), (1.60, 1.05))),
        focal_share=1.15,
    )


_Builders = dict[str, Callable[..., SyntheticScene]]
_BUILDERS: _Builders = {"hot-object": _hot_object, "house-corner": house_corner, "sphere": _sphere}
_BUILDERS |= {"courtyard": courtyard, "pipes": pipes}
_DEVELOPMENT: _Builders = {"wall-object": wall_object, "facade": facade, "street": street}

SCENE_NAMES = tuple(_BUILDERS)
"""Names of the scenes that were built by hand; `make_scene` also knows `DEVELOPMENT_NAMES`, `random-N` and `wild-N`."""
DEVELOPMENT_NAMES = tuple(_DEVELOPMENT)  # names of scenes that are hard to reconstruct, for development

VARIANTS = "+sky=R,G,B, +white, +street, +room"
"""What a name may end in, in any order: a sky of one colour (0 to 1); white plaster under a white sky (house-corner);
houses and trees around; a room around."""
_SKY = re.compile(r"sky=((?:0?\.\d+|[01](?:\.0*)?)(?:,(?:0?\.\d+|[01](?:\.0*)?)){2})")


def check_scene_name(name: str) -> str:
    """Return a name if `make_scene` knows it, else raise a `SceneError` that lists the names there are.


    >>> check_scene_name("random-17")
    'random-17'
    """
    base, *variants = name.split("+")
    kinds = {variant.split("=")[0] for variant in variants}
    known = base in _BUILDERS or base in _DEVELOPMENT or random_seed(base) is not None
    known &= all(variant in ("white", "street", "room") or _SKY.fullmatch(variant) for variant in variants)
    if not known or len(kinds) < len(variants) or kinds >= {"street", "room"} or ("white" in kinds and base != HOUSE):
        every = ", ".join((*_BUILDERS, *_DEVELOPMENT))
        seeded = " or ".join(RANDOM_NAMES)
        expected = f"{seeded} with a whole number N from 0 on, or one of {every}; with {VARIANTS} if you like"
        remedy = f"Choose one of these names, or write random-17 or {HOUSE}+sky=0.55,0.57,0.60."
        raise SceneError("synthetic scene", expected=expected, got=repr(name), remedy=remedy)
    return name


SceneWord = Annotated[
    str,
    PrimitiveConstructorSpec(
        nargs=1,
        metavar=f"{{{','.join((*SCENE_NAMES, *DEVELOPMENT_NAMES, *RANDOM_NAMES))}}}",
        instance_from_str=lambda words: check_scene_name(words[0]),
        is_instance=lambda value: isinstance(value, str),
        str_from_instance=lambda value: [value],
    ),
]
"""A scene's name as an option of a command, checked while the command line is read."""


@cache
def make_scene(name: str) -> SyntheticScene:
    """Make a synthetic scene by its name.

    One of `SCENE_NAMES` or `DEVELOPMENT_NAMES`, or ``random-`` or ``wild-`` and a seed without leading zeros; then, if
    you like, some of `VARIANTS`, such as ``sphere+sky=1,1,1`` or ``random-3+street``.

    Raises:
        SceneError: No scene has that name; the message lists those there are.

    >>> make_scene("sphere").temperature_bounds_c
    (10.0, 40.0)
    """
    base, *variants = check_scene_name(name).split("+")
    seed = random_seed(base)
    white = {"white": True} if "white" in variants else {}
    if seed is not None:
        scene = random_scene(seed, wild=base.startswith("wild"))
    else:
        scene = (_BUILDERS | _DEVELOPMENT)[base](**white)
    for variant in sorted(variants):
        if sky := _SKY.fullmatch(variant):
            scene = dataclasses.replace(scene, background_rgb=plain([float(c) for c in sky[1].split(",")]))
        elif variant != "white":
            scene = (with_street if variant == "street" else with_room)(scene, seed=zlib.crc32(base.encode()))
    return dataclasses.replace(scene, name=name)
