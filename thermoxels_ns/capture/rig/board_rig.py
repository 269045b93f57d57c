"""The rig from pictures of a checker board that both cameras see: heated, or printed on foil.

Where a scene is too flat to tell the rig, a board tells it once for all captures with the same pair of cameras.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares

from thermoxels_ns.capture.rig.parameters import PARAMETERS, RigModel, prior_sigmas
from thermoxels_ns.capture.stage_types import CameraModel, RigEstimate, RigStart
from thermoxels_ns.core.errors import SceneError

FloatArray = npt.NDArray[np.float64]

_FEWEST_BOARDS = 3
_CORNER_SIGMA_PX = 0.3
_PERCENTILES = (1.0, 99.0)
_SMALLEST_SIDE_PX = 480
_LARGEST_ENLARGEMENT = 6


@dataclass(frozen=True)
class CheckerBoard:
    """A board of dark and light squares."""

    columns: int
    """Inner corners along the longer side; one less than squares."""
    rows: int
    """Inner corners along the shorter side."""
    square_m: float
    """Side of a square [m]."""

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3 or self.columns == self.rows or not self.square_m > 0.0:
            raise SceneError(
                "checker board",
                expected="at least 3 inner corners per side, not as many along both, and a square above 0 m",
                got=f"{self.columns} x {self.rows} corners of {self.square_m} m",
                remedy="Count the inner corners; use a board with sides that differ.",
            )

    @property
    def corners(self) -> FloatArray:
        """Inner corners on the board, row by row, shape (n, 3) [m]."""
        grid = np.stack(np.meshgrid(np.arange(self.columns), np.arange(self.rows)), axis=-1).reshape(-1, 2)
        return np.column_stack([grid * self.square_m, np.zeros(len(grid))])


def find_board(image: npt.NDArray, board: CheckerBoard) -> FloatArray | None:
    """Find the board's inner corners to a fraction of a pixel.

    Args:
        image: Grey values or temperatures, shape (height, width).
        board: What to look for.

    Returns:
        Pixel positions in the order of `CheckerBoard.corners`, from one of the two ends, shape (n, 2); None: no board.
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
    pairs: Sequence[tuple[npt.NDArray, npt.NDArray]], visible: CameraModel, start: RigStart, board: CheckerBoard
) -> RigEstimate:
    """Find the rig from pictures of a checker board in different places.

    The photograph and the visible camera say where the board is; robust least squares (Huber's loss) moves the thermal
    camera until the corners fall where the thermal image shows them, held weakly by the start.

    Args:
        pairs: Photograph (grey) and temperatures of each picture.
        visible: Intrinsics of the photographs.
        start: First guess and how far it can be off, lengths in metres.
        board: The board.

    Returns:
        The rig, its transform in metres. With the board in fewer than three pairs: the start, `determined` False.
    """
    points, seen = [], []
    for photograph, temperature_c in pairs:
        there, here = find_board(photograph, board), find_board(temperature_c, board)
        if there is None or here is None:
            continue
        if np.dot(there[-1] - there[0], here[-1] - here[0]) < 0.0:  # warm squares may be the light ones or the dark
            here = here[::-1]
        points.append(_board_in_camera(there, visible, board))
        seen.append(here)
    depth = float(np.median(np.concatenate(points)[:, 2])) if points else 1.0
    rig = RigModel(start.thermal_camera, np.asarray(start.visible_to_thermal, dtype=np.float64))
    sigmas = prior_sigmas(start, depth)
    if len(points) < _FEWEST_BOARDS:
        reason = f"the board is seen by both cameras in {len(points)} of {len(pairs)} pairs ({_FEWEST_BOARDS} needed)"
        text = f"Not determined, the start value is kept ({start.source}): {reason}."
        return RigEstimate(
            rig.camera, rig.transform, PARAMETERS, np.diag(sigmas**2), False, text, np.nan, np.nan, np.nan
        )
    free = np.flatnonzero(sigmas > 0.0)
    every, target = np.concatenate(points), np.concatenate(seen)

    def change(z: FloatArray) -> FloatArray:
        full = np.zeros(len(sigmas))
        full[free] = z * sigmas[free]
        return full

    def misfit(z: FloatArray) -> FloatArray:
        errors = np.nan_to_num(rig.project(change(z), every) - target, nan=1e3).ravel()
        return np.concatenate([errors / _CORNER_SIGMA_PX, z])

    best = least_squares(misfit, np.zeros(len(free)), loss="huber", x_scale="jac")
    covariance = np.zeros((len(sigmas),) * 2)
    scatter = max(float(np.mean(best.fun[: target.size] ** 2)), 1e-6)
    inverse = np.linalg.inv(best.jac.T @ best.jac) * max(scatter, 1.0)
    covariance[np.ix_(free, free)] = inverse * np.outer(sigmas[free], sigmas[free])
    errors_px = np.linalg.norm(best.fun[: target.size].reshape(-1, 2), axis=1) * _CORNER_SIGMA_PX
    camera, transform = rig.changed(change(best.x))
    error_px = float(np.median(errors_px))
    text = (
        f"Found from {len(points)} pictures of a checker board: focal length {camera.fl_x:.1f} pixels, "
        f"{np.linalg.norm(transform[:3, 3]):.3f} m from the visible camera; corners fall {error_px:.2f} thermal pixels "
        f"from where they are seen (median)."
    )
    uncertain_px = float(np.sqrt(np.trace(best.jac[: target.size] @ inverse @ best.jac[: target.size].T) / len(every)))
    return RigEstimate(
        camera, transform, PARAMETERS, covariance, True, text, np.nan, np.nan, uncertain_px * _CORNER_SIGMA_PX
    )


def _board_in_camera(pixels: FloatArray, camera: CameraModel, board: CheckerBoard) -> FloatArray:
    """The board's corners in the camera's OpenCV axes, shape (n, 3) [m]."""
    plane = np.ascontiguousarray(camera.rays(pixels)[:, :2])
    _, turn, shift = cv2.solvePnP(board.corners, plane, np.eye(3), np.zeros(4), flags=cv2.SOLVEPNP_IPPE)
    return board.corners @ cv2.Rodrigues(turn)[0].T + shift.ravel()
