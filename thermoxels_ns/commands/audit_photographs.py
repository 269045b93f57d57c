"""Cut each defect out of the photograph and the thermal image in which the defect is largest."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

from thermoxels_ns.audit.run import Audit
from thermoxels_ns.capture.photograph import open_photograph
from thermoxels_ns.core.arrays import BoolArray, FloatArray, IntArray
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.data.scene_file import Frame, SceneFile
from thermoxels_ns.radiometry.thermal_pixels import read_thermal_file
from thermoxels_ns.reports.audit_page import MOST_DEFECTS
from thermoxels_ns.reports.page import Picture, colours, image_file

_MOST_POINTS = 1000  # Most triangles of a defect that are projected into photographs
_CELLS = 64  # Number of cells per row and per column of a photograph; the nearest triangle of a cell hides the others
_HIDDEN = 1.05  # A triangle is hidden if it is this many times as far as the nearest triangle of its cell
_MARGIN, _LEAST_SHARE = 0.6, 0.3
"""Margin around a defect, as a share of its size, and least width of the cut-out, as a share of the image's width."""
_BELOW_K, _COLDER = 0.5, 200  # Pixels colder than the range by this much, [K], have this level of grey, 0 to 255
_WIDTH = 480  # Width of a cut-out, [pixels]


def photographs_of_defects(
    scene: SceneFile, metres_per_unit: float, found: Audit
) -> dict[int, tuple[Picture, Picture]]:
    """Return cut-outs of the photograph and the thermal image that show a defect largest, by place in `found.found`.

    `metres_per_unit` is the length of one unit of the scene's poses, [m]. The colours of thermal images span the
    readings on the surface; colder pixels, such as sky, are grey. Only the first `MOST_DEFECTS` defects are searched;
    a defect is left out if no photograph shows it, or if the best photograph has no thermal image that shows it.
    """
    frames = scene.frames
    surface = found.surface
    every = surface.centroid_m / metres_per_unit
    hidden_behind = [_nearest(frame, every) for frame in frames]
    pictures = dict[int, tuple[Picture, Picture]]()
    for number, one in enumerate(found.found[:MOST_DEFECTS]):
        some = one.core[:: max(1, len(one.core) // _MOST_POINTS)]
        points, normals = every[some], surface.selection.facet_normal[some]
        area = surface.area_m2[some] / metres_per_unit**2
        scores = [_size_in_view(frame, nearest, points, normals, area) for frame, nearest in zip(frames, hidden_behind)]
        if not scores or max(scores) <= 0.0:
            continue
        frame = frames[int(np.argmax(scores))]
        shown = _cut_out(scene, frame, points, surface.range_c)
        if shown is not None:
            pictures[number] = ((shown[0], frame.image.name), (shown[1], "Thermal image, as the camera read it"))
    return pictures


def _nearest(frame: Frame, points: FloatArray) -> FloatArray:
    """Return the distance from the camera to the nearest point of each cell, (`_CELLS`, `_CELLS`); inf: no point."""
    pixels, inside, distance = _seen_from(frame, points)
    nearest = np.full((_CELLS, _CELLS), np.inf)
    np.minimum.at(nearest, _cells(frame.intrinsics, pixels[inside]), distance[inside])
    return nearest


def _cells(camera: Camera, pixels: FloatArray) -> tuple[IntArray, ...]:
    share = pixels / (camera.width, camera.height)
    return tuple(np.clip((share * _CELLS).astype(np.int64), 0, _CELLS - 1).T)


def _seen_from(frame: Frame, points: FloatArray) -> tuple[FloatArray, BoolArray, FloatArray]:
    """Return pixels of points, (k, 2), whether each lies in the photograph, (k,), and distances to the camera, (k,)."""
    pixels = frame.intrinsics.project_world(frame.pose, points)
    return pixels, frame.intrinsics.contains(pixels), np.linalg.norm(points - frame.pose[:3, 3], axis=1)


def _size_in_view(
    frame: Frame, nearest: FloatArray, points: FloatArray, normals: FloatArray, area: FloatArray
) -> float:
    """Return the solid angle, [sr], of the k triangles that lie in a photograph, face the camera, and are not hidden.

    `points` are the centroids of the triangles, (k, 3), `normals` their outward unit normals, (k, 3), and `area` their
    areas, (k,), in squared units of the scene's poses. `nearest` is `_nearest` of all triangles of the mesh: a triangle
    is hidden if it is more than `_HIDDEN` times as far as the nearest triangle of its cell.
    """
    pixels, seen, distance = _seen_from(frame, points)
    if not seen.any():
        return 0.0
    seen[seen] = distance[seen] <= _HIDDEN * nearest[_cells(frame.intrinsics, pixels[seen])]
    towards = (frame.pose[:3, 3] - points) / distance[:, None]
    facing = np.maximum(np.einsum("ij,ij->i", normals, towards), 0.0)
    return float((area * facing / distance**2)[seen].sum())


def _cut_out(
    scene: SceneFile, frame: Frame, points: FloatArray, limits: tuple[float, float]
) -> tuple[bytes, bytes] | None:
    """Return JPEG cut-outs of photograph and thermal image around points, (k, 3); None if one of these shows none.

    `limits` are the temperatures of the darkest and the brightest colour, [degrees Celsius].
    """
    if frame.thermal is None:
        return None
    temperature_c = read_thermal_file(frame.thermal, scene.unit)
    height, width = temperature_c.shape
    thermal = frame.thermal_intrinsics or frame.intrinsics.resized(width, height)
    thermal_pose = frame.pose if frame.thermal_pose is None else frame.thermal_pose
    photograph = np.asarray(open_photograph(frame.image).convert("RGB"))
    visible = frame.intrinsics.resized(photograph.shape[1], photograph.shape[0])
    cut, seen = [], colours(temperature_c, limits)
    seen[temperature_c < limits[0] - _BELOW_K] = _COLDER
    for picture, camera, pose in ((photograph, visible, frame.pose), (seen, thermal, thermal_pose)):
        pixels = camera.project_world(pose, points)
        pixels = pixels[camera.contains(pixels)]
        if not len(pixels):
            return None
        cut.append(_framed(picture, pixels))
    return cut[0], cut[1]


def _framed(picture: npt.NDArray[np.uint8], pixels: FloatArray) -> bytes:
    """Return a JPEG file of a picture, (h, w, 3), cut out around some pixels, (k, 2), with a frame around them."""
    size = np.array(picture.shape[1::-1], dtype=np.float64)
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    half = np.maximum((0.5 + _MARGIN) * (high - low), 0.5 * _LEAST_SHARE * size)
    half = np.minimum(np.maximum(half, half[::-1] * size / size[::-1]), 0.5 * size)  # proportions of the picture
    middle = np.clip(0.5 * (low + high), half, size - half)
    (left, top), (right, bottom) = np.floor(middle - half).astype(int), np.ceil(middle + half).astype(int)
    image = Image.fromarray(picture).crop((left, top, right, bottom))
    zoom = _WIDTH / image.width
    image = image.resize((_WIDTH, max(1, round(image.height * zoom))))
    frame = [*((low - (left, top)) * zoom - 4.0), *((high - (left, top)) * zoom + 4.0)]
    ImageDraw.Draw(image).rectangle([float(edge) for edge in frame], outline=(255, 255, 255), width=2)
    return image_file(np.asarray(image))
