"""Where the camera stood: structure from motion on the photographs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from thermoxels_ns.capture.masks import PhotographMasks
from thermoxels_ns.capture.photograph import open_photograph, read_photograph_facts
from thermoxels_ns.capture.rig_types import OPENGL_FROM_OPENCV
from thermoxels_ns.capture.sfm.colmap import model_of_colmap, run_in_process
from thermoxels_ns.capture.sfm.feature_matching import PoseOptions, ReducedPhotographs, as_colmap, fill_database
from thermoxels_ns.capture.sfm.sfm_model import SfmModel
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.core.errors import SceneError

MIN_FRAMES = 3  # fewer photographs are no reconstruction
_SAID_EVERY = 10
_GUESSED_FOCAL = 1.0  # of the longest side, where the photograph does not say: a lens of 53 degrees
_JPEG_QUALITY = 95
_DATABASE = "features.db"


@dataclass(frozen=True)
class Poses:
    """The poses found, and the photographs without one."""

    model: SfmModel
    dropped: Mapping[str, str]  # why, by the frame's name


def find_poses(
    photographs: Mapping[str, Path],
    folder: Path,
    focal_px: float | None = None,
    masks: PhotographMasks | None = None,
    options: PoseOptions | None = None,
    say: Callable[[str], None] = lambda _: None,
) -> Poses:
    """Find camera and poses from photographs of one camera alone (incremental structure from motion by COLMAP).

    `photographs` are files by the frame's name, in the order they were taken. What an interrupted run left in `folder`
    is used. The largest group of photographs that fit together is found, and why the others are not in it.

    Raises:
        SceneError: Fewer than 3 photographs fit together, or a photograph cannot be decoded.
    """
    options = options or PoseOptions()
    if len(photographs) < MIN_FRAMES:
        raise _too_few(len(photographs), "photographs")
    size, other = common_size(photographs)
    dropped = why_other_size(size, other)
    names = [name for name in photographs if name not in dropped]
    if len(names) < MIN_FRAMES:
        raise _too_few(len(names), "photographs of one size")
    small = _reduced_size(size, options.image_size)
    reduced = _reduced({name: photographs[name] for name in names}, folder, size, small, masks)
    # The photographs' own focal length or a usual one, the principal point at the centre.
    focal = focal_px or _GUESSED_FOCAL * max(size)
    start = Camera(*size, focal, focal, size[0] / 2.0, size[1] / 2.0).resized(*small)
    fill_database(reduced, start, focal_px is not None, options, say)
    model, elsewhere = run_in_process(_map, (reduced, options.seed), folder, say)
    if model is None or len(model.frames) < MIN_FRAMES:
        raise _too_few(0 if model is None else len(model.frames), "photographs that fit together")
    for name in names:
        if name in elsewhere:
            dropped[name] = f"fits only to {elsewhere[name]} others, in a part of its own"
        elif name not in model.frames:
            dropped[name] = "too few matches with the other photographs"
    return Poses(model, dropped)


def add_points(
    given: SfmModel,
    photographs: Mapping[str, Path],
    folder: Path,
    masks: PhotographMasks | None = None,
    options: PoseOptions | None = None,
    say: Callable[[str], None] = lambda _: None,
) -> SfmModel:
    """Find the points that at least two photographs with known poses share; camera and poses stay as they are.

    The photographs have the size of their camera.
    """
    options = options or PoseOptions()
    size = given.camera.width, given.camera.height
    small = _reduced_size(size, options.image_size)
    reduced = _reduced({name: photographs[name] for name in given.frames}, folder, size, small, masks)
    fill_database(reduced, given.camera.resized(*small), True, replace(options, lens="OPENCV"), say)
    return run_in_process(_triangulate, (reduced, given, options.seed), folder, say)


def common_size(photographs: Mapping[str, Path]) -> tuple[tuple[int, int], dict[str, tuple[int, int]]]:
    """Find the size that most photographs have, and the frames of another size with theirs."""
    sizes = {name: read_photograph_facts(path).size for name, path in photographs.items()}
    if not sizes:
        raise _too_few(0, "photographs")
    counted = list(sizes.values())
    common = max(dict.fromkeys(counted), key=counted.count)
    return common, {name: size for name, size in sizes.items() if size != common}


def why_other_size(size: tuple[int, int], other: Mapping[str, tuple[int, int]]) -> dict[str, str]:
    """Why frames of another size than most are left out."""
    most = f"the others {size[0]} x {size[1]}: another camera or mode"
    return {name: f"{width} x {height} pixels, {most}" for name, (width, height) in other.items()}


def _reduced_size(size: tuple[int, int], longest: int) -> tuple[int, int]:
    factor = min(1.0, longest / max(size))
    return max(1, round(size[0] * factor)), max(1, round(size[1] * factor))


def _reduced(
    photographs: Mapping[str, Path],
    folder: Path,
    size: tuple[int, int],
    small: tuple[int, int],
    masks: PhotographMasks | None,
) -> ReducedPhotographs:
    """Write the photographs for COLMAP, smaller and without EXIF, by which it would turn them; and their masks."""
    images, mask_folder = folder / "images", folder / "masks"
    images.mkdir(exist_ok=True)
    digits = max(4, int(math.log10(max(len(photographs), 1))) + 1)
    files = {f"{index:0{digits}d}.jpg": name for index, name in enumerate(photographs)}
    for file, name in files.items():
        if not (images / file).is_file():
            picture = open_photograph(photographs[name])
            if small != size:
                much = max(small) < 0.5 * max(size)
                picture = picture.resize(small, Image.Resampling.BOX if much else Image.Resampling.LANCZOS)
            temporary = images / f".{file}"
            picture.save(temporary, format="JPEG", quality=_JPEG_QUALITY)
            temporary.replace(images / file)
    if masks is None or not masks.any:
        return ReducedPhotographs(folder / _DATABASE, images, files, size)
    mask_folder.mkdir(exist_ok=True)
    for file, frame in files.items():
        use = Image.fromarray(np.where(masks.of(frame), np.uint8(255), np.uint8(0)))
        # COLMAP looks for the photograph's name with .png behind it.
        use.resize(small, Image.Resampling.NEAREST).save(mask_folder / f"{file}.png")
    return ReducedPhotographs(folder / _DATABASE, images, files, size, mask_folder)


def _too_few(got: int, what: str) -> SceneError:
    remedy = (
        "Take more photographs with more overlap (each part of the scene in three or more), in focus and "
        "with texture; or give poses with --poses."
    )
    return SceneError("poses", expected=f"at least {MIN_FRAMES} {what}", got=got, remedy=remedy)


def _map(matched: ReducedPhotographs, seed: int, say: Callable[[str], None]) -> tuple[SfmModel | None, dict[str, int]]:
    """Largest group of photographs that fit together (None: none do), and with how many others those elsewhere do."""
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
    given = matched.database, matched.images, folder, _options(seed)
    groups: dict[int, Any] = pycolmap.incremental_mapping(*given, next_image_callback=next_image)
    if not groups:
        return None, {}
    largest, *others = sorted(groups.values(), key=lambda group: (-group.num_reg_images(), -len(group.points3D)))
    elsewhere = {
        matched.frame_of_image[image.name]: group.num_reg_images() - 1
        for group in others
        for image in group.images.values()
        if image.has_pose
    }
    return model_of_colmap(largest, matched.frame_of_image, matched.size), elsewhere


def _triangulate(matched: ReducedPhotographs, posed: SfmModel, seed: int, say: Callable[[str], None]) -> SfmModel:
    """Find the points that photographs with known camera (at their own size) and poses share; those of `posed` go."""
    import pycolmap

    say("poses: given; looking for points")
    number = {frame: index for index, frame in enumerate(posed.frames)}
    with pycolmap.Database.open(matched.database) as opened:
        ids = {image.name: image.image_id for image in opened.read_all_images()}
        stored = opened.read_camera(1)
    camera = posed.camera.resized(stored.width, stored.height)
    start = pycolmap.Reconstruction()
    start.add_camera_with_trivial_rig(as_colmap(camera, "OPENCV"))
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
    given = start, matched.database, matched.images, folder
    found = pycolmap.triangulate_points(*given, clear_points=True, options=options, refine_intrinsics=False)
    model = model_of_colmap(found, matched.frame_of_image, matched.size)
    sighting_frame = np.array([number[frame] for frame in model.frames], dtype=np.int64)[model.sighting_frame]
    return replace(
        posed,
        points=model.points,
        colours=model.colours,
        point_error_px=model.point_error_px,
        sighting_frame=sighting_frame,
        sighting_point=model.sighting_point,
        sighting_pixel=model.sighting_pixel,
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
