import io

import numpy as np
import pytest
from PIL import Image, ImageOps
from scipy.spatial.transform import Rotation

from thermoxels_ns.capture.sfm.scale_and_up import find_up, level_rotation
from thermoxels_ns.synthetic.camera_rings import look_at

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
    assert up.spread_deg == pytest.approx(0, abs=1e-5)
    assert "pitch and roll that 4 photographs state" in up.source


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


def test_levelling_turns_up_to_z_and_ahead_to_y():
    rng = np.random.default_rng(0)
    for _ in range(20):
        up, ahead = rng.normal(size=(2, 3))
        rotation = level_rotation(up, ahead)
        assert rotation @ rotation.T == pytest.approx(np.eye(3))
        assert np.linalg.det(rotation) == pytest.approx(1)
        assert rotation @ up / np.linalg.norm(up) == pytest.approx([0, 0, 1])
        assert (rotation @ ahead)[0] == pytest.approx(0)
        assert (rotation @ ahead)[1] > 0


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
