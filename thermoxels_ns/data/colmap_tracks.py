"""Feature rays of a scene, from its file of tracks or from a COLMAP model in its folder."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import PurePosixPath
from typing import Literal

import numpy as np
from nerfstudio.utils.rich_utils import CONSOLE
from scipy.spatial.transform import Rotation

from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.core.feature_rays import FeatureRays
from thermoxels_ns.data.colmap_model import COLMAP_FOLDERS, camera_to_world, is_model, read_model
from thermoxels_ns.data.scene_file import Frame, SceneFile
from thermoxels_ns.data.tracks import TRACKS_KEY, SparseTracks, feature_rays, read_tracks
from thermoxels_ns.data.transforms_json import path_inside

MOST_OFF_PX = 2.0
"""A photograph is left out if points seen from the model's pose and from the given pose are farther apart than this
(median over its points)."""
LEAST_AGREEING = 0.7
"""Share of the photographs with points whose poses must agree; with fewer, the model belongs to other poses."""
_ROUNDS = 20  # most rounds of `align_poses`
_FEWEST = 3  # least number of cameras for a similarity; fewer cannot outvote a wrong pose
_STRAY = 5.0  # a camera whose misfit is above so many medians takes no part in the last fit

TrackSource = Literal["auto", "given", "off"]


def find_feature_rays(scene: SceneFile, training: Sequence[int], source: TrackSource = "auto") -> FeatureRays | None:
    """Return the feature rays of the photographs that train, in input coordinates; None if there are no tracks.

    `training` holds indices of frames. "auto" takes the file of tracks that the json names, else a COLMAP model in the
    scene's folder, which gives a warning and None if it cannot be used. "given": only the file; "off": None.

    Raises:
        SceneError: The file that the json names lies outside the scene, cannot be used, or does not fit the poses.
    """
    frames = [scene.frames[index] for index in training]
    if source == "off":
        return None
    if TRACKS_KEY in scene.meta:
        path = path_inside(scene.folder, str(scene.meta[TRACKS_KEY]), f"transforms.json: {TRACKS_KEY}")
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

    Photographs are matched by name. Points are moved by the similarity from the model's cameras to the json's poses.
    Two poses of a photograph agree if points appear less than `MOST_OFF_PX` apart from both (median). Sightings of
    photographs whose poses do not agree are left out, and these photographs are printed.

    Raises:
        SceneError: The model is damaged, is not of these photographs, or too few of its poses agree.
    """
    folder = next((name for name in COLMAP_FOLDERS if is_model(scene.folder / name)), None)
    if folder is None:
        return None
    for path in sorted((scene.folder / folder).iterdir()):
        if path.suffix in (".bin", ".txt"):
            path_inside(scene.folder, f"{folder}/{path.name}", f"COLMAP model {folder}")
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
    source, target = np.stack(list(map(camera_to_world, images))), np.stack([frame.pose for frame in frames])
    similarity = align_poses(source, target)
    if similarity is None:
        raise SceneError(f"{len(frames)} photographs in common, too few or all at one place: no common world")
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
    # A track may hold two features of one photograph.
    point, frame = np.unique(np.array(seen, dtype=np.int64).reshape(-1, 2), axis=0).T
    widths = [f.intrinsics.width / model.cameras[image.camera_id].width for f, image in zip(frames, images)]
    error_px = np.array([one.error for one in model.points3D.values()], dtype=np.float64) * float(np.median(widths))
    moved = points @ similarity[:3, :3].T + similarity[:3, 3]
    off_px = _off_px(frames, (source, points), (target, moved), frame, point)
    agree = off_px <= MOST_OFF_PX  # NaN, of a photograph that sees nothing, is False
    seeing = int(np.isfinite(off_px).sum())
    if seeing == 0:
        raise SceneError("it has no points that photographs of this scene see")
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
    """Return the pairs (image, frame) of indices that belong to the same photograph, matched by file name.

    If several images or frames have the same file name, the frame's name must end with the image's name, folders
    included, and the longest such image is taken. Images that then belong to several frames are left out.
    """
    of_name: dict[str, list[int]] = {}
    for number, image in enumerate(images):
        of_name.setdefault(PurePosixPath(image).name, []).append(number)
    shared = Counter(PurePosixPath(frame).name for frame in frames)
    pairs = []
    for number, frame in enumerate(frames):
        name = PurePosixPath(frame).name
        found = of_name.get(name, [])
        if len(found) > 1 or shared[name] > 1:
            found = [one for one in found if frame == images[one] or frame.endswith(f"/{images[one]}")]
            longest = max((len(images[one]) for one in found), default=0)
            found = [one for one in found if len(images[one]) == longest]
        if len(found) == 1:
            pairs.append((found[0], number))
    once = Counter(image for image, _ in pairs)
    return [pair for pair in pairs if once[pair[0]] == 1]


def _off_px(
    frames: Sequence[Frame],
    model: tuple[FloatArray, ...],
    given: tuple[FloatArray, ...],
    frame: IntArray,
    point: IntArray,
) -> FloatArray:
    """Return how far apart points appear from a frame's two poses, (frames,), [pixels]; NaN for a frame without any."""
    seen = []
    for poses, points in (model, given):
        line = np.einsum("sji,sj->si", poses[frame, :3, :3], points[point] - poses[frame, :3, 3])
        seen.append(line / np.maximum(np.linalg.norm(line, axis=1), 1e-300)[:, None])
    focal = np.array([min(one.intrinsics.fl_x, one.intrinsics.fl_y) for one in frames])
    off = np.linalg.norm(seen[0] - seen[1], axis=1) * focal[frame]
    median = np.full(len(frames), np.nan)
    for number in np.unique(frame):
        median[number] = np.median(off[frame == number])
    return median


def align_poses(source: FloatArray, target: FloatArray) -> FloatArray | None:
    """Return the similarity (4, 4) that brings camera poses `source` (n, 4, 4) of one world to `target` of another.

    The rotation is the mean of the rotations between the cameras' axes, so that cameras on one line suffice. Scale and
    translation fit the centres by least squares. The worse half of the cameras is left out and the fit repeated until
    that half stays the same (least trimmed squares), so that single wrong poses do not matter. The last fit uses all
    cameras but strays (`_STRAY`). Return None for fewer than three cameras, or if all stand at one place.
    """
    if len(source) < _FEWEST:
        return None
    used = np.ones(len(source), dtype=bool)
    for number in range(_ROUNDS):
        similarity = _fit(source[used], target[used])
        if similarity is None:
            return None
        misfit = _misfit(similarity, source, target)
        middle = float(np.sort(misfit)[max(_FEWEST, (len(misfit) + 1) // 2) - 1])
        best = misfit <= max(middle, 1e-12)
        if number and (best == used).all():
            break
        used = best
    used = misfit <= _STRAY * max(middle, 1e-12)
    return _fit(source[used], target[used])


def _fit(source: FloatArray, target: FloatArray) -> FloatArray | None:
    rotation = Rotation.from_matrix(target[:, :3, :3] @ source[:, :3, :3].transpose(0, 2, 1)).mean().as_matrix()
    centres, wanted = source[:, :3, 3] @ rotation.T, target[:, :3, 3]
    middle, wanted_middle = centres.mean(axis=0), wanted.mean(axis=0)
    spread = np.square(centres - middle).sum()
    scale = ((centres - middle) * (wanted - wanted_middle)).sum() / max(spread, 1e-300)
    if not (np.isfinite(scale) and scale > 0.0 and spread > 1e-18 * max(np.square(centres).sum(), 1e-300)):
        return None
    similarity = np.eye(4)
    similarity[:3, :3], similarity[:3, 3] = scale * rotation, wanted_middle - scale * middle
    return similarity


def _misfit(similarity: FloatArray, source: FloatArray, target: FloatArray) -> FloatArray:
    """Return per camera the distance of its centres, relative to the spread of all, plus the angle [radians], (n,)."""
    moved, wanted = similarity @ source, target[:, :3, 3]
    spread = np.median(np.linalg.norm(wanted - np.median(wanted, axis=0), axis=1))
    off = np.linalg.norm(moved[:, :3, 3] - wanted, axis=1) / max(spread, 1e-300)
    axes = moved[:, :3, :3] / np.cbrt(np.linalg.det(similarity[:3, :3]))
    return off + Rotation.from_matrix(axes.transpose(0, 2, 1) @ target[:, :3, :3]).magnitude()
