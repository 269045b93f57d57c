"""Finds the rig from pictures of a heated checker board that both cameras see."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares

from thermoxels_ns.capture.frames import read_frames
from thermoxels_ns.capture.pairs import search_pairs
from thermoxels_ns.capture.photograph import open_photograph
from thermoxels_ns.capture.rig.start import BASELINE_SIGMA_M, kept_start, rig_start
from thermoxels_ns.capture.rig_types import PARAMETERS, FloatArray, RigEstimate, RigModel, RigStart, prior_sigmas
from thermoxels_ns.capture.settings import CaptureSettings
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.data.scene_scale import SceneScale
from thermoxels_ns.radiometry.thermogram import RadiometryOptions

_SIZE = re.compile(r"(\d{1,3})\s*[xX]\s*(\d{1,3})")
_SHIFTS = slice(3, 6)  # places of the shift, which is a length, among a rig's ten parameters

_FEWEST_BOARDS = 3
_CORNER_SIGMA_PX = 0.3
_PERCENTILES = (1.0, 99.0)
_SMALLEST_SIDE_PX = 480
_LARGEST_ENLARGEMENT = 6


@dataclass(frozen=True)
class CheckerBoard:
    """A board of dark and light squares, described by the corners where four squares meet (inner corners)."""

    columns: int  # inner corners along the longer side, one less than the squares there
    rows: int  # inner corners along the shorter side
    square_m: float  # side of one square [m]

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3 or self.columns == self.rows or not self.square_m > 0.0:
            expected = "at least 3 inner corners per side, not as many along both, and a square above 0 m"
            got = f"{self.columns} x {self.rows} corners of {self.square_m} m"
            remedy = "Count the inner corners; use a board with sides that differ."
            raise SceneError("checker board", expected=expected, got=got, remedy=remedy)

    @property
    def corners(self) -> FloatArray:
        """Positions of the inner corners on the board, row by row, shape (n, 3) [m]; the third coordinate is 0."""
        grid = np.stack(np.meshgrid(np.arange(self.columns), np.arange(self.rows)), axis=-1).reshape(-1, 2)
        return np.column_stack([grid * self.square_m, np.zeros(len(grid))])


def find_board(image: npt.NDArray, board: CheckerBoard) -> FloatArray | None:
    """Find the board's inner corners in grey values or temperatures, shape (height, width), to a fraction of a pixel.

    Returns the pixels (n, 2) in the order of `CheckerBoard.corners` or the reverse; None if no board is found.
    """
    values = np.asarray(image, dtype=np.float32)
    if not np.isfinite(values).any():
        return None
    low, high = np.nanpercentile(values, _PERCENTILES)
    grey = np.nan_to_num((values - low) * (255.0 / max(float(high - low), 1e-6)), nan=0.0).clip(0, 255)
    side = min(grey.shape)
    enlarged = min(max(-(-_SMALLEST_SIDE_PX // side), 1), _LARGEST_ENLARGEMENT)
    size = grey.shape[1] * enlarged, grey.shape[0] * enlarged
    picture = cv2.resize(grey.astype(np.uint8), size, interpolation=cv2.INTER_CUBIC)
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
    found, corners = cv2.findChessboardCornersSB(picture, (board.columns, board.rows), flags=flags)
    if not found:
        return None
    return (np.asarray(corners, dtype=np.float64).reshape(-1, 2) + 0.5) / enlarged


def rig_from_boards(
    pairs: Sequence[tuple[npt.NDArray, npt.NDArray]], visible: Camera, start: RigStart, board: CheckerBoard
) -> RigEstimate:
    """Find the rig, lengths in metres, from pairs (grey photograph, temperatures) of a checker board in several places.

    Each photograph and the visible camera give the place of the board. Robust least squares (Huber's loss) then moves
    the thermal camera until the corners fall where the thermal images show them; `start` (lengths in metres) is the
    prior. If fewer than three pairs show the board to both cameras, the start is returned, with `determined` False.
    """
    points, seen = [], []
    for photograph, temperature_c in pairs:
        there, here = find_board(photograph, board), find_board(temperature_c, board)
        if there is None or here is None:
            continue
        if np.dot(there[-1] - there[0], here[-1] - here[0]) < 0.0:  # the two orders are opposite
            here = here[::-1]
        plane = np.ascontiguousarray(visible.rays(there)[:, :2])
        _, turn, shift = cv2.solvePnP(board.corners, plane, np.eye(3), np.zeros(4), flags=cv2.SOLVEPNP_IPPE)
        points.append(board.corners @ cv2.Rodrigues(turn)[0].T + shift.ravel())
        seen.append(here)
    if len(points) < _FEWEST_BOARDS:
        why = f"The board is seen by both cameras in {len(points)} of {len(pairs)} pairs ({_FEWEST_BOARDS} needed)."
        return kept_start(start, why)
    every, target = np.concatenate(points), np.concatenate(seen)
    rig = RigModel(start.thermal_camera, np.asarray(start.visible_to_thermal, dtype=np.float64))
    sigmas = prior_sigmas(start, float(np.median(every[:, 2])))

    def misfit(z: FloatArray) -> FloatArray:
        errors = np.nan_to_num(rig.project(z * sigmas, every) - target, nan=1e3).ravel()
        return np.concatenate([errors / _CORNER_SIGMA_PX, z])

    best = least_squares(misfit, np.zeros(len(sigmas)), loss="huber", x_scale="jac")
    corners = slice(target.size)
    scatter = max(float(np.mean(best.fun[corners] ** 2)), 1.0)
    inverse = np.linalg.inv(best.jac.T @ best.jac) * scatter
    camera, transform = rig.changed(best.x * sigmas)
    error_px = np.median(np.linalg.norm(best.fun[corners].reshape(-1, 2), axis=1)) * _CORNER_SIGMA_PX
    text = (
        f"Found from {len(points)} pictures of a checker board: focal length {camera.fl_x:.1f} pixels, "
        f"{np.linalg.norm(transform[:3, 3]):.3f} m from the visible camera; corners fall {error_px:.2f} thermal pixels "
        f"from where they are seen (median)."
    )
    variance = np.einsum("ij,jk,ik->", best.jac[corners], inverse, best.jac[corners]) / len(every)
    sigma_px, covariance = float(np.sqrt(variance)) * _CORNER_SIGMA_PX, inverse * np.outer(sigmas, sigmas)
    return RigEstimate(camera, transform, True, text, PARAMETERS, covariance, projection_sigma_px=sigma_px)


def board_of(settings: CaptureSettings) -> CheckerBoard | None:
    """Return the settings' checker board, or None; raise `SceneError` if it is half described or beside --rig."""
    photos, size, square_m = settings.board_photos, settings.board, settings.board_square_m
    if photos is None and size is None and square_m is None:
        return None
    match = _SIZE.fullmatch(str(size).strip())
    if photos is None or match is None or square_m is None or settings.rig is not None:
        expected = "--board-photos, --board such as 7x5 and --board-square-m together, and no --rig beside them"
        got = f"{photos}, {size}, {square_m} and --rig {settings.rig}"
        remedy = "Pass --board-photos FOLDER --board 7x5 --board-square-m 0.03 (inner corners), or none of them."
        raise SceneError("checker board", expected=expected, got=got, remedy=remedy)
    sides = sorted(map(int, match.groups()), reverse=True)
    return CheckerBoard(sides[0], sides[1], square_m)


def rig_from_board_photos(
    source: Path,
    board: CheckerBoard,
    visible: Camera,
    thermal_size: tuple[int, int],
    folder: Path,
    settings: CaptureSettings,
    radiometry: RadiometryOptions,
    say: Callable[[str], None] = lambda _: None,
) -> RigEstimate:
    """Find the rig, lengths in metres, from the folder `source` with photographs and thermal images of a board.

    The files are paired and read like the capture's, and the results are written to `folder`. Raises `SceneError` if
    there are no pairs, image sizes differ from the capture's, or fewer than three pairs show the board to both cameras.
    """
    found = search_pairs(source, settings, say=say).pairs
    read = read_frames(found, source, folder, radiometry, settings.skip_bad, say)
    pairs, size = [], (visible.width, visible.height)
    for frame in read.frames:
        photograph = open_photograph(frame.photograph)
        if read.thermal_size != thermal_size or photograph.size != size:
            expected = f"{size} pixels and {thermal_size} thermal pixels, as in the capture"
            got, remedy = f"{photograph.size} and {read.thermal_size}", "Use the same cameras in the same mode."
            raise SceneError(f"board pictures: {frame.photograph_source}", expected=expected, got=got, remedy=remedy)
        pairs.append((np.asarray(photograph.convert("L")), np.load(frame.thermal, allow_pickle=False)))
    start = rig_start(read.frames, visible, thermal_size, settings.thermal_field_of_view_deg)
    estimate = rig_from_boards(pairs, visible, replace(start, translation_sigma=BASELINE_SIGMA_M), board)
    if not estimate.determined:
        expected = f"at least three pairs in which both cameras show the {board.columns} x {board.rows} corners"
        remedy = "Check --board; heat the board evenly, hold it still, and let it fill a third of the picture."
        raise SceneError(f"board pictures in {source}", expected=expected, got=estimate.explanation, remedy=remedy)
    say(f"board: {estimate.explanation}")
    return estimate


def in_scene_units(rig: RigEstimate, scale: SceneScale | None, missing: str) -> RigEstimate:
    """Convert a rig's lengths from metres to scene units; raise `SceneError` (text: `missing`) if `scale` is None."""
    if scale is None:
        expected = "a known scale, because a board gives the distance of the lenses in metres"
        remedy = "Pass --known-distance or --marker-side-m; poses that were found are kept."
        raise SceneError("scale", expected=expected, got=f"none: {missing}", remedy=remedy)
    transform, covariance = rig.visible_to_thermal.copy(), rig.covariance.copy()
    transform[:3, 3] /= scale.metres_per_unit
    covariance[_SHIFTS] /= scale.metres_per_unit
    covariance[:, _SHIFTS] /= scale.metres_per_unit
    return replace(rig, visible_to_thermal=transform, covariance=covariance)
