import io
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps
from scipy.spatial.transform import Rotation

from tests.support.posed_model import CAMERA, ring_model
from thermoxels_ns.capture.photograph import GpsFix
from thermoxels_ns.capture.sfm.scale_and_up import find_up, local_metres, scale_from_gps, scale_from_markers
from thermoxels_ns.capture.sfm.sfm_model import SfmModel
from thermoxels_ns.synthetic.scene_truth import look_at

UNIT_M = 0.37


def fixes_at(metres):
    """GPS fixes around 48 degrees north of points east, north and up, by the lengths of a degree on the ellipsoid."""
    north, east = 111_200.6, 74_627.7  # metres per degree at 48 degrees north (WGS 84)
    return [GpsFix(48 + n / north, 11 + e / east, 500 + u) for e, n, u in metres]


def path(count=40, size_m=30.0, seed=0):
    return np.random.default_rng(seed).uniform(-size_m, size_m, (count, 3)) * (1, 1, 0.2)


def test_lengths_of_degrees_are_those_of_the_ellipsoid():
    local = local_metres([*(GpsFix(48.0, 11.0, height) for height in (1.0, None, 3.0)), GpsFix(48.001, 11.001, 2.0)])
    assert local[3, :2] - local[0, :2] == pytest.approx([74.63, 111.20], abs=0.02)
    assert local[:3, 2] - local[1, 2] == pytest.approx([-1, 0, 1])
    across = local_metres([GpsFix(0.0, 179.9999, 0.0), GpsFix(0.0, -179.9999, 0.0)])  # the date line
    assert abs(across[1, 0] - across[0, 0]) == pytest.approx(22.26, abs=0.01)


@pytest.mark.parametrize(("wild_m", "accuracy"), [(0.0, 2e-4), (500.0, 0.03)])
def test_gps_gives_the_scale_and_one_wild_fix_hardly_moves_it(wild_m, accuracy):
    metres, fixes = path(), path()
    fixes[3] += wild_m
    scale, why = scale_from_gps(metres[:, [1, 2, 0]] / UNIT_M, fixes_at(fixes))
    assert scale is not None, why
    assert scale.metres_per_unit == pytest.approx(UNIT_M, rel=accuracy)


def test_gps_error_is_the_scatter_over_many_captures():
    found, claimed = [], []
    for seed in range(60):
        metres = path(seed=seed)
        noisy = metres + np.random.default_rng(1000 + seed).normal(0, 2.0, metres.shape)
        scale, why = scale_from_gps(metres / UNIT_M, fixes_at(noisy))
        assert scale is not None and scale.standard_error is not None, why
        found.append(scale.metres_per_unit)
        claimed.append(scale.standard_error)
    assert np.mean(claimed) == pytest.approx(np.std(found), rel=0.35)


@pytest.mark.parametrize(
    ("fixes", "words"),
    [
        ([None] * 5, "no photograph has a GPS position"),
        ([GpsFix(48, 11, 0)] * 2 + [None] * 3, "4 are needed"),
        (fixes_at(np.random.default_rng(0).normal(0, 5, (5, 3))), "scatter too much"),
    ],
)
def test_gps_that_says_nothing_is_not_used(fixes, words):
    scale, why = scale_from_gps(0.01 * np.random.default_rng(1).normal(size=(5, 3)), fixes)
    assert scale is None
    assert words in why


def wall_photographs(model: SfmModel, places: list[float], folder: Path, unit_m: float = 1.0) -> dict[str, Path]:
    """Photographs of a wall with an ArUco marker of 0.4 m, whose middle is at x as given in each of them."""
    marker = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), 7, 240)
    texture = cv2.copyMakeBorder(marker, 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=255)
    pixel = np.stack(np.meshgrid(np.arange(640) + 0.5, np.arange(480) + 0.5), -1).reshape(-1, 2)
    files = {}
    for name, pose, place in zip(model.frames, model.camera_to_world, places):
        rays = CAMERA.rays(pixel) * (1, -1, -1) @ pose[:3, :3].T
        centre = pose[:3, 3] * unit_m
        hit = centre + rays * ((1.0 - centre[1]) / rays[:, 1])[:, None]
        x = ((hit[:, 0] - place + 0.3) / 0.6 * 360 - 0.5).astype(np.float32).reshape(480, 640)
        y = ((1.3 - hit[:, 2]) / 0.6 * 360 - 0.5).astype(np.float32).reshape(480, 640)
        seen = cv2.remap(texture, x, y, cv2.INTER_AREA, borderMode=cv2.BORDER_CONSTANT, borderValue=(128,))
        files[name] = folder / f"{name}.png"
        Image.fromarray(seen).save(files[name])
    return files


def test_a_marker_gives_the_scale_and_one_that_moved_between_photographs_none(tmp_path):
    model = ring_model(count=4, unit_m=UNIT_M)
    scale, why = scale_from_markers(model, wall_photographs(model, [0.0] * 4, tmp_path, UNIT_M), 0.4, 0.001)
    assert scale is not None and scale.standard_error is not None, why
    assert scale.metres_per_unit == pytest.approx(UNIT_M, rel=0.01)
    assert abs(scale.metres_per_unit - UNIT_M) < 4 * scale.standard_error
    assert "1 ArUco marker of 0.4 m (7)" in scale.source
    moved = wall_photographs(model, [-0.3, 0.3, -0.3, 0.3], tmp_path, UNIT_M)
    found, why = scale_from_markers(model, moved, 0.4)
    assert found is None and "[7]" in why


def test_places_that_are_a_mirror_image_of_the_path_are_no_scale() -> None:
    """No turn and no stretching makes a left hand a right one."""
    metres = np.random.default_rng(0).uniform(-30.0, 30.0, (40, 3))
    mirrored, _ = scale_from_gps(metres * (-2.0, 2.0, 2.0), fixes_at(metres))
    assert mirrored is None or mirrored.metres_per_unit < 0.8 * 0.5


SHAKEN = Rotation.from_euler("xyz", [40, -70, 25], degrees=True).as_matrix()
"""World in which nothing is level; its up is the third column."""


def held(azimuths_deg, pitches_deg, rolls_deg):
    """Poses of cameras that are turned, pitched and rolled against gravity, in the shaken world."""
    poses = []
    for azimuth, pitch, roll in zip(azimuths_deg, pitches_deg, rolls_deg):
        a, p = np.radians([azimuth, pitch])
        ahead = [np.cos(a) * np.cos(p), np.sin(a) * np.cos(p), np.sin(p)]
        pose = look_at((0.0, 0.0, 0.0), ahead)
        # A roll to the right, seen from behind, turns the camera clockwise about its view direction.
        pose[:3, :3] = pose[:3, :3] @ Rotation.from_euler("z", -roll, degrees=True).as_matrix()
        pose[:3, :3] = SHAKEN @ pose[:3, :3]
        poses.append(pose)
    return np.array(poses)


def off_deg(up):
    return np.degrees(np.arccos(np.clip(up.direction @ SHAKEN[:, 2], -1, 1)))


def test_up_of_pitch_and_roll_is_exact():
    azimuths, pitches, rolls = [0, 50, 170, 300], [-30, -80, 10, 0], [0, 5, -12, 90]
    up = find_up(held(azimuths, pitches, rolls), list(zip(pitches, rolls)), [1] * 4)
    assert off_deg(up) < 1e-5
    assert "pitch and roll that 4 photographs state" in up.source


def test_cameras_that_look_one_way_and_are_rolled_a_little_give_up():
    """The axes of their sides fill no plane, whose normal would be anywhere."""
    draws = np.random.default_rng(0)
    count, off = 40, []
    for _ in range(20):
        turned, pitched, rolled = (draws.normal(0.0, spread, count) for spread in (5.0, 3.0, 3.0))
        off.append(off_deg(find_up(held(turned, pitched, rolled), [None] * count, [1] * count)))
    assert np.quantile(off, 0.9) < 3.0


@pytest.mark.parametrize(("pitched_deg", "rolled_deg", "limit_deg"), [(-35.0, 0.0, 1e-5), (0.0, 2.0, 1.5)])
def test_cameras_that_are_pitched_down_or_rolled_one_by_one_still_give_up(pitched_deg, rolled_deg, limit_deg):
    count = 30
    rolls = rolled_deg * np.random.default_rng(1).standard_normal(count)
    up = find_up(held(np.linspace(0, 90, count), [pitched_deg] * count, rolls), [None] * count, [1] * count)
    assert off_deg(up) < limit_deg
    assert "held level" in up.source


@pytest.mark.parametrize("orientation", range(1, 9))
def test_the_upper_edge_is_where_the_picture_has_it_after_turning(orientation):
    """Pillow turns a stored picture upright; the edge that is then on top is the one that up points to."""
    identity = np.eye(4)[None]
    x, y, _ = find_up(identity, [None], [orientation]).direction.round()
    stored = np.zeros((4, 4), dtype=np.uint8)
    rows = {1: slice(0, 1), -1: slice(3, 4), 0: slice(None)}[int(y)]
    columns = {1: slice(3, 4), -1: slice(0, 1), 0: slice(None)}[int(x)]
    stored[rows, columns] = 255
    picture = Image.fromarray(stored)
    picture.getexif()[274] = orientation
    stream = io.BytesIO()
    picture.save(stream, "PNG", exif=picture.getexif())
    upright = np.asarray(ImageOps.exif_transpose(Image.open(stream)))
    assert (upright[0] == 255).all() and (upright[1:] == 0).all()


def test_cameras_that_look_straight_down_do_not_say_that_up_is_where_they_look_from() -> None:
    """Their sides are level however they turn; the tops of their pictures all point north, which is what they show."""
    turns = np.linspace(-20.0, 20.0, 20)
    poses = np.tile(np.eye(4), (len(turns), 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("z", turns[:, None], degrees=True).as_matrix()
    up = find_up(poses, [None] * len(poses), [1] * len(poses))
    assert "mean of the photographs' upward directions" in up.source
    assert up.direction == pytest.approx([0.0, 1.0, 0.0], abs=0.05)


def test_photographs_whose_levels_are_wrong_are_outvoted() -> None:
    """Eight say the same; three that say otherwise do not move it at all."""
    level = np.array([look_at((0.0, 0.0, 0.0), (np.cos(a), np.sin(a), 0.0)) for a in np.linspace(0.0, 3.0, 11)])
    angles = [(0.0, 0.0)] * 8 + [(0.0, 60.0), (0.0, 70.0), (50.0, 0.0)]
    up = find_up(level, angles, [1] * 11)
    assert up.direction == pytest.approx([0.0, 0.0, 1.0], abs=1e-9)
