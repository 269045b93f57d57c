"""Captures of a synthetic scene by two cameras whose rig, drift and vignetting are known exactly."""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from thermoxels_ns.capture.rig_types import OPENGL_FROM_OPENCV, RigEstimate, RigFrame, guessed_rig, radius_squared
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.synthetic.raycast import render_view
from thermoxels_ns.synthetic.scene_folder import make_scene

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class KnownCapture:
    """Frames and the truth behind them."""

    frames: list[RigFrame]
    visible: Camera
    thermal: Camera
    visible_to_thermal: FloatArray
    offsets_k: FloatArray
    radial: tuple[float, float]

    def turn_error_deg(self, found: RigEstimate) -> float:
        """Angle between the rotation found and the true one [degrees]."""
        turn = found.visible_to_thermal[:3, :3] @ self.visible_to_thermal[:3, :3].T
        return float(np.degrees(np.arccos(np.clip(0.5 * (np.trace(turn) - 1.0), -1.0, 1.0))))

    def focal_error(self, found: RigEstimate) -> float:
        """Error of the focal length as a share of it."""
        return abs(found.thermal_camera.fl_x / self.thermal.fl_x - 1.0)

    def projection_error_px(self, found: RigEstimate) -> float:
        """Median distance of where scene points fall from where they should [thermal pixels]."""
        points = np.concatenate([frame.points for frame in self.frames])
        rigs = (self.thermal, self.visible_to_thermal), (found.thermal_camera, found.visible_to_thermal)
        pixels = [camera.project(points @ rig[:3, :3].T + rig[:3, 3]) for camera, rig in rigs]
        inside = self.thermal.contains(pixels[0])
        return float(np.median(np.linalg.norm(pixels[0] - pixels[1], axis=1)[inside]))


def changes_between(start: RigEstimate, camera: Camera, transform: FloatArray) -> FloatArray:
    """The ten changes (`PARAMETERS`) that make a rig of a start that is not turned, shape (10,)."""
    turn, before = transform[:3, :3], start.thermal_camera
    angles = cv2.Rodrigues(turn)[0].ravel()
    shift = transform[:3, 3] - start.visible_to_thermal[:3, 3]
    growth = np.log(camera.fl_x / before.fl_x)
    lens = growth, camera.cx - before.cx, camera.cy - before.cy, camera.k1 - before.k1
    return np.array([*angles, *shift, *lens], dtype=np.float64)


def turned(x_deg: float, y_deg: float, z_deg: float) -> FloatArray:
    """Turn about x, then y, then z."""
    return Rotation.from_euler("xyz", [x_deg, y_deg, z_deg], degrees=True).as_matrix()


def known_capture(
    scene_name: str = "house-corner",
    views: int = 8,
    photograph_width: int = 640,
    thermal_width: int = 160,
    baseline_m: tuple[float, float, float] = (0.15, 0.03, 0.02),
    turn_deg: tuple[float, float, float] = (0.8, -1.6, 0.5),
    zoom: float = 1.06,
    seed: int = 0,
    centre_px: tuple[float, float] = (0.0, 0.0),
) -> KnownCapture:
    """Photograph a scene; scene points come from the photographs' depth and are shared where two frames see them.

    `centre_px` is how far the thermal principal point lies from the image's centre.
    """
    scene, draw, radial = make_scene(scene_name), np.random.default_rng(seed), (1.2, 0.5)
    plain = scene.camera(photograph_width, photograph_width * 3 // 4)
    small = scene.camera(thermal_width, thermal_width * 4 // 5)
    focal, centre = small.fl_x * zoom, np.add((small.cx, small.cy), centre_px)
    thermal = Camera(small.width, small.height, focal, focal, *centre.tolist())
    rig = np.eye(4)
    rig[:3, :3], rig[:3, 3] = turned(*turn_deg), baseline_m
    to_visible = OPENGL_FROM_OPENCV @ np.linalg.inv(rig) @ OPENGL_FROM_OPENCV
    poses, _ = scene.poses(views, 0)
    offsets = draw.standard_normal(views)
    offsets -= offsets.mean()
    grid = np.stack(np.meshgrid(np.arange(small.width) + 0.5, np.arange(small.height) + 0.5), axis=-1)
    r2 = radius_squared(grid, small.width, small.height)
    photographs, temperatures, depths, world = [], [], [], []
    for number, pose in enumerate(poses):
        view = render_view(scene, pose, plain, samples_per_axis=1)
        photographs.append(np.round(255.0 * view.rgb).astype(np.uint8))
        depths.append(view.depth_m)
        measured = render_view(scene, pose @ to_visible, thermal).temperature_c
        measured = measured + offsets[number] + radial[0] * r2 + radial[1] * r2 * r2
        temperatures.append((measured + 0.05 * draw.standard_normal(measured.shape)).astype(np.float32))
        seen = np.flatnonzero(np.isfinite(view.depth_m.ravel()))
        chosen = draw.choice(seen, min(900, len(seen)), replace=False)
        directions = plain.directions(pose).reshape(-1, 3)
        world.append(pose[:3, 3] + view.depth_m.ravel()[chosen, None] * directions[chosen])
    points = np.concatenate(world)
    frames = []
    for number, pose in enumerate(poses):
        pixel = plain.project_world(pose, points)
        inside = plain.contains(pixel)
        column, row = np.where(inside[:, None], np.minimum(pixel, (plain.width - 1, plain.height - 1)), 0).astype(int).T
        distance = np.linalg.norm(points - pose[:3, 3], axis=1)
        ids = np.flatnonzero(inside & (np.abs(depths[number][row, column] - distance) < 0.01 * distance))
        seen = (points[ids] - pose[:3, 3]) @ pose[:3, :3] * (1.0, -1.0, -1.0)
        frames.append(RigFrame(photographs[number], temperatures[number], seen, ids.astype(np.int64)))
    return KnownCapture(frames, plain, thermal, rig, offsets, radial)


def drawn_capture(
    scene_name: str, ratio: int, thermal_width: int, baseline_m: float, seed: int, views: int | None = None
) -> tuple[KnownCapture, RigEstimate]:
    """A capture whose turn, lenses' direction, angle of view and principal point are drawn, and what is known of it.

    That is an angle of view up to 5 % off, and nothing else: no ruler was held against the cameras. Six to eight views
    if their number is not given.
    """
    draw = np.random.default_rng(1000 + seed)
    turn, zoom = draw.normal(0.0, 1.2, 3), 1.0 + draw.uniform(0.0, 0.1)
    between = draw.normal(size=3) * (1.0, 0.4, 0.2)
    between *= baseline_m / np.linalg.norm(between)
    centre = draw.normal(0.0, 0.005 * thermal_width, 2)
    capture = known_capture(
        scene_name,
        6 + seed % 3 if views is None else views,
        thermal_width * ratio,
        thermal_width,
        (between[0], between[1], between[2]),
        (turn[0], turn[1], turn[2]),
        zoom,
        seed=seed,
        centre_px=(centre[0], centre[1]),
    )
    width, height = capture.thermal.width, capture.thermal.height
    focal = capture.thermal.fl_x * (1.0 + draw.uniform(-0.05, 0.05))
    return capture, guessed_rig(Camera(width, height, focal, focal, width / 2, height / 2), "the test")


def painted_sky() -> KnownCapture:
    """Two cameras in one place look at random blobs: no parallax, no outlines, so only the comparison of edges errs."""
    draw, views = np.random.default_rng(0), 5
    visible = Camera(480, 360, 412.8, 412.8, 240.0, 180.0)
    thermal = Camera(120, 96, 110.424, 110.424, 60.0, 48.0)
    rig = np.eye(4)
    rig[:3, :3] = turned(0.8, -1.6, 0.5)
    frames = []
    for number in range(views):
        paint = cv2.GaussianBlur(draw.standard_normal((1000, 1300)).astype(np.float32), (0, 0), 14.0)
        paint = cv2.GaussianBlur((paint > 0.0).astype(np.float32), (0, 0), 1.0)
        photograph = _seen(paint, visible, np.eye(3), 2)
        temperature_c = 20.0 + 3.0 * _seen(paint, thermal, rig[:3, :3], 4)
        pixels = draw.uniform(0.0, 1.0, (600, 2)) * (visible.width, visible.height)
        points = 10.0 * visible.rays(pixels)
        ids = np.arange(len(points)) + number * len(points)
        frames.append(RigFrame(photograph, temperature_c.astype(np.float32), points, ids))
    return KnownCapture(frames, visible, thermal, rig, np.zeros(views), (0.0, 0.0))


def _seen(paint: npt.NDArray[np.float32], camera: Camera, turn: FloatArray, samples: int) -> npt.NDArray:
    """Image of a painting far away; every pixel is the mean of samples^2 rays."""
    across = (np.arange(camera.width * samples) + 0.5) / samples
    down = (np.arange(camera.height * samples) + 0.5) / samples
    rays = camera.rays(np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)) @ turn
    place = (800.0 * rays[:, :2] / rays[:, 2:] + (650.0, 500.0) - 0.5).astype(np.float32)
    place = place.reshape(len(down), len(across), 2)
    values = cv2.remap(paint, place[..., 0].copy(), place[..., 1].copy(), cv2.INTER_LINEAR)
    return values.reshape(camera.height, samples, camera.width, samples).mean(axis=(1, 3))
