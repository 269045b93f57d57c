"""The synthetic scene `pipes`: hot pipes before a wall, seen from one side."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from thermoxels_ns.synthetic.camera_rings import CameraRing
from thermoxels_ns.synthetic.cylinder import Cylinder
from thermoxels_ns.synthetic.scene_truth import SyntheticScene
from thermoxels_ns.synthetic.solid_union import SolidUnion
from thermoxels_ns.synthetic.solids import Box, BoxSolid
from thermoxels_ns.synthetic.surroundings import room_rgb
from thermoxels_ns.synthetic.texture import Paint, SolidTexture, SunLight, painted

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
