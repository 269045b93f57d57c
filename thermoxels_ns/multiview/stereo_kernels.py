"""Compiled loops of stereo: correlation of patches, differences of pixels, costs along paths, refined depths."""

from __future__ import annotations

import numpy as np

from thermoxels_ns.core.kernel_cache import kernel

OUTSIDE = -1.0  # Result where no correlation can be computed


@kernel
def _difference(features, row, column, i, j):
    """Return the sum of the absolute differences of the features of two pixels."""
    off = 0.0
    for n in range(features.shape[2]):
        off += abs(features[i, j, n] - features[row, column, n])
    return off


@kernel
def _weigh(features, row, column, radius, likeness, least_weight, around, weights):
    """Fill `weights` with those of the patch around one pixel, as in `weigh_patches`, not yet divided by their sum.

    `around` is scratch space for nine numbers.
    """
    k = 0
    for i in range(row - 1, row + 2):
        for j in range(column - 1, column + 2):
            around[k] = _difference(features, row, column, i, j)
            k += 1
    scale = max(likeness, np.sort(around)[5])  # number 0 is the pixel itself
    k = 0
    for i in range(row - radius, row + radius + 1):
        for j in range(column - radius, column + radius + 1):
            weight = np.exp(-((_difference(features, row, column, i, j) / scale) ** 2))
            weights[k] = weight if weight >= least_weight else 0.0
            k += 1


@kernel
def weigh_patches(features, channels, radius, likeness, least_weight, noise, weights, means, variances):
    """Fill `weights`, `means` and `variances` of the patch around each pixel; similar pixels have large weights.

    A patch reaches `radius` pixels from its middle. The weight of a pixel in it is exp(-(d / s)^2), or 0 below
    `least_weight` (adaptive support weights, Yoon and Kweon 2006, without distance). d is the difference between the
    `features` (h, w, f) of the pixel and of the middle; s is the fifth smallest d of the eight pixels around the middle
    but at least `likeness`. An outline leaves s small, a texture does not. `weights`, (patch, h, w), sum to
    1 in a patch. The variance of one of the `channels` (c, h, w) is 0 where the patch leaves the photograph, holds a
    masked pixel (below 0), or has a variance below `noise` (c,). Means and variances are (c, h, w).
    """
    count, height, width = channels.shape
    around, own = np.empty(9), np.empty((2 * radius + 1) ** 2)
    weights[:] = 0.0
    means[:] = 0.0
    variances[:] = 0.0
    for row in range(radius, height - radius):
        for column in range(radius, width - radius):
            _weigh(features, row, column, radius, likeness, least_weight, around, own)
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
def correlate(channels, others, radius, weights, means, variances, noise, count, plane, result):
    """Fill ``result[row, column, plane]`` with a pixel's mean correlation with the best `count` of `others`.

    `others`, (photographs, c, h, w), are photographs drawn onto the pixels of `channels` (c, h, w). A correlation is
    weighted, normalised cross-correlation with `noise` (c,) added to both variances; channels are averaged by their
    ratio of signal to noise. A channel is left out for a photograph whose patch is masked (below 0) at a corner or in
    the middle. Where no channel is left, or none has a variance, the photograph counts as `OUTSIDE`.
    """
    kinds, height, width = channels.shape
    inner = width - 2 * radius
    scores, known = np.empty((len(others), inner), np.float32), np.empty((len(others), inner), np.bool_)
    first, second, both = np.empty(inner, np.float32), np.empty(inner, np.float32), np.empty(inner, np.float32)
    signal, best = np.empty(inner, np.float32), np.empty(count, np.float32)
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
            for number in range(len(others)):
                score = scores[number, x]
                for place in range(count if known[number, x] else 0):
                    if score > best[place]:
                        best[place], score = score, best[place]
            result[row, x + radius, plane] = best.sum() / count


@kernel(fastmath={"contract"})
def add_differences(others, expected, limit, weight, count, plane, cost):
    """Add to ``cost[row, column, plane]`` how far the best `count` of `others` are from what is expected of them.

    The difference of a pixel of `others` (photographs, c, h, w) from `expected`, of the same shape, is relative to
    `limit` (photographs, c, 1, 1), at most 1, and averaged over channels and photographs. It is multiplied by `weight`.
    A channel is left out where its limit is infinite, where `expected` is masked (below -1), or where the other
    photograph has no temperature (below 0). One that shows no brightness, or has no channel left, differs by 1.
    """
    total, kinds, height, width = others.shape
    best = np.empty(count, np.float32)
    for row in range(height):
        for column in range(width):
            best[:] = 1.0
            for number in range(total):
                off, told = np.float32(0.0), 0
                for channel in range(kinds if others[number, 0, row, column] >= 0.0 else 0):
                    here, own = others[number, channel, row, column], expected[number, channel, row, column]
                    most = limit[number, channel, 0, 0]
                    if here >= 0.0 and own > -1.0 and most < np.inf:
                        off += min(abs(here - own) / most, np.float32(1.0))
                        told += 1
                off = off / told if told else np.float32(1.0)
                for place in range(count):
                    if off < best[place]:
                        best[place], off = off, best[place]
            cost[row, column, plane] += weight * best.sum() / count


@kernel(fastmath={"contract"})
def aggregate(cost, features, small, large, edge, total):
    """Fill `total` with the mean of the least costs of paths from eight directions (Hirschmueller 2008, eq. 13).

    Between two pixels of a path, a change of one plane costs `small`. A larger change costs `large` / (1 + d / `edge`),
    at least `small`; d is the difference of the pixels' `features` (h, w, f). `cost` and `total`: (h, w, planes).
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


@kernel(fastmath={"contract"})
def refine_depths(
    width, depth, error, ratio, features, picture, others, turns, shifts, options, noise, refined, spacing
):
    """Move the depths of a small photograph to where larger versions of the photographs correlate best.

    For each pixel of the small photograph, a patch around its middle is taken from the larger photograph, weighted as
    in `weigh_patches`, and laid on the plane through the depths around the pixel. The patch is tried at inverse depths
    before and behind, at steps that move it by at most half a pixel in `others`. The new depth is at the top of the
    parabola through the best three correlations. A depth stays where the patch has no texture, the best correlation is
    too low, or the best is the first or last step.

    Args:
        width: Columns of the small photograph.
        depth: Depth of the pixels of the small photograph, (pixels,), [world units]; NaN: not known.
        error: Distance between the planes of the sweep at these depths, (pixels,), [world units].
        ratio: Columns of the larger photograph per column of the small one.
        features: Features of the larger photograph, (h, w, f).
        picture: Brightness of the larger photograph, (h, w).
        others: Brightness of the photographs to compare with, (photographs, h, w); below 0 where unknown.
        turns: Matrices from homogeneous pixels of `picture` to those of each of `others` at infinity, (n, 3, 3).
        shifts: Homogeneous pixels that are added per inverse depth, (n, 3).
        options: Radius, likeness, least weight, steps before and behind, and least correlation.
        noise: Variance of the noise of brightness.
        refined: Receives the new depths, (pixels,); unchanged where a depth stays.
        spacing: Receives the distance in depth that moves `others` by a pixel, (pixels,), where `refined` changes.
    """
    radius, likeness, least_weight, steps, least = options
    height, columns = picture.shape
    side, count, half = 2 * radius + 1, len(others), (len(others) + 1) // 2
    weights, own = np.empty(side * side), np.empty(side * side)
    around, scores, best = np.empty(9), np.empty(2 * steps + 1), np.empty(half)
    for n in range(len(depth)):
        if np.isnan(depth[n]):
            continue
        u, v = (n % width + 0.5) * ratio, (n // width + 0.5) * ratio
        column, row = int(u), int(v)
        if min(row, column) < radius or row >= height - radius or column >= columns - radius:
            continue
        inverse = 1.0 / depth[n]
        slope_u, slope_v = 0.0, 0.0
        for axis in range(2):
            step = 1 if axis == 0 else width
            if n >= step and n + step < len(depth):
                before, behind = depth[n - step], depth[n + step]
                if abs(before - depth[n]) <= 2.0 * error[n] and abs(behind - depth[n]) <= 2.0 * error[n]:
                    slope = 0.5 * (1.0 / behind - 1.0 / before) / ratio
                    slope_u, slope_v = (slope, slope_v) if axis == 0 else (slope_u, slope)
        _weigh(features, row, column, radius, likeness, least_weight, around, weights)
        total, mean, variance, k = 0.0, 0.0, 0.0, 0
        for i in range(row - radius, row + radius + 1):
            for j in range(column - radius, column + radius + 1):
                weights[k] *= picture[i, j] >= 0.0
                own[k] = picture[i, j]
                total += weights[k]
                mean += weights[k] * own[k]
                k += 1
        if total <= 0.0:
            continue
        mean /= total
        for k in range(side * side):
            weights[k] /= total
            own[k] -= mean
            variance += weights[k] * own[k] * own[k]
        if variance < 4.0 * noise:
            continue
        apart = 0.0  # most pixels that the patch moves in any picture per inverse depth; inverted below
        for o in range(count):
            t, s = turns[o], shifts[o]
            w = t[2, 0] * u + t[2, 1] * v + t[2, 2]
            x, y = t[0, 0] * u + t[0, 1] * v + t[0, 2], t[1, 0] * u + t[1, 1] * v + t[1, 2]
            far = w + inverse * s[2]
            if far > 0.0:
                moved = np.hypot(s[0] * w - s[2] * x, s[1] * w - s[2] * y) / (far * far)
                apart = max(apart, moved)
        if apart <= 0.0:
            continue
        apart = 1.0 / apart
        for number in range(2 * steps + 1):
            middle = inverse + 0.5 * (number - steps) * apart
            best[:] = OUTSIDE
            for o in range(count if middle > 0.0 else 0):
                t, s = turns[o], shifts[o]
                first, second, both, reached, k = 0.0, 0.0, 0.0, 0.0, 0
                for i in range(-radius, radius + 1):
                    for j in range(-radius, radius + 1):
                        weight = weights[k]
                        if weight > 0.0:
                            x, y = column + j + 0.5, row + i + 0.5
                            w = middle + slope_u * (x - u) + slope_v * (y - v)
                            far = t[2, 0] * x + t[2, 1] * y + t[2, 2] + w * s[2]
                            if far > 0.0:
                                a = (t[0, 0] * x + t[0, 1] * y + t[0, 2] + w * s[0]) / far - 0.5
                                b = (t[1, 0] * x + t[1, 1] * y + t[1, 2] + w * s[1]) / far - 0.5
                                if a >= 0.0 and b >= 0.0 and a < others.shape[2] - 1 and b < others.shape[1] - 1:
                                    left, top = int(a), int(b)
                                    a, b = a - left, b - top
                                    here = (1.0 - b) * (
                                        (1.0 - a) * others[o, top, left] + a * others[o, top, left + 1]
                                    ) + b * ((1.0 - a) * others[o, top + 1, left] + a * others[o, top + 1, left + 1])
                                    if here >= 0.0:
                                        here -= mean
                                        first += weight * here
                                        second += weight * here * here
                                        both += weight * here * own[k]
                                        reached += weight
                        k += 1
                if reached < 0.999:
                    continue
                score = both / np.sqrt((variance + noise) * (max(second - first * first, 0.0) + noise))
                for place in range(half):
                    if score > best[place]:
                        best[place], score = score, best[place]
            scores[number] = best.sum() / half
        top = scores.argmax()
        if scores[top] < least or top == 0 or top == 2 * steps:
            continue
        bend = scores[top - 1] - 2.0 * scores[top] + scores[top + 1]
        if not bend < 0.0:
            continue
        place = top - steps + 0.5 * (scores[top - 1] - scores[top + 1]) / bend
        found = 1.0 / (inverse + 0.5 * place * apart)
        refined[n], spacing[n] = found, found * found * apart
