"""Tracks of structure from motion, from a COLMAP model, and feature rays from them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.core.feature_rays import FeatureRays, agrees_with_neighbours
from thermoxels_ns.data.colmap_model import COLMAP_FOLDERS, camera_to_world, is_model, matched_names, read_model
from thermoxels_ns.data.scene_file import Frame, SceneFile
from thermoxels_ns.data.transforms_json import read_pose

FEWEST_VIEWS = 3  # photographs that must see a point: two photographs agree on many wrong points
MOST_ERROR_PX = 2.0  # mean reprojection error above which a point is left out, [pixels]
LEAST_ERROR_PX = 0.3  # smaller reprojection errors of points are due to chance and are raised to this, [pixels]
LEAST_PARALLAX_DEG = 2.0  # a point is left out if the largest angle between its rays is not above this
MOST_BEHIND = 0.1  # if a larger share of sightings is behind the camera, the tracks belong to other poses
MOST_OFF = 0.002
"""A photograph is left out if a component of its camera axes in the model differs from the given one by more than this,
or a coordinate of its camera by more than this share of the largest distance of a camera from the cameras' mean."""
LEAST_AGREEING = 0.7  # share of the photographs whose poses must agree; with fewer, the model belongs to other poses
TrackSource = Literal["auto", "off"]


@dataclass(frozen=True, eq=False)
class SparseTracks:
    """Points and the photographs that see each point."""

    points: FloatArray  # shape (n, 3), in the coordinates of the poses
    point_error_px: FloatArray  # mean reprojection error of each point, shape (n,), [pixels of the photographs]
    seen: Mapping[str, IntArray]  # indices into `points`, by the photograph's ``file_path`` in transforms.json
    source: str = "tracks"  # folder of the COLMAP model

    def well_seen(self) -> FloatArray:
        """Return the points (m, 3) that `FEWEST_VIEWS` or more photographs see, with errors up to `MOST_ERROR_PX`."""
        views = np.bincount(np.concatenate([*self.seen.values()]), minlength=len(self.points))
        return self.points[(views >= FEWEST_VIEWS) & (self.point_error_px <= MOST_ERROR_PX)]


def find_tracks(scene: SceneFile, say: Callable[[str], None] = print) -> SparseTracks | None:
    """Return the tracks of the COLMAP model in a scene's folder, in input coordinates; None if there is no model.

    Photographs are matched by name. Their poses in the scene must agree, within `MOST_OFF`, with those in the model
    after the json's ``applied_transform`` if it has one. Photographs whose poses do not agree are left out of the
    tracks, and `say` receives their names. Raises `SceneError` if the model is damaged or is not of these photographs,
    or if too few poses agree.
    """
    folder = next((name for name in COLMAP_FOLDERS if is_model(scene.folder / name)), None)
    if folder is None:
        if "tracks_file_path" in scene.meta:
            raise SceneError("there is none, as an earlier version captured the scene. Capture the scene again.")
        return None
    cameras, images, points = read_model(scene.folder / folder)
    pairs = matched_names([image.name for image in images.values()], [frame.name for frame in scene.frames])
    if not pairs:
        there, here = next((image.name for image in images.values()), "none"), scene.frames[0].name
        names = f"such as {there} there and {here} here"
        raise SceneError(f"it has no photograph of this scene, or several of one name ({names})")
    listed = list(images.values())
    found, frames = [listed[image] for image, _ in pairs], [scene.frames[frame] for _, frame in pairs]
    widths = [f.intrinsics.width / max(cameras[image.camera_id].width, 1) for f, image in zip(frames, found)]
    error_px = np.array([float(one.error) for one in points.values()])
    # COLMAP writes -1 for an error that it did not compute; such a point counts as the worst that is used.
    error_px = np.where(error_px < 0.0, MOST_ERROR_PX, error_px * float(np.median(widths)))
    world = np.eye(4)
    if "applied_transform" in scene.meta:
        world = read_pose(scene.meta["applied_transform"], "applied_transform", turned=False)
    poses, given = world @ np.stack(list(map(camera_to_world, found))), np.stack([one.pose for one in frames])
    spread = np.linalg.norm(given[:, :3, 3] - given[:, :3, 3].mean(axis=0), axis=1).max()
    off = np.abs(((poses - given) / [1.0, 1.0, 1.0, max(spread, 1e-300)])[:, :3]).max(axis=(1, 2))
    agree = off <= MOST_OFF
    if agree.sum() < max(3, LEAST_AGREEING * len(agree)):
        raise SceneError(
            f"its poses are others than those of {scene.json_path.name}: {int(agree.sum())} of {len(agree)} "
            f"photographs agree within {MOST_OFF:.1%} (median {np.median(off):.1%})"
        )
    say(
        f"Tracks of the COLMAP model in {folder}: {len(points):,} points, {int(agree.sum())} of {len(scene.frames)} "
        "photographs."
    )
    if not agree.all():
        strays = ", ".join(one.name for one, good in zip(frames, agree) if not good)
        say(f"Tracks: other poses than COLMAP's, left out: {strays}")
    moved = np.array([one.xyz for one in points.values()]) @ world[:3, :3].T + world[:3, 3]
    row = {point: number for number, point in enumerate(points)}
    # A photograph may show a point by two features.
    shown = [sorted({row[point] for point in image.point3D_ids.tolist() if point in row}) for image in found]
    seen = {f.name: np.array(some, dtype=np.int64) for f, some, good in zip(frames, shown, agree) if good}
    if not any(map(len, seen.values())):
        raise SceneError("it has no points that photographs of this scene see")
    return SparseTracks(moved, error_px, seen, folder)


def feature_rays(tracks: SparseTracks, frames: Sequence[Frame]) -> FeatureRays:
    """Return the feature rays from `frames` (at least one) to the points in `tracks` whose positions are well known.

    A point is used if at least `FEWEST_VIEWS` frames see it, from directions more than `LEAST_PARALLAX_DEG` apart, with
    a mean reprojection error of at most `MOST_ERROR_PX`. A used point that does not agree with its neighbours
    (`agrees_with_neighbours`) is kept without rays, because wrong rays would turn walls into air. The standard error of
    a ray's length is that of triangulation: length * reprojection error / focal length / sine of the angle.
    Raises `SceneError` if no frame is in `tracks`, or if `tracks` belong to other poses.
    """
    seen = [tracks.seen.get(one.name, np.zeros(0, dtype=np.int64)) for one in frames]
    point, frame = np.concatenate(seen), np.repeat(np.arange(len(frames)), [len(some) for some in seen])
    if not len(point):
        raise SceneError("it has no photograph that trains")
    known = np.isfinite(tracks.points).all(axis=1) & (tracks.point_error_px <= MOST_ERROR_PX)
    order = np.argsort(point, kind="stable")
    order = order[known[point[order]]]
    point, frame = point[order], frame[order]
    poses = np.stack([one.pose for one in frames])
    focal = np.array([min(one.intrinsics.fl_x, one.intrinsics.fl_y) for one in frames])
    line = tracks.points[point] - poses[frame, :3, 3]
    behind = (line * -poses[frame, :3, 2]).sum(axis=1) <= 0.0
    if behind.sum() > MOST_BEHIND * len(behind):
        raise SceneError(f"{behind.mean():.0%} of its points lie behind the photographs that see them")
    frame, point, line = frame[~behind], point[~behind], line[~behind]
    length = np.linalg.norm(line, axis=1)
    angle = _parallax(line / np.maximum(length, 1e-300)[:, None], point, len(tracks.points))
    views = np.bincount(point, minlength=len(tracks.points))
    good = (views >= FEWEST_VIEWS) & (angle > np.radians(LEAST_PARALLAX_DEG))
    chosen, renumbered = good[point], np.cumsum(good) - 1
    frame, point, length = frame[chosen], point[chosen], length[chosen]
    error_px = np.maximum(tracks.point_error_px[point], LEAST_ERROR_PX)
    error = error_px / focal[frame] / np.sin(np.minimum(angle[point], np.pi / 2))
    found = FeatureRays(poses[frame, :3, 3], renumbered[point], tracks.points[good], error * length)
    return found.of_points(agrees_with_neighbours(found))


def _parallax(directions: FloatArray, point: IntArray, count: int) -> FloatArray:
    """Return, for each of `count` points, twice the largest angle between its directions and their mean [radians]. The
    unit `directions` (n, 3) belong to the points with the indices `point` (n,). A point without directions gets 0."""
    mean = np.stack([np.bincount(point, directions[:, axis], count) for axis in range(3)], axis=1)
    mean /= np.maximum(np.linalg.norm(mean, axis=1), 1e-300)[:, None]
    off = np.zeros(count)
    across = np.linalg.norm(np.cross(directions, mean[point]), axis=1)
    np.maximum.at(off, point, np.arctan2(across, (directions * mean[point]).sum(axis=1)))
    return 2.0 * off
