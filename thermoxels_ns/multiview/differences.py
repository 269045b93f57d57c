"""Differences between photographs of the same surface: gain of each colour channel, offset of the temperature."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from thermoxels_ns.core.arrays import Float32Array, FloatArray, IntArray
from thermoxels_ns.multiview.photographs import Photographs
from thermoxels_ns.multiview.stereo import TOLERANCE, Depths

MOST_PIXELS = 1500  # Pixels of each photograph, or up to twice as many, that are looked up in the others
DARKEST, BRIGHTEST = 0.06, 0.94  # Channel values between these are used for gains: below is noise, above saturation
FEWEST_PAIRS = 30  # Pixels that two photographs must share to be compared
SYSTEMATIC = 0.02
"""Standard deviation, of 1, of the systematic error of a channel's median ratio between two photographs, which noise
does not explain: gloss, shadows, wrong depths."""
SYSTEMATIC_THERMAL = 0.003  # The same for the median difference of normalised temperatures
SURE = 3.0  # Values larger than so many standard errors are not due to chance
KNOWN = 1.0  # A value with this standard error or a larger one is unknown
FREE = 10.0  # Standard error given to an unknown value
_ROUNDS, _HUBER = 5, 2.0  # Rounds of robust least squares; a pair off by more standard errors than this counts less


def without_gains(photographs: Photographs, log_gain: FloatArray) -> Photographs:
    """Return photographs with colours divided by exp(`log_gain`), (photographs, 3); `measured` are the old colours."""
    gain = np.exp(log_gain).astype(np.float32)[photographs.numbers]
    return replace(photographs, colours=photographs.colours / gain, measured=photographs.colours)


def matters(value: FloatArray, error: FloatArray, least: float) -> bool:
    """Return whether the root mean square of `value` is above `least` and above `SURE` times that of `error`. `error`
    are the standard errors of `value`, of the same shape; values with an error of `KNOWN` or more do not count."""
    known = error < KNOWN
    if not known.any():
        return False
    size, doubt = (float(np.sqrt(np.mean(each[known] ** 2))) for each in (value, error))
    return size > max(least, SURE * doubt)


def photograph_differences(depths: Depths, thermal: Float32Array) -> tuple[FloatArray, FloatArray]:
    """Return gains and temperature offsets of the photographs, and their standard errors, both (photographs, 4).

    Columns 0 to 2 are the natural logarithms of the gains of red, green and blue; column 3 is the offset of normalised
    temperature. Two photographs a and b are compared at points at which both have the same depth. The median of
    ln(a / b) is the difference of their log gains; the median difference of `thermal` is the difference of their
    offsets. `thermal` (pixels,) is the normalised temperature, NaN if unknown. Robust, weighted least squares over all
    pairs give the values of each column, relative to their mean. Only the largest group of photographs that pairs link
    is solved. All other photographs have values of 0 and errors of `FREE`.
    """
    photographs = depths.photographs
    count = len(photographs)
    values = np.column_stack((photographs.colours, thermal)).astype(np.float64)
    usable = (values > DARKEST) & (values < BRIGHTEST)
    usable[:, 3] = np.isfinite(values[:, 3])
    with np.errstate(divide="ignore", invalid="ignore"):
        values[:, :3] = np.log(values[:, :3])
    values[~usable] = np.nan
    systematic = np.array([SYSTEMATIC] * 3 + [SYSTEMATIC_THERMAL])
    rows: list[tuple[int, int]] = []
    seen, weight = [], []
    number = photographs.numbers
    (sure,) = np.nonzero(np.isfinite(depths.depth))
    for a in range(count):
        own = sure[number[sure] == a]
        own = own[:: max(1, len(own) // MOST_PIXELS)]
        if not len(own):
            continue
        origins, along = photographs.of_pixels(own)
        points = origins + depths.depth[own, None] * along
        for b in range(count):
            if a == b:
                continue
            pixel, far, inside = photographs.shown(b, points)
            with np.errstate(invalid="ignore"):
                same = np.abs(depths.depth[pixel] - far) <= TOLERANCE * (depths.error[pixel] + depths.error[own])
            met = inside & same
            if met.sum() < FEWEST_PAIRS:
                continue
            off = values[own[met]] - values[pixel[met]]
            told = np.isfinite(off).sum(0)
            off[:, told < FEWEST_PAIRS] = 0.0
            middle = np.nanmedian(off, axis=0)
            spread = 1.48 * np.nanmedian(np.abs(off - middle), axis=0)  # standard deviation of a normal distribution
            # A median's variance is pi / 2 times that of a mean.
            variance = 0.5 * np.pi * spread**2 / np.maximum(told, 1) + systematic**2
            rows.append((a, b))
            seen.append(middle)
            weight.append(np.where(told >= FEWEST_PAIRS, 1.0 / variance, 0.0))
    solved, error = np.zeros((count, 4)), np.full((count, 4), FREE)
    if rows:
        pairs, off, weights = np.array(rows), np.array(seen), np.array(weight)
        for channel in range(4):
            solved[:, channel], error[:, channel] = _solve(pairs, off[:, channel], weights[:, channel], count)
    return solved, error


def _solve(pairs: IntArray, off: FloatArray, weights: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Return values x of `count` photographs from differences `off` (p,) = x_a - x_b of pairs (a, b), and errors.

    This is iteratively reweighted least squares (Huber) with `weights` (p,), the inverse variances of `off`. Only the
    largest group of photographs that `pairs` (p, 2) of weight above 0 link is solved; its mean is 0. All others have
    the value 0 and the standard error `FREE`. Both results are (count,).
    """
    from scipy.sparse import coo_matrix  # slow to import and only needed here
    from scipy.sparse.csgraph import connected_components

    values, errors, told = np.zeros(count), np.full(count, FREE), weights > 0.0
    pairs, off, weights = pairs[told], off[told], weights[told]
    if not len(pairs):
        return values, errors
    links = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    group = np.asarray(connected_components(links, directed=False)[1])
    linked = group == np.bincount(group).argmax()
    inside = linked[pairs[:, 0]]
    pairs, off, weights = (np.cumsum(linked) - 1)[pairs[inside]], off[inside], weights[inside]
    number, use, left = int(linked.sum()), weights, off
    matrix = np.zeros((number, number))
    for _ in range(_ROUNDS):
        matrix = np.full((number, number), weights.mean())  # sets the mean to 0 and changes nothing else
        for sign, first, second in ((1, 0, 0), (1, 1, 1), (-1, 0, 1), (-1, 1, 0)):
            np.add.at(matrix, (pairs[:, first], pairs[:, second]), sign * use)
        right = np.bincount(pairs[:, 0], use * off, number) - np.bincount(pairs[:, 1], use * off, number)
        solved = np.linalg.solve(matrix, right)
        values[linked] = solved - solved.mean()
        left = (off - solved[pairs[:, 0]] + solved[pairs[:, 1]]) * np.sqrt(weights)
        use = weights * np.minimum(1.0, _HUBER / np.maximum(np.abs(left), 1e-12))
    centred = np.eye(number) - 1.0 / number
    variance = np.diag(centred @ np.linalg.inv(matrix) @ centred)
    scale = max(1.0, float(np.sqrt(np.mean(np.minimum(np.abs(left), _HUBER) ** 2)))) * np.sqrt(2.0)
    errors[linked] = scale * np.sqrt(np.maximum(variance, 0.0))  # each pair is seen twice, hence the 2
    return values, errors
