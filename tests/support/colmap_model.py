"""COLMAP models of known cameras that all see all points."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap

from thermoxels_ns.core.camera import Camera


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
