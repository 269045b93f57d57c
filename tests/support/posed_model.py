from dataclasses import replace

import numpy as np

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
