from dataclasses import replace

import numpy as np
import pytest

from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.data.dataparser import ThermalDataParserConfig
from thermoxels_ns.data.scene_file import read_scene_file
from thermoxels_ns.data.tracks import TRACKS_KEY, SparseTracks, feature_rays, write_tracks

TAGS = ["train", "train", "eval", "train", "train", "train"]
NAMES = [f"frame_{tag}_{number:05d}" for number, tag in enumerate(TAGS)]


@pytest.fixture
def scene(scene_folder):
    """A scene of six photographs that all see all points."""
    folder = scene_folder(frames=len(NAMES), names=NAMES)
    files = tuple(entry["file_path"] for entry in folder.meta["frames"])
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (30, 3))
    frame, point = (axis.reshape(-1) for axis in np.meshgrid(range(len(files)), range(30), indexing="ij"))
    tracks = SparseTracks(points, np.full(30, 0.5), files, frame, point)
    folder.meta[TRACKS_KEY] = "tracks.npz"
    folder.rewrite()
    write_tracks(folder.path / "tracks.npz", tracks)
    return folder, tracks


def lines_of(folder, split: str = "train", **options):
    return ThermalDataParserConfig(data=folder.path, **options).setup().get_dataparser_outputs(split)


def test_lines_begin_at_training_cameras_only_and_end_at_the_points_of_the_new_world(scene):
    folder, tracks = scene
    outputs = lines_of(folder)
    lines = outputs.metadata["feature_rays"]
    centres = outputs.cameras.camera_to_worlds[:, :, 3].double().numpy()
    assert len(lines.origins) == 5 * 30
    nearest = np.linalg.norm(lines.origins[:, None] - centres, axis=2)
    assert nearest.min(axis=1).max() < 1e-5
    assert np.bincount(nearest.argmin(axis=1)).tolist() == [30] * 5
    transform = outputs.dataparser_transform.double().numpy()
    moved = outputs.dataparser_scale * (tracks.points @ transform[:, :3].T + transform[:, 3])
    assert lines.points == pytest.approx(moved, abs=1e-6)
    assert (np.diff(lines.point) >= 0).all()
    assert lines_of(folder, "val").metadata["feature_rays"] is None


def test_a_point_that_its_neighbours_contradict_is_listed_without_lines(scene):
    folder, tracks = scene
    points = np.zeros((300, 3))  # a wall, seen by the three photographs on one side of it
    points[:, 1:] = np.random.default_rng(3).uniform(-0.5, 0.5, (300, 2))
    centres = np.array([np.array(entry["transform_matrix"])[:3, 3] for entry in folder.meta["frames"]])
    frame, point = (a.reshape(-1) for a in np.meshgrid(np.flatnonzero(centres[:, 0] > 0), range(300), indexing="ij"))
    tracks = SparseTracks(points, np.full(300, 0.5), tracks.frames, frame, point)
    write_tracks(folder.path / "tracks.npz", tracks)
    assert np.bincount(lines_of(folder).metadata["feature_rays"].point).tolist() == [3] * 300
    middle = int(np.argmin(np.abs(points).sum(axis=1)))
    points[middle] += 0.1 * (centres[centres[:, 0] > 0].mean(axis=0) - points[middle])
    write_tracks(folder.path / "tracks.npz", tracks)
    lines = lines_of(folder).metadata["feature_rays"]
    assert len(lines.points) == 300
    assert sorted(set(range(300)) - set(lines.point.tolist())) == [middle]


def test_badly_known_points_are_left_out(scene):
    folder, tracks = scene
    error = tracks.point_error_px.copy()
    error[:4] = 3.0
    points = tracks.points.copy()
    points[4] = np.nan
    frames = [frame for frame in read_scene_file(folder.path).frames if "train" in frame.name]
    lines = feature_rays(replace(tracks, point_error_px=error, points=points), frames)
    assert np.array_equal(lines.points, tracks.points[5:])
    # Cameras at one place know no distances.
    together = [replace(frame, pose=frames[0].pose) for frame in frames]
    assert len(feature_rays(tracks, together).points) == 0


def test_one_camera_and_points_behind_it(scene):
    folder, tracks = scene
    frames = [frame for frame in read_scene_file(folder.path).frames if "train" in frame.name]
    assert len(feature_rays(tracks, frames[:1]).points) == 0
    points = tracks.points.copy()
    points[0] = frames[0].pose[:3, 3] + 50.0 * frames[0].pose[:3, 2]  # behind one camera, and so seen by nobody
    lines = feature_rays(replace(tracks, points=points), frames)
    axis = np.stack([-frame.pose[:3, 2] for frame in frames])
    camera = np.linalg.norm(lines.origins[:, None] - np.stack([f.pose[:3, 3] for f in frames]), axis=2).argmin(axis=1)
    assert ((lines.points[lines.point] - lines.origins) * axis[camera]).sum(axis=1).min() > 0.0


def test_the_error_of_a_length_is_that_of_a_triangulation(scene):
    folder, _ = scene
    frame = read_scene_file(folder.path).frames[0]
    frames = []
    for number, x in enumerate((-1.0, 0.0, 1.0)):
        pose = np.eye(4)
        pose[:3, 3] = (x, 0.0, 2.0)
        frames.append(replace(frame, name=str(number), pose=pose))
    one = SparseTracks(np.zeros((1, 3)), np.ones(1), ("0", "1", "2"), np.arange(3), np.zeros(3, dtype=np.int64))
    lines = feature_rays(one, frames)
    angle = 2.0 * np.arctan2(1.0, 2.0)
    expected = 1.0 / frame.intrinsics.fl_x / np.sin(angle) * np.sqrt([5.0, 4.0, 5.0])
    assert lines.uncertainty == pytest.approx(expected)


def _rewritten(**changes):
    """Write tracks in which some arrays are others, made of those that are there."""
    return lambda path, tracks: write_tracks(path, replace(tracks, **{k: make(tracks) for k, make in changes.items()}))


@pytest.mark.parametrize(
    ("spoil", "named"),
    [
        (_rewritten(frames=lambda _: tuple(f"other_{n}" for n in range(6))), "photographs of this scene.*other_0"),
        (_rewritten(points=lambda tracks: tracks.points + np.array([0.0, 0.0, 100.0])), "behind"),
        (_rewritten(sighting_point=lambda tracks: tracks.sighting_point + 1), "pairs of their numbers"),
        (lambda path, _: path.write_bytes(b""), "points"),
        (lambda path, _: path.write_bytes(b"not a zip"), "points"),
        (lambda path, _: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]), "points"),
        (lambda path, tracks: np.savez(path, points=tracks.points), "point_error_px"),
        (lambda path, _: path.unlink(), "points"),
    ],
)
def test_files_of_tracks_that_cannot_be_used_are_refused(scene, spoil, named):
    folder, tracks = scene
    spoil(folder.path / "tracks.npz", tracks)
    with pytest.raises(SceneError, match=rf"tracks\.npz.*{named}"):
        lines_of(folder)


@pytest.mark.parametrize("outside", ["../tracks.npz", "{folder}/../tracks.npz"])
def test_tracks_outside_the_scene_are_refused(scene, outside):
    folder, tracks = scene
    write_tracks(folder.path.parent / "tracks.npz", tracks)
    folder.meta[TRACKS_KEY] = outside.format(folder=folder.path)
    folder.rewrite()
    with pytest.raises(SceneError, match=r"tracks_file_path.*tracks\.npz"):
        lines_of(folder)
