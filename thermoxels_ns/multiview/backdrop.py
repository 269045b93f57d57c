"""Search for pixels of photographs that show a plain backdrop (a sky, the wall behind an object) or a ceiling."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np

from thermoxels_ns.core.arrays import BoolArray, Float32Array, FloatArray
from thermoxels_ns.multiview.photographs import SATURATED, Photographs

PLAIN = 0.03  # A pixel is plain if each channel differs by at most this, of 1, from the four pixels beside it
STEEPEST = 0.9  # Cosine between the optical axis and the vertical above which no side of a photograph is its top
LEVEL = 10.0  # Weight, in `upwards`, of how level one image axis is, relative to how steep the other is
TOLERANCE = 0.1
"""Largest difference of a pixel's channels from the backdrop's colour, of 1, and temperature, of the scene's range. On
eight drawn scenes and a real street, 0.06 for colours finds less of the sky (saharov32: 54 % instead of 69 %); neither
value takes more than 1 % of a body's pixels."""
RISE_DEG, SURROUNDED = 10.0, 0.02
"""Cameras stand inside what they photograph if, for half of them, at least the share `SURROUNDED` of all points of
known depth lies behind the camera and at least `RISE_DEG` degrees above it. The share is 0.07 in a drawn living room,
0.003 around a statue in a street, 0 around drawn houses."""
COLDER = 0.05  # A sky is colder than this quantile of the temperatures of pixels with a known depth
_SOME = 20_000  # A statistic uses about as many pixels
_WIDEST, _ROUNDS = 0.3, 8
"""Tolerance in the first fit of the backdrop's colour, and number of fits; in the last it is `TOLERANCE`."""


def plain_backdrop(photographs: Photographs, depth: Float32Array) -> tuple[BoolArray, BoolArray, BoolArray]:
    """Return three masks (pixels,): the plain backdrop, pixels at its outline with wrong depths, and a plain ceiling.

    If `what_is_above` returns "sky", the third mask is empty; if "ceiling", only the third is not; if "unknown", only
    the second is not. A plain pixel without a known `depth` (pixels,), NaN if unknown, shows the backdrop if all pixels
    from it up to the edge of the photograph are such pixels (a wall ends at a roof, windows or the ground), and if its
    colour and temperature are those of most such pixels, as a function of direction (harmonics of degree 2). Plain
    pixels of the same look that touch the backdrop, such as pixels below an object, show it too. Pixels beside the
    backdrop that look like it have wrong depths, taken from an outline (drawn courtyard: 2.6 % of all depths lie on the
    sky, 0.5 % without these pixels).
    """
    open_above, plain = (np.zeros(len(photographs.colours), dtype=bool) for _ in range(2))
    directions, up = np.empty((len(open_above), 3)), upwards(photographs)
    for number in range(len(photographs)):
        (width, height), first = photographs.sizes[number], photographs.firsts[number]
        pixels, shape = slice(first, first + width * height), (height, width)
        inverse = np.linalg.inv(photographs.matrices[number][:, :3])
        columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        along = np.column_stack((columns.ravel(), rows.ravel(), np.ones(width * height))) @ inverse.T
        directions[pixels] = along / np.linalg.norm(along, axis=1, keepdims=True)
        even = even_pixels(photographs.colours[pixels].reshape(*shape, 3)) & np.isnan(depth[pixels]).reshape(shape)
        plain[pixels] = even.ravel()
        turns = _turns(inverse, up)
        if turns is not None:
            open_above[pixels] = np.rot90(np.logical_and.accumulate(np.rot90(even, turns), axis=0), -turns).ravel()
    none = np.zeros_like(open_above)
    if open_above.mean() < 1e-3:
        return none, none, none
    values = np.column_stack((photographs.colours, photographs.thermal))
    beside = _alike(values, directions, open_above, photographs.measured)
    alike = plain & beside
    open_above &= alike
    for (width, height), first in zip(photographs.sizes, photographs.firsts):
        pixels = slice(first, first + width * height)
        picture = alike[pixels].reshape(height, width).astype(np.uint8)
        label = np.asarray(cv2.connectedComponents(picture, connectivity=4)[1], dtype=np.int64).ravel()
        touched = np.bincount(label, open_above[pixels], label.max() + 1) > 0
        alike[pixels] &= touched[label]
        around = cv2.dilate(alike[pixels].reshape(height, width).astype(np.uint8), np.ones((3, 3), np.uint8)).ravel()
        beside[pixels] &= (around > 0) & ~alike[pixels]
    above = what_is_above(photographs, np.where(beside, np.float32(np.nan), depth), alike, up)
    return (
        alike if above == "sky" else none,
        none if above == "ceiling" else beside,
        alike if above == "ceiling" else none,
    )


def what_is_above(
    photographs: Photographs, depth: Float32Array, plain: BoolArray, up: FloatArray
) -> Literal["sky", "ceiling", "unknown"]:
    """Return whether the pixels that are True in `plain` (pixels,) show a sky or the ceiling of a room.

    The result is "sky" if known surfaces hardly rise behind the cameras (`SURROUNDED`). In a room they do, as other
    photographs show, but also in a yard or a street. If they do, the result is "sky" if the median plain pixel is
    colder than nearly all surfaces (`COLDER`) or below all that the camera measures, otherwise "ceiling". Without
    temperatures of surfaces it is "unknown": a ceiling looks like a cloudy sky. `depth` (pixels,) is NaN if unknown;
    `up` is a unit vector, (3,).
    """
    (known,) = np.nonzero(np.isfinite(depth))
    some = known[:: max(1, len(known) // _SOME)]
    origins, along = photographs.of_pixels(some)
    points, rise, shares = origins + depth[some, None] * along, np.sin(np.deg2rad(RISE_DEG)), []
    for centre, forward in zip(photographs.centres, photographs.matrices[:, 2, :3]):
        away = points - centre
        behind = (away @ up > rise * np.linalg.norm(away, axis=1)) & (away @ forward < 0.0)
        shares.append(np.count_nonzero(behind) / max(1, len(behind)))
    if np.median(shares) < SURROUNDED:
        return "sky"
    warm = photographs.thermal
    theirs, surfaces = (values[np.isfinite(values)] for values in (warm[plain], warm[known]))
    if not len(surfaces):
        return "unknown"
    colder = not len(theirs) or np.median(theirs) < np.quantile(surfaces, COLDER)
    return "sky" if colder else "ceiling"


def upwards(photographs: Photographs) -> FloatArray:
    """Return the unit vector (3,) up in the world; cameras must be held level, all upright or all on a side.

    Up is as perpendicular as possible to one image axis of the photographs and as parallel as possible to the other.
    With upright cameras, the images' own top gives the sign; with cameras on a side, photographs are brighter upwards.
    """
    sides = np.linalg.inv(photographs.matrices[:, :, :3]).transpose(2, 0, 1)[:2]  # to the right, and down
    right, down = sides / np.linalg.norm(sides, axis=2, keepdims=True)
    squares = down.T @ down, right.T @ right
    found = [np.linalg.eigh(steep - LEVEL * level) for steep, level in (squares, squares[::-1])]
    if found[0].eigenvalues[2] >= found[1].eigenvalues[2]:
        up = found[0].eigenvectors[:, 2]
        return up if (down @ up).sum() <= 0.0 else -up
    up = found[1].eigenvectors[:, 2]
    along = photographs.of_pixels(np.arange(len(photographs.colours)))[1] @ up
    return up if np.nansum((along - along.mean()) * photographs.colours.mean(axis=1)) >= 0.0 else -up


def _turns(inverse: FloatArray, up: FloatArray) -> int | None:
    """Return the number of quarter turns (`np.rot90`) that bring a photograph's upper side to the top of the array.
    `inverse` (3, 3) maps homogeneous pixels to world directions. None if the camera looks steeply up or down."""
    right, down, forward = inverse.T @ up / np.linalg.norm(inverse, axis=0)
    if abs(forward) > STEEPEST:
        return None
    if abs(down) >= abs(right):
        return 0 if down < 0 else 2
    return 1 if right > 0 else 3


def even_pixels(picture: Float32Array) -> BoolArray:
    """Return which pixels of a picture (h, w, 3) differ by at most `PLAIN` from the four pixels beside them, (h, w). A
    pixel that is masked, or beside a masked pixel, is False."""
    even = np.ones(picture.shape[:2], dtype=bool)
    for axis in (0, 1):
        small = np.abs(np.diff(picture, axis=axis)).max(-1) <= PLAIN
        one, other = [slice(None)] * 2, [slice(None)] * 2
        one[axis], other[axis] = slice(1, None), slice(None, -1)
        even[tuple(one)] &= small
        even[tuple(other)] &= small
    return even


def _alike(
    values: Float32Array, directions: FloatArray, chosen: BoolArray, measured: Float32Array | None = None
) -> BoolArray:
    """Return which pixels look like most of the `chosen` ones, by colour and, if known, temperature, (pixels,).

    The expected look is fitted as a function of `directions` (pixels, 3). `values` (pixels, 4) are red, green, blue and
    temperature. `measured` (pixels, 3) are colours before correction; None: there was none. Any colour between measured
    and corrected one may match; for a saturated pixel, so may any brighter colour.
    """
    x, y, z = directions.T
    basis = np.column_stack((np.ones_like(x), x, y, z, x * y, y * z, x * z, x * x - y * y, 3.0 * z * z - 1.0))
    some = np.flatnonzero(chosen)
    some = some[:: max(1, len(some) // _SOME)]
    seen = values[some].astype(np.float64)
    bins = np.unique((np.nan_to_num(seen) / (2.0 * TOLERANCE)).astype(np.int64), axis=0, return_inverse=True)[1]
    bins = bins.reshape(-1)
    middle = np.median(seen[bins == np.bincount(bins).argmax()], axis=0)
    expected = np.broadcast_to(middle, (len(some), 4))
    fitted = np.zeros((basis.shape[1], 4))
    for widest in np.geomspace(_WIDEST / TOLERANCE, 1.0, _ROUNDS):
        off = np.abs(seen - expected) / TOLERANCE
        near = (np.nan_to_num(off) <= widest).all(1)
        for channel in range(4):
            used = near & np.isfinite(seen[:, channel])
            rows = basis[some[used]]
            ridge = 1e-3 * max(1, len(rows)) * np.diag([0.0] + [1.0] * (basis.shape[1] - 1))
            fitted[:, channel] = np.linalg.lstsq(rows.T @ rows + ridge, rows.T @ seen[used, channel], rcond=None)[0]
        expected = basis[some] @ fitted
    expected, lowest, highest = basis @ fitted, values, values
    if measured is not None:
        lowest, highest = values.copy(), values.copy()
        lowest[:, :3] = np.minimum(values[:, :3], measured)
        highest[:, :3] = np.where(measured >= SATURATED, np.inf, np.maximum(values[:, :3], measured))
    off = np.maximum(lowest - expected, expected - highest) / TOLERANCE
    return (np.nan_to_num(off) <= 1.0).all(1)


def mean_colours(photographs: Photographs, backdrop: BoolArray, points: FloatArray) -> Float32Array:
    """Return for each point (n, 3) the mean colour, over photographs, of the pixels to which it projects, (n, 3).
    Pixels of the backdrop do not count. A point without a pixel gets the mean colour of all pixels that count."""
    shown = np.isfinite(photographs.colours).all(1) & ~backdrop
    colours = photographs.colours
    total, count = np.zeros((len(points), 3)), np.zeros(len(points))
    for number in range(len(photographs)):
        pixel, far, inside = photographs.shown(number, points)
        inside &= (far > photographs.near) & shown[pixel]
        total[inside] += colours[pixel[inside]]
        count += inside
    everywhere = colours[shown].mean(0) if shown.any() else np.zeros(3)
    return np.where(count[:, None] > 0, total / np.maximum(count, 1)[:, None], everywhere).astype(np.float32)
