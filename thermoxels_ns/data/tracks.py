"""Tracks of structure from motion: their file, and feature rays from tracks."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.core.checks import remedy_of, replace_when_done
from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.core.feature_rays import FeatureRays, agrees_with_neighbours
from thermoxels_ns.data.scene_file import Frame

TRACKS_KEY = "tracks_file_path"  # key of transforms.json that names the file of tracks
FEWEST_VIEWS = 3  # photographs that must see a point: two photographs agree on many wrong points
MOST_ERROR_PX = 2.0  # mean reprojection error above which a point is left out, [pixels]
LEAST_ERROR_PX = 0.3  # a smaller reprojection error of a point is due to luck and is raised to this, [pixels]
LEAST_PARALLAX_DEG = 2.0  # a point is left out if the largest angle between its rays is not above this
MOST_BEHIND = 0.1  # if a larger share of sightings lies behind the camera, the tracks belong to other poses
_REMEDY = f"Write the scene again with thermoxels capture, or remove {TRACKS_KEY} from the json to train without it."


@dataclass(frozen=True, eq=False)
class SparseTracks:
    """Points and the photographs that see each point: the arrays in a file of tracks, by these names."""

    points: FloatArray  # shape (n, 3), in the coordinates of the poses
    point_error_px: FloatArray  # mean reprojection error of each point, shape (n,), [pixels of the photographs]
    frames: tuple[str, ...]  # names of photographs, as ``file_path`` in transforms.json
    sighting_frame: IntArray  # index into `frames` of each sighting, shape (s,)
    sighting_point: IntArray  # index into `points` of each sighting, shape (s,)


def write_tracks(path: Path, tracks: SparseTracks) -> None:
    """Write tracks to a compressed .npz file, whole or not at all; raises `OutputError` if it cannot be written."""
    packed = io.BytesIO()  # numpy warns of a file whose writing was interrupted
    np.savez_compressed(
        packed,
        points=tracks.points,
        point_error_px=tracks.point_error_px.astype(np.float32),
        frames=np.array(tracks.frames, dtype=np.str_),
        sighting_frame=tracks.sighting_frame.astype(np.int32),
        sighting_point=tracks.sighting_point.astype(np.int32),
    )
    with replace_when_done(path) as temporary:
        temporary.write_bytes(packed.getbuffer())


def read_tracks(path: Path) -> SparseTracks:
    """Read and check a file of tracks, or raise `SceneError` if it is missing, of another kind or inconsistent."""
    names = ("points", "point_error_px", "frames", "sighting_frame", "sighting_point")
    try:
        with np.load(path, allow_pickle=False) as file:
            points, error, frames, frame, point = (file[name] for name in names)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, AttributeError, TypeError) as problem:
        expected = f"an .npz with {', '.join(names)}"
        raise SceneError(path.name, expected=expected, got=problem, remedy=remedy_of(problem, _REMEDY)) from problem
    kinds = "".join(array.dtype.kind for array in (points, error, frames, frame, point))
    good = kinds == "ffUii" and (points.ndim, frames.ndim, frame.ndim) == (2, 1, 1)
    good = good and points.shape[1] == 3 and error.shape == points.shape[:1] and frame.shape == point.shape
    good = good and all(
        ((one >= 0) & (one < count)).all() for one, count in ((frame, len(frames)), (point, len(points)))
    )
    if not good:
        arrays = (points, error, frames, frame, point)
        shapes = ", ".join(f"{name} {array.dtype}{array.shape}" for name, array in zip(names, arrays))
        raise SceneError(path.name, expected="points, frames and pairs of their numbers", got=shapes, remedy=_REMEDY)
    places = points.astype(np.float64), error.astype(np.float64)
    return SparseTracks(*places, tuple(map(str, frames)), frame.astype(np.int64), point.astype(np.int64))


def feature_rays(
    tracks: SparseTracks, frames: Sequence[Frame], name: str = "tracks", remedy: str = _REMEDY
) -> FeatureRays:
    """Return the feature rays from `frames` (at least one) to the points in `tracks` whose places are well known.

    A point counts if at least `FEWEST_VIEWS` frames see it, from directions more than `LEAST_PARALLAX_DEG` apart, with
    a mean reprojection error of at most `MOST_ERROR_PX`. A counting point that does not agree with its neighbours
    (`agrees_with_neighbours`) is kept without rays, as wrong rays would turn walls into air. The standard error of a
    ray's length is that of triangulation: reprojection error / focal length / sine of the angle, times the length.

    Raises:
        SceneError: No frame is in `tracks`, or `tracks` are of other poses; the message has `name` and `remedy`.
    """
    place = {frame.name: number for number, frame in enumerate(frames)}
    number = np.array([place.get(known, -1) for known in tracks.frames], dtype=np.int64)
    if not (number >= 0).any():
        got = f"{len(tracks.frames)} others, such as {', '.join(tracks.frames[:2]) or 'none'}"
        raise SceneError(name, expected="photographs of this scene", got=got, remedy=remedy)
    known = np.isfinite(tracks.points).all(axis=1) & (tracks.point_error_px <= MOST_ERROR_PX)
    known &= tracks.point_error_px >= 0.0  # COLMAP writes -1 for an error that it did not compute
    used = (number[tracks.sighting_frame] >= 0) & known[tracks.sighting_point]
    # Sorted by point, each pair once: a photograph that sees a point twice counts once.
    pairs = np.unique(tracks.sighting_point[used] * len(frames) + number[tracks.sighting_frame[used]])
    point, frame = np.divmod(pairs, len(frames))
    poses = np.stack([one.pose for one in frames])
    focal = np.array([min(one.intrinsics.fl_x, one.intrinsics.fl_y) for one in frames])
    line = tracks.points[point] - poses[frame, :3, 3]
    behind = (line * -poses[frame, :3, 2]).sum(axis=1) <= 0.0
    if behind.sum() > MOST_BEHIND * len(behind):
        expected = "points in front of the photographs that see them"
        got = f"{behind.mean():.0%} of the sightings behind: the poses are others"
        raise SceneError(name, expected=expected, got=got, remedy=remedy)
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
    """Return twice the largest angle between a point's directions and their mean, shape (count,), [radians]."""
    mean = np.stack([np.bincount(point, directions[:, axis], count) for axis in range(3)], axis=1)
    mean /= np.maximum(np.linalg.norm(mean, axis=1), 1e-300)[:, None]
    off = np.zeros(count)
    across = np.linalg.norm(np.cross(directions, mean[point]), axis=1)
    np.maximum.at(off, point, np.arctan2(across, (directions * mean[point]).sum(axis=1)))
    return 2.0 * off
