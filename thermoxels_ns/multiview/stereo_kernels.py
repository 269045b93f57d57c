"""Compiled loops of stereo: normalised cross-correlation, differences of pixels, semi-global matching."""

from __future__ import annotations

import numpy as np

from thermoxels_ns.core.kernel_cache import kernel

OUTSIDE = -1.0  # Result where no correlation can be computed


@kernel
def _difference(features, row, column, i, j):
    """Return the sum of the absolute differences of `features` (h, w, f) at pixels (row, column) and (i, j)."""
    off = 0.0
    for n in range(features.shape[2]):
        off += abs(features[i, j, n] - features[row, column, n])
    return off


@kernel
def weigh_patches(features, channels, radius, likeness, least_weight, noise, weights, means, variances):
    """Write adaptive support weights and the weighted mean and variance of the patch around each pixel.

    Args:
        features: Values by which pixels are compared, (h, w, f).
        channels: Brightness and perhaps temperature, (c, h, w); below 0 where masked.
        radius: A patch is 2 `radius` + 1 pixels wide.
        likeness: Least scale s of differences. An outline in a patch leaves s small; a texture makes s large.
        least_weight: A smaller weight is set to 0.
        noise: Variance of the noise of each channel, (c,).
        weights: Receives exp(-(d / s)^2), normalised to sum 1 in each patch, (patch, h, w) (Yoon and Kweon 2006,
            without distance). d is the difference of a pixel's features from the middle pixel's, s the fifth smallest d
            of the eight pixels around the middle.
        means: Receives the weighted mean of each channel in the patch around each pixel, (c, h, w).
        variances: Receives the weighted variance, (c, h, w). 0 marks a pixel that cannot be correlated: its patch
            leaves the photograph, has a masked pixel, or has a variance below `noise`.
    """
    count, height, width = channels.shape
    side = 2 * radius + 1
    around, own = np.empty(9), np.empty(side * side)
    weights[:] = 0.0
    means[:] = 0.0
    variances[:] = 0.0
    for row in range(radius, height - radius):
        for column in range(radius, width - radius):
            for k in range(9):
                around[k] = _difference(features, row, column, row + k // 3 - 1, column + k % 3 - 1)
            scale = max(likeness, np.sort(around)[5])  # number 0 is the pixel itself
            for k in range(len(own)):
                i, j = row - radius + k // side, column - radius + k % side
                weight = np.exp(-((_difference(features, row, column, i, j) / scale) ** 2))
                own[k] = weight if weight >= least_weight else 0.0
            weights[:, row, column] = own / own.sum()
            for channel in range(count):
                mean, square, hidden, k = 0.0, 0.0, False, 0
                for i in range(row - radius, row + radius + 1):
                    for j in range(column - radius, column + radius + 1):
                        hidden |= channels[channel, i, j] < 0.0
                        mean += weights[k, row, column] * channels[channel, i, j]
                        k += 1
                if hidden:
                    continue
                k = 0
                for i in range(row - radius, row + radius + 1):
                    for j in range(column - radius, column + radius + 1):
                        square += weights[k, row, column] * (channels[channel, i, j] - mean) ** 2
                        k += 1
                means[channel, row, column] = mean
                if square >= noise[channel]:
                    variances[channel, row, column] = square


@kernel(fastmath={"contract"})
def correlate(channels, others, radius, weights, means, variances, noise, fewest, plane, result):
    """Write the mean correlation of each pixel with the better half of `others` to ``result[row, column, plane]``.

    `others` (photographs, c, h, w) are photographs drawn onto the pixels of `channels` (c, h, w); `result` is (h, w,
    planes). `radius`, `weights`, `means`, `variances` and `noise` are those of `weigh_patches`. A correlation is
    normalised cross-correlation of weighted patches with `noise` added to both variances. Channels are averaged by
    their ratio of signal to noise. A channel is left out for a photograph whose patch is masked (below 0) at a corner
    or in the middle. The better half is that of the photographs that have a channel left. It has at least `fewest`
    photographs, but at most half of all; those that it lacks count as `OUTSIDE`.
    """
    kinds, height, width = channels.shape
    inner = width - 2 * radius
    scores, known = np.empty((len(others), inner), np.float32), np.empty((len(others), inner), np.bool_)
    first, second, both = np.empty(inner, np.float32), np.empty(inner, np.float32), np.empty(inner, np.float32)
    most = (len(others) + 1) // 2
    signal, best = np.empty(inner, np.float32), np.empty(most, np.float32)
    result[:radius, :, plane] = OUTSIDE
    result[height - radius :, :, plane] = OUTSIDE
    result[:, :radius, plane] = OUTSIDE
    result[:, width - radius :, plane] = OUTSIDE
    for row in range(radius, height - radius):
        scores[:] = 0.0
        known[:] = False
        signal[:] = 0.0
        for channel in range(kinds):
            own, mean = variances[channel, row, radius:], means[channel, row, radius:]
            for x in range(inner):
                signal[x] += own[x] / noise[channel]
        for channel in range(kinds):
            own, mean = variances[channel, row, radius:], means[channel, row, radius:]
            if own[:inner].max() == 0.0:
                continue
            for number in range(len(others)):
                other = others[number, channel]
                first[:] = 0.0
                second[:] = 0.0
                both[:] = 0.0
                k = 0
                for i in range(row - radius, row + radius + 1):
                    for j in range(2 * radius + 1):
                        weight, line, here = weights[k, row, radius:], other[i, j:], channels[channel, i, j:]
                        for x in range(inner):
                            value = line[x] - mean[x]
                            share = weight[x] * value
                            first[x] += share
                            second[x] += share * value
                            both[x] += share * (here[x] - mean[x])
                        k += 1
                above, middle, below = other[row - radius], other[row], other[row + radius]
                for x in range(inner):
                    least = min(above[x], above[x + 2 * radius], below[x], below[x + 2 * radius], middle[x + radius])
                    if own[x] > 0.0 and least >= 0.0:
                        spread = max(second[x] - first[x] * first[x], np.float32(0.0)) + noise[channel]
                        share = own[x] / noise[channel] / signal[x]
                        scores[number, x] += share * both[x] / np.sqrt((own[x] + noise[channel]) * spread)
                        known[number, x] = True
        for x in range(inner):
            best[:] = OUTSIDE
            told = 0
            for number in range(len(others)):
                score = scores[number, x]
                told += known[number, x]
                for place in range(most if known[number, x] else 0):
                    if score > best[place]:
                        best[place], score = score, best[place]
            used = min(most, max(fewest, (told + 1) // 2))
            result[row, x + radius, plane] = best[:used].sum() / used


@kernel(fastmath={"contract"})
def add_differences(others, expected, limit, weight, fewest, plane, cost):
    """Add to ``cost[row, column, plane]`` `weight` times the mean difference of the better half of `others`.

    The difference of a photograph is the mean over channels of |others - expected| / limit, each at most 1. `others`
    and `expected` are (photographs, c, h, w), and `limit` is (photographs, c, 1, 1). A channel is left out if its limit
    is infinite, if `expected` is masked (below -1), or if the other photograph has no temperature (below 0). A
    photograph that shows no brightness (below 0), or has no channel left, has the difference 1. For the better
    half see `correlate`.
    """
    total, kinds, height, width = others.shape
    most = (total + 1) // 2
    best = np.empty(most, np.float32)
    for row in range(height):
        for column in range(width):
            best[:] = 1.0
            seen = 0
            for number in range(total):
                off, told = np.float32(0.0), 0
                for channel in range(kinds if others[number, 0, row, column] >= 0.0 else 0):
                    here, own = others[number, channel, row, column], expected[number, channel, row, column]
                    largest = limit[number, channel, 0, 0]
                    if here >= 0.0 and own > -1.0 and largest < np.inf:
                        off += min(abs(here - own) / largest, np.float32(1.0))
                        told += 1
                seen += told > 0
                off = off / told if told else np.float32(1.0)
                for place in range(most):
                    if off < best[place]:
                        best[place], off = off, best[place]
            used = min(most, max(fewest, (seen + 1) // 2))
            cost[row, column, plane] += weight * best[:used].sum() / used


@kernel(fastmath={"contract"})
def aggregate(cost, features, small, large, edge, total):
    """Write the mean over eight directions of the least path costs to `total` (semi-global matching).

    This is eq. 13 of Hirschmueller 2008. Between two pixels of a path, a change of one plane costs `small`. A larger
    change costs `large` / (1 + d / `edge`), but at least `small`, with d the difference of the two pixels' `features`
    (h, w, f). `cost` (h, w, planes) is the cost of each pixel and plane alone; `total` has the same shape.
    """
    rows, columns, planes = cost.shape
    total[:] = 0.0
    path = np.empty((2, columns, planes), np.float32)
    for dy, dx in ((0, 1), (0, -1), (1, 0), (1, 1), (1, -1), (-1, 0), (-1, 1), (-1, -1)):
        for r in range(rows):
            y = r if dy >= 0 else rows - 1 - r
            for c in range(columns):
                x = c if dx >= 0 else columns - 1 - c
                py, px = y - dy, x - dx
                here = path[r % 2, x]
                if py < 0 or py >= rows or px < 0 or px >= columns:
                    here[:] = cost[y, x]
                else:
                    before = path[r % 2, px] if dy == 0 else path[(r + 1) % 2, px]
                    least = before[0]
                    for k in range(1, planes):
                        least = min(least, before[k])
                    jump = least + max(small, large / (1 + np.float32(_difference(features, y, x, py, px)) / edge))
                    here[0] = cost[y, x, 0] + min(before[0], before[1] + small, jump) - least
                    for k in range(1, planes - 1):
                        step = min(before[k - 1], before[k + 1]) + small
                        here[k] = cost[y, x, k] + min(before[k], step, jump) - least
                    last = planes - 1
                    here[last] = cost[y, x, last] + min(before[last], before[last - 1] + small, jump) - least
                for k in range(planes):
                    total[y, x, k] += here[k]
    total /= np.float32(8)
