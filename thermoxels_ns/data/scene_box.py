"""The box of the voxel lattice: given, or found from points or cameras."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.data.colmap_model import COLMAP_FOLDERS, read_model
from thermoxels_ns.data.scene_file import Frame, SceneFile
from thermoxels_ns.data.transforms_json import read_pose

Box = npt.NDArray[np.float64]
"""Lowest and highest corner, shape (2, 3)."""

_REMEDY = "Pass --scene-box with two corners in the coordinates of the input poses: xmin ymin zmin xmax ymax zmax."
_PERCENTILES = (0.5, 99.5)
_MARGIN = 0.05
_FAR = 10.0
"""Points farther from the median point than this many median distances are strays."""
_MOST_POINTS = 50_000
# The axes that ns-process-data swapped in old versions, before it wrote applied_transform into the json.
_LEGACY_TRANSFORM = np.array([[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0]])


def find_scene_box(
    scene: SceneFile, option: Sequence[Sequence[float]] | None, rotation: npt.NDArray[np.float64]
) -> tuple[Box, str]:
    """Find the scene's box, axis-parallel after the world's `rotation`, and say in words where it came from.

    In order: the option, ``scene_box`` in the json (both in input coordinates), sparse points (``ply_file_path``, or a
    COLMAP model in one of `COLMAP_FOLDERS`), the cameras.

    Raises:
        SceneError: The box has no volume or is not finite, or none can be found.
    """
    if option is not None:
        return _rotated(_checked(option, "scene_box"), rotation), "the option scene_box"
    if "scene_box" in scene.meta:
        name = f"{scene.json_path.name}: scene_box"
        return _rotated(_checked(scene.meta["scene_box"], name), rotation), name
    if "ply_file_path" in scene.meta:
        path = scene.folder / str(scene.meta["ply_file_path"])
        return box_of_points(_read_ply(path) @ rotation.T, scene.frames, rotation), f"the points of {path.name}"
    for folder in COLMAP_FOLDERS:
        if any((scene.folder / folder / f"points3D.{suffix}").is_file() for suffix in ("bin", "txt")):
            points = _read_colmap(folder, scene)
            return box_of_points(points @ rotation.T, scene.frames, rotation), f"the points of {folder}"
    return box_of_cameras(scene.frames, rotation), "the cameras (no scene_box and no sparse points found)"


def box_of_points(points: npt.NDArray[np.float64], frames: Sequence[Frame], rotation: npt.NDArray[np.float64]) -> Box:
    """Enclose sparse points: per axis the 0.5 and 99.5 percentiles, and 5 % of the longest extent more on
    every side (so that a flat scene keeps some depth).

    Points that are not finite, behind every camera, or ten times farther from the median point than the median
    distance are strays of the reconstruction and do not count.
    """
    points = points[np.isfinite(points).all(axis=1)]
    points = points[:: max(len(points) // _MOST_POINTS, 1)]
    if len(points):
        poses = np.stack([rotation @ frame.pose[:3] for frame in frames])
        forward = -poses[:, :, 2]
        depth = points @ forward.T - (forward * poses[:, :, 3]).sum(axis=1)
        points = points[(depth > 0).any(axis=1)]
    if len(points):
        distance = np.linalg.norm(points - np.median(points, axis=0), axis=1)
        points = points[distance <= _FAR * max(np.median(distance), 1e-12)]
    if len(points) < 10:
        expected = "at least 10 points in front of the cameras to find the scene box"
        remedy = _REMEDY
        raise SceneError("sparse points", expected=expected, got=len(points), remedy=remedy)
    low, high = np.percentile(points, _PERCENTILES, axis=0)
    extent = high - low
    margin = _MARGIN * extent.max()
    return _checked(np.stack([low - margin, high + margin]), "box of the sparse points")


def box_of_cameras(frames: Sequence[Frame], rotation: npt.NDArray[np.float64]) -> Box:
    """Guess a cube from the cameras alone: centred where they look, as large as they see there.

    The centre is the point nearest to all optical axes (least squares). Half the side is the median over the cameras
    of distance times the tangent of half the field of view: what an average photograph shows at that distance.
    """
    poses = np.stack([rotation @ frame.pose[:3] for frame in frames])
    axes, origins = -poses[:, :, 2], poses[:, :, 3]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    normal = across.mean(axis=0)
    if np.linalg.eigvalsh(normal)[0] < 1e-3:  # mean squared sine of the angle to a common direction
        raise SceneError("scene box", expected="cameras that look at one place", got="parallel views", remedy=_REMEDY)
    centre = np.linalg.solve(normal, np.einsum("nij,nj->i", across, origins) / len(frames))
    depth = ((centre - origins) * axes).sum(axis=1)
    if np.median(depth) <= 0:
        remedy = _REMEDY
        got = "cameras that look away from each other"
        raise SceneError("scene box", expected="cameras that look at one place", got=got, remedy=remedy)
    half_view = np.array(
        [max(f.intrinsics.width / f.intrinsics.fl_x, f.intrinsics.height / f.intrinsics.fl_y) / 2 for f in frames]
    )
    half = np.median(depth[depth > 0] * half_view[depth > 0])
    return _checked(np.stack([centre - half, centre + half]), "box of the cameras")


def _checked(corners: Any, name: str) -> Box:
    expected = "two corners [[xmin, ymin, zmin], [xmax, ymax, zmax]] with min below max on every axis"
    try:
        box = np.array(corners, dtype=np.float64)
    except (TypeError, ValueError):
        box = np.zeros(0)
    good = box.shape == (2, 3) and np.isfinite(box).all()
    if good:
        sides = box[1] - box[0]
        good = bool((sides > 1e-6 * np.abs(sides).max()).all())
    if not good:
        raise SceneError(name, expected=expected, got=np.asarray(corners).tolist(), remedy=_REMEDY)
    return box


def _rotated(box: Box, rotation: npt.NDArray[np.float64]) -> Box:
    """Axis-parallel hull of a rotated box."""
    centre = rotation @ box.mean(axis=0)
    half = np.abs(rotation) @ (0.5 * (box[1] - box[0]))
    return np.stack([centre - half, centre + half])


def _read_ply(path: Path) -> npt.NDArray[np.float64]:
    """Read the x, y, z of a .ply (ASCII or binary); it is in the coordinates of the json."""
    import trimesh  # slow to import and only needed here

    if not path.is_file():
        raise SceneError("ply_file_path", expected=f"a file at {path}", got="nothing there", remedy=_REMEDY)
    try:
        loaded: Any = trimesh.load(path)
        points = np.asarray(loaded.vertices, dtype=np.float64).reshape(-1, 3)
    except Exception as problem:  # trimesh raises whatever its parsers meet
        raise SceneError(str(path), expected="a readable .ply", got=problem, remedy=_REMEDY) from problem
    return points


def _read_colmap(folder: str, scene: SceneFile) -> npt.NDArray[np.float64]:
    """Read a COLMAP model's points and bring them into the coordinates of the json.

    The json may hold COLMAP's world or one with other axes (``applied_transform``). Which one is decided by the
    camera centres that both files know, so that a stale model cannot give a wrong box.
    """
    try:
        model = read_model(scene.folder / folder)
    except SceneError as problem:
        raise SceneError(folder, expected="a readable COLMAP model", got=problem, remedy=_REMEDY) from problem
    centres = {Path(image.name).name: np.asarray(image.projection_center()) for image in model.images.values()}
    known = [(centres[frame.image.name], frame.pose[:3, 3]) for frame in scene.frames if frame.image.name in centres]
    in_colmap, in_json = (np.array(side).reshape(-1, 3) for side in (zip(*known) if known else ([], [])))
    candidates = [np.eye(4)[:3], _LEGACY_TRANSFORM]
    if "applied_transform" in scene.meta:
        candidates = [read_pose(scene.meta["applied_transform"], "applied_transform", turned=False)[:3]]
    for transform in candidates if known else []:
        off = np.linalg.norm(in_colmap @ transform[:, :3].T + transform[:, 3] - in_json, axis=1)
        spread = np.linalg.norm(in_json - in_json.mean(axis=0), axis=1).max()
        if np.median(off) <= 0.01 * max(spread, 1e-9):
            points = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
            return points @ transform[:, :3].T + transform[:, 3]
    remedy = _REMEDY
    got = f"{len(known)} photographs in common, at other places" if known else "no photograph in common"
    raise SceneError(folder, expected="a COLMAP model with the camera centres of the json", got=got, remedy=remedy)
