"""Tracks of structure from motion: their file, a COLMAP model beside a scene, and the feature rays they give."""

from __future__ import annotations

import io
import struct
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.core.checks import remedy_of, replace_when_done
from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.core.feature_rays import FeatureRays, agrees_with_neighbours
from thermoxels_ns.data.scene_file import Frame

TRACKS_KEY = "tracks_file_path"  # name in transforms.json under which the file of tracks is given
FEWEST_VIEWS = 3  # photographs that must see a point: two agree about many wrong ones
MOST_ERROR_PX = 2.0  # mean reprojection error above which a point is left out
LEAST_ERROR_PX = 0.3  # error that a point has at least: what three photographs agree on more closely agrees by luck
LEAST_PARALLAX_DEG = 2.0  # largest angle between the rays of a point below which its distance is not known
MOST_BEHIND = 0.1  # share of sightings behind their camera above which tracks belong to other poses
_REMEDY = f"Write the scene again with thermoxels capture, or remove {TRACKS_KEY} from the json to train without it."

COLMAP_FOLDERS = ("colmap/sparse/0", "colmap/sparse", "colmap", "sparse/0", "sparse")
"""Where a model may lie in a scene's folder, the first that does counts."""

_LEAST_CAMERA_BYTES = 48  # of a camera with three parameters; others have more
_LAYOUT = {"frames": (64, "<I", 16), "images": (64, "<Q", 24), "points3D": (43, "<Q", 8)}
"""Bytes of an entry before the number of its parts (of an image: before its name), that number, bytes of each part."""


@dataclass(frozen=True, eq=False)
class SparseTracks:
    """Points and the photographs that see them; the content of a file of tracks, arrays by these names."""

    points: FloatArray  # shape (n, 3), in the coordinates of the poses
    point_error_px: FloatArray  # mean reprojection error of each point, shape (n,), [pixels of the photographs]
    frames: tuple[str, ...]  # ``file_path`` of the photographs, as transforms.json has it
    sighting_frame: IntArray
    sighting_point: IntArray  # indices into `frames` and `points`, each shape (s,)


def write_tracks(path: Path, tracks: SparseTracks) -> None:
    """Write tracks as a compressed .npz."""
    packed = io.BytesIO()  # numpy complains of a half-made file when it is closed later
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
    """Read and check a file of tracks; a `SceneError` where it is missing, no such file, or contradicts itself."""
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
    """Return the rays from frames (at least one) to the points that they see and whose place is well known.

    A point counts if at least `FEWEST_VIEWS` of the frames see it, more than `LEAST_PARALLAX_DEG` apart, with a mean
    reprojection error of at most `MOST_ERROR_PX`. A point that does not agree with its neighbours in the frames
    (`agrees_with_neighbours`) is listed without rays: wrong rays would make air of walls. The standard error of a
    ray's length is that of a triangulation: the error in the image, over the focal length and the sine of that angle,
    times the length.

    Raises:
        SceneError: None of the frames is in the tracks, or the tracks belong to other poses.
    """
    place = {frame.name: number for number, frame in enumerate(frames)}
    number = np.array([place.get(known, -1) for known in tracks.frames], dtype=np.int64)
    if not (number >= 0).any():
        got = f"{len(tracks.frames)} others, such as {', '.join(tracks.frames[:2]) or 'none'}"
        raise SceneError(name, expected="photographs of this scene", got=got, remedy=remedy)
    known = np.isfinite(tracks.points).all(axis=1) & (tracks.point_error_px <= MOST_ERROR_PX)
    known &= tracks.point_error_px >= 0.0  # COLMAP writes -1 for an error that it did not compute
    used = (number[tracks.sighting_frame] >= 0) & known[tracks.sighting_point]
    # Sorted by point, each pair once: a photograph that sees a point twice is still one that sees it.
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
    """Return twice the largest angle between each point's directions and their mean, shape (count,), [radians]."""
    mean = np.stack([np.bincount(point, directions[:, axis], count) for axis in range(3)], axis=1)
    mean /= np.maximum(np.linalg.norm(mean, axis=1), 1e-300)[:, None]
    off = np.zeros(count)
    across = np.linalg.norm(np.cross(directions, mean[point]), axis=1)
    np.maximum.at(off, point, np.arctan2(across, (directions * mean[point]).sum(axis=1)))
    return 2.0 * off


def read_model(folder: Path) -> Any:
    """Read the COLMAP model in a folder as a `pycolmap.Reconstruction`; a `SceneError` where a file is not whole."""
    import pycolmap  # slow to import and only needed here

    check_complete(folder)
    try:
        return pycolmap.Reconstruction(str(folder))
    except Exception as problem:  # pycolmap raises RuntimeError, ValueError, IndexError by version
        raise SceneError(f"it cannot be read, {(str(problem).strip() or repr(problem)).splitlines()[-1]}") from problem


def camera_to_world(image: Any) -> FloatArray:
    """Return the pose (4, 4) of a pycolmap image, its camera axes as in transforms.json: x right, y up, z back."""
    pose = np.eye(4)
    pose[:3] = image.cam_from_world().inverse().matrix()
    return pose @ np.diag([1.0, -1.0, -1.0, 1.0])


def check_complete(folder: Path) -> None:
    """Raise `SceneError` for a file of a model that may not be read, or that ends before what it announces.

    pycolmap says of the first that it is no model, and reads on behind the end of the second, perhaps for ever.
    """
    for name in ("cameras", "frames", "images", "points3D"):
        for path in (folder / f"{name}.txt", folder / f"{name}.bin"):
            if not path.is_file():
                continue
            try:
                with path.open("rb") as file:
                    whole = path.suffix == ".txt" or _complete(name, file.read())
            except OSError as problem:
                said = f"it cannot be read, {path.name}: {problem.strerror}; check its permissions and the disk"
                raise SceneError(said) from problem
            if not whole:
                said = f"{path.name} ends before its last entry, as after an interrupted copy"
                raise SceneError(f"it cannot be read, {said}")


def _complete(name: str, data: bytes) -> bool:
    try:
        (count,) = struct.unpack_from("<Q", data)
        end = 8
        if name == "cameras":
            return len(data) >= end + count * _LEAST_CAMERA_BYTES
        before, kind, size = _LAYOUT[name]
        for _ in range(count):
            end += before
            if name == "images":
                end = data.index(b"\0", end) + 1
            (parts,) = struct.unpack_from(kind, data, end)
            end += struct.calcsize(kind) + parts * size
    except (struct.error, ValueError):  # a number, or the end of a name, behind the end
        return False
    return end <= len(data)
