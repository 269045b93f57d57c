"""Compiled loops over points and photographs: which colours the photographs show at a point, and how they differ."""

from __future__ import annotations

import numpy as np

from thermoxels_ns.core.kernel_cache import kernel


@kernel
def _look(across, down, depth, width, height, first, near, colours, seen, place):
    """Write the colour at homogeneous pixels of a photograph to ``seen[place]``; False where it shows none."""
    if not depth > near:
        return False
    # Pixel centres lie at halves.
    u, v = across / depth - 0.5, down / depth - 0.5
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


@kernel
def _median(values, count):
    """Median of the first `count` values, float32.

    Ranks by comparing all with all: for some tens of values quicker than sorting, as nothing branches.
    """
    low, high = (count - 1) // 2, count // 2
    lower = upper = np.float32(0.0)
    has_lower = has_upper = False
    for i in range(count):
        value, below, up_to = values[i], np.int32(0), np.int32(0)
        for j in range(count):
            below += np.int32(values[j] < value)
            up_to += np.int32(values[j] <= value)
        if below <= low and low < up_to:
            lower, has_lower = value, True
        if below <= high and high < up_to:
            upper, has_upper = value, True
        if has_lower and has_upper:
            break
    return 0.5 * (lower + upper)


@kernel
def colours_at(begin: int, end: int, points, matrices, sizes, firsts, near, colours, result):
    """Fill ``result[point, photograph]`` for points `begin` to `end`; NaN where a photograph does not show a point."""
    for n in range(begin, end):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        for k in range(matrices.shape[0]):
            m, width, height = matrices[k], sizes[k, 0], sizes[k, 1]
            across = m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]
            down = m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]
            depth = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
            if not _look(across, down, depth, width, height, firsts[k], near, colours, result[n], k):
                result[n, k, :] = np.nan


@kernel
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
    along = np.empty((views, 3))  # homogeneous pixels of a column of corners, without what depends on z
    of = -1
    for n in range(begin, end):
        if n // shape[2] != of:
            of = n // shape[2]
            x = lo[0] + step * (of // shape[1])
            y = lo[1] + step * (of % shape[1])
            for k in range(views):
                for c in range(3):
                    along[k, c] = matrices[k, c, 0] * x + matrices[k, c, 1] * y
        z = lo[2] + step * (n % shape[2])
        count = 0
        for k in range(views):
            across = along[k, 0] + matrices[k, 0, 2] * z + matrices[k, 0, 3]
            down = along[k, 1] + matrices[k, 1, 2] * z + matrices[k, 1, 3]
            depth = along[k, 2] + matrices[k, 2, 2] * z + matrices[k, 2, 3]
            if _look(across, down, depth, sizes[k, 0], sizes[k, 1], firsts[k], near, colours, seen, count):
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
