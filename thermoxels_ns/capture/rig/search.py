"""Finds the rig (the thermal lens and its pose relative to the visible camera) from the images of a capture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product

import cv2
import numpy as np
from scipy.optimize import approx_fprime

from thermoxels_ns.capture.rig.images import EdgePoints, PreparedFrames, RigScore, prepare_frames
from thermoxels_ns.capture.rig.refinement import RigPosterior, refine
from thermoxels_ns.capture.rig_types import PARAMETERS, FloatArray, RigEstimate, RigFrame, RigModel
from thermoxels_ns.core.arrays import Float32Array, IntArray
from thermoxels_ns.core.camera import Camera

_FEWEST_FRAMES, _FEWEST_POINTS = 3, 12
_MOST_FRAMES = 40
_SHIFT_SHARE = 0.03  # standard deviation of the lens's place without a scale, as a share of the median depth
_COARSE_BLUR_PX, _FINE_BLUR_PX = 1.5, 1.0
_ABOVE_CHANCE = 1.5
_SEARCHED_SIZES = 2
_FARTHEST_SIGMAS = 5.0
_SMALLEST_ERROR_PX, _LARGEST_ERROR_SHARE = 1.5, 0.005
_PROBE_STEP = 1e-4
_REACH_SIGMAS, _LARGEST_REACH_SHARE = 2.5, 0.75
_STEP_PX = 2.5
_COARSE_FRAMES = 16
_LEAST_POWER = 0.1
"""Floor of sum(w |a|^2) (`search_coarsely`), as a share of its maximum over all shifts. The floor prevents that a shift
at which the image shows few of the photographs' edges is chosen."""
_CHANCE_DRAWS = 3


def estimate_rig(
    frames: Sequence[RigFrame], visible: Camera, start: RigEstimate, say: Callable[[str], None] = lambda _: None
) -> RigEstimate:
    """Return the thermal camera's intrinsics and the fixed transform from the visible to the thermal camera.

    The scene points of structure from motion give the depth of the photographs' edges. The rig is changed until these
    edges, projected into the thermal images of all frames, coincide with the thermal edges; `refine` then improves it.
    `frames` must be in the order in which they were taken. Frames with fewer than 12 points are left out; of more than
    40 frames, 40 evenly spaced ones are used. If the images do not determine the rig, the guess `start` is returned,
    with the reason as explanation. Raises `SceneError` if a photograph cannot be decoded.
    """

    def kept(reason: str) -> RigEstimate:
        return replace(start, explanation=f"Not determined, the start value is kept ({start.explanation}): {reason}.")

    usable = [frame for frame in frames if np.count_nonzero(frame.points[:, 2] > 0.0) >= _FEWEST_POINTS]
    if len(usable) < _FEWEST_FRAMES:
        few = f"{len(usable)} frames with at least {_FEWEST_POINTS} scene points"
        return kept(f"{few} are too few to tell; at least {_FEWEST_FRAMES} are needed")
    chosen = [usable[i] for i in np.unique(np.linspace(0, len(usable) - 1, min(len(usable), _MOST_FRAMES)).astype(int))]
    say("Reading the frames")
    prepared = prepare_frames(chosen, visible, start.thermal_camera)
    depth, sizes = prepared.median_depth, prepared.sizes()
    sigmas = np.sqrt(np.diag(start.covariance))
    sigmas[3:6] = np.where(np.isnan(sigmas[3:6]), _SHIFT_SHARE * depth, sigmas[3:6])
    rig = RigModel(start.thermal_camera, np.asarray(start.visible_to_thermal, dtype=np.float64))
    unchanged = np.zeros(len(PARAMETERS))
    value, change, chance, size = 0.0, unchanged, 0.0, sizes[0]
    for size in sizes[:_SEARCHED_SIZES]:  # small things show in the second size only
        say(f"Comparing edges, all directions, {size[0]} x {size[1]} pixels")
        score = prepared.score(rig, unchanged, size, _COARSE_BLUR_PX)
        value, change, chance = search_coarsely(score, sigmas, depth)
        if value > _ABOVE_CHANCE * chance:
            break
    else:
        return kept(
            f"the thermal edges agree with those of the photographs no better ({value:.3f}) than "
            f"chance ({chance:.3f}): the thermal images are too flat or show other things"
        )
    finer = sizes[sizes.index(size) :]
    for size in finer[:-1] or finer:
        say(f"Comparing edges, {size[0]} x {size[1]} pixels")
        change = RigPosterior(prepared.score(rig, change, size, _COARSE_BLUR_PX), sigmas, depth).maximum(change)
    say("Comparing edges in full size")
    posterior = RigPosterior(prepared.score(rig, change, sizes[-1], _FINE_BLUR_PX), sigmas, depth)
    change = posterior.maximum(change)
    covariance = posterior.covariance(change)

    def rejection(change: FloatArray, covariance: FloatArray) -> str | None:
        """Return the reason why a rig is too far from the start or too uncertain; None if it is acceptable."""
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
    if posterior.score.slopes(change)[0] < posterior.score.slopes(unchanged)[0]:
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
    found = RigEstimate(camera, transform, True, "", covariance, error_px)
    explanation = (
        f"Found from {len(chosen)} frames{windows}: focal length {camera.fl_x:.1f} pixels, turned by "
        f"{found.turn_deg:.2f} ± {found.turn_error_deg:.2f} degrees and {np.linalg.norm(transform[:3, 3]):.3g} "
        f"units from the visible camera; scene points fall within {error_px:.2f} thermal pixels (standard error). "
        f"Start: {start.explanation}."
    )
    return replace(found, explanation=explanation)


def _projection_sigma(prepared: PreparedFrames, rig: RigModel, change: FloatArray, covariance: FloatArray) -> float:
    """Return the median standard error [pixels], both axes together, of projections of points at the median depth.

    `covariance` (10, 10) is that of the ten changes at `change`.
    """
    camera = prepared.thermal
    grid = np.linspace(0.05, 0.95, 12)
    pixels = np.array(list(product(grid, grid))) * (camera.width, camera.height)
    points = camera.rays(pixels) * prepared.median_depth
    slopes = np.asarray(approx_fprime(change, lambda moved: rig.project(moved, points).ravel(), _PROBE_STEP))
    variance = np.einsum("ni,ij,nj->n", slopes, covariance, slopes).reshape(-1, 2).sum(axis=1)
    return float(np.sqrt(np.nanmedian(variance)))


def search_coarsely(score: RigScore, sigmas: FloatArray, median_depth: float) -> tuple[float, FloatArray, float]:
    """Return the rig of the best normalised cross-correlation of edges, over focal length, roll and image shifts.

    A small turn of the thermal camera, and a shift of its lens, both shift its image. For each focal length and roll,
    the photographs' edges are drawn in thermal pixels and compared with the thermal edges at all shifts. With drawn
    edge values a, thermal edge values b, and weights w that fall to 0 at the image's border, the agreement is
    sum(w Re a* b) / sqrt(sum(w |a|^2) sum(w |b|^2)) over all frames. Shifts (of scene points at `median_depth` [world
    units]), focal lengths and rolls are searched up to 2.5 standard deviations `sigmas` (10,).

    Returns the best agreement, its ten changes (10,), and the best agreement by chance: that of thermal edges with
    randomised phases.
    """
    camera = score.rig.camera
    content = [float(np.sum(np.abs(edges.field) ** 2 * edges.weight)) for edges in score.thermal]
    chosen = np.sort(np.argsort(-np.array(content), kind="stable")[:_COARSE_FRAMES])
    weight = score.thermal[0].weight
    draw = np.random.default_rng(0)
    templates = [[score.thermal[number].field for number in chosen]]
    for _ in range(_CHANCE_DRAWS):
        phases = [np.exp(2j * np.pi * draw.random(weight.shape)) for _ in chosen]
        templates.append([np.fft.ifft2(np.fft.fft2(field) * phase) for field, phase in zip(templates[0], phases)])
    strengths = [sum(float(np.sum(weight * np.abs(field) ** 2)) for field in fields) for fields in templates]
    weighted = [
        [(field * weight).astype(np.complex64)[..., None].view(np.float32) for field in fields] for fields in templates
    ]
    turn = np.hypot(sigmas[:2], sigmas[3:5][::-1] / median_depth)[::-1]  # about y moves along x
    most = _LARGEST_REACH_SHARE * np.array([camera.width, camera.height])
    reach = np.ceil(np.minimum(_REACH_SIGMAS * turn * camera.fl_x, most)).astype(np.int64)
    best = [(0.0, np.zeros(len(PARAMETERS))) for _ in templates]
    for log_focal, roll in product(
        _steps(_REACH_SIGMAS * float(sigmas[6]), _STEP_PX / (0.5 * camera.width)),
        _steps(_REACH_SIGMAS * float(sigmas[2]), _STEP_PX / (0.5 * float(np.hypot(camera.width, camera.height)))),
    ):
        change = np.zeros(len(PARAMETERS))
        change[2], change[6] = roll, log_focal
        drawn = [_drawn(score.edges[number], score.rig, change, reach) for number in chosen]
        power = cv2.matchTemplate(np.sum(np.square(drawn), axis=(0, 3)), weight, cv2.TM_CCORR)
        power = np.maximum(power, max(_LEAST_POWER * float(power.max()), 1e-12))
        for number, (fields, strength) in enumerate(zip(weighted, strengths)):
            matches = [cv2.matchTemplate(one, other, cv2.TM_CCORR) for one, other in zip(drawn, fields)]
            agreement = np.sum(matches, axis=0) / np.sqrt(power * strength)
            row, column = np.unravel_index(int(agreement.argmax()), agreement.shape)
            if agreement[row, column] > best[number][0]:
                shifted = change.copy()
                focal = np.array([camera.fl_y, camera.fl_x]) * np.exp(log_focal)
                shifted[:2] = np.array([row - reach[1], reach[0] - column]) / focal
                best[number] = float(agreement[row, column]), shifted
    return *best[0], max(value for value, _ in best[1:])


def _drawn(edges: EdgePoints, rig: RigModel, change: FloatArray, reach: IntArray) -> Float32Array:
    """Return the sum of edge values in each thermal pixel, real and imaginary parts, shape (rows, columns, 2). The rig
    with the ten changes `change` projects the edges. The image is widened on all sides by `reach`, the numbers of
    pixels along x and y."""
    columns, rows = np.array([rig.camera.width, rig.camera.height]) + 2 * reach
    x, y = np.floor(np.nan_to_num(rig.project(change, edges.points), nan=-1e6)).astype(np.int64).T + reach[:, None]
    inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
    place, value = y[inside] * columns + x[inside], edges.value[inside]
    parts = [np.bincount(place, part, rows * columns).reshape(rows, columns) for part in (value.real, value.imag)]
    return np.stack(parts, axis=2).astype(np.float32)


def _steps(reach: float, step: float) -> FloatArray:
    """Return values from -reach to reach, evenly spaced at most `step` apart, with 0 among them."""
    count = int(np.ceil(reach / step))
    return np.linspace(-reach, reach, 2 * count + 1) if count else np.zeros(1)
