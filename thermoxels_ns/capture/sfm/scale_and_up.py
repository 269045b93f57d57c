"""Finds the metres per unit of a model, from GPS or markers, and the direction of up."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from thermoxels_ns.capture.frames import CaptureFrame
from thermoxels_ns.capture.photograph import GpsFix, open_photograph
from thermoxels_ns.capture.rig_types import FloatArray
from thermoxels_ns.capture.sfm.sfm_model import SfmModel
from thermoxels_ns.core.checks import check_positive
from thermoxels_ns.data.scene_scale import SceneScale

_WORST_GPS = 0.3  # largest relative standard error of a scale from GPS that is accepted
_LEAST_FIXES = 4
_MARKER_DICTIONARY = cv2.aruco.DICT_4X4_50
_MARKER_ERROR_PX = 2.0
"""A marker is taken to have moved, and ignored, if its corners miss their rays by more than this (median), [pixels]."""

_UP_OF_ORIENTATION = {1: (0, 1), 2: (0, 1), 3: (0, -1), 4: (0, -1), 5: (-1, 0), 6: (-1, 0), 7: (1, 0), 8: (1, 0)}
"""Direction, in the stored picture (x right, y up), to the top of the upright picture, by EXIF's orientation."""
_ROLLED_DEG = 2.0  # standard deviation of the roll at which people hold a camera, [degrees]
_LEAST_COSINE = 0.3  # least cosine of up with the pictures' mean upward direction: cameras look down by at most 72 deg
_BELIEVED_DEG = 5.0  # largest accepted standard error of the common normal of the cameras' level axes, [degrees]


def scale_from_gps(centres: FloatArray, fixes: Sequence[GpsFix | None]) -> tuple[SceneScale | None, str]:
    """Return the scale from a fit of the camera `centres` (n, 3) to their GPS fixes, and ""; or None and a reason.

    The fit is a similarity by closed-form least squares (Umeyama 1991, equation 42) with Huber's weights. The standard
    error follows from the residuals of the linearised fit; a relative error above `_WORST_GPS` is a failure.
    """
    known = [i for i, fix in enumerate(fixes) if fix is not None]
    if not known:
        return None, "no photograph has a GPS position"
    if len(known) < _LEAST_FIXES:
        return None, f"{len(known)} photographs have a GPS position, {_LEAST_FIXES} are needed"
    local = local_metres([fix for fix in fixes if fix is not None])
    model = centres[known]
    weight = np.ones(len(known))
    scale, residual = 0.0, np.zeros(len(known))
    for _ in range(20):
        scale, residual = _similarity(model, local, weight)
        limit = 1.345 * 1.4826 * float(np.median(residual)) + 1e-9
        weight = np.minimum(1.0, limit / np.maximum(residual, 1e-12))
    spread = float((weight * ((model - np.average(model, axis=0, weights=weight)) ** 2).sum(axis=1)).sum())
    freedom = max(3 * len(known) - 7, 1)
    if not (scale > 0 and spread > 0):
        return None, "the GPS positions do not follow the cameras"
    error = math.sqrt(float((weight * residual**2).sum()) / freedom / spread)
    if error > _WORST_GPS * scale:
        return None, f"the GPS positions scatter too much for the size of the path ({100 * error / scale:.0f} % error)"
    source = (
        f"From the GPS positions of {len(known)} photographs, which differ from the cameras' path by "
        f"{math.sqrt(float((residual**2).mean())):.2f} m (root mean square)."
    )
    return SceneScale(scale, error, source), ""


def local_metres(fixes: Sequence[GpsFix]) -> FloatArray:
    """Return each fix's position east, north and above the mean position, (n, 3), [m]; unknown altitudes: the mean."""
    import pycolmap

    known = [fix.altitude_m for fix in fixes if fix.altitude_m is not None]
    usual = float(np.mean(known)) if known else 0.0
    heights = [usual if fix.altitude_m is None else fix.altitude_m for fix in fixes]
    places = np.array([(fix.latitude_deg, fix.longitude_deg, height) for fix, height in zip(fixes, heights)])
    metres = pycolmap.GPSTransform().ellipsoid_to_enu(places, *places[0])
    return metres - metres.mean(axis=0)


def scale_from_markers(
    model: SfmModel, photographs: Mapping[str, Path], side_m: float, standard_error_m: float | None = None
) -> tuple[SceneScale | None, str]:
    """Return the scale from printed ArUco markers (4 x 4 cells, numbers 0 to 49), and ""; or None and a reason.

    `photographs` are files by frame name. `side_m` is the side of a marker's black square, `standard_error_m` its
    standard error (None: 0). A marker's corners are triangulated from all photographs that show it (linear least
    squares of the rays). Each marker gives four sides. The result's standard error combines that of the sides' mean
    with `standard_error_m`.
    """
    check_positive("marker side", side_m, "Pass the side of the black square in metres.")
    seen: dict[int, list[tuple[int, FloatArray]]] = {}
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(_MARKER_DICTIONARY), parameters)
    for index, name in enumerate(model.frames):
        grey = np.asarray(open_photograph(photographs[name]).convert("L"))
        corners, ids, _ = detector.detectMarkers(grey)
        for four, marker in zip(corners, [] if ids is None else ids.ravel()):
            seen.setdefault(int(marker), []).append((index, np.asarray(four, dtype=np.float64).reshape(4, 2) + 0.5))
    sides, offs, used = [], [], []
    for marker, views in sorted(seen.items()):
        if len(views) < 2:
            continue
        placed = [_triangulate(model, [(index, four[corner]) for index, four in views]) for corner in range(4)]
        missed = float(np.median(np.concatenate([error for _, error in placed])))
        if missed > _MARKER_ERROR_PX:
            continue
        square = np.stack([point for point, _ in placed])
        sides.append(np.linalg.norm(square - np.roll(square, 1, axis=0), axis=1))
        offs.append(missed)
        used.append(marker)
    if not used:
        if not seen:
            return None, "no photograph shows an ArUco marker of 4 x 4 cells"
        return None, f"markers {sorted(seen)} are in one photograph only, or moved between photographs"
    lengths = np.concatenate(sides)
    mean = float(lengths.mean())
    relative = float(lengths.std(ddof=1)) / mean / math.sqrt(len(lengths))
    relative = math.hypot(relative, (standard_error_m or 0.0) / side_m)
    scale = side_m / mean
    source = (
        f"From {len(used)} ArUco marker{'s' * (len(used) != 1)} of {side_m:g} m "
        f"({', '.join(map(str, used))}), whose corners miss their rays by {np.mean(offs):.2f} pixels."
    )
    return SceneScale(scale, scale * relative, source), ""


def _similarity(model: FloatArray, metres: FloatArray, weight: FloatArray) -> tuple[float, FloatArray]:
    """Return the scale of the weighted least-squares similarity from model to metres, and its residuals (n,), [m]."""
    share = weight / weight.sum()
    a, b = model - share @ model, metres - share @ metres
    rotated = Rotation.align_vectors(b, a, share)[0].apply(a)
    scale = float(share @ (b * rotated).sum(axis=1)) / max(float(share @ (a * a).sum(axis=1)), 1e-300)
    return scale, np.linalg.norm(b - scale * rotated, axis=1)


def _triangulate(model: SfmModel, views: Sequence[tuple[int, npt.NDArray]]) -> tuple[FloatArray, FloatArray]:
    """Return the point nearest to all rays, shape (3,), and its reprojection errors, shape (views,), [pixels]."""
    normal, right = np.zeros((3, 3)), np.zeros(3)
    for index, pixel in views:
        ray = model.camera.rays(pixel[None])[0] * (1.0, -1.0, -1.0) @ model.camera_to_world[index, :3, :3].T
        across = np.eye(3) - np.outer(ray, ray) / (ray @ ray)
        normal += across
        right += across @ model.centres[index]
    point = np.linalg.lstsq(normal, right, rcond=1e-9)[0]
    off = [np.linalg.norm(model.camera.project(model.in_camera(i, point[None]))[0] - pixel) for i, pixel in views]
    return point, np.nan_to_num(np.array(off), nan=np.inf)


@dataclass(frozen=True)
class Up:
    """Direction of up in the model, and how it was found."""

    direction: FloatArray  # unit vector in the model's coordinates, shape (3,)
    source: str  # sentence for the report that says how the direction was found


def upright(model: SfmModel, frames: Sequence[CaptureFrame]) -> tuple[SfmModel, Up, FloatArray]:
    """Return the model in axes with z up, y ahead of the cameras and the origin amid the scene points; up in them; and
    the matrix (4, 4) from the old axes to them. `frames` must be the frames of `model`, in its order."""
    up = find_up(model.camera_to_world, [one.gimbal_deg for one in frames], [one.orientation for one in frames])
    ahead = -model.camera_to_world[:, :3, 2].mean(axis=0)
    # The infinite weight turns up to z exactly; ahead then comes as near to y as it can.
    turn = Rotation.align_vectors([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]], [up.direction, ahead], [np.inf, 1.0])[0]
    move, rotation = np.eye(4), turn.as_matrix()
    origin = np.median(model.points, axis=0) if len(model.points) else model.centres.mean(axis=0)
    move[:3, :3], move[:3, 3] = rotation, -rotation @ origin
    moved = replace(model, camera_to_world=move @ model.camera_to_world, points=(model.points - origin) @ rotation.T)
    return moved, replace(up, direction=rotation @ up.direction), move


def find_up(
    camera_to_world: FloatArray, gimbal_deg: Sequence[tuple[float, float] | None], orientation: Sequence[int]
) -> Up:
    """Return the direction of up, from the pitch and roll that photographs state, else from level pictures.

    A camera with pitch p (0 level, -90 straight down) and roll r against gravity has up at (-sin r cos p, cos r cos p,
    -sin p) in its axes x right, y up, z back. If no photograph states these angles, pictures are assumed to be level:
    up is normal to the pictures' horizontal axes if these axes differ enough, else the mean of the vertical axes.
    `gimbal_deg` is pitch and roll per camera [degrees] or None; EXIF's `orientation`, 1 to 8, decides on these axes.
    """
    rotations = camera_to_world[:, :3, :3]
    measured = [i for i, angles in enumerate(gimbal_deg) if angles is not None]
    if measured:
        local = []
        for pitch, roll in (map(math.radians, angles) for angles in gimbal_deg if angles is not None):
            # A camera that is rolled clockwise, as seen from behind, has up to its left.
            local.append((-math.sin(roll) * math.cos(pitch), math.cos(roll) * math.cos(pitch), -math.sin(pitch)))
        each = np.einsum("nij,nj->ni", rotations[measured], np.array(local))
        return Up(_robust_mean(each), f"From the pitch and roll that {len(measured)} photographs state.")
    flat = np.array([_UP_OF_ORIENTATION[o] for o in orientation], dtype=np.float64)
    held = np.einsum("nij,nj->ni", rotations[:, :, :2], flat)
    mean = _robust_mean(held)
    level = np.einsum("nij,nj->ni", rotations[:, :, :2], np.stack([flat[:, 1], -flat[:, 0]], axis=1))
    values, vectors = np.linalg.eigh(level.T @ level / len(level))
    turned = math.sqrt(max(float(values[1]), 0.0))  # sine of how far the axes spread, root mean square
    if len(level) >= 3 and _BELIEVED_DEG * math.sqrt(len(level)) * turned > _ROLLED_DEG:
        normal = vectors[:, 0] if vectors[:, 0] @ mean > 0 else -vectors[:, 0]
        # Axes that lie in no plane are of cameras that were rolled, or that all look one way: they tell no normal.
        if values[0] < 0.2 * values[1] and normal @ mean > _LEAST_COSINE:
            return Up(normal, "Assumed: the photographs' sides were held level.")
    return Up(mean, "Assumed: the mean of the photographs' upward directions.")


def _robust_mean(directions: FloatArray) -> FloatArray:
    """Return the mean direction, a unit vector (3,), of the half of the directions (n, 3) nearest to that mean."""
    mean = directions.sum(axis=0)
    for _ in range(5):
        mean = mean / max(float(np.linalg.norm(mean)), 1e-12)
        nearness = directions @ mean
        mean = directions[nearness >= np.median(nearness)].sum(axis=0)
    return mean / max(float(np.linalg.norm(mean)), 1e-12)
