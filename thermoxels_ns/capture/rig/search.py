"""Finds the rig (the thermal lens and its pose relative to the visible camera) from the images of a capture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product

import numpy as np
import numpy.typing as npt
from scipy import fft
from scipy.optimize import approx_fprime

from thermoxels_ns.capture.rig.images import EdgePoints, PreparedFrames, RigScore, prepare_frames
from thermoxels_ns.capture.rig.refinement import RigPosterior, refine
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
_SMALLEST_ERROR_PX, _LARGEST_ERROR_SHARE = 1.5, 0.005
_PROBE_STEP = 1e-4
_REACH_SIGMAS = 2.5
_STEP_PX = 2.5
_COARSE_FRAMES = 16
_SMALLEST_OVERLAP = 0.3
_PADDING = 1.6
_CHANCE_DRAWS = 3

_Spectra = tuple[npt.NDArray, ...]
_Found = tuple[float, FloatArray]  # a score and the ten changes that reach it


def estimate_rig(
    frames: Sequence[RigFrame],
    visible: Camera,
    start: RigStart,
    say: Callable[[str], None] = lambda _: None,
) -> RigEstimate:
    """Find the thermal camera's intrinsics and the fixed transform from the visible to the thermal camera.

    The scene points of structure from motion give the depth of the photographs' edges. The rig is moved until these
    edges, projected into the thermal images of all frames, lie on the thermal edges; `refine` then improves it. Frames
    (in the order they were taken) with fewer than 12 points are left out, and of more than 40 frames an even choice is
    used. If the images do not determine the rig, the start is returned, with `determined` False.

    Raises:
        SceneError: No frame has 12 scene points, an image cannot be read, or its size does not fit its camera.
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
    depth, sizes = prepared.median_depth, prepared.sizes()
    sigmas = prior_sigmas(start, depth)
    rig = RigModel(start.thermal_camera, np.asarray(start.visible_to_thermal, dtype=np.float64))
    unchanged = np.zeros(len(PARAMETERS))
    coarse = prepared.score(rig, unchanged, sizes[0], _COARSE_BLUR_PX)

    def kept(reason: str) -> RigEstimate:
        covariance = np.diag(sigmas**2)
        error_px = _projection_sigma(prepared, rig, unchanged, covariance)
        text = f"Not determined, the start value is kept ({start.source}): {reason}."
        return RigEstimate(rig.camera, rig.transform, False, text, PARAMETERS, covariance, error_px)

    if len(chosen) < _FEWEST_FRAMES:
        return kept(f"{len(chosen)} frames are too few to tell; at least {_FEWEST_FRAMES} are needed")
    value, change, chance, level = 0.0, unchanged, 0.0, 0
    for level, size in enumerate(sizes[:_SEARCHED_SIZES]):  # small things show in the second size only
        say(f"Comparing edges, all directions, {size[0]} x {size[1]} pixels")
        coarse = prepared.score(rig, unchanged, size, _COARSE_BLUR_PX) if level else coarse
        search = CoarseSearch(coarse, sigmas, depth)
        (value, change), chance = search.best(), search.best_by_chance()
        if value > _ABOVE_CHANCE * chance:
            break
    else:
        return kept(
            f"the thermal edges agree with those of the photographs no better ({value:.3f}) than "
            f"chance ({chance:.3f}): the thermal images are too flat or show other things"
        )
    score = coarse.around(change)
    change = RigPosterior(score, sigmas, depth).maximum(change)
    for size in sizes[level + 1 :] or sizes[-1:]:
        say(f"Comparing edges, {size[0]} x {size[1]} pixels")
        score = prepared.score(rig, change, size, _FINE_BLUR_PX if size == sizes[-1] else _COARSE_BLUR_PX)
        change = RigPosterior(score, sigmas, depth).maximum(change)
    covariance = RigPosterior(score, sigmas, depth).covariance(change)

    def rejection(change: FloatArray, covariance: FloatArray) -> str | None:
        """Return why a rig is too far from the start or too uncertain; None if it is acceptable."""
        free = sigmas > 0.0
        far = np.abs(change[free]) / sigmas[free]
        if far.max() > _FARTHEST_SIGMAS:
            name = np.array(PARAMETERS)[free][int(far.argmax())]
            return f"the best agreement needs {name} {far.max():.0f} standard deviations from the start"
        limit = max(_SMALLEST_ERROR_PX, _LARGEST_ERROR_SHARE * prepared.thermal.width)
        error_px = _projection_sigma(prepared, rig, change, covariance)
        if error_px > limit:
            return f"scene points would be uncertain by {error_px:.1f} thermal pixels (limit {limit:.1f})"
        return None

    reason = rejection(change, covariance)
    if score.value(change) < score.value(unchanged):
        reason = "the start agrees better than all that was tried"
    if reason is not None:
        return kept(reason)
    say("Comparing windows")
    better = refine(prepared, rig, change, sigmas)
    windows = ""
    if better is not None and rejection(*better[:2]) is None:
        change, covariance, count = better
        windows = f" and {count} windows of them that agree"
    camera, transform = rig.changed(change)
    error_px = _projection_sigma(prepared, rig, change, covariance)
    found = RigEstimate(camera, transform, True, "", PARAMETERS, covariance, error_px)
    explanation = (
        f"Found from {len(chosen)} frames{windows}: focal length {camera.fl_x:.1f} pixels, turned by "
        f"{found.turn_deg:.2f} ± {found.turn_error_deg:.2f} degrees and {np.linalg.norm(transform[:3, 3]):.3g} "
        f"units from the visible camera; scene points fall within {error_px:.2f} thermal pixels (standard error). "
        f"Start: {start.source}."
    )
    return replace(found, explanation=explanation)


def _projection_sigma(prepared: PreparedFrames, rig: RigModel, change: FloatArray, covariance: FloatArray) -> float:
    """Return the median standard error of where points at the median depth fall, both axes together [pixels]."""
    camera = prepared.thermal
    grid = np.linspace(0.05, 0.95, 12)
    pixels = np.array(list(product(grid, grid))) * (camera.width, camera.height)
    points = camera.rays(pixels) * prepared.median_depth
    slopes = np.asarray(approx_fprime(change, lambda moved: rig.project(moved, points).ravel(), _PROBE_STEP))
    variance = np.einsum("ni,ij,nj->n", slopes, covariance, slopes).reshape(-1, 2).sum(axis=1)
    return float(np.sqrt(np.nanmedian(variance)))


class CoarseSearch:
    """Search over focal length, roll and all shifts of the thermal image for the rig with the best edge score.

    A small turn of the thermal camera shifts its image. For one focal length and roll, the scores of all shifts are
    cross-correlations, which Fourier transforms compute at once.
    """

    def __init__(self, score: RigScore, sigmas: FloatArray, median_depth: float) -> None:
        """Prepare a search at one size, limited by `sigmas` (10,) of the prior; `median_depth` is in world units."""
        camera = score.rig.camera
        self._rig = score.rig
        # The images are padded for shifts, to lengths at which Fourier transforms are fast.
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

    def best(self) -> _Found:
        """Return score and ten changes of the best rig."""
        return self._best([self._spectra(edges.field, edges.weight) for edges in self._thermal])

    def best_by_chance(self) -> float:
        """Return the highest score that the search finds by chance: thermal edges with their phases randomised."""
        draw = np.random.default_rng(0)
        highest = 0.0
        for _ in range(_CHANCE_DRAWS):
            spectra = []
            for edges in self._thermal:
                phases = np.exp(2j * np.pi * draw.random(edges.field.shape))
                noise = np.asarray(fft.ifft2(np.asarray(fft.fft2(edges.field)) * phases))
                spectra.append(self._spectra(noise, edges.weight))
            highest = max(highest, self._best(spectra)[0])
        return highest

    def _spectra(self, field: npt.NDArray, weight: npt.NDArray) -> _Spectra:
        """Return the Fourier transforms of weighted edge values, weights, and weighted edge strengths of an image."""
        planes = field * weight, weight, np.abs(field) ** 2 * weight
        return tuple(np.asarray(fft.fft2(plane.astype(np.complex64), s=self._shape)) for plane in planes)

    def _best(self, spectra: Sequence[_Spectra]) -> _Found:
        """Return score and ten changes of the best shift for any focal length and roll."""
        found: list[_Found] = []
        for log_focal, roll in product(self._focals, self._rolls):
            change = np.zeros(len(PARAMETERS))
            change[2], change[6] = roll, log_focal
            found.append(self._best_shift(self._surface(spectra, change), change))
        return max(found, key=lambda each: each[0])

    def _surface(self, spectra: Sequence[_Spectra], change: FloatArray) -> FloatArray:
        """Return the score for every whole-pixel shift of the thermal image, (rows, columns); shift 0 is at [0, 0]."""
        sums = np.zeros((3, *self._shape), np.complex64)
        for edges, thermal in zip(self._edges, spectra):
            for total, plane, spectrum in zip(sums, self._splat(edges, change), thermal):
                total += np.conj(np.asarray(fft.fft2(plane))) * spectrum
        agreement, overlap, strengths = np.asarray(fft.ifft2(sums)).real
        enough = overlap > _SMALLEST_OVERLAP * max(float(overlap.max()), 1e-12)
        return agreement / np.sqrt(np.where(enough, np.maximum(overlap * strengths, 1e-12), np.inf))

    def _splat(self, edges: EdgePoints, change: FloatArray) -> tuple[npt.NDArray, npt.NDArray, npt.NDArray]:
        """Return sums of edge values, their power and their number in each padded pixel, where shifts wrap around."""
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

    def _best_shift(self, surface: FloatArray, change: FloatArray) -> _Found:
        """Return the highest score of one surface within reach, and `change` turned by its shift."""
        across, down = (int(np.ceil(reach)) for reach in self._reach_px)
        window = np.roll(surface, (down, across), axis=(0, 1))[: 2 * down + 1, : 2 * across + 1]
        focal = np.array([self._rig.camera.fl_x, self._rig.camera.fl_y]) * np.exp(change[6])
        row, column = divmod(int(window.argmax()), window.shape[1])
        shifted = change.copy()
        shifted[:2] = -(row - down) / focal[1], (column - across) / focal[0]
        return float(window[row, column]), shifted


def _steps(reach: float, step: float) -> FloatArray:
    """Return values from -reach to reach, evenly spaced at most `step` apart, with 0 among them."""
    count = int(np.ceil(reach / step))
    return np.linspace(-reach, reach, 2 * count + 1) if count else np.zeros(1)
