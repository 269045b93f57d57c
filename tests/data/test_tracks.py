"""Sparse points and who sees them: from a COLMAP model, as lines of sight in training."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.support.posed_model import write_colmap_model
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.data.colmap_model import COLMAP_FOLDERS, matched_names
from thermoxels_ns.data.dataparser import ThermalDataParserConfig
from thermoxels_ns.data.scene_box import find_scene_box
from thermoxels_ns.data.scene_file import read_scene_file
from thermoxels_ns.data.tracks import MOST_ERROR_PX, SparseTracks, feature_rays, find_tracks

TAGS = ["train", "train", "eval", "train", "train", "train"]
NAMES = [f"frame_{tag}_{number:05d}" for number, tag in enumerate(TAGS)]
POINTS = np.random.default_rng(0).uniform(-0.5, 0.5, (30, 3))


@pytest.fixture
def scene(scene_folder):
    """A scene of six photographs, without points."""
    return scene_folder(frames=len(NAMES), names=NAMES, scene_box=[[-1, -1, -1], [1, 1, 1]])


def frames_of(folder, side=""):
    return [frame for frame in read_scene_file(folder.path).frames if side in frame.name]


def add_model(
    folder, where="colmap/sparse/0", frames=None, names=None, focal_factor=1.0, points=POINTS, **more
) -> None:
    frames = frames_of(folder) if frames is None else frames
    lens, names = frames[0].intrinsics, names or [frame.image.name for frame in frames]
    camera = Camera(lens.width, lens.height, lens.fl_x, lens.fl_y, lens.cx, lens.cy)
    camera = camera.resized(*(round(side * focal_factor) for side in (lens.width, lens.height)))
    poses = [frame.pose for frame in frames]
    write_colmap_model(folder.path / where, names, poses, camera, points, **{"lens": "PINHOLE", **more})


def tracks_of(folder) -> SparseTracks:
    return find_tracks(read_scene_file(folder.path))


def lines_of(folder, split="train", **options):
    return ThermalDataParserConfig(data=folder.path, **options).setup().get_dataparser_outputs(split)


@pytest.mark.parametrize("where", COLMAP_FOLDERS)
def test_points_of_a_model_wherever_it_may_lie_make_lines_and_the_box(scene_folder, where):
    scene = scene_folder(frames=len(NAMES), names=NAMES, scene_box=None)
    add_model(scene, where)
    tracks = tracks_of(scene)
    assert np.sort(tracks.points, axis=0) == pytest.approx(np.sort(POINTS, axis=0), abs=1e-6)
    assert sum(map(len, tracks.seen.values())) == 6 * 30
    lines = lines_of(scene).metadata["feature_rays"]
    assert len(lines.points) == 30 and len(lines.origins) == 5 * 30  # the one that evaluates is left out
    evidence = find_scene_box(read_scene_file(scene.path), None, range(len(NAMES)), tracks)
    box = evidence.box
    assert evidence.source == f"the points of {where}"
    assert (box[0] < POINTS.min(axis=0)).all() and (box[1] > POINTS.max(axis=0)).all() and np.abs(box).max() < 0.6


def test_a_scene_captured_by_an_earlier_version_says_why_it_trains_without_tracks(scene, capsys):
    scene.meta["tracks_file_path"] = "sparse_tracks.npz"
    scene.rewrite()
    assert lines_of(scene).metadata["feature_rays"] is None
    assert "Capture the scene again" in " ".join(capsys.readouterr().out.split())


def test_the_json_says_how_its_world_differs_from_the_models(scene):
    turn = np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]])
    add_model(scene, turn=turn.T, shift=(0.0, 0.0, 1.0))
    assert lines_of(scene).metadata["feature_rays"] is None
    scene.meta["applied_transform"] = np.column_stack([turn, -turn @ [0.0, 0.0, 1.0]]).tolist()
    scene.rewrite()
    assert np.sort(tracks_of(scene).points, axis=0) == pytest.approx(np.sort(POINTS, axis=0), abs=1e-6)


def test_without_a_model_and_switched_off_there_are_no_lines(scene):
    assert lines_of(scene).metadata["feature_rays"] is None
    add_model(scene)
    assert lines_of(scene).metadata["feature_rays"] is not None
    assert lines_of(scene, tracks="off").metadata["feature_rays"] is None


def test_some_wrong_poses_are_left_out_and_named_and_move_nothing(scene, capsys):
    frames = frames_of(scene)
    add_model(scene, frames=frames)
    entry = next(one for one in scene.meta["frames"] if frames[4].image.name in one["file_path"])
    entry["transform_matrix"][0][3] += 2.0
    scene.rewrite()
    tracks = tracks_of(scene)
    assert np.sort(tracks.points, axis=0) == pytest.approx(np.sort(POINTS, axis=0), abs=1e-6)
    assert set(tracks.seen) == {one.name for one in frames} - {frames[4].name}
    assert frames[4].name in capsys.readouterr().out.replace("\n", "")


def _turned(frames, degrees: float):
    """The frames, looking so far to the side: 4 pixels with a focal length of 1000."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0.0, np.radians(degrees), 0.0]).as_matrix()
    return [replace(frame, pose=frame.pose @ turn) for frame in frames]


def _changed(scene, name: str, change, **options) -> None:
    add_model(scene, **options)
    path = scene.path / "colmap/sparse/0" / name
    path.write_bytes(change(path.read_bytes()))


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda s, f: add_model(s, frames=f[3:] + f[:3], names=[one.image.name for one in f]), "poses are others"),
        (lambda s, f: add_model(s, frames=_turned(f, 0.25)), "poses are others"),
        (lambda s, f: add_model(s, names=[f"other_{n}.jpg" for n in range(6)]), "no photograph of this scene"),
        (lambda s, f: add_model(s, frames=f[:2]), "2 of 2 photographs agree"),
        (lambda s, f: add_model(s, points=POINTS + np.array([0.0, 0.0, 100.0])), "behind the photographs"),
        (lambda s, f: _changed(s, "points3D.bin", lambda _: b""), "points3D as .bin or .txt) that can be read"),
        *(
            (lambda s, f, name=name: _changed(s, name, lambda b: b[:-1]), "points3D as .bin or .txt) that can be read")
            for name in ("cameras.bin", "images.bin", "points3D.bin")
        ),
    ],
)
def test_models_that_cannot_be_used_are_left_out_with_a_warning(scene, capsys, spoil, said):
    spoil(scene, frames_of(scene))
    assert lines_of(scene).metadata["feature_rays"] is None
    assert said in " ".join(capsys.readouterr().out.split())


def test_errors_are_pixels_of_the_photographs_and_the_worst_that_counts_where_colmap_gives_none(scene):
    add_model(scene, focal_factor=0.5, error=0.4)
    assert tracks_of(scene).point_error_px == pytest.approx(0.8)
    add_model(scene, error=-1.0)
    assert (tracks_of(scene).point_error_px == MOST_ERROR_PX).all()


def test_photographs_of_one_name_are_told_apart_by_their_folders():
    images = ["left/1.jpg", "right/1.jpg", "2.jpg"]
    assert matched_names(images, ["images/right/1.jpg", "images/left/1.jpg", "images/2.jpg"]) == [
        (1, 0),
        (0, 1),
        (2, 2),
    ]
    assert matched_names(images, ["images/1.jpg", "2.jpg"]) == [(2, 1)]
    assert matched_names(["1.jpg"], ["a/1.jpg", "b/1.jpg"]) == matched_names(["1.tif", "1.png"], ["1.jpg"]) == []
    for files in (["images/1.jpg", "images/1.npy"], ["images/1.jpg", "images/thermal/1.png"]):
        assert matched_names(["1.jpg"], files) == [(0, 0)]  # whole names count before names without suffixes


def test_lines_begin_at_training_cameras_only_and_end_at_the_points_of_the_new_world(scene):
    add_model(scene)
    outputs = lines_of(scene)
    lines = outputs.metadata["feature_rays"]
    centres = outputs.cameras.camera_to_worlds[:, :, 3].double().numpy()
    assert len(lines.origins) == 5 * 30
    nearest = np.linalg.norm(lines.origins[:, None] - centres, axis=2)
    assert nearest.min(axis=1).max() < 1e-5
    assert np.bincount(nearest.argmin(axis=1)).tolist() == [30] * 5
    transform = outputs.dataparser_transform.double().numpy()
    moved = outputs.dataparser_scale * (tracks_of(scene).points @ transform[:, :3].T + transform[:, 3])
    assert lines.points == pytest.approx(moved, abs=1e-6)
    assert (np.diff(lines.point) >= 0).all()
    assert lines_of(scene, "val").metadata["feature_rays"] is None


def test_a_point_that_its_neighbours_contradict_is_listed_without_lines(scene):
    frames = frames_of(scene, "train")
    points = np.zeros((300, 3))  # a wall, seen by the photographs on one side of it
    points[:, 1:] = np.random.default_rng(3).uniform(-0.5, 0.5, (300, 2))
    front = [number for number, frame in enumerate(frames) if frame.pose[0, 3] > 0]
    tracks = SparseTracks(points, np.full(300, 0.5), {frames[number].name: np.arange(300) for number in front})
    assert np.bincount(feature_rays(tracks, frames).point).tolist() == [len(front)] * 300
    middle = int(np.argmin(np.abs(points).sum(axis=1)))
    points[middle] += 0.1 * (np.mean([frames[number].pose[:3, 3] for number in front], axis=0) - points[middle])
    lines = feature_rays(tracks, frames)
    assert len(lines.points) == 300
    assert sorted(set(range(300)) - set(lines.point.tolist())) == [middle]


def test_badly_known_points_and_those_behind_a_camera_are_left_out(scene):
    add_model(scene)
    tracks, frames = tracks_of(scene), frames_of(scene, "train")
    error, points = tracks.point_error_px.copy(), tracks.points.copy()
    error[:4] = 3.0
    points[4] = np.nan
    lines = feature_rays(replace(tracks, point_error_px=error, points=points), frames)
    assert np.array_equal(lines.points, tracks.points[5:])
    points[4] = frames[0].pose[:3, 3] + 50.0 * frames[0].pose[:3, 2]  # behind one camera, and so seen by nobody
    lines = feature_rays(replace(tracks, points=points), frames)
    axis, centres = (np.stack([sign * frame.pose[:3, at] for frame in frames]) for sign, at in ((-1, 2), (1, 3)))
    camera = np.linalg.norm(lines.origins[:, None] - centres, axis=2).argmin(axis=1)
    assert ((lines.points[lines.point] - lines.origins) * axis[camera]).sum(axis=1).min() > 0.0
    # One camera, or cameras at one place, know no distances.
    for some in (frames[:1], [replace(frame, pose=frames[0].pose) for frame in frames]):
        assert len(feature_rays(tracks, some).points) == 0


def test_the_error_of_a_length_is_that_of_a_triangulation(scene):
    frame = frames_of(scene)[0]
    frames = []
    for number, x in enumerate((-1.0, 0.0, 1.0)):
        pose = np.eye(4)
        pose[:3, 3] = (x, 0.0, 2.0)
        frames.append(replace(frame, name=str(number), pose=pose))
    one = SparseTracks(np.zeros((1, 3)), np.ones(1), {name: np.zeros(1, np.int64) for name in "012"})
    lines = feature_rays(one, frames)
    angle = 2.0 * np.arctan2(1.0, 2.0)
    expected = 1.0 / frame.intrinsics.fl_x / np.sin(angle) * np.sqrt([5.0, 4.0, 5.0])
    assert lines.uncertainty == pytest.approx(expected)
