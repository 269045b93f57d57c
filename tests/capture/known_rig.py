"""Captures of a synthetic scene by two cameras whose rig, drift and vignetting are known exactly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from thermoxels_ns.capture.contract import OPENGL_FROM_OPENCV, CameraModel, RigFrame, radius_squared
from thermoxels_ns.data.pinhole import PinholeCamera
from thermoxels_ns.data.raycast import render_view
from thermoxels_ns.data.synthetic import make_scene

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class KnownCapture:
    """Frames and the truth behind them."""

    frames: list[RigFrame]
    visible: CameraModel
    thermal: CameraModel
    visible_to_thermal: FloatArray
    offsets_k: FloatArray
    radial: tuple[float, float]


def turned(x_deg: float, y_deg: float, z_deg: float) -> FloatArray:
    """Rotation matrix Rz Ry Rx."""
    x, y, z = np.radians([x_deg, y_deg, z_deg])
    about_x = np.array([[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]])
    about_y = np.array([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]])
    about_z = np.array([[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def known_capture(
    scene_name: str = "house-corner",
    views: int = 8,
    photograph_width: int = 640,
    thermal_width: int = 160,
    baseline_m: tuple[float, float, float] = (0.15, 0.03, 0.02),
    turn_deg: tuple[float, float, float] = (0.8, -1.6, 0.5),
    zoom: float = 1.06,
    noise_k: float = 0.05,
    drift_k: float = 1.0,
    radial: tuple[float, float] = (1.2, 0.5),
    points_per_frame: int = 900,
    seed: int = 0,
) -> KnownCapture:
    """Photograph a scene; scene points come from the photographs' depth and are shared where two frames see them."""
    scene, draw = make_scene(scene_name), np.random.default_rng(seed)
    plain = scene.camera(photograph_width, photograph_width * 3 // 4)
    small = scene.camera(thermal_width, thermal_width * 4 // 5)
    focal = small.fl_x * zoom
    pinhole = PinholeCamera(small.width, small.height, focal, focal, small.cx, small.cy)
    visible = CameraModel(plain.width, plain.height, plain.fl_x, plain.fl_y, plain.cx, plain.cy)
    thermal = CameraModel(small.width, small.height, focal, focal, small.cx, small.cy)
    rig = np.eye(4)
    rig[:3, :3], rig[:3, 3] = turned(*turn_deg), baseline_m
    to_visible = OPENGL_FROM_OPENCV @ np.linalg.inv(rig) @ OPENGL_FROM_OPENCV
    poses, _ = scene.poses(views, 0)
    offsets = drift_k * draw.standard_normal(views)
    offsets -= offsets.mean()
    grid = np.stack(np.meshgrid(np.arange(small.width) + 0.5, np.arange(small.height) + 0.5), axis=-1)
    r2 = radius_squared(grid, small.width, small.height)
    photographs, temperatures, depths, world = [], [], [], []
    for number, pose in enumerate(poses):
        view = render_view(scene, pose, plain, samples_per_axis=1)
        photographs.append(np.round(255.0 * view.rgb).astype(np.uint8))
        depths.append(view.depth_m)
        measured = render_view(scene, pose @ to_visible, pinhole).temperature_c
        measured = measured + offsets[number] + radial[0] * r2 + radial[1] * r2 * r2
        temperatures.append((measured + noise_k * draw.standard_normal(measured.shape)).astype(np.float32))
        seen = np.flatnonzero(view.hit.ravel())
        chosen = draw.choice(seen, min(points_per_frame, len(seen)), replace=False)
        directions = plain.directions(pose).reshape(-1, 3)
        world.append(pose[:3, 3] + view.depth_m.ravel()[chosen, None] * directions[chosen])
    points = np.concatenate(world)
    frames = []
    for number, pose in enumerate(poses):
        pixels, inside = plain.project(pose, points)
        column, row = np.where(inside[:, None], np.minimum(pixels, (plain.width - 1, plain.height - 1)), 0).astype(int).T
        distance = np.linalg.norm(points - pose[:3, 3], axis=1)
        ids = np.flatnonzero(inside & (np.abs(depths[number][row, column] - distance) < 0.01 * distance))
        frames.append(
            RigFrame(f"view {number}", photographs[number], temperatures[number], pose, points[ids], ids.astype(np.int64))
        )
    return KnownCapture(frames, visible, thermal, rig, offsets, radial)
