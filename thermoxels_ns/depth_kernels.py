"""Compiled loops over depths of photographs: where they agree, and which voxels lie before them."""

from __future__ import annotations

import numpy as np
from numba import njit

FEWEST_DISTANCES = 3
"""Photographs that must see a point for their distances to be averaged."""


@njit(nogil=True, cache=True, error_model="numpy")
def _pixel(x, y, z, matrix, width, height, first):
    """Number of the pixel that shows a point, and the point's depth; -1 where the photograph does not show it."""
    depth = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z + matrix[2, 3]
    if not depth > 0.0:
        return -1, depth
    column = np.floor((matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z + matrix[0, 3]) / depth)
    row = np.floor((matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z + matrix[1, 3]) / depth)
    if not (column >= 0.0 and column < width and row >= 0.0 and row < height):
        return -1, depth
    return first + int(row) * width + int(column), depth


@njit(nogil=True, cache=True, error_model="numpy")
def agreeing_views(begin: int, end: int, matrices, inverses, centres, sizes, firsts, depth, error, result):
    """Count in ``result[pixel]`` the other photographs whose own depth lies where that of a pixel does.

    Depths agree if they differ by no more than the sum of both pixels' errors. Pixels `begin` to `end`; 0 where a depth
    is NaN.
    """
    number = len(firsts) - 1
    while number > 0 and firsts[number] > begin:
        number -= 1
    for n in range(begin, end):
        while number + 1 < len(firsts) and firsts[number + 1] <= n:
            number += 1
        result[n] = 0
        if np.isnan(depth[n]):
            continue
        u = (n - firsts[number]) % sizes[number, 0] + 0.5
        v = (n - firsts[number]) // sizes[number, 0] + 0.5
        m = inverses[number]
        x = centres[number, 0] + depth[n] * (m[0, 0] * u + m[0, 1] * v + m[0, 2])
        y = centres[number, 1] + depth[n] * (m[1, 0] * u + m[1, 1] * v + m[1, 2])
        z = centres[number, 2] + depth[n] * (m[2, 0] * u + m[2, 1] * v + m[2, 2])
        for k in range(len(firsts)):
            if k == number:
                continue
            at, far = _pixel(x, y, z, matrices[k], sizes[k, 0], sizes[k, 1], firsts[k])
            if at < 0:
                continue
            if abs(depth[at] - far) <= error[at] + error[n]:  # False where it is NaN
                result[n] += 1


@njit(nogil=True, cache=True, error_model="numpy")
def count_sights(
    begin: int, end: int, lo, step, shape, matrices, sizes, firsts, sure, likely, error, margin, through, ends
):
    """Count for voxels `begin` to `end` (flat numbers) the photographs that look through them, and that end there.

    A photograph looks through a voxel whose middle lies more than `margin` and the pixel's error before its sure depth;
    it ends there if its likely depth is no farther from the middle than that.
    """
    for n in range(begin, end):
        x = lo[0] + step * (n // (shape[1] * shape[2]) + 0.5)
        y = lo[1] + step * (n // shape[2] % shape[1] + 0.5)
        z = lo[2] + step * (n % shape[2] + 0.5)
        through[n], ends[n] = 0, 0
        for k in range(len(firsts)):
            at, far = _pixel(x, y, z, matrices[k], sizes[k, 0], sizes[k, 1], firsts[k])
            if at < 0:
                continue
            if sure[at] - far > margin + error[at]:  # False where it is NaN
                through[n] += 1
            elif abs(likely[at] - far) <= margin + error[at]:
                ends[n] += 1


@njit(nogil=True, cache=True, error_model="numpy")
def mean_distances(begin: int, end: int, points, matrices, sizes, firsts, depth, reach, result):
    """Fill ``result[point]`` for points `begin` to `end` with the mean distance before the depths of photographs.

    Distances along the view direction, positive before a depth, at most `reach`; photographs whose depth is nearer than
    the point by more than that do not see it. Fewer than `FEWEST_DISTANCES` that do: NaN.
    """
    for n in range(begin, end):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        total, count = 0.0, 0
        for k in range(len(firsts)):
            at, far = _pixel(x, y, z, matrices[k], sizes[k, 0], sizes[k, 1], firsts[k])
            if at < 0:
                continue
            before = depth[at] - far
            if before >= -reach:  # False where it is NaN
                total += min(before, reach)
                count += 1
        result[n] = total / count if count >= FEWEST_DISTANCES else np.nan
