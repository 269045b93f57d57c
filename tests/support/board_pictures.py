"""Pictures of a checker board in five places, by two cameras whose rig is known."""

from pathlib import Path

import numpy as np

from tests.support.camera_card import photograph
from tests.support.known_rig import turned
from thermoxels_ns.capture.rig.board import CheckerBoard
from thermoxels_ns.core.camera import Camera

BOARD = CheckerBoard(7, 5, 0.06)
_PLACES = (
    (5, 20, 3, 0.0, 0.0, 0.9),
    (-20, -15, -5, 0.12, 0.05, 0.8),
    (15, -25, 8, -0.12, -0.04, 0.85),
    (-25, 10, -3, -0.08, 0.08, 1.0),
    (10, 5, 0, 0.1, -0.08, 0.7),
)
"""Turns about x, y, z [degrees] and the board's middle [m], in the visible camera's OpenCV axes."""


def picture(camera: Camera, board_to_camera: np.ndarray, samples: int = 4) -> np.ndarray:
    """The board seen by a camera: 1 on light squares, 0 on dark ones, 0.5 around, mean over samples^2 rays."""
    across = (np.arange(camera.width * samples) + 0.5) / samples
    down = (np.arange(camera.height * samples) + 0.5) / samples
    rays = camera.rays(np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2))
    normal, origin = board_to_camera[:3, 2], board_to_camera[:3, 3]
    distance = (normal @ origin) / (rays @ normal)
    on_board = (distance[:, None] * rays - origin) @ board_to_camera[:3, :2] / BOARD.square_m
    square = np.floor(on_board).astype(int)  # the first inner corner is at (0, 0)
    inside = (on_board > -1).all(axis=1) & (on_board[:, 0] < BOARD.columns) & (on_board[:, 1] < BOARD.rows)
    around = (on_board > -2).all(axis=1) & (on_board[:, 0] < BOARD.columns + 1) & (on_board[:, 1] < BOARD.rows + 1)
    value = np.where(inside, (square.sum(axis=1) % 2).astype(float), np.where(around, 1.0, 0.5))
    return value.reshape(camera.height, samples, camera.width, samples).mean(axis=(1, 3))


def board_pairs(visible: Camera, thermal: Camera, rig: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Photographs (grey, 0 to 255) and temperatures; what is dark in the one is warm in the other."""
    draw = np.random.default_rng(0)
    result = []
    for x_deg, y_deg, z_deg, x, y, z in _PLACES:
        board = np.eye(4)
        board[:3, :3] = turned(x_deg, y_deg, z_deg)
        board[:3, 3] = np.array((x, y, z)) - board[:3, :2] @ (3 * BOARD.square_m, 2 * BOARD.square_m)
        seen = 255.0 * picture(visible, board, 2)
        warm_is_dark = 25.0 - 4.0 * picture(thermal, rig @ board)
        result.append((seen, warm_is_dark + 0.05 * draw.standard_normal(warm_is_dark.shape)))
    return result


def write_board_folder(folder: Path, pairs: list[tuple[np.ndarray, np.ndarray]]) -> Path:
    for number, (grey, temperature_c) in enumerate(pairs):
        photograph(folder / f"board{number}-visible.jpg", np.dstack([np.round(grey).astype(np.uint8)] * 3))
        np.save(folder / f"board{number}-thermal.npy", temperature_c.astype(np.float32))
    return folder
