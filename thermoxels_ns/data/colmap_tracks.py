"""Feature rays of a scene, from its file of tracks or from a COLMAP model in its folder."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import PurePosixPath
from typing import Literal

import numpy as np
from nerfstudio.utils.rich_utils import CONSOLE

from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.core.feature_rays import FeatureRays
from thermoxels_ns.data.colmap_model import COLMAP_FOLDERS, camera_to_world, is_model, read_model, worlds_of_json
from thermoxels_ns.data.scene_file import Frame, SceneFile
from thermoxels_ns.data.tracks import TRACKS_KEY, SparseTracks, feature_rays, read_tracks

MOST_OFF_PX = 2.0
"""A photograph is left out if points seen from the model's pose and from the given pose are farther apart than this
(median over its points)."""
LEAST_AGREEING = 0.7
"""Share of the photographs with points whose poses must agree; with fewer, the model belongs to other poses."""

TrackSource = Literal["auto", "given", "off"]


def find_feature_rays(scene: SceneFile, training: Sequence[int], source: TrackSource = "auto") -> FeatureRays | None:
    """Return the feature rays of the photographs that train, in input coordinates; None if there are no tracks.

    `training` holds indices of frames. "auto" takes the file of tracks that the json names, else a COLMAP model in the
    scene's folder, which gives a warning and None if it cannot be used. "given": only the file; "off": None.

    Raises:
        SceneError: The file that the json names cannot be used, or does not fit the poses.
    """
    frames = [scene.frames[index] for index in training]
    if source == "off":
        return None
    if TRACKS_KEY in scene.meta:
        path = scene.folder / str(scene.meta[TRACKS_KEY])
        return feature_rays(read_tracks(path), frames, path.name)
    try:
        found = read_colmap_tracks(scene) if source == "auto" else None
        remedy = "Give it the photographs and poses of the json, or move it away."
        return None if found is None else feature_rays(found, frames, "its tracks", remedy)
    except SceneError as problem:
        said = f"the COLMAP model in the scene's folder is not used, training does without: {problem}"
        CONSOLE.print(f"Tracks: {said} (--tracks off goes without and without this warning)", style="bold yellow")
        return None


def read_colmap_tracks(scene: SceneFile) -> SparseTracks | None:
    """Return the tracks of the COLMAP model in a scene's folder, in input coordinates; None if there is no model.

    Photographs are matched by name. The json's poses must be in the model's world, or in one of `worlds_of_json`. Two
    poses of a photograph agree if points appear less than `MOST_OFF_PX` apart from both (median). Sightings of
    photographs whose poses do not agree are left out, and these photographs are printed.

    Raises:
        SceneError: The model is damaged, is not of these photographs, or too few of its poses agree.
    """
    folder = next((name for name in COLMAP_FOLDERS if is_model(scene.folder / name)), None)
    if folder is None:
        return None
    model = read_model(scene.folder / folder)
    if any(point.error < 0.0 for point in model.points3D.values()):  # not computed
        model.update_point_3d_errors()
    images = [image for image in model.images.values() if image.has_pose]
    pairs = _matched([image.name for image in images], [frame.name for frame in scene.frames])
    if not pairs:
        there, here = next((image.name for image in images), "none"), scene.frames[0].name
        names = f"such as {there} there and {here} here"
        raise SceneError(f"it has no photograph of this scene, or several of one name ({names})")
    images, frames = [images[image] for image, _ in pairs], [scene.frames[frame] for _, frame in pairs]
    if not all(camera.width for camera in model.cameras.values()):
        raise SceneError("it has a camera whose photographs are 0 pixels wide")
    number = {image.image_id: place for place, image in enumerate(images)}
    points = np.array([point.xyz for point in model.points3D.values()], dtype=np.float64).reshape(-1, 3)
    seen = [
        (place, number[element.image_id])
        for place, one in enumerate(model.points3D.values())
        for element in one.track.elements
        if element.image_id in number
    ]
    if not seen:
        raise SceneError("it has no points that photographs of this scene see")
    # A track may hold two features of one photograph.
    point, frame = np.unique(np.array(seen, dtype=np.int64), axis=0).T
    widths = [f.intrinsics.width / model.cameras[image.camera_id].width for f, image in zip(frames, images)]
    error_px = np.array([one.error for one in model.points3D.values()], dtype=np.float64) * float(np.median(widths))
    poses = np.stack(list(map(camera_to_world, images)))
    tried = []
    for world in worlds_of_json(scene.meta):
        moved = points @ world[:3, :3].T + world[:3, 3]
        tried.append((moved, _off_px(frames, world @ poses, moved, frame, point)))
    moved, off_px = min(tried, key=lambda one: np.nanmedian(one[1]))
    agree = off_px <= MOST_OFF_PX  # NaN, of a photograph that sees nothing, is False
    seeing = int(np.isfinite(off_px).sum())
    if agree.sum() < max(3, LEAST_AGREEING * seeing):
        raise SceneError(
            f"its poses are others than those of {scene.json_path.name}: {int(agree.sum())} of {seeing} photographs "
            f"agree within {MOST_OFF_PX:g} pixels (median {np.nanmedian(off_px):.1f})"
        )
    CONSOLE.print(
        f"Tracks of the COLMAP model in {folder}: {len(points):,} points, {int(agree.sum())} of {len(scene.frames)} "
        f"photographs, whose poses agree within {np.median(off_px[agree]):.2f} pixels (median)."
    )
    strays = [one.name for one, good, off in zip(frames, agree, off_px) if not good and np.isfinite(off)]
    if strays:
        CONSOLE.print(f"Tracks: other poses than COLMAP's, left out: {', '.join(strays)}", style="bold yellow")
    kept = agree[frame]
    return SparseTracks(moved, error_px, tuple(one.name for one in frames), frame[kept], point[kept])


def _matched(images: Sequence[str], frames: Sequence[str]) -> list[tuple[int, int]]:
    """Return the pairs (image, frame) of indices that belong to the same photograph: the frame's name ends with the
    image's, folders included. The longest such image is taken; images that then belong to several frames are left out.
    """
    number = {image: place for place, image in enumerate(images)}
    pairs = []
    for place, frame in enumerate(frames):
        parts = PurePosixPath(frame).parts
        endings = ("/".join(parts[first:]) for first in range(len(parts)))
        pairs += [(number[ending], place) for ending in endings if ending in number][:1]
    once = Counter(image for image, _ in pairs)
    return [pair for pair in pairs if once[pair[0]] == 1]


def _off_px(
    frames: Sequence[Frame], poses: FloatArray, points: FloatArray, frame: IntArray, point: IntArray
) -> FloatArray:
    """Return how far apart (median) a frame's points appear from its own pose and from its pose in `poses` (n, 4, 4).

    Sighting number s is: frame `frame[s]` sees `points[point[s]]`. The result, shape (frames,), is in pixels; NaN for a
    frame that sees nothing.
    """
    seen = []
    for stands in (poses, np.stack([one.pose for one in frames])):
        line = np.einsum("sji,sj->si", stands[frame, :3, :3], points[point] - stands[frame, :3, 3])
        seen.append(line / np.maximum(np.linalg.norm(line, axis=1), 1e-300)[:, None])
    focal = np.array([min(one.intrinsics.fl_x, one.intrinsics.fl_y) for one in frames])
    off = np.linalg.norm(seen[0] - seen[1], axis=1) * focal[frame]
    median = np.full(len(frames), np.nan)
    for number in np.unique(frame):
        median[number] = np.median(off[frame == number])
    return median
