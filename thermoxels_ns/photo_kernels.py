"""Compiled loops over points and photographs: which colours the photographs show at a point, and how they differ."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(nogil=True, cache=True, error_model="numpy")
def _look(matrix, size, first, near, colours, x, y, z, seen, place):
    """Write the colour that one photograph shows at a point to ``seen[place]``; False where it shows none."""
    depth = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z + matrix[2, 3]
    if not depth > near:
        return False
    # Pixel centres lie at halves.
    u = (matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z + matrix[0, 3]) / depth - 0.5
    v = (matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z + matrix[1, 3]) / depth - 0.5
    width, height = size[0], size[1]
    if not (u >= -0.5 and u <= width - 0.5 and v >= -0.5 and v <= height - 0.5):
        return False
    u, v = min(max(u, 0.0), width - 1.0), min(max(v, 0.0), height - 1.0)
    left, top = min(int(u), max(width - 2, 0)), min(int(v), max(height - 2, 0))
    right, bottom = min(left + 1, width - 1), min(top + 1, height - 1)
    a, b = u - left, v - top
    p, q = first + top * width, first + bottom * width
    for c in range(3):
        upper = (1.0 - a) * colours[p + left, c] + a * colours[p + right, c]
        lower = (1.0 - a) * colours[q + left, c] + a * colours[q + right, c]
        seen[place, c] = (1.0 - b) * upper + b * lower
    return not np.isnan(seen[place, 0])  # masked pixels are NaN


@njit(nogil=True, cache=True, error_model="numpy")
def _median(values, count):
    """Median of the first `count` values, which are sorted on the way."""
    for i in range(1, count):
        value, j = values[i], i - 1
        while j >= 0 and values[j] > value:
            values[j + 1] = values[j]
            j -= 1
        values[j + 1] = value
    return 0.5 * (values[(count - 1) // 2] + values[count // 2])


@njit(nogil=True, cache=True, error_model="numpy")
def colours_at(begin: int, end: int, points, matrices, sizes, firsts, near, colours, result):
    """Fill ``result[point, photograph]`` for points `begin` to `end`; NaN where a photograph does not show a point."""
    for n in range(begin, end):
        for k in range(matrices.shape[0]):
            x, y, z = points[n, 0], points[n, 1], points[n, 2]
            if not _look(matrices[k], sizes[k], firsts[k], near, colours, x, y, z, result[n], k):
                result[n, k, :] = np.nan


@njit(nogil=True, cache=True, error_model="numpy")
def deviations_at_corners(
    begin: int, end: int, lo, step, shape, matrices, sizes, firsts, near, colours, fewest, result
):
    """Fill ``result[corner]`` for corners `begin` to `end` (flat numbers of a lattice).

    The median over the photographs of the sum over channels of the distance to the median colour; NaN where fewer than
    `fewest` photographs show the corner.
    """
    views = matrices.shape[0]
    seen = np.empty((views, 3), dtype=np.float32)
    column = np.empty(views, dtype=np.float32)
    middle = np.empty(3, dtype=np.float32)
    for n in range(begin, end):
        x = lo[0] + step * (n // (shape[1] * shape[2]))
        y = lo[1] + step * (n // shape[2] % shape[1])
        z = lo[2] + step * (n % shape[2])
        count = 0
        for k in range(views):
            if _look(matrices[k], sizes[k], firsts[k], near, colours, x, y, z, seen, count):
                count += 1
        if count < fewest:
            result[n] = np.nan
            continue
        for c in range(3):
            for k in range(count):
                column[k] = seen[k, c]
            middle[c] = _median(column, count)
        for k in range(count):
            column[k] = abs(seen[k, 0] - middle[0]) + abs(seen[k, 1] - middle[1]) + abs(seen[k, 2] - middle[2])
        result[n] = _median(column, count)
