"""Compiled loops over depths of photographs: where they agree, and which voxels lie before them."""

from __future__ import annotations

import numpy as np
from numba import njit


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
            p = matrices[k]
            far = p[2, 0] * x + p[2, 1] * y + p[2, 2] * z + p[2, 3]
            if not far > 0.0:
                continue
            column = np.floor((p[0, 0] * x + p[0, 1] * y + p[0, 2] * z + p[0, 3]) / far)
            row = np.floor((p[1, 0] * x + p[1, 1] * y + p[1, 2] * z + p[1, 3]) / far)
            if not (column >= 0.0 and column < sizes[k, 0] and row >= 0.0 and row < sizes[k, 1]):
                continue
            at = firsts[k] + int(row) * sizes[k, 0] + int(column)
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
            p = matrices[k]
            far = p[2, 0] * x + p[2, 1] * y + p[2, 2] * z + p[2, 3]
            if not far > 0.0:
                continue
            column = np.floor((p[0, 0] * x + p[0, 1] * y + p[0, 2] * z + p[0, 3]) / far)
            row = np.floor((p[1, 0] * x + p[1, 1] * y + p[1, 2] * z + p[1, 3]) / far)
            if not (column >= 0.0 and column < sizes[k, 0] and row >= 0.0 and row < sizes[k, 1]):
                continue
            at = firsts[k] + int(row) * sizes[k, 0] + int(column)
            if sure[at] - far > margin + error[at]:  # False where it is NaN
                through[n] += 1
            elif abs(likely[at] - far) <= margin + error[at]:
                ends[n] += 1


@njit(nogil=True, cache=True, error_model="numpy")
def mean_distances(begin: int, end: int, points, matrices, sizes, firsts, depth, reach, result):
    """Fill ``result[point]`` for points `begin` to `end` with the mean distance before the depths of photographs.

    Distances along the view direction, positive before a depth, at most `reach`; photographs whose depth is nearer than
    the point by more than that do not see it. Fewer than three that do: NaN.
    """
    for n in range(begin, end):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        total, count = 0.0, 0
        for k in range(len(firsts)):
            p = matrices[k]
            far = p[2, 0] * x + p[2, 1] * y + p[2, 2] * z + p[2, 3]
            if not far > 0.0:
                continue
            column = np.floor((p[0, 0] * x + p[0, 1] * y + p[0, 2] * z + p[0, 3]) / far)
            row = np.floor((p[1, 0] * x + p[1, 1] * y + p[1, 2] * z + p[1, 3]) / far)
            if not (column >= 0.0 and column < sizes[k, 0] and row >= 0.0 and row < sizes[k, 1]):
                continue
            before = depth[firsts[k] + int(row) * sizes[k, 0] + int(column)] - far
            if before >= -reach:  # False where it is NaN
                total += min(before, reach)
                count += 1
        result[n] = total / count if count >= 3 else np.nan
