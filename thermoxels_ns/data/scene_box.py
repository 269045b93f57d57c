"""The scene box, in which the voxel lattice lies: given, or found from points, depths of photographs, or cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from thermoxels_ns.core.arrays import Float32Array, FloatArray, IntArray
from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.core.snapshot import Views
from thermoxels_ns.data.scene_file import Frame, SceneFile
from thermoxels_ns.data.tracks import SparseTracks
from thermoxels_ns.radiometry.decoders import errors_name

Box = FloatArray  # Lowest and highest corner, shape (2, 3)

_REMEDY = "Pass --scene-box with two corners in the coordinates of the input poses: xmin ymin zmin xmax ymax zmax."
_TAIL = 0.5
"""Weight of points left outside the box at either end of an axis, [%], because some are wrong. It was chosen on a
synthetic block before far walls, with 0.7 % wrong depths: 0.1 makes its box 1.5 times as long. A mast of fewer points
is inside the box only because of `_MARGIN`."""
_MARGIN = 0.08  # Width added on every side, relative to the longest side of the box
_ROUNDED = 2.0**-8  # Corners are rounded to this share of the longest side, or less
_MOST_POINTS = 20_000  # Number of points, evenly chosen, to which larger sets are reduced (about)
_MOST_PHOTOGRAPHS = 64  # Largest number of photographs into which points are projected
_PROBES = 8  # Grid points along each side of a box in which no scene points are known
_STEREO_PHOTOGRAPHS, _STEREO_SIDE = 32, 96
"""Photographs whose depths are found, and pixels along their longer side; this takes some seconds."""
_FEWEST_POINTS = 10  # Sparse points in view that a box needs
_FEWEST_DEPTHS = 200  # Depths that a box needs; with fewer it is found from the cameras
_FEW_IN_VIEW = 0.05  # A photograph with fewer points in view, relative to the photograph with most, is a blind one
_NEARER_HALF = 0.25  # Without points, the surface is assumed at this quantile of the depths in the box
_CONVERGING = 0.5  # Cameras look outwards if the point they look at is nearer than this share of their spread


@dataclass(frozen=True, eq=False)
class FoundBox:
    """The scene box in input coordinates, and what it was found from."""

    source: str  # Text for the log: what the box was found from
    box: Box
    points: FloatArray | None = None  # Points of the scene, shape (n, 3); None: not known

    def pixel_size(self, frames: Sequence[Frame]) -> float:
        """Return the width that a pixel covers at the typical distance of surfaces in the box, in input units.

        It is the median of depth / focal length over the points in the box and the photographs that have them in view;
        without points, the quantile `_NEARER_HALF` over a grid in the box. It is infinite if no camera sees the box.
        """
        low, high = self.box
        if self.points is not None:
            points, quantile = self.points[((self.points >= low) & (self.points <= high)).all(axis=1)], 0.5
        else:
            steps = (np.arange(_PROBES) + 0.5) / _PROBES
            grid = np.stack(np.meshgrid(*3 * [steps], indexing="ij"), axis=-1).reshape(-1, 3)
            points, quantile = low + grid * (high - low), _NEARER_HALF
        frames = _spread(frames, _MOST_PHOTOGRAPHS)
        if not len(points):
            return float("inf")
        depth = depths_in_view(points[:: max(len(points) // _MOST_POINTS, 1)], frames)
        sizes = depth / np.array([[f.intrinsics.fl_x] for f in frames])
        return float(np.quantile(sizes[np.isfinite(sizes)], quantile)) if np.isfinite(sizes).any() else float("inf")


def find_scene_box(
    scene: SceneFile, option: Sequence[Sequence[float]] | None, training: Sequence[int], tracks: SparseTracks | None
) -> FoundBox:
    """Return the scene box in input coordinates, and what it was found from.

    The first available source is used: `option`, two corners; ``scene_box`` in the json; sparse points
    (``ply_file_path``, or the points of `tracks`); depths on which the photographs that train (indices `training`)
    agree; the cameras. The same folder and split give the same result. Raises `SceneError` if a box has no volume or is
    not finite, if a file cannot be read, or if neither points nor cameras suffice.
    """
    frames = scene.frames
    if option is not None:
        return FoundBox("the option scene_box", _checked(option, "scene_box"))
    if "scene_box" in scene.meta:
        name = f"{scene.json_path.name}: scene_box"
        return FoundBox(name, _checked(scene.meta["scene_box"], name))
    if "ply_file_path" in scene.meta:
        path = scene.folder / str(scene.meta["ply_file_path"])
        points = _read_ply(path)
        return FoundBox(f"the points of {path.name}", box_of_points(points, frames), points)
    if tracks is not None:
        good = tracks.well_seen()
        points = good if len(good) >= _FEWEST_POINTS else tracks.points
        return FoundBox(f"the points of {tracks.source}", box_of_points(points, frames), points)
    points, weight, photographs = _points_of_photographs([frames[index] for index in training])
    if len(points) < _FEWEST_DEPTHS:
        source = "the cameras (no scene_box, no sparse points, no depths that photographs agree on)"
        return FoundBox(source, box_of_cameras(frames))
    source = f"{len(points)} depths on which {photographs} photographs agree"
    return FoundBox(source, box_of_points(points, frames, weight), points)


def _points_of_photographs(frames: Sequence[Frame]) -> tuple[FloatArray, FloatArray, int]:
    """Return stereo points (n, 3) on which photographs agree, in input coordinates, their weights (n,) for the box
    (`exactness`), and the number of photographs."""
    from thermoxels_ns.multiview import photographs, stereo  # its kernels are slow to load and only needed here

    frames = _spread(frames, _STEREO_PHOTOGRAPHS)
    pinholes = []
    for frame in frames:
        picture, shown = frame.read_picture("RGB", 2 * _STEREO_SIDE)
        mask, camera = None if shown is None else np.array(shown) > 0, frame.intrinsics.resized(*picture.size)
        pinholes.append(photographs.pinhole(np.array(picture), mask, camera, frame.pose, _STEREO_SIDE))
    seen = photographs.gathered(pinholes, [frame.pose[:3, 3] for frame in frames])
    depths = stereo.depths_of(seen)
    depths = stereo.depths_before_backdrop(depths)[0]
    rays = stereo.feature_rays_to_depths(depths)
    return rays.points, exactness(rays.uncertainty, seen.numbers[np.isfinite(depths.depth)]), len(frames)


def exactness(error: FloatArray, photograph: IntArray) -> FloatArray:
    """Return weights (n,) of points with standard errors (n,), each found in the photograph of that number (n,).

    A point counts by the density that it stands for, one over the cube of its error, but at most 1, which is the weight
    of the photograph's point of median error. So what is far behind a scene, and wrong, hardly counts, and photographs
    of a detail from near do not outweigh the others. The cube was chosen on one drawn street, with mirroring panes.
    """
    weight = np.ones(len(error))
    for number in np.unique(photograph):
        own = photograph == number
        weight[own] = np.minimum(1.0, np.median(error[own]) / error[own]) ** 3
    return weight


def box_of_points(points: FloatArray, frames: Sequence[Frame], weight: FloatArray | None = None) -> Box:
    """Return the box around those of the points (n, 3), in input coordinates, that photographs show well.

    `Views.shown_well` decides which points photographs show well; the export chooses its region by the same rule. Each
    camera is taken to be pointed at the median depth of the points in its view. Along each axis, `_TAIL` of the weights
    (n,) of the points (None: all alike) at either end are left out, and `_MARGIN` is added on both sides, because parts
    without texture have no points and a flat scene needs some depth. If a photograph, as of a plain wall, has hardly
    any of these points in view (`_FEW_IN_VIEW`), the box is extended to the point on its optical axis at the median of
    the cameras' depths.
    """
    weight = np.ones(len(points)) if weight is None else weight
    chosen = np.flatnonzero(np.isfinite(points).all(axis=1))
    chosen, frames = chosen[:: max(len(chosen) // _MOST_POINTS, 1)], _spread(frames, _MOST_PHOTOGRAPHS)
    points, weight = points[chosen], weight[chosen]
    depth = depths_in_view(points, frames)
    seen = np.isfinite(depth)
    ahead = np.array([np.median(row[known]) if known.any() else np.nan for row, known in zip(depth, seen)])
    views = Views.of([frame.intrinsics for frame in frames], [frame.pose for frame in frames])
    kept = seen.any(axis=0) & views.shown_well(points, ahead)
    points, weight, shown = points[kept], weight[kept], seen[:, kept].sum(axis=1)
    if len(points) < _FEWEST_POINTS:
        expected = f"at least {_FEWEST_POINTS} points in front of the cameras to find the scene box"
        raise SceneError("sparse points", expected=expected, got=len(points), remedy=_REMEDY)
    low, high = (_weighted_percentile(points, weight, percent) for percent in (_TAIL, 100.0 - _TAIL))
    margin = _MARGIN * (high - low).max()
    few = shown < _FEW_IN_VIEW * shown.max()
    if few.any():
        typical = np.nanmedian(ahead)
        ends = np.stack([f.pose[:3, 3] - typical * f.pose[:3, 2] for f, blind in zip(frames, few) if blind])
        low, high = np.minimum(low, ends.min(axis=0)), np.maximum(high, ends.max(axis=0))
    # Rounded outwards, so that other processors, on which a few depths differ, find the same box.
    step = _ROUNDED * 2.0 ** np.floor(np.log2(max((high - low).max(), 1e-300)))
    low, high = low - margin, high + margin
    low, high = np.floor(low / step) * step, np.ceil(high / step) * step
    return _checked(np.stack([low, high]), "box of the points")


def _weighted_percentile(points: FloatArray, weight: FloatArray, percent: float) -> FloatArray:
    """Return the coordinate (3,) along each axis below which `percent` of the weights (n,) of the points (n, 3) lie."""
    order = np.argsort(points, axis=0)
    below = np.cumsum(weight[order], axis=0) - 0.5 * weight[order]
    ascending = np.take_along_axis(points, order, axis=0)
    return np.array([np.interp(0.01 * percent * weight.sum(), *pair) for pair in zip(below.T, ascending.T)])


def depths_in_view(points: FloatArray, frames: Sequence[Frame]) -> Float32Array:
    """Return the depth of each point in each photograph, (photographs, points); NaN for a point that is not in view."""
    depth = np.full((len(frames), len(points)), np.nan, dtype=np.float32)
    for row, frame in zip(depth, frames):
        camera, local = frame.intrinsics, (points - frame.pose[:3, 3]) @ frame.pose[:3, :3] * (1.0, -1.0, -1.0)
        shown = (local[:, 2] > 0.0) & camera.contains(camera.project(local))
        row[shown] = local[shown, 2]
    return depth


def _spread(frames: Sequence[Frame], most: int) -> list[Frame]:
    """Return at most `most` frames, evenly spaced in the list."""
    return [frames[k] for k in np.unique(np.linspace(0, len(frames) - 1, min(most, len(frames))).round().astype(int))]


def box_of_cameras(frames: Sequence[Frame]) -> Box:
    """Return a cube as scene box, guessed from the cameras alone.

    If the cameras look at one place, the cube's centre is the point nearest to all optical axes (least squares). Half
    the cube's side is the median, over the cameras, of the centre's depth times the tangent of half the field of view.
    If the cameras look outwards, as in a room, the cube lies around them and its side is four times their extent.
    Raises `SceneError` if all cameras look in one direction, or look outwards from one place.
    """
    axes, origins = (np.stack([frame.pose[:3, column] for frame in frames]) for column in (2, 3))
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    normal = across.mean(axis=0)
    if np.linalg.eigvalsh(normal)[0] < 1e-3:  # mean squared sine of the angle to a common direction
        raise SceneError("scene box", expected="cameras that look at one place", got="parallel views", remedy=_REMEDY)
    centre = np.linalg.solve(normal, np.einsum("nij,nj->i", across, origins) / len(frames))
    depth = ((origins - centre) * axes).sum(axis=1)
    if np.median(depth) > _CONVERGING * np.sqrt(((origins - origins.mean(axis=0)) ** 2).sum(axis=1).mean()):
        views = [f.intrinsics for f in frames]
        widths = np.array([max(v.width / v.fl_x, v.height / v.fl_y) for v in views])
        half = float(np.median(0.5 * (depth * widths)[depth > 0.0]))
    else:
        low, high = origins.min(axis=0), origins.max(axis=0)
        centre, half = 0.5 * (low + high), 2.0 * (high - low).max()
    return _checked(np.stack([centre - half, centre + half]), "box of the cameras")


def _checked(corners: Any, name: str) -> Box:
    expected = "two corners [[xmin, ymin, zmin], [xmax, ymax, zmax]] with min below max on every axis"
    try:
        box = np.array(corners, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        box = np.zeros(0)
    good = box.shape == (2, 3) and np.isfinite(box).all()
    if good:
        sides = box[1] - box[0]
        good = bool((sides > 1e-6 * np.abs(sides).max()).all())
    if not good:
        raise SceneError(name, expected=expected, got=corners, remedy=_REMEDY)
    return box


def _read_ply(path: Path) -> FloatArray:
    """Return the points (n, 3) of a .ply file (ASCII or binary), in the coordinates of the json."""
    import trimesh  # slow to import and only needed here

    if not path.is_file():
        raise SceneError("ply_file_path", expected=f"a file at {path}", got="nothing there", remedy=_REMEDY)
    with errors_name(path, "a readable .ply", _REMEDY):  # trimesh raises whatever its parsers meet
        loaded: Any = trimesh.load(path)
        return np.asarray(loaded.vertices, dtype=np.float64).reshape(-1, 3)
