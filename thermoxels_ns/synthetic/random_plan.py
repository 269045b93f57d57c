"""The plan of a scene: pieces, openings and warm spots. Plans of random scenes have voxels as unit of length."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import Float32Array, FloatArray, IntArray
from thermoxels_ns.synthetic.appearance import Paint, SolidTexture, SunLight
from thermoxels_ns.synthetic.solids import (
    Box,
    BoxSolid,
    Cylinder,
    Solid,
    SolidUnion,
    Sphere,
    Vector,
    box_beside,
    box_between,
    distance_to_box,
)

Shape = Box | Sphere | Cylinder
Range = tuple[float, float]
Wall = tuple[int, int, float]
"""A wall: the axis of its normal (0 or 1), the sign of its outward normal, and the coordinate of its plane."""

SMALLEST = 3.1  # lower bound of thicknesses, gaps and steps of a random plan, except railings [voxels of the plan]
WIDEST = 116.0  # upper bound of a plan's extent [voxels of the plan]; with the margins of the scene box below 127
HAIR = 0.002
"""Gap between a cylinder and what carries it [voxels of the plan], since parts of `SolidUnion` must share no face."""

_BLEND = 2.0
_LIGHTEST, _STRONGEST = 0.08, 0.35
_SHADE = 0.07
_BASES: dict[str, tuple[Vector, ...]] = {
    "ground": ((0.50, 0.49, 0.44), (0.36, 0.43, 0.28), (0.56, 0.50, 0.42), (0.44, 0.44, 0.46)),
    "wall": ((0.76, 0.72, 0.62), (0.62, 0.40, 0.31), (0.70, 0.62, 0.45), (0.60, 0.61, 0.62), (0.72, 0.56, 0.50)),
    "roof": ((0.46, 0.28, 0.24), (0.36, 0.36, 0.39), (0.52, 0.40, 0.34), (0.42, 0.46, 0.42)),
    "stone": ((0.58, 0.57, 0.54), (0.68, 0.65, 0.60), (0.46, 0.44, 0.42)),
    "glass": ((0.24, 0.31, 0.40), (0.30, 0.36, 0.38), (0.20, 0.24, 0.30)),
    "metal": ((0.55, 0.58, 0.62), (0.38, 0.48, 0.58), (0.66, 0.36, 0.28), (0.70, 0.60, 0.32), (0.40, 0.52, 0.42)),
}


@dataclass(frozen=True, eq=False)
class Piece:
    """One shape of a plan with its paint and warmth."""

    shape: Shape
    paint: int  # index into `Plan.paints`
    warmth: float  # warmth at the middle of the shape, from about 0 (coldest of the scene) to 1 (hottest)
    slope: FloatArray  # gradient of the warmth, (3,) [per unit of length]


@dataclass(frozen=True, eq=False)
class Glow:
    """A box or a point with a warmth of its own. Around the box, this warmth fades into that of the pieces."""

    core: Box  # box that has the full warmth; a point if both corners agree
    warmth: float  # warmth of the core, on the scale of `Piece.warmth`
    reach: float  # distance from the core beyond which the glow changes nothing [units of length]


@dataclass(eq=False)
class Plan:
    """The pieces, openings and glows of a scene; a point has the paint of the last piece that contains it."""

    draw: np.random.Generator  # source of all random choices
    pieces: list[Piece] = field(default_factory=list)
    """Pieces in the order in which they were put; boxes may overlap and touch, round pieces must not."""
    removed: list[Box] = field(default_factory=list)  # boxes that are cut out of all box-shaped pieces
    glows: list[Glow] = field(default_factory=list)  # places that are warmer, or colder, than the piece around them
    paints: list[Paint] = field(default_factory=list)
    unit: float = 1.0  # length of a voxel of the plan, which is also the thickness of panes [unit of the plan]
    plain_walls: bool = False  # True: walls that are painted from now on are plain plaster, without texture
    mirror: float = 0.0  # share of light that panes painted from now on reflect as mirrors do

    def u(self, low: float, high: float) -> float:
        """Draw a uniform number between `low` and `high`; return `low` if `high` is below `low`."""
        return float(self.draw.uniform(low, max(low, high)))

    def chance(self, share: float) -> bool:
        """Return True with probability `share`."""
        return bool(self.draw.random() < share)

    def paint(self, material: str) -> int:
        """Add a paint of a material (a key of `_BASES`), drawn at random, to the plan; return its index in `paints`."""
        base = np.asarray(_BASES[material][int(self.draw.integers(len(_BASES[material])))])
        mixed = np.clip(base + self.u(-_SHADE, _SHADE) + self.draw.uniform(-0.03, 0.03, 3), 0.12, 0.85)
        red, green, blue = mixed.tolist()
        contrast = _LIGHTEST * (_STRONGEST / _LIGHTEST) ** float(self.draw.random())
        if material == "wall" and self.plain_walls:
            contrast = 0.0
        return self.add_paint(Paint((red, green, blue), contrast, self.mirror if material == "glass" else 0.0))

    def add_paint(self, paint: Paint) -> int:
        """Add a paint to the plan and return its index in `paints`."""
        self.paints.append(paint)
        return len(self.paints) - 1

    def put(self, shape: Shape, paint: int, warmth: float = 0.0) -> None:
        """Add a `Piece` to the plan. `paint` is an index into `paints`; `warmth` is the warmth at the shape's middle.

        The slope, which is the gradient of the warmth, is drawn at random: each component is uniform from -s to s, with
        s = 0.12 / the longest side of the shape's bounds (at least 1).
        """
        lo, hi = bounds_of(shape)
        slope = self.draw.uniform(-0.12, 0.12, 3) / max(float(np.subtract(hi, lo).max()), 1.0)
        self.pieces.append(Piece(shape, paint, warmth, slope))

    def recess(self, wall: Wall, along: Range, height: Range, depth: float, paint: int, warmth: float) -> None:
        """Cut an opening into a wall, and put a pane, `unit` thick, into it, `depth` behind the wall's plane.

        `along` and `height` are the opening's extents along the wall and in z; `paint` is an index into `paints`. A
        `Glow` lets the pane's `warmth` fade into the wall within the distance `depth`.
        """
        axis, sign, plane = wall
        back = plane - sign * depth
        self.removed.append(box_beside(axis, (plane, back), along, height))
        pane = box_beside(axis, (back, back - sign * self.unit), along, height)
        self.pieces.append(Piece(pane, paint, warmth, np.zeros(3)))
        self.glows.append(Glow(pane, warmth, depth))

    def spot(self, box: Box, warmth: float, reach: float) -> None:
        """Add a `Glow` with this warmth and reach at a random point on the top or an upright side of a box."""
        lo, hi = np.asarray(box[0]), np.asarray(box[1])
        point = self.draw.uniform(lo, hi)
        side = int(self.draw.integers(5))
        axis, upper = (2, True) if side == 4 else (side // 2, bool(side % 2))
        point[axis] = hi[axis] if upper else lo[axis]
        self.glows.append(Glow(box_between(point, point), warmth, reach))

    def scaled(self, factor: float) -> Plan:
        """Return a copy of this plan with all lengths times `factor`. Copy and plan share `draw` and `paints`."""

        def scale(shape: Any) -> Any:
            if isinstance(shape, tuple):
                return box_between(*(np.array(shape) * factor))
            lengths = {name: value * factor for name, value in vars(shape).items() if name in ("radius", "length")}
            return replace(shape, centre=tuple(c * factor for c in shape.centre), **lengths)

        return replace(
            self,
            pieces=[replace(p, shape=scale(p.shape), slope=p.slope / factor) for p in self.pieces],
            removed=[scale(cut) for cut in self.removed],
            glows=[replace(glow, core=scale(glow.core), reach=glow.reach * factor) for glow in self.glows],
            unit=self.unit * factor,
        )

    def solid(self) -> Solid:
        """Return the exact solid: the union of all box-shaped pieces minus the openings, and of the round pieces."""
        boxes = [piece.shape for piece in self.pieces if isinstance(piece.shape, tuple)]
        parts: list[Solid] = [BoxSolid(boxes, self.removed)] if boxes else []
        parts += [piece.shape for piece in self.pieces if not isinstance(piece.shape, tuple)]
        return parts[0] if len(parts) == 1 else SolidUnion(tuple(parts))

    def part(self, points: npt.ArrayLike, normals: npt.ArrayLike) -> IntArray:
        """Return, for each surface point (n, 3), the paint index of the last piece that contains it, (n,); none: 0.
        Each point is first moved inwards by 0.01 `unit`, against its outward unit normal (n, 3)."""
        inner = np.asarray(points, dtype=np.float64) - 0.01 * self.unit * np.asarray(normals, dtype=np.float64)
        number = np.zeros(len(inner), dtype=np.int64)
        x, y, z = np.ascontiguousarray(inner.T)
        for piece in self.pieces:
            if isinstance(piece.shape, tuple):
                lo, hi = piece.shape
                held = (x > lo[0]) & (x < hi[0]) & (y > lo[1]) & (y < hi[1]) & (z > lo[2]) & (z < hi[2])
            else:
                held = piece.shape.contains(inner)
            number[held] = piece.paint
        return number

    def colour(
        self, points: npt.ArrayLike, normals: npt.ArrayLike, texture: SolidTexture, light: SunLight
    ) -> Float32Array:
        """Return the colour of surface points, (n, 3) in [0, 1]: base colour plus texture, times the brightness.

        Points and outward unit normals have shape (n, 3). The share that a paint mirrors is ignored here.
        """
        part, kinds = self.part(points, normals), [(paint.base, paint.contrast) for paint in self.paints]
        base, contrast = (np.array(one, dtype=np.float32)[part] for one in zip(*kinds))
        colour = (base + contrast[:, None] * texture(points)) * light.brightness(normals)
        return np.clip(colour, 0.0, 1.0).astype(np.float32, copy=False)

    def warmth(self, points: npt.ArrayLike) -> FloatArray:
        """Return the warmth at points (n, 3), shape (n,). It is continuous in space.

        It is the weighted mean of the pieces' warmths, with the weights exp(-distance / (2 `unit`)): touching pieces
        blend as by heat conduction. Glows are then blended in.
        """
        points = np.asarray(points, dtype=np.float64)
        far = np.array([distance_to(piece.shape, points) for piece in self.pieces])
        share = np.exp((far.min(axis=0) - far) / (_BLEND * self.unit))
        own = np.array([p.warmth + (points - np.mean(bounds_of(p.shape), axis=0)) @ p.slope for p in self.pieces])
        warmth = np.einsum("pn,pn->n", share, own) / share.sum(axis=0)
        self.add_glows(warmth, points)
        return warmth

    def add_glows(self, values: FloatArray, points: FloatArray) -> None:
        """Change `values` (n,), the warmth or temperature at `points` (n, 3), in place: blend the glows into them."""
        for glow in self.glows:
            near = np.maximum(1.0 - distance_to_box(points, *glow.core) / glow.reach, 0.0)
            values += (glow.warmth - values) * near * near * (3.0 - 2.0 * near)


def bounds_of(shape: Shape) -> Box:
    """Return the smallest box around a shape."""
    return shape if isinstance(shape, tuple) else shape.bounds


def distance_to(shape: Shape, points: npt.ArrayLike) -> FloatArray:
    """Return the distance of points (n, 3) to a shape, 0 inside the shape, shape (n,)."""
    if isinstance(shape, tuple):
        return distance_to_box(points, *shape)
    return np.maximum(shape.signed_distance(points), 0.0)
