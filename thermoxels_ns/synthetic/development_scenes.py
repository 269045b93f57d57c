"""Scenes to develop on, which show what photographs leave open: `wall-object`, `facade`, `street`."""

from __future__ import annotations

import numpy as np

from thermoxels_ns.synthetic.appearance import Paint, SunLight, plain, sky_rgb, sky_temperature_c
from thermoxels_ns.synthetic.camera_rings import CameraRing, CameraWalk
from thermoxels_ns.synthetic.random_plan import HAIR, Plan
from thermoxels_ns.synthetic.random_scene import scene_of_plan
from thermoxels_ns.synthetic.scene_truth import SyntheticScene
from thermoxels_ns.synthetic.solids import Box, Cylinder, Sphere, Vector
from thermoxels_ns.synthetic.surroundings import before_wall, with_street

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
    plan.put(((-28.0, -20.0, 0.0), (34.0, 20.0, 8.0)), stand, 0.0)
    plan.put(((-14.0, -12.0, 8.0), (10.0, 12.0, 20.0)), stand, 0.2)
    plan.put(((-24.0, -10.0, 20.0), (12.0, 10.0, 52.0)), body, 0.6)
    plan.put(((12.0, -6.0, 34.0), (32.0, 6.0, 44.0)), arm, 0.4)
    plan.put(Cylinder((22.0, 0.0, 53.0 + HAIR), 9.0, 16.0, 1), metal, 1.0)
    plan.put(Cylinder((-8.0, 0.0, 59.0 + HAIR), 7.0, 14.0, 2), arm, 0.5)
    plan.put(Sphere((-8.0, 0.0, 77.0 + 2.0 * HAIR), 11.0), metal, 0.9)
    plan.spot(((-24.0, -10.0, 20.0), (12.0, 10.0, 52.0)), 1.0, 14.0)
    paint = Paint((0.55, 0.55, 0.55), 0.0)
    scene = scene_of_plan(
        "wall-object",
        plan.scaled(0.012),
        texture_seed=23,
        light=SunLight((0.3, -0.8, 0.6), ambient=0.7),
        surface_c=(_ROOM_C + 2.0, 45.0),
        temperature_bounds_c=(_ROOM_C, 45.0),
        background_rgb=plain(paint.base),
        background_temperature_c=lambda directions: np.full(len(np.asarray(directions)), _ROOM_C),
        rings=tuple(
            CameraRing((0.04, 0.0, aim), radius, height, start_deg=-160.0, span_deg=140.0)
            for aim, radius, height in ((0.52, 1.75, 0.25), (0.52, 1.85, 0.8), (0.5, 1.65, 1.45))
        ),
        focal_share=0.98,
    )
    return before_wall(scene, behind_m=0.7, half_m=25.0, paint=paint)


def facade() -> SyntheticScene:
    """Build one front of a house, textured, with windows, ledges, a door and a strip of ground, under a plain sky.

    Cameras walk along in front of it; none stands behind.
    """
    return _front("facade", Paint((0.70, 0.60, 0.46), 0.25), mirror=0.0, sky=(0.62, 0.72, 0.84), railing=False)


def street() -> SyntheticScene:
    """Build a front of plain plaster with mirroring panes and a balcony with a railing of 2 cm bars, in a street.

    Textured houses stand opposite, behind the cameras, and farther away beside the front; panes show them mirrored.
    """
    scene = _front("street", Paint((0.80, 0.76, 0.68), 0.0), mirror=0.6, sky=None, railing=True)
    return with_street(scene, seed=1)


def _front(name: str, wall: Paint, mirror: float, sky: Vector | None, railing: bool) -> SyntheticScene:
    """Build a front of 10.4 x 7.6 m, in decimetres, and walk past it in three lines of cameras."""
    plan = Plan(np.random.default_rng(8))
    plaster, ground, stone, glass, door, metal = (
        plan.add_paint(paint)
        for paint in (
            *(wall, Paint((0.46, 0.45, 0.42), 0.26), Paint((0.58, 0.55, 0.50), 0.22)),
            *(Paint((0.22, 0.30, 0.40), 0.16 if mirror == 0.0 else 0.0, mirror), Paint((0.42, 0.24, 0.16), 0.2)),
            Paint((0.30, 0.32, 0.34), 0.1),
        )
    )
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
            if not railing:
                plan.put(((x - 8.0, -3.2, low - 3.2), (x + 8.0, 0.0, low)), stone, 0.25)
    if railing:
        _balcony(plan, stone, metal)
    return scene_of_plan(
        name,
        plan.scaled(0.1),
        texture_seed=29,
        light=SunLight((0.4, -0.7, 0.6)),
        surface_c=(_AIR_C, 18.0),
        temperature_bounds_c=(_AIR_C - _SKY_DROP_K, 18.0),
        background_rgb=sky_rgb if sky is None else plain(sky),
        background_temperature_c=lambda directions: sky_temperature_c(directions, _AIR_C, _SKY_DROP_K),
        rings=tuple(
            CameraWalk(((-x, y, z), (x, y, z)), ((-aim, 0.0, 3.4), (aim, 0.0, 3.4)))
            for x, y, z, aim in ((6.5, -12.0, 1.7, 1.0), (7.5, -11.0, 4.2, 2.0), (5.0, -9.5, 2.6, 2.8))
        ),
        focal_share=0.8,
    )


def _balcony(plan: Plan, stone: int, metal: int) -> None:
    """A slab over the door with bars 2 cm thick, 12 cm apart, and a rail on top of them [decimetres]."""
    x, out, low, top, thick = 18.0, 13.0, 39.0, 50.0, 0.2
    plan.put(((-x, -out, low - 3.0), (x, 0.0, low)), stone, 0.3)
    across, along = np.arange(-x + 0.2, x - 0.2, 1.2).tolist(), np.arange(-out + 1.4, -1.0, 1.2).tolist()
    rails: list[Box] = [((-x, -out, top), (x, -out + thick, top + 0.4))]
    bars = [(at, -out) for at in across] + [(side, at) for side in (-x, x - thick) for at in along]
    rails += [((side, -out, top), (side + thick, 0.0, top + 0.4)) for side in (-x, x - thick)]
    for box in rails + [((bx, by, low), (bx + thick, by + thick, top)) for bx, by in bars]:
        plan.put(box, metal, 0.1)
