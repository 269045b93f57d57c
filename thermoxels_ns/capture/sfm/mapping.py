"""COLMAP's mapping: cameras and points out of matched features."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from thermoxels_ns.capture.rig_types import OPENGL_FROM_OPENCV
from thermoxels_ns.capture.sfm.colmap_model import model_of_colmap
from thermoxels_ns.capture.sfm.colmap_process import quiet_colmap, run_in_process
from thermoxels_ns.capture.sfm.feature_matching import ReducedPhotographs, lens_parameters
from thermoxels_ns.capture.sfm.model import SfmModel

MIN_FRAMES = 3
"""Fewer photographs are no reconstruction."""
_SAID_EVERY = 10


@dataclass(frozen=True)
class MappedPhotographs:
    """The largest group of photographs that fit together, and those of smaller groups."""

    model: SfmModel
    elsewhere: Mapping[str, int]
    """With how many others a frame of a smaller group fits together."""


def map_photographs(matched: ReducedPhotographs, seed: int, say: Callable[[str], None]) -> MappedPhotographs | None:
    """Find camera, poses and points (incremental structure from motion); None where no photographs fit together."""
    return run_in_process(_map, (matched, seed), matched.database.parent, say)


def triangulate(matched: ReducedPhotographs, posed: SfmModel, seed: int, say: Callable[[str], None]) -> SfmModel:
    """Find the points that photographs with known camera (at their own size) and poses share; those of `posed` go."""
    return run_in_process(_triangulate, (matched, posed, seed), matched.database.parent, say)


def _map(matched: ReducedPhotographs, seed: int, say: Callable[[str], None]) -> MappedPhotographs | None:
    """`map_photographs` in this process."""
    import pycolmap

    found = 2  # the first pair comes without a call

    def next_image() -> None:
        nonlocal found
        found += 1
        if found % _SAID_EVERY == 0:
            count = len(matched.frame_of_image)
            say(f"poses: {min(found, count)} of {count} photographs")

    folder = matched.database.parent
    pycolmap.set_random_seed(seed)
    groups: dict[int, Any] = {}
    with quiet_colmap(folder):
        groups = pycolmap.incremental_mapping(
            matched.database, matched.images, folder, _options(seed), next_image_callback=next_image
        )
    if not groups:
        return None
    largest, *others = sorted(groups.values(), key=lambda group: (-group.num_reg_images(), -len(group.points3D)))
    elsewhere = {
        matched.frame_of_image[image.name]: group.num_reg_images() - 1
        for group in others
        for image in group.images.values()
        if image.has_pose
    }
    return MappedPhotographs(model_of_colmap(largest, matched.frame_of_image, matched.size), elsewhere)


def _triangulate(matched: ReducedPhotographs, posed: SfmModel, seed: int, say: Callable[[str], None]) -> SfmModel:
    """`triangulate` in this process."""
    import pycolmap

    say("poses: given; looking for points")
    number = {frame: index for index, frame in enumerate(posed.frames)}
    with pycolmap.Database.open(matched.database) as opened:
        ids = {image.name: image.image_id for image in opened.read_all_images()}
        stored = opened.read_camera(1)
    camera = posed.camera.resized(stored.width, stored.height)
    start = pycolmap.Reconstruction()
    start.add_camera_with_trivial_rig(
        pycolmap.Camera(
            model="OPENCV",
            width=camera.width,
            height=camera.height,
            params=lens_parameters(camera, "OPENCV"),
            camera_id=1,
        )
    )
    for name, frame in matched.frame_of_image.items():
        inverse = np.linalg.inv(posed.camera_to_world[number[frame]] @ OPENGL_FROM_OPENCV)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(inverse[:3, :3]), inverse[:3, 3])
        start.add_image_with_trivial_frame(pycolmap.Image(name=name, camera_id=1, image_id=ids[name]), pose)
    options = _options(seed)
    options.ba_refine_focal_length = options.ba_refine_extra_params = False
    options.constant_cameras = {1}
    options.fix_existing_frames = True
    folder = matched.database.parent
    pycolmap.set_random_seed(seed)
    with quiet_colmap(folder):
        found = pycolmap.triangulate_points(
            start, matched.database, matched.images, folder, clear_points=True, options=options, refine_intrinsics=False
        )
    model = model_of_colmap(found, matched.frame_of_image, matched.size)
    sighting_frame = np.array([number[frame] for frame in model.frames], dtype=np.int64)[model.sighting_frame]
    order = np.lexsort((model.sighting_point, sighting_frame))
    return replace(
        posed,
        points=model.points,
        colours=model.colours,
        point_error_px=model.point_error_px,
        sighting_frame=sighting_frame[order],
        sighting_point=model.sighting_point[order],
        sighting_pixel=model.sighting_pixel[order],
    )


def _options(seed: int) -> Any:
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = seed
    options.mapper.random_seed = seed
    options.triangulation.random_seed = seed
    # Sums over threads come in any order, and their last bits decide which point is kept: one thread, same result.
    options.num_threads = 1
    options.mapper.num_threads = 1
    options.min_model_size = MIN_FRAMES
    return options
