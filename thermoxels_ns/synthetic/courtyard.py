"""The synthetic scene `courtyard`: plain walls, thin parts, a yard few cameras see."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from thermoxels_ns.synthetic.appearance import Paint, SolidTexture, SunLight, painted, sky_rgb, sky_temperature_c
from thermoxels_ns.synthetic.box_solid import BoxSolid, distance_to_box, recesses
from thermoxels_ns.synthetic.camera_rings import CameraRing
from thermoxels_ns.synthetic.scene_truth import SyntheticScene
from thermoxels_ns.synthetic.solids import Box

FloatArray = npt.NDArray[np.float64]

_BOX: Box = ((-5.7, -5.7, -0.8), (5.7, 5.7, 5.1))
_GROUND: Box = ((-5.2, -5.2, -0.4), (5.2, 5.2, 0.0))

# A U of three wings that opens towards -y; the east wing is lower and shorter.
_WEST: Box = ((-3.9, -2.4, 0.0), (-1.7, 2.0, 3.4))
_NORTH: Box = ((-3.9, 2.0, 0.0), (3.9, 4.2, 3.4))
_EAST: Box = ((1.7, -0.9, 0.0), (3.9, 2.0, 2.7))
_WINGS = (_WEST, _NORTH, _EAST)
_ROOFS: tuple[Box, ...] = (
    ((-4.3, -2.8, 3.4), (-1.3, 2.0, 3.7)),
    ((-4.3, 1.6, 3.4), (4.3, 4.6, 3.7)),
    ((1.3, -1.3, 2.7), (4.3, 2.0, 3.0)),
)
_CHIMNEY: Box = ((0.4, 2.9, 3.7), (0.9, 3.4, 4.6))

# A pergola across the mouth of the yard: a beam on columns 2.5 % as thick as the scene is wide.
_COLUMN_M = 0.28
_COLUMN_X = (-0.75, 0.25, 1.25, 2.25)
_COLUMN_Y = -2.3
_BEAM_Z = 2.4
_COLUMNS: tuple[Box, ...] = tuple(
    ((x, _COLUMN_Y, 0.0), (x + _COLUMN_M, _COLUMN_Y + _COLUMN_M, _BEAM_Z)) for x in _COLUMN_X
)
_END_M = _COLUMN_Y + _COLUMN_M
_BEAM: Box = ((_WEST[1][0], _COLUMN_Y, _BEAM_Z), (_COLUMN_X[-1] + _COLUMN_M, _END_M, _BEAM_Z + _COLUMN_M))

# A free-standing wall, 1.8 voxels thick where 128 of them span the scene.
_GARDEN_WALL: Box = ((1.2, -4.4, 0.0), (4.8, -4.24, 1.6))
_FLUE: Box = ((3.9, 0.3, 1.2), (4.25, 0.65, 1.55))

_RECESS_M, _PANE_M = 0.3, 0.1
_GLASS, _DOOR = 7, 8
# Openings: plane's axis, outward sign and position; (along the wall from, to); (z from, to); pane [C]; paint.
_OPENINGS = (
    (1, -1, 2.0, (-1.1, -0.1), (0.0, 2.1), 22.0, _DOOR),
    (1, -1, 2.0, (0.5, 1.3), (1.0, 2.2), 17.0, _GLASS),
    (0, +1, -1.7, (-1.2, 0.3), (0.9, 2.2), 18.0, _GLASS),
    (0, +1, 3.9, (2.4, 3.6), (1.1, 2.3), 16.0, _GLASS),
    (1, +1, 4.2, (-2.6, -1.2), (1.1, 2.3), 17.0, _GLASS),
    (1, -1, -0.9, (2.3, 3.4), (0.9, 2.0), 19.0, _GLASS),
)

_HORIZON_C, _SKY_DROP_K = 2.0, 12.0
_FLUE_C, _FLUE_REACH_M = 39.5, 0.35


def courtyard() -> SyntheticScene:
    """Build the courtyard: a U of three wings, a pergola, a thin garden wall, roofs that stand out, ground and sky.

    The west wing is nearly without texture, the north and the east wing beside it are not. Walls run from 5.5 to 11 C
    along the building, panes lie at 16 to 22 C, the roofs at -2.5 to 1 C, the garden wall is 15 C on its sunny and 5 C
    on its other side, the chimney rises to 30 C and a flue in the east wall, 0.35 m wide, is 39.5 C hot. The sky falls
    from 2 C at the horizon to -10 C at the zenith.
    """
    cut, panes = recesses(_OPENINGS, _RECESS_M, _PANE_M)
    panes_c = [opening[5] for opening in _OPENINGS]
    texture, light = SolidTexture(_BOX, seed=31), SunLight(towards=(0.5, -0.7, 0.6))
    paints = (
        Paint((0.52, 0.50, 0.44), 0.24),  # ground
        Paint((0.78, 0.74, 0.66), 0.025),  # west wing, nearly plain
        Paint((0.60, 0.38, 0.29), 0.24),  # north wing
        Paint((0.70, 0.62, 0.42), 0.22),  # east wing
        Paint((0.36, 0.33, 0.34), 0.20),  # roofs
        Paint((0.72, 0.70, 0.67), 0.16),  # pergola
        Paint((0.62, 0.56, 0.50), 0.20),  # garden wall
        Paint((0.22, 0.30, 0.40), 0.16),  # glass
        Paint((0.42, 0.22, 0.14), 0.18),  # door
        Paint((0.34, 0.34, 0.38), 0.16),  # chimney and flue
    )
    areas: list[tuple[Box, int]] = [
        (_WEST, 1),
        (_NORTH, 2),
        (_EAST, 3),
        *((box, 4) for box in _ROOFS),
        *((box, 5) for box in (*_COLUMNS, _BEAM)),
        (_GARDEN_WALL, 6),
        (_CHIMNEY, 9),
        (_FLUE, 9),
        *((pane, opening[6]) for pane, opening in zip(panes, _OPENINGS)),
    ]

    def part(points: npt.ArrayLike, normals: npt.ArrayLike) -> npt.NDArray[np.int64]:
        """Paint of the last box that holds the point just below the surface; the ground where none does."""
        inner = np.asarray(points) - 1e-4 * np.asarray(normals)
        number = np.zeros(len(inner), dtype=np.int64)
        for (lo, hi), paint in areas:
            number[np.all((inner > lo) & (inner < hi), axis=1)] = paint
        return number

    def temperature_c(points: npt.ArrayLike) -> FloatArray:
        points = np.asarray(points, dtype=np.float64)
        x, y, z = points.T
        house_c = 8.0 + 0.6 * np.clip(x, -3.9, 3.9) + 0.3 * (np.clip(z, 0.0, 3.4) - 1.7)
        for (lo, hi), pane_c in zip(panes, panes_c):
            share = np.maximum(1.0 - distance_to_box(points, lo, hi) / _RECESS_M, 0.0)
            house_c += (pane_c - house_c) * share * share * (3.0 - 2.0 * share)
        from_flue = distance_to_box(points, *_FLUE) / _FLUE_REACH_M
        house_c += (_FLUE_C - house_c) * np.exp(-from_flue * from_flue)
        from_house = np.min([distance_to_box(points, *box) for box in _WINGS], axis=0)
        sunny = np.clip((_GARDEN_WALL[1][1] - y) / (_GARDEN_WALL[1][1] - _GARDEN_WALL[0][1]), 0.0, 1.0)
        temperatures = [
            house_c,
            2.5 + 0.25 * x + 3.0 * np.exp(-from_house / 0.7),  # ground
            -1.0 + 0.45 * np.clip(y, -3.3, 4.6),  # roofs
            3.0 + 1.5 * np.clip(z, 0.0, 2.7),  # pergola
            5.0 + 10.0 * sunny + 0.4 * (np.clip(x, 1.2, 4.8) - 3.0),  # garden wall
            np.full_like(x, _FLUE_C),
            12.0 + 20.0 * (np.clip(z, 3.7, 4.6) - 3.7),  # chimney
        ]
        groups = (_WINGS, (_GROUND,), _ROOFS, (*_COLUMNS, _BEAM), (_GARDEN_WALL,), (_FLUE,), (_CHIMNEY,))
        distances = [np.min([distance_to_box(points, *box) for box in group], axis=0) for group in groups]
        return np.choose(np.argmin(distances, axis=0), temperatures)

    return SyntheticScene(
        name="courtyard",
        solid=BoxSolid((_GROUND, *_WINGS, *_ROOFS, _CHIMNEY, *_COLUMNS, _BEAM, _GARDEN_WALL, _FLUE), removed=cut),
        scene_box=_BOX,
        temperature_bounds_c=(_HORIZON_C - _SKY_DROP_K, 40.0),
        colour=lambda points, normals: painted(points, normals, part(points, normals), paints, texture, light),
        surface_temperature_c=temperature_c,
        background_rgb=sky_rgb,
        background_temperature_c=lambda directions: sky_temperature_c(directions, _HORIZON_C, _SKY_DROP_K),
        rings=(
            CameraRing((0.0, -0.3, 1.5), 15.0, 1.9, start_deg=-200.0, span_deg=220.0),
            CameraRing((0.0, 0.0, 0.1), 14.0, 7.2),
            CameraRing((0.0, 0.0, -0.4), 11.0, 12.6),
        ),
        focal_share=0.79,
    )
