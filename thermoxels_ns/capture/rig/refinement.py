"""Refines a rig by windows of thermal images that follow the photographs."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from thermoxels_ns.capture.rig.fit import RigMaximizer
from thermoxels_ns.capture.rig.images import FARTHEST_FROM_POINT, SURE_DISTANCE, PreparedFrame, PreparedFrames
from thermoxels_ns.capture.rig.parameters import PARAMETERS, RigModel
from thermoxels_ns.capture.rig.windows import THERMAL_BLUR_PX, SmoothThermal, WindowDesign, WindowScore, window_design
from thermoxels_ns.capture.rig_types import FloatArray

_PITCH = 1.3  # pixels of the reduced photograph per thermal pixel
_WINDOW_PX = 1.0
_LENS_BLURS_PX = (0.0, 0.5, 0.8, 1.2, 1.6)
"""Blurs of the thermal camera that are tried, beside the pixel itself [thermal pixels]."""
_BLUR_FRAMES, _BLUR_WINDOWS = 8, 1000
"""From how many frames and windows of each the blur is chosen, and whether windows agree at all is seen."""
_MOST_WINDOWS = 3000
_AGREEMENT = 0.9  # R2 from which on a window counts
_REACHES_PX = (0.5, 0.25, 0.0, 0.0)
"""How far around its place a window may agree to count, in every round [thermal pixels]."""
_FEWEST_WINDOWS = 150
_ABOVE_CHANCE = 3.0
_ELSEWHERE_PX = 5.0
_MOST_SHIFT_PX = 2.0
_CORRELATED_FRAMES = 6
"""Frames that count as one. In five drawn captures of 36 frames the turn was wrong by 0.09 degrees (median) with 6, by
0.22 where all counted as one; where none did, no better in the four that were tried."""
_CENTRE = [PARAMETERS.index(name) for name in ("cx", "cy")]
_CENTRE_INFLATION = 4.0
"""By how much the windows' information on the principal point is divided. In drawn captures with known rigs its errors
were one to two times what the scatter of the windows says, up to six times in one; those of the rest were not."""


@dataclass(frozen=True, eq=False)
class RefinedRig:
    """The rig after the last step."""

    change: FloatArray  # the ten changes
    covariance: FloatArray  # of the ten changes, shape (10, 10)
    windows: int  # how many windows it rests on


def refine(prepared: PreparedFrames, rig: RigModel, change: FloatArray, sigmas: FloatArray) -> RefinedRig | None:
    """Move a rig that is right to about a pixel to where the windows agree best.

    The comparison of edges leaves a bias of some tenths of a pixel, because edges in a photograph and in a thermal
    image are not of the same strength. Windows that one gain explains almost wholly do not have that bias (`patches`);
    they are chosen anew after each maximisation.

    Frames show the same things, so their errors are correlated: up to six together count as one frame in the standard
    errors and against the prior. More frames look from other places, where the errors of the same windows differ, so
    that thirty tell more than six. What the windows say of the principal point counts less still
    (`inflate_centre_covariance`).

    None where too few windows agree, or hardly more than by chance.
    """
    view = _View.of(prepared, rig, change)
    count = len(prepared.frames)
    some = np.unique(np.linspace(0, count - 1, min(count, _BLUR_FRAMES)).astype(int))
    few = [prepared.frames[number] for number in some]
    smooth = [SmoothThermal(frame.contrast) for frame in few]
    trials = {
        blur_px: WindowScore([_design(frame, prepared, view, blur_px, _BLUR_WINDOWS) for frame in few], smooth, rig)
        for blur_px in _LENS_BLURS_PX
    }

    def explained(tried: float) -> float:
        """How well the windows that agree do so: the sum of -log(1 - R2)."""
        counted = [found[found > _AGREEMENT] for found in trials[tried].agreement(change)]
        return float(np.sum(-np.log1p(-np.concatenate([np.zeros(0), *counted]))))

    blur_px = max(trials, key=explained)
    if not _agrees(trials[blur_px], change, _FEWEST_WINDOWS * len(few) / count):
        return None
    thermal = [SmoothThermal(frame.contrast) for frame in prepared.frames]
    designs = [_design(frame, prepared, view, blur_px, _MOST_WINDOWS) for frame in prepared.frames]
    score = WindowScore(designs, thermal, rig)
    start, chosen, maximizer = change, score, RigMaximizer(score, sigmas, prepared.median_depth)
    for reach_px in _REACHES_PX:
        steps = (-reach_px, 0.0, reach_px) if reach_px > 0.0 else (0.0,)
        around = [score.agreement(change, (x, y)) for x in steps for y in steps]
        agree = (np.max(found, axis=0) > _AGREEMENT for found in zip(*around))
        chosen = WindowScore([design.chosen(mask) for design, mask in zip(designs, agree)], thermal, rig)
        if chosen.windows < _FEWEST_WINDOWS:
            return None
        maximizer = RigMaximizer(chosen, sigmas, prepared.median_depth, min(count, _CORRELATED_FRAMES))
        change = maximizer.maximize(change).change
    points = np.concatenate([design.points for design in score.designs])
    moved = np.linalg.norm(rig.project(change, points) - rig.project(start, points), axis=1)
    if not np.nanmedian(moved) < _MOST_SHIFT_PX:
        return None
    return RefinedRig(change, inflate_centre_covariance(maximizer.covariance(change), sigmas), chosen.windows)


def inflate_centre_covariance(covariance: FloatArray, sigmas: FloatArray) -> FloatArray:
    """State the principal point, and what stands for it, as less sure than the windows' scatter says.

    Turn and principal point differ in the image only by terms of second order, some tenths of a pixel in its corners,
    which errors that all windows share reach. With C_cc the covariance of the principal point and D that of the start,
    the information gained is C_cc^-1 - D^-1; a quarter of it counts. The other numbers follow by their regression on
    the principal point, so what they would be with it known stays as it is. Where the principal point is kept fixed
    (0 in `sigmas`), the covariance is unchanged.
    """
    if np.any(sigmas[_CENTRE] <= 0.0):
        return covariance
    before = np.diag(1.0 / sigmas[_CENTRE] ** 2)
    inner = covariance[np.ix_(_CENTRE, _CENTRE)]
    known = np.linalg.inv(inner)
    gained = _positive_part(known - before)
    added = _positive_part(np.linalg.inv(before + gained / _CENTRE_INFLATION) - inner)
    follow = covariance[:, _CENTRE] @ known
    return covariance + follow @ added @ follow.T


def _positive_part(symmetric: FloatArray) -> FloatArray:
    """A symmetric matrix with its negative eigenvalues set to 0."""
    values, vectors = np.linalg.eigh(0.5 * (symmetric + symmetric.T))
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T, dtype=np.float64)


def _agrees(score: WindowScore, change: FloatArray, fewest: float) -> bool:
    """Whether enough windows agree here, and clearly more than some pixels away."""

    def count(shift_px: tuple[float, float]) -> int:
        return sum(int(np.count_nonzero(found > _AGREEMENT)) for found in score.agreement(change, shift_px))

    far, here = _ELSEWHERE_PX, count((0.0, 0.0))
    elsewhere = np.mean([count(shift) for shift in ((far, far), (-far, far), (far, -far), (-far, -far))])
    return here >= fewest and here > _ABOVE_CHANCE * max(float(elsewhere), 1.0)


@dataclass(frozen=True, eq=False)
class _View:
    """The reduced photograph's pixels, the same for all photographs."""

    size: tuple[int, int]  # width and height
    pitch: float  # its pixels per thermal pixel
    rays: FloatArray  # points at depth 1 that the pixels see, shape (height * width, 3)
    inside: npt.NDArray[np.bool_]  # which of them the thermal camera sees too, shape (height, width)

    @classmethod
    def of(cls, prepared: PreparedFrames, rig: RigModel, change: FloatArray) -> _View:
        visible = prepared.visible
        same = rig.camera.fl_x / visible.fl_x
        scale = min(_PITCH * same, *(frame.grey.shape[1] / visible.width for frame in prepared.frames))
        size = max(round(visible.width * scale), 8), max(round(visible.height * scale), 8)
        rows, columns = np.mgrid[: size[1], : size[0]]
        rays = visible.resized(*size).rays(np.column_stack([columns.ravel() + 0.5, rows.ravel() + 0.5]))
        inside = rig.camera.contains(rig.project(change, rays * prepared.median_depth))
        return cls(size, scale / same, rays, inside.reshape(size[1], size[0]))


def _design(
    frame: PreparedFrame, prepared: PreparedFrames, view: _View, lens_blur_px: float, most: int
) -> WindowDesign:
    """Windows of a photograph, reduced and blurred to what the thermal camera sees of it."""
    pitch = view.pitch
    small = cv2.resize(frame.grey, view.size, interpolation=cv2.INTER_AREA)
    # The thermal pixel is a box of 1, the reduced photograph's one of 1 / pitch; a box of w has variance w^2 / 12.
    variance = THERMAL_BLUR_PX**2 + lens_blur_px**2 + (1.0 - 1.0 / pitch**2) / 12.0
    small = cv2.GaussianBlur(small, (0, 0), np.sqrt(max(variance, 0.01)) * pitch, borderType=cv2.BORDER_REPLICATE)
    window_px = float(np.hypot(_WINDOW_PX, lens_blur_px))
    design = window_design(small.astype(np.float32), view.rays, view.inside, pitch, window_px, most)
    return design.at_depth(*frame.depth.at(design.points), FARTHEST_FROM_POINT, SURE_DISTANCE)
