"""Synthetic scenes from a seed, such as `random-17` and `wild-17`, and streets and rooms around any scene."""

from __future__ import annotations

import dataclasses
import itertools
import math
import re
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import Float32Array, FloatArray
from thermoxels_ns.synthetic.appearance import SolidTexture, SunLight, plain, room_rgb, sky_rgb, sky_temperature_c
from thermoxels_ns.synthetic.random_arrangements import (
    detached_house,
    facade,
    machinery,
    pipes_and_radiators,
    railing,
    wings,
)
from thermoxels_ns.synthetic.random_plan import Plan, bounds_of
from thermoxels_ns.synthetic.scene_truth import Body, CameraRing, RgbFunction, SyntheticScene
from thermoxels_ns.synthetic.solids import Box, Solid, Sphere, box_beside, box_between, distance_to_box

_NAME = re.compile(r"(?:random|wild)-(0|[1-9][0-9]{0,17})")
_STREAM, _WILD_STREAM = 7411, 7413
_HARDSHIP_SHARE = 0.4
_MIRROR = (0.4, 0.7)
_WHITE, _MID_GREY = (0.94, 0.94, 0.94), (0.5, 0.5, 0.5)
_MARGIN_SHARE = 0.04
_SURFACE_SAMPLES = 20_000
_RANGE_K = (15.0, 60.0)


class Family(NamedTuple):
    """A kind of random scene."""

    lay_out: Callable[[Plan], None]  # puts the pieces of a scene into a plan
    size_m: tuple[float, float]  # longest side of the smallest and of the largest scene [m]
    outdoors: float  # share of the scenes that stand under the sky; the others stand in a room
    arc_deg: tuple[float, float] | None = None
    """Shortest and longest arc of cameras in front of a scene (towards -y) [degrees]; None: cameras all round."""


FAMILIES = (
    Family(detached_house, (11.0, 20.0), outdoors=1.0),
    Family(machinery, (1.2, 5.0), outdoors=0.3),
    Family(pipes_and_radiators, (1.8, 4.0), outdoors=0.15),
    Family(wings, (14.0, 26.0), outdoors=1.0),
    Family(facade, (8.0, 14.0), outdoors=1.0, arc_deg=(90.0, 130.0)),
)
"""The kinds of random scenes; the scene of seed N is of kind N modulo their number."""


def random_seed(name: str) -> int | None:
    """Return the seed in the name of a random or wild scene; None for any other name.

    >>> random_seed("random-17"), random_seed("wild-3"), random_seed("random-017")
    (17, 3, None)
    """
    found = _NAME.fullmatch(name)
    return int(found[1]) if found else None


def random_scene(seed: int, wild: bool = False) -> SyntheticScene:
    """Return the scene of a seed; the same seed gives the same scene.

    Random scenes have textured walls and a background of smooth gradients. With `wild`, some scenes have plain walls,
    mirroring panes or a thin railing. Their background is, by `seed` modulo 3: smooth gradients (0), one plain colour
    (1), or a street or a room (2).
    """
    draw = np.random.default_rng([_WILD_STREAM if wild else _STREAM, seed])
    family = FAMILIES[seed % len(FAMILIES)]
    plan = Plan(draw)
    if wild:
        plan.plain_walls = plan.chance(_HARDSHIP_SHARE)
        plan.mirror = plan.u(*_MIRROR) if plan.chance(_HARDSHIP_SHARE) else 0.0
    family.lay_out(plan)
    if wild and plan.chance(_HARDSHIP_SHARE):
        railing(plan)
    lo, hi = plan.solid().bounds
    extent = float(np.subtract(hi, lo).max())
    plan = plan.scaled(float(np.round(draw.uniform(*family.size_m), 2)) / extent)
    texture_seed = int(draw.integers(2**31))
    azimuth, height = draw.uniform(0.0, 2.0 * np.pi), draw.uniform(0.35, 1.2)
    towards = (float(np.cos(azimuth)), float(np.sin(azimuth)), float(height))
    light = SunLight(towards, ambient=float(draw.uniform(0.5, 0.75)))
    outdoors = draw.random() < family.outdoors
    surface_c, weather = _weather(draw, outdoors)
    focal_share = round(float(draw.uniform(0.78, 1.05)), 3)
    span = 360.0 if family.arc_deg is None else round(float(draw.uniform(*family.arc_deg)), 1)
    start = round(float(draw.uniform(0.0, 360.0)), 1) if family.arc_deg is None else -90.0 - 0.5 * span
    rings = random_rings(draw, [bounds_of(piece.shape) for piece in plan.pieces], focal_share, (start, span))
    scene = warm_scene(
        plan, surface_c, texture_seed=texture_seed, light=light, rings=rings, focal_share=focal_share, **weather
    )
    kind = seed % 3  # the family is seed % 5, so 15 seeds in a row have every pair of kind and family
    if not wild or kind == 0:
        return scene
    if kind == 1:
        points, normals = scene.solid.surface_points(_SURFACE_SAMPLES, seed=1)
        colours = (scene.colour(points, normals).mean(axis=0), _MID_GREY, _WHITE, draw.uniform(0.05, 1.0, 3))
        rgb = np.asarray(colours[int(draw.integers(len(colours)))]).tolist()
        return dataclasses.replace(scene, background_rgb=plain(rgb))
    return (with_street if outdoors else with_room)(scene, int(draw.integers(2**31)))


def warm_scene(plan: Plan, surface_c: tuple[float, float], **rest: Any) -> SyntheticScene:
    """Return the scene of a plan in metres, with surface temperatures that are linear in the plan's warmth.

    The least and the greatest warmth become `surface_c`, two temperatures [C]. For `rest` see `painted_scene`.
    """
    solid = plan.solid()
    lo, hi = np.asarray(solid.bounds)  # the scene box has a margin of 4 % of its longest side all round
    margin = float((hi - lo).max()) * _MARGIN_SHARE / (1.0 - 2.0 * _MARGIN_SHARE)
    box = box_between(np.round(lo - margin, 3), np.round(hi + margin, 3))
    sampled = plan.warmth(solid.surface_points(_SURFACE_SAMPLES, seed=1)[0])
    coldest, hottest = round(float(sampled.min()), 6), round(float(sampled.max()), 6)

    def temperature_c(points: npt.ArrayLike) -> FloatArray:
        share = np.clip((plan.warmth(points) - coldest) / (hottest - coldest), 0.0, 1.0)
        return (1.0 - share) * surface_c[0] + share * surface_c[1]

    return painted_scene(plan, solid=solid, scene_box=box, surface_temperature_c=temperature_c, **rest)


def painted_scene(
    plan: Plan,
    *,
    texture_seed: int,
    scene_box: Box,
    light: SunLight = SunLight(),  # noqa: B008 - frozen
    solid: Solid | None = None,
    **rest: Any,
) -> SyntheticScene:
    """Return the textured scene of a plan in metres; `rest` are further fields of `SyntheticScene`. `solid` must be the
    plan's solid; None: it is made here. By default the background is a room at the lower of `temperature_bounds_c`."""
    room = {"background_rgb": room_rgb, "background_temperature_c": plain(rest["temperature_bounds_c"][0])}
    texture = SolidTexture(scene_box, texture_seed)
    mirrors = np.array([paint.mirror for paint in plan.paints], dtype=np.float32)
    return SyntheticScene(
        solid=solid or plan.solid(),
        scene_box=scene_box,
        colour=lambda points, normals: plan.colour(points, normals, texture, light),
        mirror=(lambda points, normals: mirrors[plan.part(points, normals)]) if mirrors.any() else None,
        **(room | rest),
    )


def _weather(draw: np.random.Generator, outdoors: bool) -> tuple[tuple[float, float], dict[str, Any]]:
    """Return random lowest and highest surface temperatures [C], and fields of `SyntheticScene` for its background."""
    brightness, spread = np.float32(draw.uniform(0.75, 1.0)), _degrees(draw.uniform(*_RANGE_K))
    behind: RgbFunction = sky_rgb if outdoors else room_rgb
    fields: dict[str, Any] = {
        "background_rgb": lambda directions: np.asarray(behind(directions) * brightness, dtype=np.float32)
    }
    if outdoors:
        air, drop = _degrees(draw.uniform(-10.0, 18.0)), _degrees(draw.uniform(0.2, 0.45) * spread)
        coldest, surface = air - drop, air + float(draw.uniform(-0.5, 2.0))
        fields["background_temperature_c"] = lambda directions: sky_temperature_c(directions, air, drop)
    else:
        coldest = _degrees(draw.uniform(12.0, 25.0))
        surface = coldest + float(draw.uniform(0.0, 1.5))
    return (surface, coldest + spread), {"temperature_bounds_c": (coldest, coldest + spread), **fields}


def _degrees(value: float) -> float:
    """Return the nearest multiple of 0.25, so that sums and differences of temperatures are exact."""
    return 0.25 * round(4.0 * float(value))


_PICTURE_ASPECT = 0.75
_RIM = 0.95  # all boxes must be in view within this share of the picture's width and height
_AZIMUTHS = 73
_AIMS = 9
_ELEVATIONS_DEG = {2: ((10.0, 20.0), (38.0, 50.0)), 3: ((7.0, 15.0), (24.0, 36.0), (46.0, 60.0))}
_FARTHEST_SHARE = 1.10


def random_rings(
    draw: np.random.Generator, boxes: Sequence[Box], focal_share: float, arc_deg: tuple[float, float]
) -> tuple[CameraRing, ...]:
    """Return two or three random rings of cameras, from low to high. Every camera has all of the boxes [m] in view.

    `arc_deg` is begin and length of each ring's arc. `focal_share` is the focal length over the width of a 4:3 image.
    Cameras are at most a tenth farther away than the least distance that brings all boxes into view.
    """
    corners = np.array([corner for box in boxes for corner in itertools.product(*zip(*box))], dtype=np.float64)
    lo, hi = corners.min(axis=0), corners.max(axis=0)
    (x, y, _), rings = (0.5 * (lo + hi)).tolist(), []
    aims = np.linspace(max(lo[2], 0.0), 0.6 * hi[2], _AIMS)
    for low, high in _ELEVATIONS_DEG[3 if draw.random() < 0.75 else 2]:
        elevation = math.radians(draw.uniform(low, high))
        distance, aim_z = min(
            (_nearest(corners - (x, y, aim), elevation, focal_share, arc_deg), round(float(aim), 4)) for aim in aims
        )
        distance *= draw.uniform(1.0, _FARTHEST_SHARE)
        radius, height = distance * math.cos(elevation), aim_z + distance * math.sin(elevation)
        rings.append(CameraRing((round(x, 4), round(y, 4), aim_z), round(radius, 4), round(height, 4), *arc_deg))
    return tuple(rings)


def _nearest(relative: FloatArray, elevation: float, focal_share: float, arc_deg: tuple[float, float]) -> float:
    """Return the least distance from the origin at which all cameras of an arc have all points (n, 3) in view. The
    cameras look at the origin from the angle `elevation` [radians]. A camera has a point in view if the point's offsets
    from the view axis, sideways and upwards, are at most the half width and half height of the view at the point's
    depth: beside <= half (distance - nearer), and likewise above."""
    azimuth = np.radians(arc_deg[0] + arc_deg[1] * np.linspace(0.0, 1.0, _AZIMUTHS))
    back = np.stack([np.cos(azimuth), np.sin(azimuth), np.full(_AZIMUTHS, math.tan(elevation))], axis=1)
    back *= math.cos(elevation)
    right = np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros(_AZIMUTHS)], axis=1)
    beside, above = np.abs(relative @ right.T), np.abs(relative @ np.cross(back, right).T)
    half = 0.5 * _RIM / focal_share
    return float((relative @ back.T + np.maximum(beside, above / _PICTURE_ASPECT) / half).max())


_HOUSES, _TREES, _CUPBOARDS = 18, 14, 7
_FARTHEST = 20.0
_GAP = 1.2
_GLASS_SHARE, _GLASS_DIM = (0.32, 0.68), 0.35


def with_street(scene: SyntheticScene, seed: int) -> SyntheticScene:
    """Return the scene with a street around its cameras: ground, houses with windows, and trees, near air temperature.

    Houses stand all round, up to 14 times the scene's size away; the ground reaches 26 times the scene's size.
    """
    plan, (x, y), size, reach, floor = _place(scene, seed)
    half = 1.3 * _FARTHEST * size
    ground: Box = ((x - half, y - half, floor - 0.2 * size), (x + half, y + half, floor))
    plan.put(ground, plan.paint("ground"), 0.3)
    houses: list[Box] = []
    for number in range(_HOUSES):
        sides, high = (plan.u(0.35, 0.9) * size, plan.u(0.35, 0.9) * size), plan.u(0.5, 1.5) * size
        near = reach + float(np.hypot(*sides))
        away, turn = near * (0.7 * _FARTHEST * size / near) ** plan.u(0.0, 1.0) ** 2, 2.0 * np.pi * number / _HOUSES
        hx, hy = x + away * np.cos(turn), y + away * np.sin(turn)
        houses.append(((hx - sides[0], hy - sides[1], floor), (hx + sides[0], hy + sides[1], floor + high)))
        plan.put(houses[-1], plan.paint("wall"), plan.u(0.4, 1.0))
    windowed = len(plan.paints)
    for (x0, y0, _), (x1, y1, top) in houses:
        over = 0.05 * size
        roof: Box = ((x0 - over, y0 - over, top), (x1 + over, y1 + over, top + plan.u(0.1, 0.3) * size))
        plan.put(roof, plan.paint("roof"), plan.u(0.0, 0.4))
    leaves = plan.paint("ground")
    crowns: list[Sphere] = []
    while len(crowns) < _TREES:
        radius, away, turn = plan.u(0.1, 0.35) * size, reach * plan.u(1.2, 4.0), plan.u(0.0, 2.0 * np.pi)
        at = np.array([x + away * np.cos(turn), y + away * np.sin(turn), floor + plan.u(1.5, 3.0) * radius])
        clear = [distance_to_box(at[None], h[0], np.add(h[1], (0.0, 0.0, size)))[0] for h in houses]
        clear += [float(np.linalg.norm(at - other.centre)) - other.radius for other in crowns]
        if min(clear) > 1.1 * radius + 0.05 * size:
            tx, ty, tz = at.tolist()
            crowns.append(Sphere((tx, ty, tz), radius))
            plan.put(crowns[-1], leaves, plan.u(0.0, 0.3))
            thick, top = 0.12 * radius, tz - 1.001 * radius
            plan.put(((tx - thick, ty - thick, floor), (tx + thick, ty + thick, top)), plan.paint("stone"), 0.3)
    return surrounded(scene, plan, seed, range_k=2.5, windows=(range(1, windowed), floor, 0.32 * size))


def with_room(scene: SyntheticScene, seed: int) -> SyntheticScene:
    """Return the scene with a room around its cameras: walls, floor, ceiling and cupboards, near air temperature."""
    plan, (x, y), size, reach, floor = _place(scene, seed)
    half = (max(reach, 2.0 * size) * plan.u(1.2, 2.2), max(reach, 2.0 * size) * plan.u(1.2, 2.2))
    top = max(scene.poses(48, 0)[0][:, 2, 3].max(), floor + 1.2 * size) + plan.u(0.3, 1.0) * size
    thick, along_x, along_y = 0.3 * size, (x - half[0], x + half[0]), (y - half[1], y + half[1])
    for z in (floor - thick, top):
        box: Box = ((along_x[0], along_y[0], z), (along_x[1], along_y[1], z + thick))
        plan.put(box, plan.paint("stone"), plan.u(0.0, 0.5))
    for axis, middle, along in ((0, x, along_y), (1, y, along_x)):
        for sign in (-1, 1):
            plane = middle + sign * half[axis]
            wall = box_beside(axis, (plane, plane + sign * thick), along, (floor, top))
            plan.put(wall, plan.paint("wall"), plan.u(0.0, 0.5))
            for _ in range(_CUPBOARDS // 2):
                deep, wide = plan.u(0.3, 0.9) * (half[axis] - 1.1 * reach), plan.u(0.15, 0.5) * size
                at, high = plan.u(along[0] + wide, along[1] - wide), plan.u(0.2, 0.9) * (top - floor)
                box = box_beside(axis, (plane, plane - sign * deep), (at - wide, at + wide), (floor, floor + high))
                plan.put(box, plan.paint("metal"), plan.u(0.3, 1.0))
    return surrounded(scene, plan, seed, range_k=0.75)


def _place(scene: SyntheticScene, seed: int) -> tuple[Plan, tuple[float, float], float, float, float]:
    """Return an empty plan, the scene's middle (x, y) and size, a radius around its cameras, and the floor's z [m]."""
    lo, hi = np.array(scene.scene_box)
    size, middle = scene.size, 0.5 * (lo + hi)
    cameras = scene.poses(48, 6)[0][:, :3, 3]
    reach = _GAP * max(float(np.linalg.norm((cameras - middle)[:, :2], axis=1).max()), size)
    floor = min(float(scene.solid.bounds[0][2]), float(cameras[:, 2].min()) - 0.1 * size)
    plan = Plan(np.random.default_rng([7412, seed]), unit=0.02 * size)
    return plan, (float(middle[0]), float(middle[1])), size, reach, floor


def surrounded(
    scene: SyntheticScene, plan: Plan, seed: int, range_k: float, windows: tuple[range, float, float] | None = None
) -> SyntheticScene:
    """Return the scene with a plan in metres as its surroundings (`around`), which have a texture from `seed`.

    A place of the plan with the warmth w (cut to 0 to 1) is w * `range_k` warmer than the scene's horizon. `windows` is
    the indices of the paints of walls with windows, the z at which storeys begin [m], and the height of a storey [m].
    """
    lo = np.asarray(scene.scene_box[0])
    texture, light = SolidTexture(box_between(lo, lo + 3.0 * scene.size), seed), SunLight()
    air_c = float(scene.background_temperature_c([[1.0, 0.0, 0.0]])[0])

    def colour(points: npt.ArrayLike, normals: npt.ArrayLike) -> Float32Array:
        points, normals, rgb = np.asarray(points), np.asarray(normals), plan.colour(points, normals, texture, light)
        if windows is not None:
            walls, floor, storey = windows
            along = np.where(np.abs(normals[:, 0]) > 0.5, points[:, 1], points[:, 0])
            share = np.mod(np.stack([along, points[:, 2] - floor]) / storey, 1.0)
            glass = np.all((share > _GLASS_SHARE[0]) & (share < _GLASS_SHARE[1]), axis=0)
            glass[glass] = np.isin(plan.part(points[glass], normals[glass]), walls)
            rgb[glass & (np.abs(normals[:, 2]) < 0.5)] *= _GLASS_DIM
        return rgb

    around = Body(plan.solid(), colour, lambda points: air_c + range_k * np.clip(plan.warmth(points), 0.0, 1.0))
    return dataclasses.replace(scene, around=around)
