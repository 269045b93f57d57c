"""Guesses the rig from which the search starts, from metadata of the camera files, or reads a given rig."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from statistics import median

import numpy as np
from scipy.spatial.transform import Rotation

from thermoxels_ns.capture.frames import CaptureFrame
from thermoxels_ns.capture.rig_types import RigEstimate, RigFrame, guessed_rig
from thermoxels_ns.capture.sfm.sfm_model import SfmModel
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.core.checks import check_ranges
from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.core.json_values import read_json_object
from thermoxels_ns.data.transforms_json import read_intrinsics, read_pose

_MOST_ERROR_PX = 4.0  # scene points with a larger mean reprojection error are ignored, [pixels of the photographs]
_FROM_LENS, _FROM_FLIR, _FROM_ANGLE, _FROM_USER, _GUESSED = 0.03, 0.06, 0.1, 0.05, 0.25
"""Standard deviation of the thermal focal length, as a share of it, for each source of the value."""
_BASELINE_SIGMA_M = 0.1
"""Standard deviation of the thermal lens's place relative to the visible lens, along each axis, [m]."""
_BELIEVED_DEG = (3.0, 150.0)  # angles of view outside these limits are ignored; some cameras state nonsense


def rig_frames(model: SfmModel, frames: Sequence[CaptureFrame]) -> list[RigFrame]:
    """Return a `RigFrame` for each of `frames`, without scene points of a reprojection error above `_MOST_ERROR_PX`.
    `frames` must be the frames of `model`, in its order."""
    good = model.point_error_px <= _MOST_ERROR_PX
    result = []
    for index, frame in enumerate(frames):
        seen = model.seen[index][good[model.seen[index]]]
        points = model.in_camera(index, model.points[seen])
        result.append(RigFrame(frame.photograph, frame.thermal, points, seen))
    return result


def rig_start(
    frames: Sequence[CaptureFrame],
    visible: Camera,
    thermal_size: tuple[int, int],
    field_of_view_deg: float | None = None,
    metres_per_unit: float | None = None,
) -> RigEstimate:
    """Return a guess of the thermal camera and the rig, with standard deviations.

    The focal length comes from the first of these that is known: `field_of_view_deg`, the user's horizontal angle of
    view; the thermal files' focal length; FLIR's alignment of the two pictures; the thermal files' angle of view; the
    angle of view of the photographs' camera `visible`. If `metres_per_unit` is known, the lenses are taken to be within
    about 0.1 m of each other; None: their distance is unknown. `thermal_size` is width and height [pixels].
    """
    width, height = thermal_size
    transform = np.eye(4)

    def centred(focal_px: float) -> Camera:
        return Camera(width, height, focal_px, focal_px, width / 2, height / 2)

    def seen_under(angle_deg: float) -> Camera:
        return centred(0.5 * width / math.tan(math.radians(0.5 * angle_deg)))

    lens = [frame.thermal_focal_px for frame in frames if frame.thermal_focal_px]
    flir = [frame.metadata.picture_in_picture for frame in frames if frame.metadata.picture_in_picture]
    angles = [frame.metadata.field_of_view_deg for frame in frames if frame.metadata.field_of_view_deg]
    angles = [angle for angle in angles if _BELIEVED_DEG[0] < angle < _BELIEVED_DEG[1]]
    if field_of_view_deg is not None:
        limits = (field_of_view_deg, 0.1, 179.0, "from 0.1 to 179 degrees, as in the lens's data sheet")
        check_ranges("--", {"thermal_field_of_view_deg": limits})
        camera = seen_under(field_of_view_deg)
        sigma, source = _FROM_USER, f"the angle of view that was given, {field_of_view_deg:g} degrees"
    elif lens:
        focal = median(lens)
        camera = centred(focal)
        sigma, source = _FROM_LENS, f"the thermal files' focal length and pixel pitch, {focal:.1f} pixels"
    elif flir:
        ratio = median(each.real_to_thermal for each in flir)
        camera = centred(visible.fl_x * width / visible.width * ratio)
        x, y = (median(getattr(each, name) for each in flir) for name in ("offset_x", "offset_y"))
        # The thermal image's centre lies at the photograph's centre plus the offset.
        ahead, down = [x / visible.fl_x, y / visible.fl_y, 1.0], [0.0, 1.0, 0.0]
        turn = Rotation.align_vectors([[0.0, 0.0, 1.0], down], [ahead, down], [np.inf, 1.0])[0]
        transform[:3, :3] = turn.as_matrix()
        sigma, source = _FROM_FLIR, f"FLIR's alignment of the pictures (Real2IR {ratio:.3f}, offset {x:g}, {y:g})"
    elif angles:
        angle = median(angles)
        camera = seen_under(angle)
        sigma, source = _FROM_ANGLE, f"the thermal files' angle of view, {angle:g} degrees"
    else:
        camera = centred(visible.fl_x * width / visible.width)
        sigma, source = _GUESSED, "a guess: the photographs' angle of view"
    shift = math.nan if metres_per_unit is None else _BASELINE_SIGMA_M / metres_per_unit
    return guessed_rig(camera, source, transform, sigma, shift)


def read_rig(file: Path, thermal_size: tuple[int, int], metres_per_unit: float | None = None) -> RigEstimate:
    """Return the rig in an earlier capture's transforms.json (``thermal_camera`` and ``rig``).

    Lengths are converted if both captures have a scale; `metres_per_unit` is this capture's (None: it has none). Raises
    `ThermoxelsError` if the file is bad, or if the thermal image's size there is not `thermal_size` (width, height).
    """
    remedy = "Pass the transforms.json of an earlier capture with the same camera."
    content = read_json_object(file, remedy)
    if not isinstance(content.get("thermal_camera"), dict):
        raise SceneError(str(file), expected="'thermal_camera' and 'rig'", got="neither or one", remedy=remedy)
    camera = read_intrinsics(content["thermal_camera"], {}, None, f"{file.name}: thermal_camera")
    transform = read_pose(content.get("rig"), f"{file}: rig")
    if (camera.width, camera.height) != thermal_size:
        expected = f"{thermal_size[0]} x {thermal_size[1]} pixels, as the images have"
        got, remedy = f"{camera.width} x {camera.height}", "Pass the rig of the same camera and mode."
        raise SceneError(f"{file.name}: thermal_camera", expected=expected, got=got, remedy=remedy)
    theirs = content.get("metres_per_unit")
    if metres_per_unit is not None and isinstance(theirs, (int, float)) and 0.0 < theirs < math.inf:
        transform[:3, 3] *= theirs / metres_per_unit
        lengths = "its lengths converted by the two scales"
    else:
        lengths = "its lengths taken for those of this scene, because not both have a scale"
    return RigEstimate(camera, transform, True, f"Given in {file.name}, {lengths}.")
