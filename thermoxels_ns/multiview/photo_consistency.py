"""Where the photographs agree: a start for the density from colours alone, before any training step.

At a surface every photograph that sees a point shows the same colour; before and behind it they show different things
(voxel colouring, Seitz and Dyer 1999). A training that starts from fog everywhere has to find that out by itself, and
where a wall is seen at a grazing angle it ends in front of it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt
from scipy import ndimage

from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.threads import run_ranges
from thermoxels_ns.multiview.photo_kernels import colours_at, deviations_at_corners

FINEST = 128
"""Voxels along the longest side of the lattice on which colours are compared."""
FEWEST_VIEWS = 3
"""Photographs that must show a point: the colours of two always have a middle."""
LEAST_PARALLAX_DEG = 2.5
"""Angle between the view directions of a point and their mean below which colours say nothing about distance."""
LEAST_SEEN = 0.01
"""Share of the box that `FEWEST_VIEWS` photographs must show."""
SMALLEST_DEVIATION = 2e-3
"""Deviation, sum of three channels in [0, 1], below which photographs agree entirely (noise of 8 bits)."""
NEIGHBOURHOOD = 9
"""Points along each axis over which a deviation is compared with the mean of its neighbours'."""
SHARPNESS = 5.0
"""Factor from the logarithm of a contrast to that of a density."""
CONTRAST = 0.7
"""Logarithm of (mean around / deviation) at which the start density stays what it is."""
LEAST_GAIN, MOST_GAIN = -4.0, 6.0
"""Limits of the logarithm by which the start density changes."""
_SAMPLES = 12_000
_BEST_SHARES = (0.1, 0.1, 0.1, 0.1, 0.03, 0.03, 0.03)
"""Share of the points taken for surfaces, estimate after estimate."""
_FEWEST_POINTS = 25
"""Points that a photograph must show for its exposure to be estimated anew."""
_SURFACE_SHARE = 0.01
"""Share of the points at which agreement is measured."""
_CLEARLY_BETTER = 0.5
"""Share of the deviation that may remain for exposures to be believed."""
_USABLE = (0.02, 0.98)
"""Channel values between which brightness follows exposure."""
_TEXTURED_SHARE = 0.3
"""Share of the pixels, those with most texture, on which exposures are estimated: plain surroundings whose brightness
changes with the direction agree at every point once each photograph has the exposure that explains them."""
_LEAST_TEXTURE = 0.01
"""Standard deviation of the logarithm of brightness below which there is none, however little others have."""
_TEXTURE_PIXELS = 5
"""Side of the square of pixels whose brightness varies where there is texture."""


@dataclass(frozen=True, eq=False)
class Photographs:
    """Pinhole photographs in one array, for the kernels."""

    matrices: npt.NDArray[np.float64]
    """World to homogeneous pixels, depth positive in front, shape (photographs, 3, 4)."""
    centres: npt.NDArray[np.float64]
    """Camera centres, [world units], shape (photographs, 3)."""
    sizes: npt.NDArray[np.int64]
    """Width and height, [pixels], shape (photographs, 2)."""
    firsts: npt.NDArray[np.int64]
    """Row of `colours` with each photograph's upper left pixel, shape (photographs,)."""
    colours: npt.NDArray[np.float32]
    """Channels in [0, 1], photograph after photograph, row after row, shape (pixels, 3); NaN where masked."""
    near: float = 0.0
    """Depth up to which a photograph shows nothing, [world units]."""

    def __len__(self) -> int:
        return len(self.matrices)

    def views(self) -> tuple[npt.NDArray, npt.NDArray, npt.NDArray, float, npt.NDArray]:
        """What the kernels take."""
        return self.matrices, self.sizes, self.firsts, self.near, self.colours


@dataclass(frozen=True, eq=False)
class DensityStart:
    """What the photographs say about the density at the start."""

    log_gain: npt.NDArray[np.float32] | None
    """Logarithm of the factor on the start density at the corners, shape `lattice.shape`. None: they say nothing."""
    report: str
    """One line: what was found, or why nothing was."""


def density_from_photographs(lattice: Lattice, photographs: Photographs) -> DensityStart:
    """Find where photographs agree more than around.

    With d the median absolute deviation of the colours that photographs show at a point, and m the geometric mean of d
    around it, the logarithm of the gain is ``clip(5 (ln(m / d) - 0.7), -4, 6)``; the largest in reach of a corner
    counts. Each photograph's exposure (one factor) is removed first. A corner that fewer than three
    photographs show keeps the start density.

    Args:
        lattice: The lattice of the start. Finer than `FINEST` / 2, the result is interpolated.
        photographs: A selection of the training photographs.
    """
    points = _sample(lattice)
    seen = _colours(points, photographs)
    known = np.isfinite(seen[..., 0])
    enough = known.sum(1) >= FEWEST_VIEWS
    if len(photographs) < FEWEST_VIEWS:
        return DensityStart(None, f"{len(photographs)} photographs, {FEWEST_VIEWS} are needed")
    if np.mean(enough) < LEAST_SEEN:
        return DensityStart(None, f"{FEWEST_VIEWS} photographs together show {np.mean(enough):.1%} of the box")
    angle = _parallax_deg(points[enough], known[enough], photographs.centres)
    if angle < LEAST_PARALLAX_DEG:
        return DensityStart(None, f"the photographs look from one place ({angle:.1f} degrees apart)")
    exposure = exposures(seen[enough], _colours(points[enough], _textured(photographs)))
    gain = _log_gain(lattice, _without_exposure(photographs, exposure))
    if not np.any(gain > 0):
        return DensityStart(None, "nowhere do photographs agree more than around")
    spread = float(np.exp(np.ptp(exposure))) - 1.0
    return DensityStart(
        gain,
        f"{len(photographs)} photographs agree at {np.mean(gain > 0):.1%} of the corners "
        f"({angle:.0f} degrees apart, exposures within {spread:.0%})",
    )


def exposures(
    seen: npt.NDArray[np.float32], textured: npt.NDArray[np.float32] | None = None
) -> npt.NDArray[np.float64]:
    """Estimate the logarithm of each photograph's exposure, its mean over photographs 0, shape (photographs,).

    Photographs are compared with the median of all at the points where they agree best, which are sought anew with each
    estimate. Zeros unless the photographs agree clearly better with it than without.

    Args:
        seen: Colours of points in photographs, NaN where one does not show a point, shape (points, photographs, 3).
        textured: The same, NaN also where a photograph shows no texture: what the estimate is made from. None: `seen`.
    """
    usable, found = _usable(seen), np.zeros(seen.shape[1])
    if not usable.any():
        return found
    found = _estimate(seen if textured is None else textured)
    rows = usable.any(1)
    before, after = (_agreement(seen[rows] * np.exp(-e)[:, None]) for e in (np.zeros_like(found), found))
    return found if after < _CLEARLY_BETTER * before else np.zeros_like(found)


def _usable(seen: npt.NDArray[np.float32]) -> npt.NDArray[np.bool_]:
    """Where brightness follows exposure in enough photographs, shape (points, photographs)."""
    usable = ((seen > _USABLE[0]) & (seen < _USABLE[1])).all(-1)
    return usable & (usable.sum(1) >= FEWEST_VIEWS)[:, None]


def _estimate(seen: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
    """The exposures with which photographs agree best; 0 for one that shows too few points."""
    usable, found = _usable(seen), np.zeros(seen.shape[1])
    rows = usable.any(1)
    if not rows.any():
        return found
    logs = np.log(np.where(usable[rows][..., None], seen[rows], np.nan)).astype(np.float64)
    brightness = logs.mean(-1)
    hue = logs - brightness[..., None]
    hue_apart = np.abs(hue - _median(hue, 1)[:, None]).sum(-1)  # no exposure changes it
    for share in _BEST_SHARES:
        middle = _median(brightness - found, 1)[:, None]
        apart = _median(3.0 * np.abs(brightness - found - middle) + hue_apart, 1)
        best = apart <= np.quantile(apart, share)
        differences = (brightness - found - middle)[best]
        enough = np.isfinite(differences).sum(0) >= _FEWEST_POINTS
        found += np.where(enough, np.nan_to_num(_median(differences, 0)), 0.0)
        found -= np.median(found)
    return found - found.mean()


def _agreement(seen: npt.NDArray[np.float64]) -> float:
    """Deviation of the colours at the points where photographs agree best."""
    apart = np.abs(seen - _median(seen, 1)[:, None]).sum(-1)
    return float(np.quantile(_median(apart, 1), _SURFACE_SHARE))


def _textured(photographs: Photographs) -> Photographs:
    """The same photographs, NaN but for the share of pixels with most texture."""
    variations = []
    for (width, height), first in zip(photographs.sizes, photographs.firsts):
        picture = photographs.colours[first : first + width * height].reshape(height, width, 3)
        brightness = np.log(np.maximum(picture, _USABLE[0])).mean(-1)
        hidden = np.isnan(brightness)
        brightness[hidden] = 0.0
        mean, square = (cv2.blur(v, (_TEXTURE_PIXELS, _TEXTURE_PIXELS)) for v in (brightness, brightness**2))
        # The edge of what a mask hides is no texture.
        whole = cv2.blur(hidden.astype(np.float32), (_TEXTURE_PIXELS, _TEXTURE_PIXELS)) == 0.0
        variations.append(np.where(whole, square - mean * mean, 0.0).reshape(-1))
    variation = np.concatenate(variations)
    plain = variation < max(np.quantile(variation, 1.0 - _TEXTURED_SHARE), _LEAST_TEXTURE**2)
    return replace(photographs, colours=np.where(plain[:, None], np.float32(np.nan), photographs.colours))


def _without_exposure(photographs: Photographs, exposure: npt.NDArray[np.float64]) -> Photographs:
    counts = np.prod(photographs.sizes, axis=1)
    factors = np.repeat(np.exp(-exposure).astype(np.float32), counts)[:, None]
    return replace(photographs, colours=photographs.colours * factors)


def _sample(lattice: Lattice) -> npt.NDArray[np.float64]:
    """Points spread at random over the box, always the same."""
    inside = np.random.default_rng(0).random((_SAMPLES, 3))
    return np.asarray(lattice.lo) + inside * (np.asarray(lattice.hi) - np.asarray(lattice.lo))


def _colours(points: npt.NDArray[np.float64], photographs: Photographs) -> npt.NDArray[np.float32]:
    """Colours of points, shape (points, photographs, 3)."""
    seen = np.full((len(points), len(photographs), 3), np.nan, dtype=np.float32)
    run_ranges(lambda a, b: colours_at(a, b, points, *photographs.views(), seen), len(points))
    return seen


def _parallax_deg(points: npt.NDArray, known: npt.NDArray[np.bool_], centres: npt.NDArray) -> float:
    """Median over points of the largest angle between a view direction and the mean one, [degrees]."""
    towards = centres[None] - points[:, None]
    towards /= np.maximum(np.linalg.norm(towards, axis=-1, keepdims=True), 1e-12)
    mean = (towards * known[..., None]).sum(1)
    mean /= np.maximum(np.linalg.norm(mean, axis=-1, keepdims=True), 1e-12)
    cosine = np.where(known, np.einsum("nvi,ni->nv", towards, mean), 1.0)
    return float(np.degrees(np.median(np.arccos(np.clip(cosine.min(1), -1.0, 1.0)))))


def deviations(lattice: Lattice, photographs: Photographs) -> npt.NDArray[np.float32]:
    """Median absolute deviation of the colours that photographs show at each corner; NaN where fewer than three do."""
    result = np.empty(lattice.num_corners, dtype=np.float32)
    lo, shape = np.asarray(lattice.lo), np.asarray(lattice.shape)

    def work(begin: int, end: int) -> None:
        views = photographs.views()
        deviations_at_corners(begin, end, lo, lattice.voxel_size, shape, *views, FEWEST_VIEWS, result)

    run_ranges(work, len(result), 4096)
    return result.reshape(lattice.shape)


def _log_gain(lattice: Lattice, photographs: Photographs) -> npt.NDArray[np.float32]:
    """Logarithm of the gain at the corners of a lattice."""
    longest = max(lattice.cell_shape)
    if longest > FINEST // 2:
        coarse = Lattice.covering(lattice.lo, lattice.hi, FINEST // 2)
        at = np.moveaxis(coarse.world_to_index(lattice.corner_positions()), -1, 0)
        interpolated = ndimage.map_coordinates(_log_gain(coarse, photographs), at, order=1, mode="nearest")
        return np.asarray(interpolated, dtype=np.float32)
    factor = min(4, FINEST // longest)
    apart = deviations(lattice.refined(factor), photographs)
    known = np.isfinite(apart)
    logs = np.log(np.where(known, apart, 1.0) + SMALLEST_DEVIATION)
    total = ndimage.uniform_filter(np.where(known, logs, 0.0), NEIGHBOURHOOD, mode="nearest")
    share = ndimage.uniform_filter(known.astype(np.float32), NEIGHBOURHOOD, mode="nearest")
    contrast = np.where(known, total / np.maximum(share, 1e-6) - logs, -np.inf)
    largest = ndimage.maximum_filter(contrast, 2 * (factor // 2) + 1, mode="nearest")[::factor, ::factor, ::factor]
    gain = np.clip(SHARPNESS * (largest - CONTRAST), LEAST_GAIN, MOST_GAIN)
    return np.where(np.isfinite(largest), gain, 0.0).astype(np.float32)


def _median(values: npt.NDArray[np.float64], axis: int) -> npt.NDArray[np.float64]:
    """Median along an axis without NaN; NaN where there is nothing else."""
    ordered = np.sort(values, axis=axis)  # NaN goes to the end
    count = np.isfinite(values).sum(axis=axis, keepdims=True)
    low = np.take_along_axis(ordered, np.maximum(count - 1, 0) // 2, axis)
    return 0.5 * (low + np.take_along_axis(ordered, np.minimum(count // 2, values.shape[axis] - 1), axis)).squeeze(axis)
