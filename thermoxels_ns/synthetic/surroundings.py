"""What photographs of a scene show behind it: a plain sky, houses and trees, the walls of a room."""

from __future__ import annotations

import dataclasses

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import Float32Array
from thermoxels_ns.synthetic.appearance import Paint, SolidTexture, SunLight, painted, plain
from thermoxels_ns.synthetic.random_plan import Plan
from thermoxels_ns.synthetic.scene_truth import Surroundings, SyntheticScene
from thermoxels_ns.synthetic.solids import Box, Sphere, box_beside, distance_to_box

_HOUSES, _TREES, _CUPBOARDS = 18, 14, 7
_FARTHEST = 20.0
_GAP = 1.2
_GLASS_SHARE, _GLASS_DIM = (0.32, 0.68), 0.35


def with_street(scene: SyntheticScene, seed: int) -> SyntheticScene:
    """Put ground, houses with windows and trees around a scene and its cameras, near the temperature of the air.

    They stand all round, between the cameras and 20 times the scene's size away.
    """
    plan, middle, size, reach, floor = _place(scene, seed)
    x, y = middle
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
    return _surrounded(scene, plan, seed, windows=(range(1, windowed), floor, 0.32 * size), range_k=2.5)


def with_room(scene: SyntheticScene, seed: int) -> SyntheticScene:
    """Put a scene and its cameras into a room of its temperature: walls, floor, ceiling, cupboards along the walls."""
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
    return _surrounded(scene, plan, seed, windows=None, range_k=0.75)


def before_wall(scene: SyntheticScene, behind_m: float, half_m: float, paint: Paint) -> SyntheticScene:
    """Put a large upright wall of the air's temperature behind a scene, at a y [m] and so far to all sides [m].

    What is seen past the wall's edges has its colour too.
    """
    plan = Plan(np.random.default_rng(0), paints=[paint])
    plan.put(((-half_m, behind_m, -half_m), (half_m, behind_m + 0.1, half_m)), 0, 0.0)
    scene = _surrounded(scene, plan, 0, windows=None, range_k=0.0)
    assert scene.around is not None
    seen = scene.around.colour([[0.0, behind_m, 0.0]], [[0.0, -1.0, 0.0]])[0]
    return dataclasses.replace(scene, background_rgb=plain(seen.tolist()))


def _place(scene: SyntheticScene, seed: int) -> tuple[Plan, tuple[float, float], float, float, float]:
    """An empty plan, the middle (x, y) and size of the scene, how far from it its cameras stand, and a floor below."""
    lo, hi = np.array(scene.scene_box)
    size, middle = scene.size, 0.5 * (lo + hi)
    cameras = scene.poses(48, 6)[0][:, :3, 3]
    reach = _GAP * max(float(np.linalg.norm((cameras - middle)[:, :2], axis=1).max()), size)
    floor = min(float(scene.solid.bounds[0][2]), float(cameras[:, 2].min()) - 0.1 * size)
    plan = Plan(np.random.default_rng([7412, seed]), unit=0.02 * size)
    return plan, (float(middle[0]), float(middle[1])), size, reach, floor


def _surrounded(
    scene: SyntheticScene, plan: Plan, seed: int, windows: tuple[range, float, float] | None, range_k: float
) -> SyntheticScene:
    """The scene with a plan around it, from the temperature at the horizon to so much warmer [K].

    `windows`: paints of walls that have them, where storeys begin [m] and their height [m].
    """
    size, lo = scene.size, np.asarray(scene.scene_box[0])
    texture, light = SolidTexture((tuple(lo.tolist()), tuple((lo + 3.0 * size).tolist())), seed), SunLight()
    air_c = float(scene.background_temperature_c([[1.0, 0.0, 0.0]])[0])

    def colour(points: npt.ArrayLike, normals: npt.ArrayLike) -> Float32Array:
        points, normals, part = np.asarray(points), np.asarray(normals), plan.part(points, normals)
        rgb = painted(points, normals, part, plan.paints, texture, light)
        if windows is not None:
            walls, floor, storey = windows
            along = np.where(np.abs(normals[:, 0]) > 0.5, points[:, 1], points[:, 0])
            share = np.mod(np.stack([along, points[:, 2] - floor]) / storey, 1.0)
            glass = np.all((share > _GLASS_SHARE[0]) & (share < _GLASS_SHARE[1]), axis=0)
            rgb[glass & np.isin(part, walls) & (np.abs(normals[:, 2]) < 0.5)] *= _GLASS_DIM
        return rgb

    around = Surroundings(plan.solid(), colour, lambda points: air_c + range_k * np.clip(plan.warmth(points), 0.0, 1.0))
    return dataclasses.replace(scene, around=around)
