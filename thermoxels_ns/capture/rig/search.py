"""Finds the rig (thermal lens and pose beside the visible camera) from images."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from thermoxels_ns.capture.rig.coarse_search import CoarseSearch
from thermoxels_ns.capture.rig.explanation import uncertainty_text
from thermoxels_ns.capture.rig.fit import RigFit, RigMaximizer
from thermoxels_ns.capture.rig.images import PreparedFrames, prepare_frames
from thermoxels_ns.capture.rig.parameters import PARAMETERS, RigModel, prior_sigmas
from thermoxels_ns.capture.rig.refinement import refine
from thermoxels_ns.capture.rig_types import FloatArray, RigEstimate, RigFrame, RigStart
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.core.errors import SceneError

_FEWEST_FRAMES, _FEWEST_POINTS = 3, 12
_MOST_FRAMES = 40
_COARSE_BLUR_PX, _FINE_BLUR_PX = 1.5, 1.0
_ABOVE_CHANCE = 1.5
_SEARCHED_SIZES = 2
_FARTHEST_SIGMAS = 5.0
_WORTH_TRYING = 0.8
_SMALLEST_ERROR_PX, _LARGEST_ERROR_SHARE = 1.5, 0.005
_PROBE_STEP = 1e-4


def estimate_rig(
    frames: Sequence[RigFrame],
    visible: Camera,
    start: RigStart,
    progress: Callable[[str, float], None] = lambda message, share: None,
) -> RigEstimate:
    """Find the thermal camera's intrinsics and the fixed transform from the visible to the thermal camera.

    The photographs' edges are carried into the thermal images through the scene points of structure from motion, and
    the rig is moved until they lie on the thermal edges, coarse to fine, over all frames together. Frames (in the order
    they were taken) with fewer than 12 points are left out; of more than 40 an even choice is used. Where the images
    cannot tell, the start is returned, `determined` False.

    Raises:
        SceneError: No frame has scene points, or an image cannot be read or does not have the size of its camera.
    """
    usable = [frame for frame in frames if np.count_nonzero(frame.points_visible()[:, 2] > 0.0) >= _FEWEST_POINTS]
    if not usable:
        expected = f"frames with a pose, a thermal partner and at least {_FEWEST_POINTS} scene points"
        got = f"{len(frames)} frames, none of them with that many"
        remedy = "Check that structure from motion registered the photographs and that poses are in OpenGL axes."
        raise SceneError("rig", expected=expected, got=got, remedy=remedy)
    chosen = [usable[i] for i in np.unique(np.linspace(0, len(usable) - 1, min(len(usable), _MOST_FRAMES)).astype(int))]
    progress("Reading the frames", 0.0)
    prepared = prepare_frames(chosen, visible, start.thermal_camera)
    return _RigSearch(prepared, start, progress).run()


@dataclass(frozen=True, eq=False)
class _RigSearch:
    prepared: PreparedFrames
    start: RigStart
    progress: Callable[[str, float], None]

    def run(self) -> RigEstimate:
        depth = self.prepared.median_depth
        sigmas = prior_sigmas(self.start, depth)
        rig = RigModel(self.start.thermal_camera, np.asarray(self.start.visible_to_thermal, dtype=np.float64))
        unchanged = np.zeros(len(PARAMETERS))
        sizes = self.prepared.sizes()
        coarse = self.prepared.score(rig, unchanged, sizes[0], _COARSE_BLUR_PX)
        before = coarse.value(unchanged)
        if len(self.prepared.frames) < _FEWEST_FRAMES:
            reason = f"{len(self.prepared.frames)} frames are too few to tell; at least {_FEWEST_FRAMES} are needed"
            return self._kept(rig, sigmas, before, reason)
        coarse_rigs: list[RigFit] = []
        chance, level = 0.0, 0
        for level, size in enumerate(sizes[:_SEARCHED_SIZES]):  # small things show in the second size only
            self.progress(f"Comparing edges, all directions, {size[0]} x {size[1]} pixels", 0.1 * (1 + level))
            coarse = self.prepared.score(rig, unchanged, size, _COARSE_BLUR_PX) if level else coarse
            search = CoarseSearch(coarse, sigmas, depth)
            coarse_rigs, chance = search.best(), search.best_by_chance()
            if coarse_rigs[0].score > _ABOVE_CHANCE * chance:
                break
        else:
            reason = (
                f"the thermal edges agree with those of the photographs no better ({coarse_rigs[0].score:.3f}) than "
                f"chance ({chance:.3f}): the thermal images are too flat or show other things"
            )
            return self._kept(rig, sigmas, before, reason)
        maxima = []
        for one in coarse_rigs:
            if one.score >= _WORTH_TRYING * coarse_rigs[0].score:
                maxima.append(RigMaximizer(coarse.around(one.change), sigmas, depth).maximize(one.change))
        change = max(maxima, key=lambda fit: fit.score).change
        finer = sizes[level + 1 :] or sizes[-1:]
        score, maximizer = coarse, RigMaximizer(coarse, sigmas, depth)
        for number, size in enumerate(finer):
            self.progress(f"Comparing edges, {size[0]} x {size[1]} pixels", 0.3 + 0.6 * number / len(finer))
            blur_px = _FINE_BLUR_PX if size == sizes[-1] else _COARSE_BLUR_PX
            score = self.prepared.score(rig, change, size, blur_px)
            maximizer = RigMaximizer(score, sigmas, depth)
            change = maximizer.maximize(change).change
        covariance = maximizer.covariance(change)
        before, after = score.value(unchanged), score.value(change)
        error_px = self._projection_sigma(rig, change, covariance)
        reason = self._rejection(change, sigmas, before, after, error_px)
        if reason is not None:
            return self._kept(rig, sigmas, before, reason)
        self.progress("Comparing windows", 0.9)
        better = refine(self.prepared, rig, change, sigmas)
        windows = ""
        if better is not None:
            error_px = self._projection_sigma(rig, better.change, better.covariance)
            reason = self._rejection(better.change, sigmas, before, after, error_px)
            if reason is None:
                change, covariance = better.change, better.covariance
                after = score.value(change)
                windows = f" and {better.windows} windows of them that agree"
            error_px = self._projection_sigma(rig, change, covariance)
        self.progress("Rig found", 1.0)
        camera, transform = rig.changed(change)
        turn_deg = np.degrees(np.arccos(np.clip(0.5 * (np.trace(transform[:3, :3]) - 1.0), -1.0, 1.0)))
        explanation = (
            f"Found from {len(self.prepared.frames)} frames{windows}: focal length {camera.fl_x:.1f} pixels, "
            f"{turn_deg:.2f} degrees and {np.linalg.norm(transform[:3, 3]):.3g} world units from the visible camera; "
            f"scene points fall within {error_px:.2f} thermal pixels (standard error). Start: {self.start.source}. "
            f"{uncertainty_text(covariance, sigmas)}"
        ).rstrip()
        return RigEstimate(camera, transform, True, explanation, PARAMETERS, covariance, before, after, error_px)

    def _rejection(
        self, change: FloatArray, sigmas: FloatArray, before: float, after: float, error_px: float
    ) -> str | None:
        """Why the result is not to be trusted; None if nothing speaks against it."""
        free = sigmas > 0.0
        far = np.abs(change[free]) / sigmas[free]
        if far.max() > _FARTHEST_SIGMAS:
            name = np.array(PARAMETERS)[free][int(far.argmax())]
            return f"the best agreement needs {name} {far.max():.0f} standard deviations from the start"
        if after < before:
            return "the start agrees better than all that was tried"
        limit = max(_SMALLEST_ERROR_PX, _LARGEST_ERROR_SHARE * self.prepared.thermal.width)
        if error_px > limit:
            return f"scene points would be uncertain by {error_px:.1f} thermal pixels (limit {limit:.1f})"
        return None

    def _kept(self, rig: RigModel, sigmas: FloatArray, score: float, reason: str) -> RigEstimate:
        """The start as the result."""
        covariance = np.diag(sigmas**2)
        error_px = self._projection_sigma(rig, np.zeros(len(sigmas)), covariance)
        text = f"Not determined, the start value is kept ({self.start.source}): {reason}."
        return RigEstimate(rig.camera, rig.transform, False, text, PARAMETERS, covariance, score, score, error_px)

    def _projection_sigma(self, rig: RigModel, change: FloatArray, covariance: FloatArray) -> float:
        """Median standard error of where scene points fall [thermal pixels], both axes together."""
        camera = self.prepared.thermal
        across, down = np.meshgrid(np.linspace(0.05, 0.95, 12), np.linspace(0.05, 0.95, 12))
        rays = camera.rays(np.column_stack([across.ravel() * camera.width, down.ravel() * camera.height]))
        points = rays * self.prepared.median_depth
        here = rig.project(change, points)
        slopes = np.empty((len(PARAMETERS), *here.shape))
        for number in range(len(PARAMETERS)):
            moved = change.copy()
            moved[number] += _PROBE_STEP
            slopes[number] = (rig.project(moved, points) - here) / _PROBE_STEP
        variance = np.einsum("inx,ij,jnx->n", slopes, covariance, slopes)
        return float(np.sqrt(np.nanmedian(variance)))
