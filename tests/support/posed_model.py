"""Models of known cameras, as structure from motion gives them and as COLMAP writes them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap

from thermoxels_ns.capture.sfm.sfm_model import SfmModel
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.synthetic.scene_truth import look_at

CAMERA = Camera(640, 480, 500.0, 500.0, 320.0, 240.0, k1=0.02)


def ring_model(count: int = 8, points: int = 300, seed: int = 0, unit_m: float = 1.0) -> SfmModel:
    """Cameras on a half circle of 4 m that look at points on a wall and a floor; one unit is `unit_m` metres."""
    rng = np.random.default_rng(seed)
    on_wall = np.stack([rng.uniform(-2, 2, points), np.full(points, 1.0), rng.uniform(0, 2, points)], axis=1)
    angles = np.linspace(-0.6, 0.6, count)
    poses = np.array([look_at((4 * np.sin(a), 1 - 4 * np.cos(a), 1.5), (0, 1, 1)) for a in angles])
    poses[:, :3, 3] /= unit_m
    model = SfmModel(
        frames=tuple(f"f{n}" for n in range(count)),
        camera=CAMERA,
        camera_to_world=poses,
        points=on_wall / unit_m,
        point_error_px=np.zeros(points),
        seen=(),
        errors_px=(),
    )
    places = (CAMERA.project(model.in_camera(index, model.points)) for index in range(count))
    seen = tuple(np.flatnonzero(CAMERA.contains(place)) for place in places)
    return replace(model, seen=seen, errors_px=tuple(np.zeros(len(some)) for some in seen))


def write_colmap_model(
    folder: Path,
    names: list[str],
    camera_to_world: npt.NDArray,
    camera: Camera,
    points: npt.NDArray,
    *,
    text: bool = False,
    error: float = 0.5,
    lens: str = "SIMPLE_RADIAL",
    turn: npt.NDArray | None = None,
    shift: npt.ArrayLike = (0.0, 0.0, 0.0),
) -> None:
    """Write cameras (poses with OpenGL axes) and points in a world that is turned and moved."""
    turn = np.eye(3) if turn is None else turn
    model = pycolmap.Reconstruction()
    params = {
        "PINHOLE": [camera.fl_x, camera.fl_y, camera.cx, camera.cy],
        "SIMPLE_RADIAL": [camera.fl_x, camera.cx, camera.cy, camera.k1],
    }[lens]
    size = {"width": camera.width, "height": camera.height}
    model.add_camera_with_trivial_rig(pycolmap.Camera(camera_id=1, model=lens, **size, params=params))
    for number, (name, pose) in enumerate(zip(names, camera_to_world), start=1):
        seen = (points - pose[:3, 3]) @ pose[:3, :3] * (1, -1, -1)
        world = np.empty((3, 4))
        world[:, :3] = (turn @ pose[:3, :3] * (1, -1, -1)).T
        world[:, 3] = -world[:, :3] @ (turn @ pose[:3, 3] + shift)
        image = pycolmap.Image(name=name, image_id=number, camera_id=1)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in camera.project(seen)])
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(world))
    for number, point in enumerate(points):
        track = pycolmap.Track()
        for image_id in range(1, len(names) + 1):
            track.add_element(image_id, number)
        model.add_point3D(turn @ point + shift, track, np.zeros(3, dtype=np.uint8))
    for point in model.points3D.values():
        point.error = error
    folder.mkdir(parents=True, exist_ok=True)
    (model.write_text if text else model.write_binary)(str(folder))
