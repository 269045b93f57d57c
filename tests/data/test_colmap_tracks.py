import shutil
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.data.colmap_tracks import _matched, read_colmap_tracks
from thermoxels_ns.data.dataparser import ThermalDataParserConfig
from thermoxels_ns.data.scene_box import find_scene_box
from thermoxels_ns.data.scene_file import read_scene_file
from thermoxels_ns.data.tracks import COLMAP_FOLDERS, TRACKS_KEY, SparseTracks, check_complete, write_tracks

TAGS = ["train", "train", "eval", "train", "train", "train"]
NAMES = [f"frame_{tag}_{number:05d}" for number, tag in enumerate(TAGS)]
SCALE, SHIFT = 2.5, np.array([0.3, -4.0, 1.0])
TURN = pycolmap.Rotation3d(np.array([0.1, -0.7, 0.3, 0.64]) / np.linalg.norm([0.1, -0.7, 0.3, 0.64]))
OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
POINTS = np.random.default_rng(0).uniform(-0.5, 0.5, (30, 3))


def write_model(
    frames, names, folder: Path, *, text=False, points=POINTS, focal_factor=1.0, error=0.5, moved=True
) -> None:
    """A model of cameras that all see all points, in a world that is turned, moved and scaled if `moved`."""
    turn, scale, shift = (TURN.matrix(), SCALE, SHIFT) if moved else (np.eye(3), 1.0, np.zeros(3))
    model = pycolmap.Reconstruction()
    first = frames[0].intrinsics
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(
            camera_id=1,
            model="PINHOLE",
            width=round(first.width * focal_factor),
            height=round(first.height * focal_factor),
            params=[v * focal_factor for v in (first.fl_x, first.fl_y, first.cx, first.cy)],
        )
    )
    for number, (frame, name) in enumerate(zip(frames, names), start=1):
        pose = frame.pose @ OPENCV
        world = np.eye(4)[:3]
        world[:, :3] = (turn @ pose[:3, :3]).T
        world[:, 3] = -world[:, :3] @ (scale * turn @ pose[:3, 3] + shift)
        seen = (points - frame.pose[:3, 3]) @ frame.pose[:3, :3]
        pixels = np.column_stack((seen[:, 0] / -seen[:, 2], -seen[:, 1] / -seen[:, 2])) * first.fl_x * focal_factor
        image = pycolmap.Image(name=name, image_id=number, camera_id=1)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in pixels])
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(world))
    for number, point in enumerate(points):
        track = pycolmap.Track()
        for image in range(1, len(frames) + 1):
            track.add_element(image, number)
        model.add_point3D(scale * turn @ point + shift, track, np.zeros(3, dtype=np.uint8))
    for point in model.points3D.values():
        point.error = error
    folder.mkdir(parents=True, exist_ok=True)
    (model.write_text if text else model.write_binary)(str(folder))


@pytest.fixture
def scene(scene_folder):
    """A scene of six photographs, without a model."""
    return scene_folder(frames=len(NAMES), names=NAMES, scene_box=[[-1, -1, -1], [1, 1, 1]])


def frames_of(folder):
    return read_scene_file(folder.path).frames


def add_model(folder, where="colmap/sparse/0", frames=None, names=None, **options) -> None:
    frames = frames_of(folder) if frames is None else frames
    write_model(frames, names or [one.image.name for one in frames], folder.path / where, **options)


def tracks_of(folder) -> SparseTracks:
    tracks = read_colmap_tracks(read_scene_file(folder.path))
    assert tracks is not None
    return tracks


def lines_of(folder, split="train", **options):
    return ThermalDataParserConfig(data=folder.path, **options).setup().get_dataparser_outputs(split)


@pytest.mark.parametrize("where", COLMAP_FOLDERS)
@pytest.mark.parametrize("text", [False, True])
def test_points_come_in_the_worlds_of_the_json_and_of_training(scene, where, text):
    add_model(scene, where, text=text)
    tracks = tracks_of(scene)
    assert np.sort(tracks.points, axis=0) == pytest.approx(np.sort(POINTS, axis=0), abs=1e-6)
    assert len(tracks.sighting_frame) == 6 * 30
    outputs = lines_of(scene)
    lines = outputs.metadata["feature_rays"]
    centres = outputs.cameras.camera_to_worlds[:, :, 3].double().numpy()
    nearest = np.linalg.norm(lines.origins[:, None] - centres, axis=2)
    assert len(lines.points) == 30 and len(lines.origins) == 5 * 30  # the one that evaluates is left out
    assert nearest.min(axis=1).max() < 1e-5
    assert lines_of(scene, "val").metadata["feature_rays"] is None


@pytest.mark.parametrize("where", COLMAP_FOLDERS)
def test_the_box_too_is_found_wherever_a_model_may_lie(scene_folder, where):
    scene = scene_folder(frames=len(NAMES), names=NAMES, scene_box=None)
    add_model(scene, where, moved=False)
    file = read_scene_file(scene.path)
    evidence = find_scene_box(file, None, range(len(NAMES)))
    box = evidence.box()
    assert evidence.source == f"the points of {where}"
    assert (box[0] < POINTS.min(axis=0)).all() and (box[1] > POINTS.max(axis=0)).all()


def test_without_a_model_and_switched_off_there_are_no_lines(scene):
    assert lines_of(scene).metadata["feature_rays"] is None
    add_model(scene)
    assert lines_of(scene).metadata["feature_rays"] is not None
    assert lines_of(scene, tracks="given").metadata["feature_rays"] is None
    assert lines_of(scene, tracks="off").metadata["feature_rays"] is None


def test_the_file_that_the_json_names_comes_first(scene):
    add_model(scene)
    tracks = tracks_of(scene)
    few = tracks.sighting_point < 7
    some = type(tracks)(
        tracks.points, tracks.point_error_px, tracks.frames, tracks.sighting_frame[few], tracks.sighting_point[few]
    )
    write_tracks(scene.path / "tracks.npz", some)
    scene.meta[TRACKS_KEY] = "tracks.npz"
    scene.rewrite()
    assert len(lines_of(scene).metadata["feature_rays"].points) == 7
    assert lines_of(scene, tracks="off").metadata["feature_rays"] is None


def test_some_wrong_poses_are_left_out_and_named_and_move_nothing(scene, capsys):
    frames = frames_of(scene)
    add_model(scene, frames=frames)
    entry = next(one for one in scene.meta["frames"] if frames[4].image.name in one["file_path"])
    entry["transform_matrix"][0][3] += 2.0
    scene.rewrite()
    tracks = tracks_of(scene)
    assert np.sort(tracks.points, axis=0) == pytest.approx(np.sort(POINTS, axis=0), abs=1e-6)
    assert set(tracks.sighting_frame.tolist()) == {0, 1, 2, 3, 5}
    assert frames[4].name in capsys.readouterr().out.replace("\n", "")


def _outside(scene) -> None:
    add_model(scene)
    shutil.move(scene.path / "colmap", scene.path.parent / "outside")
    (scene.path / "colmap").symlink_to(scene.path.parent / "outside")


def _changed(scene, name: str, change, **options) -> None:
    add_model(scene, **options)
    path = scene.path / "colmap/sparse/0" / name
    path.write_bytes(change(path.read_bytes()))


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda s, f: add_model(s, frames=f[3:] + f[:3], names=[one.image.name for one in f]), "poses are others"),
        (lambda s, f: add_model(s, names=[f"other_{n}.jpg" for n in range(6)]), "no photograph of this scene"),
        (lambda s, f: add_model(s, frames=f[:2]), "too few"),
        (lambda s, f: _outside(s), "a file inside"),
        (lambda s, f: _changed(s, "images.bin", lambda _: b"\x07"), "cannot be read"),
        (lambda s, f: _changed(s, "points3D.bin", lambda b: b[:-1]), "points3D.bin ends before its last entry"),
        (lambda s, f: _changed(s, "cameras.txt", lambda b: b.replace(b"24 18", b"0 0"), text=True), "0 pixels wide"),
    ],
)
def test_models_that_cannot_be_used_are_left_out_with_a_warning(scene, capsys, spoil, said):
    spoil(scene, frames_of(scene))
    assert lines_of(scene).metadata["feature_rays"] is None
    assert said in " ".join(capsys.readouterr().out.split())


def test_errors_are_pixels_of_the_photographs_and_are_computed_where_colmap_did_not(scene):
    add_model(scene, focal_factor=0.5, error=0.4)
    assert tracks_of(scene).point_error_px == pytest.approx(0.8)
    add_model(scene, error=-1.0)
    assert (tracks_of(scene).point_error_px >= 0.0).all()


def test_photographs_of_one_name_are_told_apart_by_their_folders():
    images = ["left/1.jpg", "right/1.jpg", "2.jpg"]
    assert _matched(images, ["images/right/1.jpg", "images/left/1.jpg", "images/2.jpg"]) == [(1, 0), (0, 1), (2, 2)]
    assert _matched(images, ["images/1.jpg", "2.jpg"]) == [(2, 1)]
    assert _matched(["1.jpg"], ["a/1.jpg", "b/1.jpg"]) == []
    assert _matched(["1.jpg", "left/1.jpg"], ["images/left/1.jpg", "images/1.jpg"]) == [(1, 0), (0, 1)]


@pytest.mark.parametrize("part", ["cameras", "frames", "images", "points3D"])
@pytest.mark.parametrize("share", [0.0, 0.6])
def test_files_of_an_interrupted_copy_are_refused_before_colmap_reads_them(scene, part, share):
    add_model(scene)
    path = scene.path / f"colmap/sparse/0/{part}.bin"
    check_complete(path.parent)  # complete ones are not refused
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(SceneError, match=rf"{part}\.bin ends before"):
        check_complete(path.parent)
    if part != "cameras":  # what a camera's parameters are is not looked at
        path.write_bytes(whole[:-1])
        with pytest.raises(SceneError, match=rf"{part}\.bin ends before"):
            check_complete(path.parent)
