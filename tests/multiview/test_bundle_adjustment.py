import cv2
import numpy as np
import pytest

from thermoxels_ns.core.camera import Camera
from thermoxels_ns.multiview.bundle_adjustment import (
    FEWEST_TRACKS,
    Features,
    Tracks,
    _distances,
    adjust_poses,
    features_of,
    find_tracks,
)
from thermoxels_ns.synthetic.imperfections import DrawnFlaws, Imperfections
from thermoxels_ns.synthetic.raycast import render_view
from thermoxels_ns.synthetic.scene_folder import make_scene
from thermoxels_ns.synthetic.scene_truth import look_at

FOCAL, VIEWS = 300.0, 12


def poses() -> np.ndarray:
    angles = np.linspace(0.0, 2.0 * np.pi, VIEWS, endpoint=False)
    return np.stack([look_at((4 * np.cos(a), 4 * np.sin(a), 1.0 + 0.3 * np.sin(3 * a)), (0, 0, 0)) for a in angles])


def off_by(angle_deg: float, seed: int = 0) -> np.ndarray:
    flaws = Imperfections(pose_error_deg=angle_deg)
    return DrawnFlaws(flaws, seed, poses(), (0.0, 0.0, 0.0)).given_poses()


def tracks(noise_px: float = 0.2, points: int = 400, seed: int = 1) -> Tracks:
    """What cameras on a ring see of points in a ball; each point by about half of them."""
    draw = np.random.default_rng(seed)
    world = draw.normal(0.0, 0.5, (points, 3))
    seen = draw.random((points, VIEWS)) < 0.5
    seen[:, :2] |= (seen.sum(1) < 2)[:, None]
    point, photograph = np.nonzero(seen)
    turned = poses()[photograph][:, :3, :3] * np.array([1.0, -1.0, -1.0])
    local = np.einsum("nji,nj->ni", turned, world[point] - poses()[photograph, :3, 3])
    place = local[:, :2] / local[:, 2:] + noise_px / FOCAL * draw.standard_normal((len(local), 2))
    return Tracks(photograph, point, place)


def inconsistency_px(estimated: np.ndarray) -> float:
    """Median distance between exact sightings and points triangulated from poses: what a reconstruction suffers."""
    return float(np.median(_distances(tracks(noise_px=0.0), estimated, np.full(VIEWS, FOCAL))))


@pytest.mark.parametrize("angle_deg", [0.15, 0.3])
def test_poses_that_are_off_are_found_fivefold_nearer_where_and_as_large_as_the_given_ones(angle_deg):
    given = off_by(angle_deg)
    found = adjust_poses(tracks(), given, np.full(VIEWS, FOCAL))
    assert found is not None and found.after_px < found.before_px
    assert inconsistency_px(found.poses) < 0.2 * inconsistency_px(given)
    centres, before = found.poses[:, :3, 3], given[:, :3, 3]
    np.testing.assert_allclose(centres.mean(0), before.mean(0), atol=1e-9)
    spread = [np.sqrt(((c - c.mean(0)) ** 2).sum()) for c in (centres, before)]
    assert abs(spread[0] / spread[1] - 1.0) < 1e-3
    np.testing.assert_allclose(np.linalg.det(found.poses[:, :3, :3]), 1.0, atol=1e-9)
    mean_turn = np.einsum("nij,nkj->ik", given[:, :3, :3], found.poses[:, :3, :3])
    np.testing.assert_allclose(mean_turn, mean_turn.T, atol=1e-6)


@pytest.mark.parametrize(("unit", "shift"), [(1000.0, (0.0, 0.0, 0.0)), (1.0, (4.5e6, 5.3e6, 120.0))])
def test_size_and_beginning_of_the_world_do_not_matter(unit, shift):
    given, other = off_by(0.3), off_by(0.3)
    other[:, :3, 3] = unit * other[:, :3, 3] + shift
    found, found_other = (adjust_poses(tracks(), each, np.full(VIEWS, FOCAL)) for each in (given, other))
    np.testing.assert_allclose((found_other.poses[:, :3, 3] - shift) / unit, found.poses[:, :3, 3], atol=1e-5)
    np.testing.assert_allclose(found_other.poses[:, :3, :3], found.poses[:, :3, :3], atol=1e-6)


@pytest.mark.parametrize("off_px", [3.0, 10.0, 200.0])
def test_wrong_matches_do_little_harm(off_px):
    seen, draw = tracks(), np.random.default_rng(3)
    wrong = draw.random(len(seen.point)) < 0.1
    shift = off_px / FOCAL * (1.0 + 0.3 * draw.standard_normal(seen.place.shape))  # to one side, as of a moving shadow
    given = off_by(0.15)
    found = adjust_poses(
        Tracks(seen.photograph, seen.point, seen.place + wrong[:, None] * shift), given, np.full(VIEWS, FOCAL)
    )
    assert found is not None and inconsistency_px(found.poses) < 0.15 * inconsistency_px(given)


def test_a_photograph_with_hardly_a_feature_stays_nearly_where_it_is():
    seen, given = tracks(noise_px=1.0), off_by(0.3)
    few = np.flatnonzero(seen.photograph == 5)[3:]
    kept = np.ones(len(seen.point), dtype=bool)
    kept[few] = False
    seen = Tracks(seen.photograph[kept], seen.point[kept], seen.place[kept])
    found = adjust_poses(seen, given, np.full(VIEWS, FOCAL))
    turn = found.poses[5, :3, :3] @ given[5, :3, :3].T
    assert np.rad2deg(np.arccos((np.trace(turn) - 1.0) / 2.0)) < 1.0
    assert np.linalg.norm(found.poses[5, :3, 3] - given[5, :3, 3]) < 0.05


def test_matches_far_from_their_lines_are_none():
    """Of twelve features in two photographs taken side by side one lies too low in the second."""
    camera, side = Camera(200, 100, FOCAL, FOCAL, 100.0, 50.0), np.repeat(np.eye(4)[None], 2, axis=0)
    side[1, 0, 3], looks = 0.3, np.eye(12, 16, dtype=np.float32)
    one = np.column_stack((10.0 * np.arange(12) + 5.0, 5.0 * np.arange(12) + 5.0))
    other = one - (4.0, 0.0)
    other[3, 1] += 40.0
    assert find_tracks([Features(one, looks), Features(other, looks)], [camera] * 2, side).points == 11


def test_features_lie_where_rays_say_that_they_do():
    rows, columns = np.mgrid[:80, :100] + 0.5
    spot = 255.0 * np.exp(-((columns - 40.2) ** 2 + (rows - 31.7) ** 2) / (2.0 * 4.0**2))
    pixels = features_of(np.round(spot).astype(np.uint8)).pixels
    assert np.abs(pixels - (40.2, 31.7)).max(1).min() < 0.2


def test_too_few_tracks_say_nothing():
    few = tracks(points=FEWEST_TRACKS - 1)
    assert adjust_poses(few, off_by(0.3), np.full(VIEWS, FOCAL)) is None
    none = Tracks(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2)))
    assert adjust_poses(none, poses(), np.full(VIEWS, FOCAL)) is None


def test_photographs_of_other_brightness_have_the_same_tracks():
    scene = make_scene("house-corner")
    camera, views = scene.camera(160, 120), scene.poses(8, 0)[0]
    pictures = [render_view(scene, view, camera).rgb for view in views]
    found = []
    for gains in (np.ones(8), 2.0 ** np.random.default_rng(0).normal(0.0, 0.3, 8)):
        grey = [cv2.cvtColor(np.clip(g * p, 0, 1), cv2.COLOR_RGB2GRAY) for g, p in zip(gains, pictures)]
        features = [features_of(np.round(255.0 * picture).astype(np.uint8)) for picture in grey]
        found.append(find_tracks(features, [camera] * 8, views))
    alike, changed = (each.points for each in found)
    assert alike > 50 and changed > 0.6 * alike
    for each in found:
        pairs = each.point * 8 + each.photograph
        assert len(np.unique(pairs)) == len(pairs)
        assert np.bincount(each.point).min() >= 2
