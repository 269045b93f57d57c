"""Multi-view stereo: depths of photographs by plane sweep, and feature rays to these depths."""

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
from thermoxels_ns.multiview.stereo_kernels import add_differences, aggregate, correlate, weigh_patches

NEIGHBOURS = 6
"""Most photographs that each photograph is compared with, its neighbours. At each pixel the better half of those that
show the place counts, but at least `FEWEST_VIEWS`: the surface may be hidden in the others. Six was chosen among 4, 6
and 8 on street, white house, wild-24 and living-room. On wild-0 to 19 F is lower than with 4 by 0.001 in the median."""
ANGLES_DEG = (4.0, 60.0)
"""Least and largest angle between the rays of two photographs to a point at which they are compared. Smaller angles
tell nothing about depth; at larger angles the surface looks too different."""
BEST_ANGLE_DEG = 15.0  # Neighbours at about this angle are preferred
RADIUS = 2  # A patch, the square of pixels that is compared, is 2 RADIUS + 1 pixels wide
LIKENESS = 0.025
"""Least scale s, of 1, of the weights exp(-(d / s)^2) in a patch (see `weigh_patches`), where d is the difference of a
pixel from the middle pixel."""
LEAST_WEIGHT = 0.05
"""A smaller weight, of 1, is set to 0. Without this, depths of plane photographs that differ by noise alone give gains
up to 0.6 % off instead of 0.5 %; on a drawn white house nothing changes."""
PLANES = (24, 256)
"""Least and most planes per photograph. Between these limits the picture moves by about a pixel from plane to plane."""
NOISE = (1.5 / 255.0, 1.0 / 255.0)
"""Standard deviations of the noise of brightness, of 1, and of temperature, of the scene's range. They are also the
least standard deviations of differences between two photographs."""
DIFFERENCE, ALIKE = 0.4, 2.0
"""Cost of a pixel that differs by `ALIKE` or more standard deviations from what another photograph shows on a plane; a
smaller difference costs in proportion. The standard deviation is measured on the planes on which patches correlate
best. On a ramp these may be wrong planes, but sure depths alone gave no better result. Correlation cannot tell apart
places along a shallow ramp, nor say where an even area ends: with this cost and `PAIRS_IN_LINE`, pixels of the body
with a depth rise from 37, 55, 35 and 52 % to 61, 66, 49 and 54 % (wild-7, courtyard, white house, saharov32), and the
wrong ones among them fall to half or less. Costs of 0.1 to 0.6 and limits of 2 to 6 were tried, with margins of 0.03 to
0.1. If texture is as fine as pixels, differences are noise: a block before far random walls loses 12 % of depths."""
STEP, JUMP = 0.05, 0.6
"""Costs of a change of one plane, and of several planes, between pixels side by side; a correlation r costs
(1 - r) / 2. Steps of 0.02 and jumps of 0.3 to 1.2 gave the same on four drawn scenes, before `DIFFERENCE`."""
EDGE = 0.02  # Difference of two pixels, of 1, at which a jump between them costs half
MARGIN = 0.06  # Cost by which the best plane must beat every plane more than two planes away
FEWEST_VIEWS = 2  # Fewest other photographs that must agree with a depth
TOLERANCE = 0.3  # Depths of two photographs agree if they differ by at most this share of the sum of plane spacings
PAIRS_IN_LINE = 3  # Least number, of the four pairs of opposite neighbours, with which a sure pixel must be in line
LEAST_CORRELATION = 0.6  # Least correlation at which a depth on the farthest plane is accepted
ERROR_PLANES = 0.1
"""Standard error of a depth that trainings and votes assume, in spacings of planes. Of single pixels 68 % are
within 0.26 to 0.29 (house-corner, facade, courtyard), but errors average out over a surface: with 0.25, F of facade,
courtyard and wild-14 was 0.014, 0.004 and 0.058 lower, and rendered depths were 1.6, 1.2 and 1.4 times as far off."""
_NEAREST = 0.1  # Least distance of the nearest plane in the box, relative to the farthest
_OUTSIDE = -100.0
"""Value of a pixel that a photograph does not show. Interpolation between this value and other pixels is below 0."""
_FEWEST_ALIKE = 30  # Fewest pixels from which the standard deviation of two photographs' differences is taken
_PROBES = (5, 4)  # Points along each side of a photograph, and depths, at which neighbours are looked for
_FEWEST_PROBES = 0.1  # Share of these points that a neighbour must see
_DEPTHS_PER_SPREAD = 2.0 ** np.arange(-6.0, 6.5, 0.5)
"""Depths tried if no box is known, relative to the root mean square distance of the cameras from their mean."""


@dataclass(frozen=True, eq=False)
class Depths:
    """Photographs, with the depth of each pixel where a depth is sure."""

    photographs: Photographs
    depth: Float32Array
    """Depth of each pixel, in the order of `photographs.colours`, shape (pixels,), [world units]; NaN: not sure."""
    error: Float32Array  # Spacing of the planes of the sweep at each depth, shape (pixels,), [world units]

    @property
    def share(self) -> float:
        """Share of the pixels whose depth is sure, 0 to 1."""
        return float(np.mean(np.isfinite(self.depth)))


def depths_before_backdrop(depths: Depths) -> tuple[Depths, BoolArray, BoolArray]:
    """Return depths with wrong ones beside a backdrop set to NaN, and masks (pixels,) of plain backdrop and ceiling."""
    backdrop, beside, ceiling = plain_backdrop(depths.photographs, depths.depth)
    return replace(depths, depth=np.where(beside, np.float32(np.nan), depths.depth)), backdrop, ceiling


def depths_of(photographs: Photographs, lo: npt.ArrayLike | None = None, hi: npt.ArrayLike | None = None) -> Depths:
    """Return the depths of the pixels of photographs by plane sweep (Collins 1996) and semi-global matching.

    For each photograph, its neighbours are drawn onto planes parallel to its image. Patches are compared by normalised
    cross-correlation of brightness and, if the same camera measured it, temperature. In a patch only pixels that look
    like the middle one count: otherwise pixels beside an outline would take the outline's depth. The cost of a plane is
    low correlation plus the difference of the pixels (`DIFFERENCE`). Costs are summed along paths through the
    photograph (Hirschmueller 2008), so that a pixel without texture takes the depth of similar pixels beside it. The
    plane of least cost gives the depth if it beats all planes farther than two planes away by `MARGIN`. A depth is sure
    if `FEWEST_VIEWS` other photographs have a depth at the same point, and if the surrounding pixels lie in line with
    it. Planes reach through the box and behind it; without a box, they reach
    through the depths at which views overlap.

    Args:
        photographs: Pinhole photographs, best some 160 pixels wide: time grows with the third power of their width.
        lo: Lower corner of the box, [world units]. None: no box.
        hi: Upper corner of the box. None: no box.
    """
    corners = None if lo is None or hi is None else (np.asarray(lo, np.float64), np.asarray(hi, np.float64))
    views = [_View.of(photographs, number) for number in range(len(photographs))]
    total = len(photographs.colours)
    depth, error = (np.full(total, np.nan, np.float32) for _ in range(2))

    def work(begin: int, end: int) -> None:
        for number in range(begin, end):
            view = views[number]
            span = _overlap(photographs, number) if corners is None else _span(view, *corners, photographs.near)
            if span is None:
                continue
            others = _neighbours(photographs, number, *span)
            if others:
                planes = _planes(photographs, number, others, *span, corners is not None)
                first = int(photographs.firsts[number])
                pixels = slice(first, first + view.shape[0] * view.shape[1])
                found = _sweep(view, [views[other] for other in others], planes, corners is not None)
                depth[pixels], error[pixels] = found

    run_ranges(work, len(views), 1)
    depth[_agreeing_views(photographs, depth, error) < FEWEST_VIEWS] = np.nan
    for view, first in zip(views, photographs.firsts):
        pixels = slice(first, first + view.shape[0] * view.shape[1])
        agree = _neighbours_agree(depth[pixels].reshape(view.shape), error[pixels].reshape(view.shape))
        depth[pixels][~agree.ravel()] = np.nan
    return Depths(photographs, depth, error)


def _agreeing_views(photographs: Photographs, depth: Float32Array, spacing: Float32Array) -> IntArray:
    """Return for each pixel the number of other photographs that agree with its depth, (pixels,).

    A photograph agrees if its depth at the point differs by at most `TOLERANCE` times the sum of both pixels' `spacing`
    of planes. All arrays are (pixels,); a `depth` of NaN is unknown.
    """
    agreeing = np.zeros(len(depth), dtype=np.int64)
    (known,) = np.nonzero(np.isfinite(depth))

    def compare(begin: int, end: int) -> None:
        own = known[begin:end]
        origins, along = photographs.of_pixels(own)
        points, number = origins + depth[own, None] * along, np.searchsorted(photographs.firsts, own, side="right") - 1
        for other in range(len(photographs)):
            pixel, far, shown = photographs.shown(other, points)
            off = np.abs(depth[pixel] - far)  # NaN fails the comparison
            agreeing[own] += shown & (number != other) & (off <= TOLERANCE * (spacing[pixel] + spacing[own]))

    run_ranges(compare, len(known), 1 << 15)
    return agreeing


@dataclass(frozen=True, eq=False)
class _View:
    """One photograph, prepared for the sweep."""

    channels: Float32Array
    """Brightness and, where the same camera measured it, temperature, shape (1 or 2, h, w); `_OUTSIDE` where masked."""
    picture: Float32Array  # The channels as OpenCV has them, shape (h, w, 1 or 2)
    features: Float32Array
    """Values by which pixels are compared within the photograph, shape (h, w, 3 or 4): a third of each colour, and
    temperature, which sets a cold sky apart."""
    matrix: FloatArray  # World to homogeneous pixels, (3, 4)
    inverse: FloatArray  # Homogeneous pixels to directions of depth 1 in the world, (3, 3)
    centre: FloatArray  # Camera centre in the world, (3,)

    @classmethod
    def of(cls, photographs: Photographs, number: int) -> _View:
        width, height = photographs.sizes[number]
        pixels = slice(photographs.firsts[number], photographs.firsts[number] + width * height)
        warm, matrix = photographs.thermal[pixels].reshape(height, width), photographs.matrices[number]
        measured = [warm] * bool(np.isfinite(warm).any())
        colours = photographs.colours[pixels].reshape(height, width, 3)
        channels = np.stack([np.nan_to_num(values, nan=_OUTSIDE) for values in (colours.mean(axis=2), *measured)])
        thirds = colours / np.float32(3.0)
        features = np.nan_to_num(np.dstack([thirds, *measured]))
        picture = np.ascontiguousarray(channels.transpose(1, 2, 0))
        return cls(channels, picture, features, matrix, np.linalg.inv(matrix[:, :3]), photographs.centres[number])

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows and of columns."""
        return self.channels.shape[1], self.channels.shape[2]

    @property
    def noise(self) -> Float32Array:
        """Variance of the noise of each channel, shape (channels,)."""
        return np.square(np.array(NOISE[: len(self.channels)], dtype=np.float32))


def _span(view: _View, low: FloatArray, high: FloatArray, near: float) -> tuple[float, float] | None:
    """Return the least and largest depth of the box `low` to `high` in a view; None if all of it is before `near`."""
    corners = np.stack(np.meshgrid(*zip(low, high)), -1).reshape(-1, 3)
    depth = corners @ view.matrix[2, :3] + view.matrix[2, 3]
    far = float(depth.max())
    if far <= near or far <= 0.0:
        return None
    return max(float(depth.min()), near, _NEAREST * far), far


def _overlap(photographs: Photographs, number: int) -> tuple[float, float] | None:
    """Return the least and largest depth at which at least two other photographs see enough of what photograph
    `number` sees, at angles within `ANGLES_DEG`; None if fewer than two of the depths tried qualify."""
    centres = photographs.centres
    depths = np.sqrt(((centres - centres.mean(0)) ** 2).sum(1).mean()) * _DEPTHS_PER_SPREAD
    points, others = _probes(photographs, number, depths), np.zeros(len(depths) * _PROBES[0] ** 2, int)
    for other in range(len(photographs)):
        others += (other != number) & _usefully_seen(photographs, number, other, points)[0]
    enough = (others >= 2).reshape(len(depths), -1).mean(1) >= _FEWEST_PROBES
    return (float(depths[enough][0]), float(depths[enough][-1])) if enough.sum() > 1 else None


def _probes(photographs: Photographs, number: int, depths: FloatArray) -> FloatArray:
    """Return the world points on a grid of pixels of a photograph at each of the depths, (depths * pixels, 3)."""
    columns, rows = ((np.arange(_PROBES[0]) + 0.5) * side / _PROBES[0] for side in photographs.sizes[number])
    pixels = np.stack(np.meshgrid(columns, rows, [1.0]), -1).reshape(-1, 3)
    along = pixels @ np.linalg.inv(photographs.matrices[number, :, :3]).T
    return (photographs.centres[number] + depths[:, None, None] * along).reshape(-1, 3)


def _usefully_seen(
    photographs: Photographs, number: int, other: int, points: FloatArray
) -> tuple[BoolArray, FloatArray]:
    """Return the mask (n,) of the points (n, 3) that photograph `other` shows at an angle, between its ray and that of
    photograph `number`, within `ANGLES_DEG`; and the angles (n,), [degrees]."""
    towards, away = (photographs.centres[each] - points for each in (number, other))
    lengths = np.linalg.norm(towards, axis=1) * np.linalg.norm(away, axis=1)
    cosine = np.einsum("ni,ni->n", away, towards) / np.maximum(lengths, 1e-12)
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return photographs.shown(other, points)[2] & (angle > ANGLES_DEG[0]) & (angle < ANGLES_DEG[1]), angle


def _neighbours(photographs: Photographs, number: int, near: float, far: float) -> list[int]:
    """Return the best `NEIGHBOURS` (or fewer) photographs for comparison with photograph `number`: those that see most
    of what it sees between depths `near` and `far` at angles near `BEST_ANGLE_DEG`."""
    points = _probes(photographs, number, 1.0 / np.linspace(1.0 / far, 1.0 / near, _PROBES[1] + 2)[1:-1])
    worth = np.zeros(len(photographs))
    for other in range(len(photographs)):
        useful, angle = _usefully_seen(photographs, number, other, points)
        if other != number and useful.mean() >= _FEWEST_PROBES:
            worth[other] = np.sum(useful * np.exp(-0.5 * (np.log(np.maximum(angle, 1e-3) / BEST_ANGLE_DEG)) ** 2))
    best = np.argsort(-worth, kind="stable")[:NEIGHBOURS]
    return [int(other) for other in best if worth[other] > 0.0]


def _sweep(view: _View, others: list[_View], inverse_depths: FloatArray, endless: bool) -> tuple[FloatArray, ...]:
    """Return depths, NaN where not sure, and spacings of planes at these depths, (pixels,) each, [world units].

    Planes stand at `inverse_depths` (planes,), farthest first; if `endless`, what is behind them is matched on the
    farthest.
    """
    weights = np.empty(((2 * RADIUS + 1) ** 2, *view.shape), dtype=np.float32)
    means, variances = (np.empty(view.channels.shape, dtype=np.float32) for _ in range(2))
    weigh_patches(view.features, view.channels, RADIUS, LIKENESS, LEAST_WEIGHT, view.noise, weights, means, variances)
    cost = np.empty((*view.shape, len(inverse_depths)), dtype=np.float32)
    # All that is drawn is kept for `add_differences`: 90 MB for 100 planes, six photographs and 160 x 120 pixels.
    moved = np.empty((len(inverse_depths), len(others), *view.channels.shape), dtype=np.float32)
    best_yet = np.full(view.shape, LEAST_CORRELATION)
    at_best = np.full_like(moved[0], _OUTSIDE)
    for plane, seen in enumerate(moved):
        for number, other in enumerate(others):
            _warped(other, view, 1.0 / inverse_depths[plane], seen[number])
        correlate(view.channels, seen, RADIUS, weights, means, variances, view.noise, FEWEST_VIEWS, plane, cost)
        better = cost[..., plane] >= best_yet
        np.copyto(best_yet, cost[..., plane], where=better)
        np.copyto(at_best, seen, where=better)
    cost[(variances == 0.0).all(axis=0)] = 0.0  # nothing but noise: no plane correlates better than another
    cost *= -0.5
    cost += 0.5
    correlates = cost[..., 0] <= 0.5 * (1.0 - LEAST_CORRELATION)
    expected, limit = _expected_pixels(view, at_best)
    for plane, seen in enumerate(moved):
        add_differences(seen, expected, limit, np.float32(DIFFERENCE), FEWEST_VIEWS, plane, cost)
    total = np.empty_like(cost)
    aggregate(cost, view.features, *(np.float32(value) for value in (STEP, JUMP, EDGE)), total)
    best = total.argmin(-1)
    away = np.abs(np.arange(total.shape[-1]) - best[..., None]) > 2
    elsewhere = np.where(away, total, np.inf).min(-1)
    sure = elsewhere - np.take_along_axis(total, best[..., None], -1)[..., 0] >= MARGIN
    sure &= (best < total.shape[-1] - 1) & (view.channels[0] >= 0.0)
    # Everything behind the farthest plane is matched there, so a depth on it is sure only where patches agree well.
    sure &= (best > 0) | (endless & correlates)
    apart = np.diff(inverse_depths, append=2.0 * inverse_depths[-1] - inverse_depths[-2])[best]
    found = 1.0 / np.maximum(inverse_depths[best] + _between(total, best) * apart, inverse_depths[0])
    return np.where(sure, found, np.nan).ravel(), (found * found * apart).ravel()


def _expected_pixels(view: _View, at_best: Float32Array) -> tuple[Float32Array, Float32Array]:
    """Return the pixels that other photographs are expected to show, and limits of their differences from these pixels.

    `at_best` (photographs, c, h, w) is what the others show at each pixel on the plane on which patches correlate best;
    `_OUTSIDE` if they correlate by less than `LEAST_CORRELATION`. The expected pixels, of the same shape, are the
    view's own brightness times the median ratio, or its temperature plus the median difference, over all pixels. The
    limits, (photographs, c, 1, 1), are `ALIKE` robust standard deviations of `at_best` from the expected pixels;
    infinite if fewer than `_FEWEST_ALIKE` pixels are known. Masked pixels of the result are far below 0.
    """
    expected = np.broadcast_to(view.channels, at_best.shape).copy()
    limit = np.full((*at_best.shape[:2], 1, 1), np.inf, np.float32)
    for number, channel in np.ndindex(*at_best.shape[:2]):
        shown, own = at_best[number, channel], view.channels[channel]
        told = (shown >= 0.0) & (own > 0.0)
        if told.sum() >= _FEWEST_ALIKE:
            if channel == 0:  # cameras differ in exposure, and their temperatures by an offset
                expected[number, channel] *= np.median(shown[told] / own[told])
            else:
                expected[number, channel] += np.median(shown[told] - own[told])
            off = np.median(np.abs(shown - expected[number, channel])[told])
            limit[number, channel] = ALIKE * max(1.48 * off, NOISE[channel])  # 1.48: from a median to a deviation
    return expected, limit


def _neighbours_agree(depth: Float32Array, spacing: Float32Array) -> BoolArray:
    """Return which pixels (h, w) lie in line with at least `PAIRS_IN_LINE` of their four pairs of opposite neighbours.
    On a plane, inverse depth is linear in the image. A pixel is in line if it is off the middle of the pair by at most
    the `spacing` of planes."""
    height, width = depth.shape
    framed, count = 1.0 / np.pad(depth, 1, constant_values=np.nan), np.zeros(depth.shape, dtype=np.int64)
    for row, column in ((0, 0), (0, 1), (0, 2), (1, 0)):
        one, other = (framed[r : r + height, c : c + width] for r, c in ((row, column), (2 - row, 2 - column)))
        count += np.abs(one + other - 2.0 / depth) <= 2.0 * spacing / depth**2
    return count >= PAIRS_IN_LINE


def _planes(
    photographs: Photographs, number: int, others: list[int], near: float, far: float, endless: bool
) -> FloatArray:
    """Return the inverse depths of the planes for the sweep of photograph `number`, farthest first, (planes,). They
    reach from depth `far`, or from infinity if `endless`, to depth `near`.

    From plane to plane the picture moves by about a pixel, within the limits `PLANES`, in that photograph of `others`
    in which it moves most. This is not even in inverse depth where cameras stand one behind the other, as in a room:
    the picture then moves much where surfaces are far and little where they are near. Depths at which no other
    photograph sees what this one does get no planes.
    """
    inverse_depths = np.linspace(1e-6 / far if endless else 1.0 / far, 1.0 / near, PLANES[1])
    points, moves = _probes(photographs, number, 1.0 / inverse_depths), np.zeros(len(inverse_depths) - 1)
    for other in others:
        seen = points @ photographs.matrices[other, :, :3].T + photographs.matrices[other, :, 3]
        shown = photographs.shown(other, points)[2].reshape(len(inverse_depths), -1)
        place = (seen[:, :2] / np.where(seen[:, 2:] > 0.0, seen[:, 2:], np.inf)).reshape(*shown.shape, 2)
        both = shown[1:] & shown[:-1]
        enough = both.mean(axis=1) >= _FEWEST_PROBES
        moved = np.where(both, np.linalg.norm(np.diff(place, axis=0), axis=2), np.nan)[enough]
        moves[enough] = np.maximum(moves[enough], np.nanmedian(moved, axis=1))
    pixels = np.append(0.0, np.cumsum(np.maximum(moves, 1e-6)))  # ascending
    planes = int(np.clip(np.ceil(pixels[-1]) + 1, *PLANES))
    farthest = 0.5 * pixels[-1] / planes if endless else 0.0
    return np.interp(np.linspace(farthest, pixels[-1], planes), pixels, inverse_depths)


def _warped(other: _View, view: _View, depth: float, warped: Float32Array) -> None:
    """Write to `warped` (c, h, w) what `view` would see if `other` were projected onto the plane at its `depth`."""
    turn = depth * (other.matrix[:, :3] @ view.inverse)
    turn[:, 2] += other.matrix[:, :3] @ view.centre + other.matrix[:, 3]
    half = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])  # OpenCV's pixel centres are whole numbers
    height, width = view.shape
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    to_other = np.linalg.inv(half) @ turn @ half
    border = cv2.BORDER_CONSTANT, (_OUTSIDE, _OUTSIDE)
    found = cv2.warpPerspective(other.picture, to_other, (width, height), None, flags, *border)
    shown = found.reshape(height, width, -1).transpose(2, 0, 1)[: len(warped)]
    warped[: len(shown)], warped[len(shown) :] = shown, _OUTSIDE  # one of the two may have no temperatures
    # Points behind the other camera would be drawn upside down. Depth in that camera is linear over the picture.
    if min(turn[2] @ (column, row, 1.0) for column in (0, width) for row in (0, height)) <= 0.0:
        columns, rows = np.arange(width) + 0.5, np.arange(height)[:, None] + 0.5
        warped[:, turn[2, 0] * columns + turn[2, 1] * rows + turn[2, 2] <= 0.0] = _OUTSIDE


def _between(cost: Float32Array, best: IntArray) -> FloatArray:
    """Return the offset of the least cost from plane `best` (h, w), in planes, -1/2 to 1/2, (h, w): the vertex of the
    parabola through `cost` (h, w, planes) at `best` and both neighbours; 0 at the first and last plane."""
    inner = np.clip(best, 1, cost.shape[-1] - 2)
    before, at, behind = (
        np.take_along_axis(cost, inner[..., None] + step, -1)[..., 0].astype(np.float64) for step in (-1, 0, 1)
    )
    bend = before - 2.0 * at + behind
    bottom = np.clip(0.5 * (before - behind) / np.where(bend > 1e-6, bend, np.inf), -0.5, 0.5)
    return np.where(best == inner, bottom, 0.0)


def feature_rays_to_depths(depths: Depths) -> FeatureRays:
    """Return one feature ray per sure pixel, each to a point of its own, photograph after photograph, [world units].
    The uncertainty of a ray is `ERROR_PLANES` times `Depths.error`, measured along the ray."""
    (sure,) = np.nonzero(np.isfinite(depths.depth))
    depth, error = (values[sure].astype(np.float64) for values in (depths.depth, depths.error))
    return rays_through(depths.photographs, sure, depth, ERROR_PLANES * error)


def rays_through(
    photographs: Photographs, chosen: IntArray, depth: FloatArray, error: FloatArray | float = 0.0
) -> FeatureRays:
    """Return feature rays through the pixels `chosen` (n,) to depths (n,) with standard errors (n,), [world units]."""
    origins, along = photographs.of_pixels(chosen)
    points, errors = origins + depth[:, None] * along, np.asarray(error) * np.linalg.norm(along, axis=1)
    return FeatureRays(origins, np.arange(len(chosen)), points, errors)
