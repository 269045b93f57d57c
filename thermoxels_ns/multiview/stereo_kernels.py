"""Compiled loops over photographs that are compared with each other: patches, and where depths agree."""

from __future__ import annotations

import numpy as np

from thermoxels_ns.core.kernel_cache import kernel

OUTSIDE = -1.0  # Correlation that stands for none


@kernel
def _difference(colours, row, column, i, j):
    """Mean difference of the channels of two pixels."""
    off = 0.0
    for channel in range(3):
        off += abs(colours[i, j, channel] - colours[row, column, channel])
    return off / 3.0


@kernel
def weigh_patches(
    colours, brightness, radius, likeness, spread, least_weight, least_variance, weights, means, variances
):
    """Fill weights, mean and variance of the patch around each pixel: who has the pixel's colour belongs to it.

    A neighbour's weight is exp(-(d / s)^2) with d the mean difference of its three channels from the pixel's, and
    nothing below `least_weight` (adaptive support weights, Yoon and Kweon 2006, without distance). s is the fifth
    smallest d of the eight pixels around, which an outline leaves small and a texture does not, times `spread`, but at
    least `likeness`. The weights of a patch sum to 1. A pixel's variance is 0 where its patch reaches beyond the
    photograph, holds a masked pixel (brightness below 0), or varies by less than `least_variance` among what belongs to
    it.
    """
    height, width = brightness.shape
    around = np.empty(9, np.float64)
    for row in range(height):
        for column in range(width):
            variances[row, column] = 0.0
            if row < radius or column < radius or row >= height - radius or column >= width - radius:
                continue
            k = 0
            for i in range(row - 1, row + 2):
                for j in range(column - 1, column + 2):
                    around[k] = _difference(colours, row, column, i, j)
                    k += 1
            scale = max(likeness, spread * np.sort(around)[5])  # the first is the pixel itself
            total, mean, hidden, k = 0.0, 0.0, False, 0
            for i in range(row - radius, row + radius + 1):
                for j in range(column - radius, column + radius + 1):
                    hidden |= brightness[i, j] < 0.0
                    weight = np.exp(-((_difference(colours, row, column, i, j) / scale) ** 2))
                    if not weight >= least_weight:
                        weight = 0.0
                    weights[row, column, k] = weight
                    total += weight
                    mean += weight * brightness[i, j]
                    k += 1
            if hidden:
                continue
            mean /= total
            variance, k = 0.0, 0
            for i in range(row - radius, row + radius + 1):
                for j in range(column - radius, column + radius + 1):
                    weights[row, column, k] /= total
                    variance += weights[row, column, k] * (brightness[i, j] - mean) ** 2
                    k += 1
            means[row, column] = mean
            if variance >= least_variance:
                variances[row, column] = variance


@kernel(fastmath=True)
def correlate(brightness, others, radius, weights, means, variances, noise, count, result):
    """Fill ``result[row, column]`` with how well the patch of a pixel is met by others drawn onto the same pixels.

    Weighted, normalised cross-correlation; the mean of the best `count` of `others` (photographs, rows, columns), and
    `OUTSIDE` where the pixel has no variance. `noise` [brightness^2] is added to both variances. A photograph whose
    patch is masked (below 0) at a corner or in the middle counts as `OUTSIDE`.
    """
    height, width = brightness.shape
    best = np.empty(count, np.float32)
    for row in range(height):
        for column in range(width):
            result[row, column] = OUTSIDE
            if variances[row, column] == 0.0:
                continue
            best[:] = OUTSIDE
            middle, own = means[row, column], variances[row, column] + noise
            up, down, left, right = row - radius, row + radius, column - radius, column + radius
            for number in range(len(others)):
                other = others[number]
                if (
                    min(other[up, left], other[up, right], other[down, left], other[down, right]) < 0.0
                    or other[row, column] < 0.0
                ):
                    continue
                first, second, both = np.float32(0.0), np.float32(0.0), np.float32(0.0)
                k = 0
                for i in range(up, down + 1):
                    for j in range(left, right + 1):
                        weight = weights[row, column, k]
                        value = other[i, j] - middle
                        first += weight * value
                        second += weight * value * value
                        both += weight * value * (brightness[i, j] - middle)
                        k += 1
                score = both / np.sqrt(own * (max(second - first * first, np.float32(0.0)) + noise))
                for place in range(count):
                    if score > best[place]:
                        best[place], score = score, best[place]
            result[row, column] = best.sum() / count


@kernel
def other_views(
    begin: int,
    end: int,
    matrices,
    inverses,
    centres,
    sizes,
    firsts,
    depth,
    error,
    tolerance,
    confirmed,
    agreeing,
    behind,
):
    """Count the other photographs whose own depth lies where that of a pixel does, and those where it lies behind.

    Depths agree if they differ by no more than `tolerance` times the sum of both pixels' errors; a photograph looks
    through the point if its own depth is farther by more than twice that sum. Only `confirmed` depths count as
    looking through. Pixels `begin` to `end`; 0 where a depth is NaN.
    """
    number = len(firsts) - 1
    while number > 0 and firsts[number] > begin:
        number -= 1
    for n in range(begin, end):
        while number + 1 < len(firsts) and firsts[number + 1] <= n:
            number += 1
        agreeing[n], behind[n] = 0, 0
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
            seen = matrices[k]
            far = seen[2, 0] * x + seen[2, 1] * y + seen[2, 2] * z + seen[2, 3]
            if not far > 0.0:
                continue
            column = np.floor((seen[0, 0] * x + seen[0, 1] * y + seen[0, 2] * z + seen[0, 3]) / far)
            row = np.floor((seen[1, 0] * x + seen[1, 1] * y + seen[1, 2] * z + seen[1, 3]) / far)
            if not (column >= 0.0 and column < sizes[k, 0] and row >= 0.0 and row < sizes[k, 1]):
                continue
            at = firsts[k] + int(row) * sizes[k, 0] + int(column)
            farther, planes = depth[at] - far, error[at] + error[n]  # neither is true where they are NaN
            if abs(farther) <= tolerance * planes:
                agreeing[n] += 1
            elif confirmed[at] and farther > 2.0 * planes:
                behind[n] += 1
