"""Result of structure from motion: one camera, its poses and scene points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from thermoxels_ns.capture.rig_types import OPENGL_FROM_OPENCV, FloatArray
from thermoxels_ns.core.camera import Camera


@dataclass(frozen=True)
class SfmModel:
    """Poses of the photographs and the points that they share, in one arbitrary unit of length.

    Sightings are a list: sighting s says that frame `sighting_frame[s]` shows point `sighting_point[s]` at pixel
    `sighting_pixel[s]`. They are sorted by frame, then by point.
    """

    frames: tuple[str, ...]  # names of the frames that have a pose, in order, all different
    camera: Camera  # the photographs' lens
    camera_to_world: FloatArray  # shape (f, 4, 4), camera axes x right, y up, z back, as transforms.json has them
    points: FloatArray  # shape (n, 3), in world units; empty where poses were given without points
    colours: npt.NDArray[np.uint8]  # red, green and blue of the points, shape (n, 3)
    point_error_px: FloatArray  # mean reprojection error of each point, shape (n,), [pixels of the photographs]
    sighting_frame: npt.NDArray[np.int64]
    sighting_point: npt.NDArray[np.int64]  # indices into `frames` and `points`, each shape (s,)
    sighting_pixel: FloatArray  # where the frame shows the point, shape (s, 2), [pixels of the photographs]

    @property
    def centres(self) -> FloatArray:
        """Where the cameras stood, shape (f, 3)."""
        return self.camera_to_world[:, :3, 3]

    def seen_by(self, frame: int) -> tuple[npt.NDArray[np.int64], FloatArray]:
        """Indices (m,) of the points that a frame shows, and their pixels (m, 2)."""
        first, last = np.searchsorted(self.sighting_frame, [frame, frame + 1])
        return self.sighting_point[first:last], self.sighting_pixel[first:last]

    def in_camera(self, frame: int, points: npt.ArrayLike) -> FloatArray:
        """Express world points (m, 3) in a frame's camera axes x right, y down, z ahead."""
        pose = self.camera_to_world[frame]
        return (np.asarray(points, dtype=np.float64) - pose[:3, 3]) @ pose[:3, :3] @ OPENGL_FROM_OPENCV[:3, :3]

    def sighting_error_px(self) -> FloatArray:
        """Distance between where each point is seen and where it projects to, shape (s,), [pixels]."""
        errors = [np.zeros(0)]
        for frame in range(len(self.frames)):
            seen, pixels = self.seen_by(frame)
            projected = self.camera.project(self.in_camera(frame, self.points[seen]))
            errors.append(np.linalg.norm(projected - pixels, axis=1))
        return np.concatenate(errors)

    def moved(self, rotation: FloatArray, origin: FloatArray) -> SfmModel:
        """Same model in other axes: p_new = rotation (p - origin); `rotation` (3, 3), `origin` (3,) in old axes."""
        poses = self.camera_to_world.copy()
        poses[:, :3, :3] = rotation @ poses[:, :3, :3]
        poses[:, :3, 3] = (poses[:, :3, 3] - origin) @ rotation.T
        return replace(self, camera_to_world=poses, points=(self.points - origin) @ rotation.T)

    def without(self, names: Sequence[str]) -> SfmModel:
        """Same model without some frames; its points stay, also those that only they saw."""
        keep = np.array([name not in set(names) for name in self.frames], dtype=bool)
        number = np.cumsum(keep) - 1
        stays = keep[self.sighting_frame]
        return replace(
            self,
            frames=tuple(name for name, stay in zip(self.frames, keep) if stay),
            camera_to_world=self.camera_to_world[keep],
            sighting_frame=number[self.sighting_frame[stays]],
            sighting_point=self.sighting_point[stays],
            sighting_pixel=self.sighting_pixel[stays],
        )
