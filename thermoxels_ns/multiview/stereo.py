"""Multi-view stereo: depths of photographs by plane sweep, and feature rays to them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from thermoxels_ns.core.feature_rays import FeatureRays
from thermoxels_ns.core.threads import run_ranges
from thermoxels_ns.multiview.backdrop import plain_backdrop
from thermoxels_ns.multiview.photographs import Photographs
from thermoxels_ns.multiview.stereo_kernels import aggregate, correlate, refine_depths, weigh_patches

NEIGHBOURS = 4
"""Photographs that one is compared with; of these the better half counts at each pixel, as others may be hidden."""
ANGLES_DEG = (4.0, 60.0)
"""Angles between directions to the same point at which two photographs are compared: a smaller one says nothing about
depth, a larger one shows something else."""
BEST_ANGLE_DEG = 15.0  # Neighbours at about this angle are preferred
RADIUS = 2  # Pixels from the middle of the square that is compared to its sides
LIKENESS = 0.025
"""Difference of two pixels, of 1, at which one has 37 % of the weight of the other in its square."""
SPREAD = 1.0  # The same, relative to how much the pixels around the middle one differ from it, where that is more
LEAST_WEIGHT = 0.05  # Weight below which it has none
PLANES = (24, 128)
"""Planes per photograph: such that the picture moves by about a pixel from one to the next, within these limits."""
NOISE = (1.5 / 255.0, 1.0 / 255.0)
"""Standard deviations within a patch that are noise: of brightness, of 1, and of temperature, of the scene's range."""
STEP, JUMP = 0.05, 0.6
"""Cost of a step of one plane from a pixel to the next, and of a longer one, as half of one minus a correlation. Steps
of 0.02 and jumps of 0.3 to 1.2 gave the same on four drawn scenes."""
EDGE = 0.02  # Difference of two pixels, of 1, at which a jump costs half
MARGIN = 0.05  # By how much the best plane must beat the best one that is not its neighbour
TOLERANCE = 0.3
"""Share of the distance between planes, of both photographs together, by which depths that agree may differ."""
FEWEST_VIEWS = 2  # Photographs whose own depths must lie where a sure one does
VIEWS_PER_CONTRADICTION = 2  # As many must do so for each photograph that looks through the point
VIEWS_TO_CONTRADICT = 3  # Photographs that must agree with a depth behind the point, which is else likely to be wrong
FEWEST_AROUND = 6
"""Of the eight pixels around a sure one, those whose depths agree with its own too: outlines and noise have fewer."""
REFINED_RADIUS, REFINED_LIKENESS = 3, 0.06
"""The same of refinement in larger photographs. Radii of 2 to 4 and a likeness of 0.025 to 10 tried on house-corner and
courtyard: the median error falls from 0.34 and 0.36 % to 0.28 and 0.22 %."""
LEAST_CORRELATION = 0.6  # Correlation below which that does not move a depth, and nothing is as far as the last plane
ERROR_PLANES = 0.25  # Standard error of a depth, in planes of the sweep
_NEAREST = 0.1  # Distance of the nearest plane in the box relative to the farthest
_OUTSIDE = -100.0
"""Brightness that stands for a pixel that a photograph does not show: where it is mixed in, the rest is negative."""
_PROBES = (5, 4)  # Pixels along each side and depths at which neighbours are looked for
_FEWEST_PROBES = 0.1  # Share of these that a neighbour must see
_DEPTHS_PER_SPREAD = 2.0 ** np.arange(-6.0, 6.5, 0.5)
"""Depths tried where no box is known, relative to the root of the cameras' mean squared distance from their middle."""


@dataclass(frozen=True, eq=False)
class Depths:
    """Depths of the pixels of photographs."""

    photographs: Photographs  # The photographs
    depth: Float32Array
    """Depth of each pixel, in the order of `photographs.colours`, shape (pixels,), [world units]; NaN: not sure."""
    error: Float32Array  # Depth by which its planes are apart there, shape (pixels,), [world units]

    @property
    def share(self) -> float:
        """Share of the pixels whose depth is known."""
        return float(np.mean(np.isfinite(self.depth)))


def depths_before_backdrop(depths: Depths) -> tuple[Depths, BoolArray]:
    """Depths without those that an outline gave to the backdrop beside it, and the backdrop's pixels, (pixels,)."""
    backdrop, beside = plain_backdrop(depths.photographs, depths.depth)
    return replace(depths, depth=np.where(beside, np.float32(np.nan), depths.depth)), backdrop


def depths_of(
    photographs: Photographs,
    lo: npt.ArrayLike | None = None,
    hi: npt.ArrayLike | None = None,
    views_to_contradict: int = VIEWS_TO_CONTRADICT,
    larger: Photographs | None = None,
) -> Depths:
    """Find the depths of photographs: in a box and behind it, or wherever they see the same from different directions.

    For each photograph, its neighbours are drawn onto planes parallel to it, one behind the other, and compared with it
    patch by patch (plane sweep, Collins 1996; normalised cross-correlation), by brightness and, where the same camera
    measured it, temperature. How little they agree is a cost, which is added up along paths through the photograph
    (semi-global matching, Hirschmueller 2008), so that where texture fades, a pixel takes its depth from those beside
    it that look alike. The plane of least cost is the depth of a pixel if it beats all but its neighbours by `MARGIN`.
    It counts where depths of other photographs, found on their own, lie in the same place, and not too many that others
    confirm lie behind it. Within a patch only pixels that look like the middle one count: else an outline gives its
    depth to all that lies beside it.

    Args:
        photographs: Pinhole photographs, best some 160 pixels wide: cost grows with the third power of their size.
        lo: Lower corner of the box, [world units]. None: no box.
        hi: Upper corner.
        views_to_contradict: Photographs that must agree with a depth for it to contradict others.
        larger: The same photographs with more pixels, in which depths are refined.

    Returns:
        Depths; not known anywhere where no photograph has a neighbour.
    """
    corners = None if lo is None or hi is None else (np.asarray(lo, np.float64), np.asarray(hi, np.float64))
    views = [_View.of(photographs, number) for number in range(len(photographs))]
    total = len(photographs.colours)
    depth, error = (np.full(total, np.nan, np.float32) for _ in range(2))
    neighbours: list[list[int]] = [[] for _ in views]

    def work(begin: int, end: int) -> None:
        for number in range(begin, end):
            view = views[number]
            span = _overlap(photographs, number) if corners is None else _span(view, *corners, photographs.near)
            if span is None:
                continue
            neighbours[number] = _neighbours(photographs, number, *span)
            if neighbours[number]:
                first = int(photographs.firsts[number])
                pixels = slice(first, first + view.shape[0] * view.shape[1])
                near = [views[other] for other in neighbours[number]]
                depth[pixels], error[pixels] = _sweep(view, near, *span, corners is not None)

    run_ranges(work, len(views), 1)
    confirmed = other_views(photographs, depth, error)[0] >= views_to_contradict
    agreeing, behind = other_views(photographs, depth, error, confirmed)
    sure = (agreeing >= FEWEST_VIEWS) & (agreeing >= VIEWS_PER_CONTRADICTION * behind)
    depth[~sure] = np.nan
    for view, first in zip(views, photographs.firsts):
        pixels = slice(first, first + view.shape[0] * view.shape[1])
        agree = _neighbours_agree(depth[pixels].reshape(view.shape), error[pixels].reshape(view.shape))
        depth[pixels][~agree.ravel()] = np.nan
    if larger is not None:
        _refine(photographs, larger, neighbours, depth, error)
    return Depths(photographs, depth, error)


def other_views(
    photographs: Photographs,
    depth: Float32Array,
    error: Float32Array,
    confirmed: BoolArray | None = None,
) -> tuple[IntArray, IntArray]:
    """Count for each pixel the other photographs whose depth lies where its own does, and those that look through it.

    Depths agree if they differ by no more than `TOLERANCE` times the sum of both pixels' errors. A photograph looks
    through the point if its own depth there is `confirmed` and farther by more than twice that sum. All are (pixels,).
    """
    agreeing, behind = (np.zeros(len(depth), dtype=np.int64) for _ in range(2))
    (known,) = np.nonzero(np.isfinite(depth))

    def compare(begin: int, end: int) -> None:
        own = known[begin:end]
        origins, along = photographs.of_pixels(own)
        points, number = origins + depth[own, None] * along, np.searchsorted(photographs.firsts, own, side="right") - 1
        for other in range(len(photographs)):
            pixel, far, shown = photographs.shown(other, points)
            farther, planes = depth[pixel] - far, error[pixel] + error[own]  # NaN is neither
            shown &= number != other
            agreeing[own] += shown & (np.abs(farther) <= TOLERANCE * planes)
            if confirmed is not None:
                behind[own] += shown & confirmed[pixel] & (farther > 2.0 * planes)

    run_ranges(compare, len(known), 1 << 15)
    return agreeing, behind


def _refine(
    photographs: Photographs,
    larger: Photographs,
    neighbours: list[list[int]],
    depth: Float32Array,
    error: Float32Array,
) -> None:
    """Refine depths (pixels,) and their errors in `larger` photographs: surfaces are as exact as depths are."""
    turns, shifts = larger.matrices[:, :, :3], larger.matrices[:, :, 3]
    pictures = [_brightness(larger, number) for number in range(len(larger))]

    def work(begin: int, end: int) -> None:
        for number in range(begin, end):
            (width, height), first = photographs.sizes[number], photographs.firsts[number]
            pixels = slice(first, first + width * height)
            ratio = larger.sizes[number, 0] / width
            near = [other for other in neighbours[number] if pictures[other].shape == pictures[number].shape]
            if ratio <= 1.0 or not near or np.isnan(depth[pixels]).all():
                continue
            view = _View.of(larger, number)
            refine_depths(
                width,
                depth[pixels].copy(),
                error[pixels].copy(),
                ratio,
                view.features,
                pictures[number],
                np.stack([pictures[other] for other in near]),
                turns[near] @ view.inverse,
                turns[near] @ view.centre + shifts[near],
                (REFINED_RADIUS, REFINED_LIKENESS, SPREAD, LEAST_WEIGHT, int(np.ceil(2.0 * ratio)), LEAST_CORRELATION),
                float(view.noise[0]),
                depth[pixels],
                error[pixels],
            )

    run_ranges(work, len(larger), 1)


def _brightness(photographs: Photographs, number: int) -> Float32Array:
    """Brightness of one photograph, shape (h, w); `_OUTSIDE` where masked."""
    (width, height), first = photographs.sizes[number], photographs.firsts[number]
    mean = photographs.colours[first : first + width * height].mean(axis=1).reshape(height, width)
    return np.nan_to_num(mean, nan=_OUTSIDE)


@dataclass(frozen=True, eq=False)
class _View:
    """One photograph."""

    channels: Float32Array
    """Brightness and, where the same camera measured it, temperature, shape (1 or 2, h, w); `_OUTSIDE` where masked."""
    features: Float32Array
    """What tells which pixels belong together, shape (h, w, 3 or 4): a third of each colour, and temperature, as skies
    are cold."""
    matrix: FloatArray  # World to homogeneous pixels, (3, 4)
    inverse: FloatArray  # Homogeneous pixels to directions of depth 1 in the world, (3, 3)
    centre: FloatArray

    @classmethod
    def of(cls, photographs: Photographs, number: int) -> _View:
        width, height = photographs.sizes[number]
        pixels = slice(photographs.firsts[number], photographs.firsts[number] + width * height)
        warm, matrix = photographs.thermal[pixels].reshape(height, width), photographs.matrices[number]
        measured = [warm] * bool(np.isfinite(warm).any())
        channels = np.stack([_brightness(photographs, number), *(np.nan_to_num(t, nan=_OUTSIDE) for t in measured)])
        thirds = photographs.colours[pixels].reshape(height, width, 3) / np.float32(3.0)
        features = np.nan_to_num(np.dstack([thirds, *measured]))
        return cls(channels, features, matrix, np.linalg.inv(matrix[:, :3]), photographs.centres[number])

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.channels.shape[1], self.channels.shape[2]

    @property
    def noise(self) -> Float32Array:
        """Variance of each channel that is noise."""
        return np.square(np.array(NOISE[: len(self.channels)], dtype=np.float32))


def _span(view: _View, low: FloatArray, high: FloatArray, near: float) -> tuple[float, float] | None:
    """Least and largest depth at which a photograph looks at the box; None if it does not."""
    corners = np.stack(np.meshgrid(*zip(low, high)), -1).reshape(-1, 3)
    depth = corners @ view.matrix[2, :3] + view.matrix[2, 3]
    far = float(depth.max())
    if far <= near or far <= 0.0:
        return None
    return max(float(depth.min()), near, _NEAREST * far), far


def _overlap(photographs: Photographs, number: int) -> tuple[float, float] | None:
    """Least and largest depth at which enough others look at the same from useful directions; None: nowhere."""
    centres = photographs.centres
    depths = np.sqrt(((centres - centres.mean(0)) ** 2).sum(1).mean()) * _DEPTHS_PER_SPREAD
    points, others = _probes(photographs, number, depths), np.zeros(len(depths) * _PROBES[0] ** 2, int)
    for other in range(len(photographs)):
        others += (other != number) & _usefully_seen(photographs, number, other, points)[0]
    enough = (others >= 2).reshape(len(depths), -1).mean(1) >= _FEWEST_PROBES
    return (float(depths[enough][0]), float(depths[enough][-1])) if enough.sum() > 1 else None


def _probes(photographs: Photographs, number: int, depths: FloatArray) -> FloatArray:
    """Points that a photograph sees, spread over it at each of the depths, (depths * points, 3)."""
    columns, rows = ((np.arange(_PROBES[0]) + 0.5) * side / _PROBES[0] for side in photographs.sizes[number])
    pixels = np.stack(np.meshgrid(columns, rows, [1.0]), -1).reshape(-1, 3)
    along = pixels @ np.linalg.inv(photographs.matrices[number, :, :3]).T
    return (photographs.centres[number] + depths[:, None, None] * along).reshape(-1, 3)


def _usefully_seen(
    photographs: Photographs, number: int, other: int, points: FloatArray
) -> tuple[BoolArray, FloatArray]:
    """Which points of one photograph another shows from a direction that tells how far they are; angles in degrees."""
    towards, away = (photographs.centres[each] - points for each in (number, other))
    lengths = np.linalg.norm(towards, axis=1) * np.linalg.norm(away, axis=1)
    cosine = np.einsum("ni,ni->n", away, towards) / np.maximum(lengths, 1e-12)
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return photographs.shown(other, points)[2] & (angle > ANGLES_DEG[0]) & (angle < ANGLES_DEG[1]), angle


def _neighbours(photographs: Photographs, number: int, near: float, far: float) -> list[int]:
    """Photographs that see most of what one sees, from directions that tell how far it is."""
    points = _probes(photographs, number, 1.0 / np.linspace(1.0 / far, 1.0 / near, _PROBES[1] + 2)[1:-1])
    worth = np.zeros(len(photographs))
    for other in range(len(photographs)):
        useful, angle = _usefully_seen(photographs, number, other, points)
        if other != number and useful.mean() >= _FEWEST_PROBES:
            worth[other] = np.sum(useful * np.exp(-0.5 * (np.log(np.maximum(angle, 1e-3) / BEST_ANGLE_DEG)) ** 2))
    best = np.argsort(-worth, kind="stable")[:NEIGHBOURS]
    return [int(other) for other in best if worth[other] > 0.0]


def _sweep(view: _View, others: list[_View], near: float, far: float, endless: bool) -> tuple[FloatArray, ...]:
    """Depth of every pixel, NaN where not sure, and distance of planes; if `endless`, on planes behind `far` too."""
    inverse_depths = np.linspace(1.0 / far, 1.0 / near, _num_planes(view, others, near, far))
    beyond = min(len(inverse_depths), int(inverse_depths[0] / (inverse_depths[1] - inverse_depths[0]))) * endless
    farthest = 0.5 * inverse_depths[0] / max(1, beyond)
    inverse_depths = np.concatenate((np.linspace(farthest, inverse_depths[0], beyond, endpoint=False), inverse_depths))
    patches = _Patches.of(view)
    agreement = np.empty((*view.shape, len(inverse_depths)), dtype=np.float32)
    moved = np.empty((len(others), *view.channels.shape), dtype=np.float32)
    for plane, inverse_depth in enumerate(inverse_depths):
        for number, other in enumerate(others):
            _warped(other, view, 1.0 / inverse_depth, moved[number])
        half = -(-len(others) // 2)
        correlate(
            view.channels,
            moved,
            RADIUS,
            patches.weights,
            patches.means,
            patches.variances,
            view.noise,
            half,
            plane,
            agreement,
        )
    plain = (patches.variances == 0.0).all(axis=0)
    agreement *= -0.5
    agreement += 0.5
    agreement[plain] = 0.5  # nothing but noise: no plane is better than another
    total = np.empty_like(agreement)
    aggregate(agreement, view.features, *(np.float32(value) for value in (STEP, JUMP, EDGE)), total)
    best = total.argmin(-1)
    away = np.abs(np.arange(total.shape[-1]) - best[..., None]) > 2
    elsewhere = np.where(away, total, np.inf).min(-1)
    sure = elsewhere - np.take_along_axis(total, best[..., None], -1)[..., 0] >= MARGIN
    sure &= (best < total.shape[-1] - 1) & (view.channels[0] >= 0.0)
    # Nothing is farther than the last plane: only what agrees well there is that far.
    sure &= (best > 0) | ((beyond > 0) & (agreement[..., 0] <= 0.5 * (1.0 - LEAST_CORRELATION)))
    apart = np.diff(inverse_depths, append=2.0 * inverse_depths[-1] - inverse_depths[-2])[best]
    found = 1.0 / np.maximum(inverse_depths[best] + _between(total, best) * apart, inverse_depths[0])
    return np.where(sure, found, np.nan).ravel(), (found * found * apart).ravel()


@dataclass(frozen=True, eq=False)
class _Patches:
    """Who belongs to the patch around each pixel of a photograph, and how much the patch varies."""

    weights: Float32Array  # Shape (pixels of a patch, h, w)
    means: Float32Array  # Shape (channels, h, w)
    variances: Float32Array  # Shape (channels, h, w)

    @classmethod
    def of(cls, view: _View) -> _Patches:
        weights = np.empty(((2 * RADIUS + 1) ** 2, *view.shape), dtype=np.float32)
        means, variances = (np.empty(view.channels.shape, dtype=np.float32) for _ in range(2))
        limits = LIKENESS, SPREAD, LEAST_WEIGHT, view.noise
        weigh_patches(view.features, view.channels, RADIUS, *limits, weights, means, variances)
        return cls(weights, means, variances)


def _neighbours_agree(depth: Float32Array, error: Float32Array) -> BoolArray:
    """Which pixels have `FEWEST_AROUND` neighbours whose depths are the same to one plane, shape (h, w)."""
    height, width = depth.shape
    framed, count = np.pad(depth, 1, constant_values=np.nan), np.zeros(depth.shape, dtype=np.int64)
    for row in range(3):
        for column in range(3):
            count += np.abs(framed[row : row + height, column : column + width] - depth) <= error
    return count > FEWEST_AROUND  # the pixel itself is one of them


def _num_planes(view: _View, others: list[_View], near: float, far: float) -> int:
    """Planes such that the middle of the picture moves by a pixel in the neighbour where it moves most."""
    height, width = view.shape
    middle = view.centre + np.outer((near, far), view.inverse @ (0.5 * width, 0.5 * height, 1.0))
    most = 0.0
    for other in others:
        x, y, depth = other.matrix[:, :3] @ middle.T + other.matrix[:, 3:]
        if (depth > 0.0).all():
            most = max(most, float(np.hypot(np.diff(x / depth), np.diff(y / depth))[0]))
    return int(np.clip(np.ceil(most) + 1, *PLANES)) if most > 0.0 else PLANES[1]


def _warped(other: _View, view: _View, depth: float, warped: Float32Array) -> None:
    """Warp a photograph by the plane at a depth of another into what the other would see; fill `warped` (c, h, w)."""
    turn = depth * (other.matrix[:, :3] @ view.inverse)
    turn[:, 2] += other.matrix[:, :3] @ view.centre + other.matrix[:, 3]
    half = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])  # pixel centres lie at halves, OpenCV's not
    height, width = view.shape
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    to_other = np.linalg.inv(half) @ turn @ half
    for channel, picture in zip(warped, other.channels):
        cv2.warpPerspective(picture, to_other, (width, height), channel, flags, cv2.BORDER_CONSTANT, (_OUTSIDE,))
    # What lies behind the other photograph would be drawn upside down. Depth in it is linear over the picture.
    if min(turn[2] @ (column, row, 1.0) for column in (0, width) for row in (0, height)) <= 0.0:
        columns, rows = np.arange(width) + 0.5, np.arange(height)[:, None] + 0.5
        warped[:, turn[2, 0] * columns + turn[2, 1] * rows + turn[2, 2] <= 0.0] = _OUTSIDE


def _between(cost: Float32Array, best: IntArray) -> FloatArray:
    """Where between planes, the last axis, the cost is least: the bottom of a parabola, in -1/2 to 1/2 planes."""
    inner = np.clip(best, 1, cost.shape[-1] - 2)
    before, at, behind = (
        np.take_along_axis(cost, inner[..., None] + step, -1)[..., 0].astype(np.float64) for step in (-1, 0, 1)
    )
    bend = before - 2.0 * at + behind
    bottom = np.clip(0.5 * (before - behind) / np.where(bend > 1e-6, bend, np.inf), -0.5, 0.5)
    return np.where(best == inner, bottom, 0.0)


def feature_rays_to_depths(depths: Depths) -> FeatureRays:
    """One feature ray per sure pixel, to a point of its own.

    The rays stand photograph after photograph [world units]. A ray's uncertainty is `ERROR_PLANES` times the distance
    between the planes of its sweep, along the ray.
    """
    (sure,) = np.nonzero(np.isfinite(depths.depth))
    depth, error = (values[sure].astype(np.float64) for values in (depths.depth, depths.error))
    return rays_through(depths.photographs, sure, depth, ERROR_PLANES * error)


def rays_through(
    photographs: Photographs, chosen: IntArray, depth: FloatArray, error: FloatArray | float = 0.0
) -> FeatureRays:
    """Feature rays through the pixels `chosen` (n,) to depths (n,) with standard errors (n,), [world units]."""
    origins, along = photographs.of_pixels(chosen)
    points, errors = origins + depth[:, None] * along, np.asarray(error) * np.linalg.norm(along, axis=1)
    return FeatureRays(origins, np.arange(len(chosen)), points, errors)
