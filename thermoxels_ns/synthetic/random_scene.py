"""Synthetic scenes from a seed, `random-17` and `wild-17`: arrangements that nobody chose."""

from __future__ import annotations

import dataclasses
import itertools
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.synthetic.appearance import (
    SolidTexture,
    SunLight,
    painted,
    plain,
    room_rgb,
    sky_rgb,
    sky_temperature_c,
)
from thermoxels_ns.synthetic.camera_rings import CameraRing
from thermoxels_ns.synthetic.random_arrangements import (
    detached_house,
    facade,
    machinery,
    pipes_and_radiators,
    railing,
    wings,
)
from thermoxels_ns.synthetic.random_plan import Plan, bounds_of
from thermoxels_ns.synthetic.scene_truth import RgbFunction, SyntheticScene
from thermoxels_ns.synthetic.solids import Box, box_between
from thermoxels_ns.synthetic.surroundings import with_room, with_street

_PICTURE_ASPECT = 0.75
_RIM = 0.95
_AZIMUTHS = 73
_AIMS = 9
_ELEVATIONS_DEG = {2: ((10.0, 20.0), (38.0, 50.0)), 3: ((7.0, 15.0), (24.0, 36.0), (46.0, 60.0))}
_FARTHEST_SHARE = 1.10


def random_rings(
    draw: np.random.Generator, boxes: Sequence[Box], focal_share: float, arc_deg: tuple[float, float]
) -> tuple[CameraRing, ...]:
    """Draw two or three rings, or arcs (begin and length, [degrees]), around boxes [m] that every picture shows.

    The focal length is a share of the width of a 4:3 image. Rings come from the lowest to the highest, at most a tenth
    farther than the nearest at which all boxes show.
    """
    corners = np.array([corner for box in boxes for corner in itertools.product(*zip(*box))], dtype=np.float64)
    lo, hi = corners.min(axis=0), corners.max(axis=0)
    middle, aims = 0.5 * (lo + hi), np.linspace(max(lo[2], 0.0), 0.6 * hi[2], _AIMS)
    elevations = _ELEVATIONS_DEG[3 if draw.random() < 0.75 else 2]
    rings = []
    for low, high in elevations:
        elevation = math.radians(draw.uniform(low, high))
        aim_z, distance = min(
            (_nearest(corners - (middle[0], middle[1], aim), elevation, focal_share, arc_deg), round(float(aim), 4))
            for aim in aims
        )[::-1]
        distance *= draw.uniform(1.0, _FARTHEST_SHARE)
        radius, height = distance * math.cos(elevation), aim_z + distance * math.sin(elevation)
        aim = (round(float(middle[0]), 4), round(float(middle[1]), 4), aim_z)
        rings.append(CameraRing(aim, round(radius, 4), round(height, 4), *arc_deg))
    return tuple(rings)


def _nearest(relative: FloatArray, elevation: float, focal_share: float, arc_deg: tuple[float, float]) -> float:
    """Least distance from the origin at which an arc of cameras that look at it has all points (n, 3) in the picture.

    A point is in it if its distances from the view axis, sideways and upwards, are within the picture's half width and
    half height at the point's depth: beside <= half (distance - nearer), and likewise above.
    """
    azimuth = np.radians(arc_deg[0] + arc_deg[1] * np.linspace(0.0, 1.0, _AZIMUTHS))
    back = np.stack([np.cos(azimuth), np.sin(azimuth), np.full(_AZIMUTHS, math.tan(elevation))], axis=1)
    back *= math.cos(elevation)
    right = np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros(_AZIMUTHS)], axis=1)
    beside, above = np.abs(relative @ right.T), np.abs(relative @ np.cross(back, right).T)
    half = 0.5 * _RIM / focal_share
    return float((relative @ back.T + np.maximum(beside, above / _PICTURE_ASPECT) / half).max())


RANDOM_NAMES = ("random-N", "wild-N")
"""How the names of these scenes are written where all names are listed; N is the seed."""

_NAME = re.compile(r"(?:random|wild)-(0|[1-9][0-9]{0,17})")
_STREAM, _WILD_STREAM = 7411, 7413
_HARDSHIP_SHARE = 0.4
_MIRROR = (0.4, 0.7)
_WHITE, _MID_GREY = (0.94, 0.94, 0.94), (0.5, 0.5, 0.5)
_MARGIN_SHARE = 0.04
_SURFACE_SAMPLES = 20_000
_RANGE_K = (15.0, 60.0)


@dataclass(frozen=True)
class Family:
    """A kind of arrangement."""

    name: str
    lay_out: Callable[[Plan], None]  # puts its pieces into a plan
    size_m: tuple[float, float]  # longest side of the smallest and of the largest one [m]
    outdoors: float  # share of them that stand under the sky; the others stand in a room
    arc_deg: tuple[float, float] | None = None
    """Shortest and longest arc of cameras, in front of it (towards -y) [degrees]; None: all round."""


FAMILIES = (
    Family("detached house", detached_house, (11.0, 20.0), outdoors=1.0),
    Family("machinery", machinery, (1.2, 5.0), outdoors=0.3),
    Family("pipes and radiators", pipes_and_radiators, (1.8, 4.0), outdoors=0.15),
    Family("wings", wings, (14.0, 26.0), outdoors=1.0),
    Family("facade", facade, (8.0, 14.0), outdoors=1.0, arc_deg=(90.0, 130.0)),
)
"""The kinds; seed N has number N modulo their count."""


def random_seed(name: str) -> int | None:
    """Seed of a scene's name; None if it is not the name of a random or a wild scene.

    >>> random_seed("random-17"), random_seed("wild-3"), random_seed("random-017"), random_seed("house-corner")
    (17, 3, None, None)
    """
    found = _NAME.fullmatch(name)
    return int(found[1]) if found else None


def random_scene(seed: int, wild: bool = False) -> SyntheticScene:
    """Make the scene of a seed, named ``random-`` or ``wild-`` and the seed; the same seed makes the same scene.

    Random scenes have textured walls before smooth gradients. Some wild ones have plain walls, mirroring panes or a
    thin railing; behind a third of them each lie smooth gradients, one plain colour, and a street or a room.

    Raises:
        SceneError: The seed is below 0.

    >>> random_scene(3).name
    'random-3'
    """
    if seed < 0:
        raise SceneError("seed", expected="a whole number from 0 on", got=seed, remedy="Pass a seed such as 17.")
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
    background_rgb, background_c, surface_c, bounds_c = _surroundings(draw, outdoors)
    focal_share = round(float(draw.uniform(0.78, 1.05)), 3)
    span = 360.0 if family.arc_deg is None else round(float(draw.uniform(*family.arc_deg)), 1)
    start = round(float(draw.uniform(0.0, 360.0)), 1) if family.arc_deg is None else -90.0 - 0.5 * span
    rings = random_rings(draw, [bounds_of(piece.shape) for piece in plan.pieces], focal_share, (start, span))
    rest: dict[str, Any] = {"background_rgb": background_rgb, "background_temperature_c": background_c}
    rest |= {"temperature_bounds_c": bounds_c, "rings": rings, "focal_share": focal_share}
    name = f"{'wild' if wild else 'random'}-{seed}"
    scene = scene_of_plan(name, plan, texture_seed, light, surface_c, **rest)
    kind = seed % 3  # beside seed % 5 of the families: 15 seeds in a row show every pair
    if not wild or kind == 0:
        return scene
    if kind == 1:
        points, normals = scene.solid.surface_points(_SURFACE_SAMPLES, seed=1)
        colours = (scene.colour(points, normals).mean(axis=0), _MID_GREY, _WHITE, draw.uniform(0.05, 1.0, 3))
        rgb = np.asarray(colours[int(draw.integers(len(colours)))]).tolist()
        return dataclasses.replace(scene, background_rgb=plain(rgb))
    return (with_street if outdoors else with_room)(scene, int(draw.integers(2**31)))


def scene_of_plan(
    name: str, plan: Plan, texture_seed: int, light: SunLight, surface_c: tuple[float, float], **rest: Any
) -> SyntheticScene:
    """Make a scene of a plan in metres, whose warmth becomes temperatures from its coldest to its hottest surface [C].

    The scene's other fields are passed by name.
    """
    solid = plan.solid()
    lo, hi = np.asarray(solid.bounds)  # to reconstruct: with a margin of 4 % of the longest side all round
    margin = float((hi - lo).max()) * _MARGIN_SHARE / (1.0 - 2.0 * _MARGIN_SHARE)
    box = box_between(np.round(lo - margin, 3), np.round(hi + margin, 3))
    texture = SolidTexture(box, seed=texture_seed)
    sampled = plan.warmth(solid.surface_points(_SURFACE_SAMPLES, seed=1)[0])
    coldest, hottest = round(float(sampled.min()), 6), round(float(sampled.max()), 6)

    def temperature_c(points: npt.ArrayLike) -> FloatArray:
        share = np.clip((plan.warmth(points) - coldest) / (hottest - coldest), 0.0, 1.0)
        return (1.0 - share) * surface_c[0] + share * surface_c[1]

    mirrors = np.array([paint.mirror for paint in plan.paints], dtype=np.float32)
    look = plan.paints, texture, light
    return SyntheticScene(
        name=name,
        solid=solid,
        scene_box=box,
        colour=lambda points, normals: painted(points, normals, plan.part(points, normals), *look),
        surface_temperature_c=temperature_c,
        mirror=(lambda points, normals: mirrors[plan.part(points, normals)]) if mirrors.any() else None,
        **rest,
    )


def _surroundings(
    draw: np.random.Generator, outdoors: bool
) -> tuple[RgbFunction, Callable[[npt.ArrayLike], FloatArray], tuple[float, float], tuple[float, float]]:
    """Colour and temperature of what lies behind, the surface's coldest and hottest, and the bounds of it all [C]."""
    brightness, spread = float(draw.uniform(0.75, 1.0)), _degrees(draw.uniform(*_RANGE_K))
    if outdoors:
        air, drop = _degrees(draw.uniform(-10.0, 18.0)), _degrees(draw.uniform(0.2, 0.45) * spread)
        bounds = (air - drop, air - drop + spread)
        surface = (air + float(draw.uniform(-0.5, 2.0)), bounds[1])
        return _dimmed(sky_rgb, brightness), lambda d: sky_temperature_c(d, air, drop), surface, bounds
    room = _degrees(draw.uniform(12.0, 25.0))
    surface = (room + float(draw.uniform(0.0, 1.5)), room + spread)
    bounds = (room, room + spread)
    return _dimmed(room_rgb, brightness), lambda d: np.full(len(np.asarray(d)), room), surface, bounds


def _degrees(value: float) -> float:
    """A multiple of a quarter, so that sums and differences of temperatures are exact."""
    return 0.25 * round(4.0 * float(value))


def _dimmed(colours: RgbFunction, brightness: float) -> RgbFunction:
    factor = np.float32(brightness)
    return lambda directions: np.asarray(colours(directions) * factor, dtype=np.float32)
