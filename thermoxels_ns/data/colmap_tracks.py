"""Feature rays of a scene, from its file of tracks or a COLMAP model."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import numpy as np
from nerfstudio.utils.rich_utils import CONSOLE

from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.core.feature_rays import FeatureRays, FloatArray, IntArray
from thermoxels_ns.data.scene_file import Frame, SceneFile
from thermoxels_ns.data.tracks import (
    COLMAP_FOLDERS,
    TRACKS_KEY,
    SparseTracks,
    camera_to_world,
    feature_rays,
    read_model,
    read_tracks,
)
from thermoxels_ns.data.transforms_json import path_inside

MOST_OFF_PX = 2.0
"""Median distance in a photograph between points as the model's pose and as the given one sees them, above which the
photograph is left out."""
LEAST_AGREEING = 0.7
"""Share of the photographs in common whose poses must agree; with fewer the model belongs to other poses."""
_PARTS = ("cameras", "images", "points3D")
_ROUNDS = 20
_FEWEST = 3  # cameras from which a similarity is found; fewer cannot outvote a wrong one
_STRAY = 5.0  # medians of the misfit above which a camera takes no part in the last fit

TrackSource = Literal["auto", "given", "off"]


def find_feature_rays(scene: SceneFile, training: Sequence[int], source: TrackSource = "auto") -> FeatureRays | None:
    """The feature rays of the photographs that train, in input coordinates; None where the scene has no tracks.

    The source "auto" is the file that the json names, else a COLMAP model in the scene's folder; "given" only the file.
    What photographs see that do not train is not used.

    Raises:
        SceneError: The file that the json names lies outside the scene, cannot be used, or does not fit the poses. A
            COLMAP model that does not is left out with a warning: nobody asked for it.
    """
    frames = [scene.frames[index] for index in training]
    if source == "off":
        return None
    if TRACKS_KEY in scene.meta:
        path = path_inside(scene.folder, str(scene.meta[TRACKS_KEY]), f"transforms.json: {TRACKS_KEY}")
        return feature_rays(read_tracks(path), frames, path.name)
    found = read_colmap_tracks(scene) if source == "auto" else None
    if found is None:
        return None
    remedy = "Give it the photographs and poses of the json, or move it away."
    try:
        return feature_rays(found, frames, "its tracks", remedy)
    except SceneError as problem:
        warn_unused("the scene's folder", str(problem))
        return None


def read_colmap_tracks(scene: SceneFile) -> SparseTracks | None:
    """Read the tracks of the COLMAP model in a scene's folder, if any, and bring them to the scene's poses.

    Photographs are matched by name. The similarity between the model's cameras and the json's poses moves the points;
    what it leaves is measured in the photographs: how far apart a point is seen from the model's pose and from the
    given one. Photographs that do not agree are left out; without enough that do the model is not used, and a warning
    says why.
    """
    folder = _model_folder(scene.folder)
    if folder is None:
        return None
    try:
        return _tracks(scene, folder)
    except SceneError as problem:
        warn_unused(folder, str(problem))
        return None


def warn_unused(folder: str, why: str) -> None:
    """Say that a COLMAP model is not used for tracks."""
    CONSOLE.print(
        f"Tracks: the COLMAP model in {folder} is not used, training does without: {why} "
        "(--tracks off goes without and without this warning)",
        style="bold yellow",
    )


def _model_folder(folder: Path) -> str | None:
    for name in COLMAP_FOLDERS:
        if all(any((folder / name / f"{part}.{suffix}").is_file() for suffix in ("bin", "txt")) for part in _PARTS):
            return name
    return None


def _tracks(scene: SceneFile, folder: str) -> SparseTracks:
    for path in sorted((scene.folder / folder).iterdir()):
        if path.suffix in (".bin", ".txt"):
            path_inside(scene.folder, f"{folder}/{path.name}", f"COLMAP model {folder}")
    model = read_model(scene.folder / folder)
    if any(point.error < 0.0 for point in model.points3D.values()):  # not computed
        model.update_point_3d_errors()
    images = {number: image for number, image in model.images.items() if image.has_pose}
    numbers = list(images)
    pairs = _matched([image.name for image in images.values()], [frame.name for frame in scene.frames])
    if not pairs:
        there, here = next((image.name for image in images.values()), "none"), scene.frames[0].name
        names = f"such as {there} there and {here} here"
        raise SceneError(f"it has no photograph of this scene, or several of one name ({names})")
    frames = [scene.frames[frame] for _, frame in pairs]
    place = {numbers[image]: number for number, (image, _) in enumerate(pairs)}
    source = np.stack([camera_to_world(images[number]) for number in place])
    target = np.stack([frame.pose for frame in frames])
    found = align_poses(source, target)
    if found is None:
        raise SceneError(f"{len(frames)} photographs in common, too few or all at one place: no common world")
    points, error_px, frame, point = _points(model, place)
    if not all(camera.width for camera in model.cameras.values()):
        raise SceneError("it has a camera whose photographs are 0 pixels wide")
    widths = [f.intrinsics.width / model.cameras[images[n].camera_id].width for n, f in zip(place, frames)]
    error_px = error_px * float(np.median(widths))
    moved = found.points(points)
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
    """Numbers of image and frame that are the same photograph, by the name of the file; where several have it, the one
    whose folders too are those of the frame's name, and of more than one such that with most folders.
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


def _points(model: Any, place: dict[int, int]) -> tuple[FloatArray, FloatArray, IntArray, IntArray]:
    """Points (n, 3), their errors (n,) [pixels], and who sees which: two arrays (s,), without repetitions."""
    found = model.points3D.values()
    points = np.array([point.xyz for point in found], dtype=np.float64).reshape(-1, 3)
    error = np.array([point.error for point in found], dtype=np.float64)
    images = [[element.image_id for element in point.track.elements] for point in found]
    point = np.repeat(np.arange(len(images)), [len(seen) for seen in images])
    image = np.array([number for seen in images for number in seen], dtype=np.int64)
    numbers = np.array(sorted(place), dtype=np.int64)  # any numbers: some programs count from thousands of millions
    frame_of = np.array([place[number] for number in numbers.tolist()], dtype=np.int64)
    at = np.minimum(np.searchsorted(numbers, image), len(numbers) - 1)
    known = numbers[at] == image
    frame = frame_of[at]
    # A track may hold two features of one photograph.
    pairs = np.unique(point[known] * max(1, len(place)) + frame[known])
    return points, error, pairs % max(1, len(place)), pairs // max(1, len(place))


def _off_px(
    frames: Sequence[Frame],
    model: tuple[FloatArray, ...],
    given: tuple[FloatArray, ...],
    frame: IntArray,
    point: IntArray,
) -> FloatArray:
    """Median angle, times the focal length, between a frame's points as its two poses see them, shape (frames,)."""
    seen = []
    for poses, points in (model, given):
        line = np.einsum("sji,sj->si", poses[frame, :3, :3], points[point] - poses[frame, :3, 3])
        seen.append(line / np.maximum(np.linalg.norm(line, axis=1), 1e-300)[:, None])
    focal = np.array([min(one.intrinsics.fl_x, one.intrinsics.fl_y) for one in frames])
    off = np.linalg.norm(seen[0] - seen[1], axis=1) * focal[frame]
    order = np.lexsort((off, frame))
    counts = np.bincount(frame, minlength=len(frames))
    middle = np.cumsum(counts) - counts + counts // 2
    median = np.full(len(frames), np.nan)
    median[counts > 0] = off[order][middle[counts > 0]]
    return median


@dataclass(frozen=True, eq=False)
class Similarity:
    """Brings points of one world into another: scale * rotation p + translation."""

    rotation: FloatArray
    translation: FloatArray  # shapes (3, 3) and (3,)
    scale: float

    def points(self, points: FloatArray) -> FloatArray:
        """Move points, shape (n, 3)."""
        return self.scale * points @ self.rotation.T + self.translation


def align_poses(source: FloatArray, target: FloatArray) -> Similarity | None:
    """Find the similarity that brings cameras to world of one world, shape (n, 4, 4), to the same ones in another.

    The rotation is that between the cameras' axes, so that cameras on one line will do; scale and translation fit the
    centres in the least squares. The half of the cameras that fits worst is left out and the fit repeated until the
    half stays the same (least trimmed squares), so that some wrong poses do not move the others. None where the cameras
    are fewer than three or at one place.
    """
    if len(source) < _FEWEST:
        return None
    used = np.ones(len(source), dtype=bool)
    found = None
    for number in range(_ROUNDS):
        found = _fit(source[used], target[used])
        if found is None:
            return None
        misfit = _misfit(found, source, target)
        middle = float(np.sort(misfit)[max(_FEWEST, (len(misfit) + 1) // 2) - 1])
        best = misfit <= max(middle, 1e-12)
        if number and (best == used).all():
            break
        used = best
    used = misfit <= _STRAY * max(middle, 1e-12)
    return _fit(source[used], target[used])


def _fit(source: FloatArray, target: FloatArray) -> Similarity | None:
    # Sum of the rotations from source to target; the nearest rotation to it is their chordal mean.
    turns = np.einsum("nij,nkj->ik", target[:, :3, :3], source[:, :3, :3])
    left, _, right = np.linalg.svd(turns)
    rotation = left @ np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))]) @ right
    centres, wanted = source[:, :3, 3] @ rotation.T, target[:, :3, 3]
    middle, wanted_middle = centres.mean(axis=0), wanted.mean(axis=0)
    spread = np.square(centres - middle).sum()
    scale = ((centres - middle) * (wanted - wanted_middle)).sum() / max(spread, 1e-300)
    if not (np.isfinite(scale) and scale > 0.0 and spread > 1e-18 * max(np.square(centres).sum(), 1e-300)):
        return None
    return Similarity(rotation, wanted_middle - scale * middle, float(scale))


def _misfit(found: Similarity, source: FloatArray, target: FloatArray) -> FloatArray:
    """Of each camera: distance between the centres over the spread of all, and angle between the axes [radians]."""
    wanted = target[:, :3, 3]
    spread = np.median(np.linalg.norm(wanted - np.median(wanted, axis=0), axis=1))
    off = np.linalg.norm(found.points(source[:, :3, 3]) - wanted, axis=1) / max(spread, 1e-300)
    turned = found.rotation @ source[:, :3, :3]
    # |A - B| of rotations is 2 sqrt(2) sin(angle / 2).
    chord = np.linalg.norm(turned - target[:, :3, :3], axis=(1, 2))
    return off + 2.0 * np.arcsin(np.minimum(chord / np.sqrt(8.0), 1.0))
