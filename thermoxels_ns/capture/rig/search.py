"""Finds the rig (thermal lens and pose beside the visible camera) from images."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy import fft

from thermoxels_ns.capture.rig.images import EdgePoints, PreparedFrames, RigScore, prepare_frames
from thermoxels_ns.capture.rig.refinement import RigFit, RigMaximizer, refine
from thermoxels_ns.capture.rig_types import (
    PARAMETERS,
    FloatArray,
    RigEstimate,
    RigFrame,
    RigModel,
    RigStart,
    prior_sigmas,
)
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
_Spectra = tuple[npt.NDArray, ...]
_REACH_SIGMAS = 2.5
_STEP_PX = 2.5
_COARSE_FRAMES = 16
_CANDIDATES = 4
_APART_PX = 3.0
_SMALLEST_OVERLAP = 0.3
_PADDING = 1.6
_CHANCE_DRAWS = 3
_WORDS = (
    *("the tilt up or down", "the turn left or right", "the roll", "the shift to the side", "the shift up or down"),
    *("the shift ahead", "the focal length", "the principal point's column", "the principal point's row"),
    "the distortion",
)
_SAME = 0.8
"""Correlation from which on two numbers stand for each other: knowing one would make the other 1.7 times as sure."""
_NOTHING_LEARNT = 0.8  # share of the first standard deviation that is left where the images say next to nothing


def estimate_rig(
    frames: Sequence[RigFrame],
    visible: Camera,
    start: RigStart,
    say: Callable[[str], None] = lambda _: None,
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
    say("Reading the frames")
    prepared = prepare_frames(chosen, visible, start.thermal_camera)
    return _RigSearch(prepared, start, say).run()


@dataclass(frozen=True, eq=False)
class _RigSearch:
    prepared: PreparedFrames
    start: RigStart
    say: Callable[[str], None]

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
            self.say(f"Comparing edges, all directions, {size[0]} x {size[1]} pixels")
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
        for size in finer:
            self.say(f"Comparing edges, {size[0]} x {size[1]} pixels")
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
        self.say("Comparing windows")
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
        camera, transform = rig.changed(change)
        found = RigEstimate(camera, transform, True, "", PARAMETERS, covariance, before, after, error_px)
        explanation = (
            f"Found from {len(self.prepared.frames)} frames{windows}: focal length {camera.fl_x:.1f} pixels, turned by "
            f"{found.turn_deg:.2f} ± {found.turn_error_deg:.2f} degrees and {np.linalg.norm(transform[:3, 3]):.3g} "
            f"units from the visible camera; scene points fall within {error_px:.2f} thermal pixels (standard error). "
            f"Start: {self.start.source}.{_unsure(covariance, sigmas)}"
        )
        return replace(found, explanation=explanation)

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


def _unsure(covariance: FloatArray, sigmas: FloatArray) -> str:
    """Say which of the ten numbers of a rig are not to be trusted alone; empty where all are."""
    errors = np.sqrt(np.diag(covariance))
    alike = np.triu(np.abs(covariance) > _SAME * np.outer(errors, errors), 1)
    pairs = [f"{_WORDS[first]} and {_WORDS[second]}" for first, second in zip(*np.nonzero(alike))]
    unknown = [
        word for word, error, sigma in zip(_WORDS, errors, sigmas) if sigma > 0 and error > _NOTHING_LEARNT * sigma
    ]
    text = f" The images hardly tell apart {'; '.join(pairs)}." if pairs else ""
    return text + (f" They say next to nothing about {', '.join(unknown)}." if unknown else "")


class CoarseSearch:
    """Compares all shifts of the photographs' edges at once, for a range of focal lengths and rolls.

    A small turn of the thermal camera shifts its image; so for one focal length and roll the scores of all turns are
    cross-correlations, which Fourier transforms give together.
    """

    def __init__(self, score: RigScore, sigmas: FloatArray, median_depth: float) -> None:
        """Take the score at the coarsest size, the ten standard deviations and the points' depth [world units]."""
        camera = score.rig.camera
        self._rig = score.rig
        # Lengths that Fourier transforms are fast at, with room for shifts.
        rows, columns = (int(fft.next_fast_len(int(_PADDING * n)) or 0) for n in (camera.height, camera.width))
        self._shape: tuple[int, int] = (rows, columns)
        content = [float(np.sum(np.abs(edges.field) ** 2 * edges.weight)) for edges in score.thermal]
        chosen = np.sort(np.argsort(-np.array(content), kind="stable")[:_COARSE_FRAMES])
        self._edges = [score.edges[number] for number in chosen]
        self._thermal = [score.thermal[number] for number in chosen]
        turn = np.hypot(sigmas[:2], sigmas[3:5][::-1] / median_depth)[::-1]  # about y moves along x
        self._reach_px = np.minimum(_REACH_SIGMAS * turn * camera.fl_x, 0.5 * np.array([columns, rows]) - 2.0)
        corner_px = 0.5 * float(np.hypot(camera.width, camera.height))
        self._focals = _steps(_REACH_SIGMAS * float(sigmas[6]), _STEP_PX / (0.5 * camera.width))
        self._rolls = _steps(_REACH_SIGMAS * float(sigmas[2]), _STEP_PX / corner_px)

    def best(self) -> list[RigFit]:
        """Find the best few places that differ, best first."""
        found = self._found([self._spectra(edges.field, edges.weight) for edges in self._thermal])
        kept: list[RigFit] = []
        for rig in sorted(found, key=lambda rig: -rig.score):
            apart = [np.abs((rig.change - other.change)[:2]).max() * self._rig.camera.fl_x for other in kept]
            if not apart or min(apart) >= _APART_PX:
                kept.append(rig)
            if len(kept) == _CANDIDATES:
                break
        return kept

    def best_by_chance(self) -> float:
        """Highest score that the same search finds if edges of the same scales lie anywhere (noise, random phases)."""
        draw = np.random.default_rng(0)
        highest = 0.0
        for _ in range(_CHANCE_DRAWS):
            spectra = []
            for edges in self._thermal:
                phases = np.exp(2j * np.pi * draw.random(edges.field.shape))
                noise = np.asarray(fft.ifft2(np.asarray(fft.fft2(edges.field)) * phases))
                spectra.append(self._spectra(noise, edges.weight))
            highest = max(highest, *(rig.score for rig in self._found(spectra)))
        return highest

    def _spectra(self, field: npt.NDArray, weight: npt.NDArray) -> _Spectra:
        """Fourier transforms of a thermal image's edge values, weights and edge strengths."""
        weighted = fft.fft2((field * weight).astype(np.complex64), s=self._shape)
        planes = weight, (np.abs(field) ** 2 * weight).astype(np.float32)
        return (np.asarray(weighted), *(np.asarray(fft.rfft2(plane, s=self._shape)) for plane in planes))

    def _found(self, spectra: Sequence[_Spectra]) -> list[RigFit]:
        found: list[RigFit] = []
        for log_focal in self._focals:
            for roll in self._rolls:
                change = np.zeros(10)
                change[2], change[6] = roll, log_focal
                found += self._best_shifts(self._surface(spectra, change), change)
        return found

    def _surface(self, spectra: Sequence[_Spectra], change: FloatArray) -> FloatArray:
        """Score for every whole shift of the thermal image, shape (rows, columns), shift 0 at [0, 0]."""
        product: npt.NDArray = np.zeros(self._shape, np.complex64)
        own: npt.NDArray = np.zeros((self._shape[0], self._shape[1] // 2 + 1), np.complex64)
        other = own.copy()
        for edges, (field, weight, strength) in zip(self._edges, spectra):
            value, power, count = self._splat(edges, change)
            product += np.conj(np.asarray(fft.fft2(value))) * field
            own += np.conj(np.asarray(fft.rfft2(power))) * weight
            other += np.conj(np.asarray(fft.rfft2(count))) * strength
        overlap, strengths = np.asarray(fft.irfft2(own, s=self._shape)), np.asarray(fft.irfft2(other, s=self._shape))
        enough = overlap > _SMALLEST_OVERLAP * max(float(overlap.max()), 1e-12)
        norm = np.where(enough, np.maximum(overlap * strengths, 1e-12), np.inf)
        return np.asarray(fft.ifft2(product)).real / np.sqrt(norm)

    def _splat(self, edges: EdgePoints, change: FloatArray) -> tuple[npt.NDArray, npt.NDArray, npt.NDArray]:
        """Edge values, their power and their number in each pixel of the padded image, around which shifts wrap."""
        rows, columns = self._shape
        pixels = np.nan_to_num(self._rig.project(change, edges.points), nan=-1e6)
        x, y = np.floor(pixels[:, 0]).astype(np.int64), np.floor(pixels[:, 1]).astype(np.int64)
        spare_x, spare_y = columns - self._rig.camera.width, rows - self._rig.camera.height
        inside = (x >= -spare_x // 2) & (x < columns - spare_x // 2) & (y >= -spare_y // 2) & (y < rows - spare_y // 2)
        place, value = (y[inside] % rows) * columns + x[inside] % columns, edges.value[inside]
        real, imaginary, power, count = (
            np.bincount(place, weights, rows * columns).reshape(self._shape).astype(np.float32)
            for weights in (value.real, value.imag, np.abs(value) ** 2, np.ones(len(value)))
        )
        return real + np.complex64(1j) * imaginary, power, count

    def _best_shifts(self, surface: FloatArray, change: FloatArray) -> list[RigFit]:
        """The highest places of one surface within reach, as turns of the camera."""
        across, down = (int(np.ceil(reach)) for reach in self._reach_px)
        window = np.roll(surface, (down, across), axis=(0, 1))[: 2 * down + 1, : 2 * across + 1]
        focal = np.array([self._rig.camera.fl_x, self._rig.camera.fl_y]) * np.exp(change[6])
        found = []
        for place in np.argsort(-window, axis=None, kind="stable")[:_CANDIDATES]:
            row, column = divmod(int(place), window.shape[1])
            shifted = change.copy()
            shifted[:2] = -(row - down) / focal[1], (column - across) / focal[0]
            found.append(RigFit(shifted, float(window[row, column])))
        return found


def _steps(reach: float, step: float) -> FloatArray:
    """Values from -reach to reach, at most `step` apart, with 0 among them."""
    count = int(np.ceil(reach / step))
    return np.linspace(-reach, reach, 2 * count + 1) if count else np.zeros(1)
