import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
import tyro
from PIL import Image

from tests.support.scene_folders import write_counts
from thermoxels_ns.core.errors import SceneError, ThermalFileError
from thermoxels_ns.core.lattice import input_from_world
from thermoxels_ns.core.units import TemperatureRange
from thermoxels_ns.data.dataparser import ThermalDataParserConfig
from thermoxels_ns.data.dataset import ThermalDataset
from thermoxels_ns.data.scene_box import box_of_cameras, box_of_points
from thermoxels_ns.data.scene_file import BOUNDS_NAME, read_scene_file
from thermoxels_ns.mesh.build import apply_transform


def parse(data: Path, split: str = "train", **options):
    return ThermalDataParserConfig(data=data, **options).setup().get_dataparser_outputs(split)


def names(outputs) -> list[str]:
    return [path.stem for path in outputs.image_filenames]


# --- Splits ---


def test_frames_are_sorted_by_name_with_their_own_poses(scene_folder):
    scene = scene_folder()
    scene.meta["frames"].reverse()
    scene.rewrite()
    outputs = parse(scene.path)
    assert names(outputs) == sorted(names(outputs))
    by_name = {Path(frame["file_path"]).stem: frame["transform_matrix"] for frame in scene.meta["frames"]}
    expected = torch.tensor([by_name[name] for name in names(outputs)])[:, :3]
    torch.testing.assert_close(outputs.cameras.camera_to_worlds, expected)
    assert [path.stem for path in outputs.metadata["thermal_filenames"]] == names(outputs)
    assert outputs.metadata["thermal_cameras"] is None, "images of one size share the photographs' cameras"


# --- World ---


def test_box_goes_to_plus_minus_one(scene_folder):
    scene = scene_folder(scene_box=[[-1.0, -2.0, 0.0], [3.0, 0.0, 1.0]])
    outputs = parse(scene.path)
    torch.testing.assert_close(outputs.scene_box.aabb, torch.tensor([[-1, -0.5, -0.25], [1, 0.5, 0.25]]))
    assert outputs.dataparser_scale == pytest.approx(0.5)
    torch.testing.assert_close(outputs.dataparser_transform[:, 3], torch.tensor([-1.0, 1.0, -0.5]))
    doubled = parse(scene.path, scale_factor=2.0)
    torch.testing.assert_close(doubled.scene_box.aabb, 2 * outputs.scene_box.aabb)


def test_option_goes_before_the_json(scene_folder):
    outputs = parse(scene_folder().path, scene_box=((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)))
    torch.testing.assert_close(outputs.dataparser_transform[:, 3], torch.full((3,), -0.5))
    assert outputs.dataparser_scale == pytest.approx(2.0)


@pytest.mark.parametrize("orientation", ["none", "up", "vertical", "pca"])
@pytest.mark.parametrize("centre", ["box", "poses", "focus", "none"])
def test_transform_moves_poses_points_and_box_alike(scene_folder, orientation, centre):
    """p_ns = scale * (R p + t): the input poses come back through nerfstudio's own inverse."""
    scene = scene_folder(own_camera=True, thermal_size=(12, 10), scene_box=[[-1, -2, -1], [1, 1, 1]])
    outputs = parse(scene.path, orientation_method=orientation, center_method=centre)
    given = {Path(f["file_path"]).stem: f for f in scene.meta["frames"]}
    for key, cameras in (
        ("transform_matrix", outputs.cameras),
        ("thermal_transform_matrix", outputs.metadata["thermal_cameras"]),
    ):
        back = outputs.transform_poses_to_original_space(cameras.camera_to_worlds, camera_convention="opengl")
        expected = torch.tensor([given[name][key] for name in names(outputs)])[:, :3]
        torch.testing.assert_close(back, expected, atol=2e-5, rtol=0)
    corners = torch.cartesian_prod(*torch.tensor([[-1.0, 1], [-2, 1], [-1, 1]]))
    matrix = outputs.dataparser_transform
    moved = outputs.dataparser_scale * (corners @ matrix[:, :3].T + matrix[:, 3])
    hull = torch.stack([moved.amin(0), moved.amax(0)])
    torch.testing.assert_close(outputs.scene_box.aabb, hull, atol=1e-5, rtol=0)
    sides = outputs.scene_box.aabb[1] - outputs.scene_box.aabb[0]
    assert float(sides.max()) == pytest.approx(2.0, abs=1e-5)
    if centre == "box":
        torch.testing.assert_close(outputs.scene_box.get_center(), torch.zeros(3), atol=1e-6, rtol=0)


@pytest.mark.parametrize("centre", ["box", "poses"])
@pytest.mark.parametrize("orientation", ["none", "up"])
def test_far_from_the_origin_the_way_back_is_as_exact(scene_folder, centre, orientation):
    """In national coordinates (easting, northing in metres) single precision is half a metre wide."""
    shift = np.array([450_000.3, 5_200_000.4, 300.0])
    scene = scene_folder(scene_box=[(shift - 4.0).tolist(), (shift + 4.0).tolist()])
    for frame in scene.meta["frames"]:
        pose = np.array(frame["transform_matrix"])
        pose[:3, 3] += shift
        frame["transform_matrix"] = pose.tolist()
    scene.rewrite()
    outputs = parse(scene.path, center_method=centre, orientation_method=orientation)
    to_input = input_from_world(outputs.dataparser_transform.numpy(), outputs.dataparser_scale)
    centres = apply_transform(to_input, outputs.cameras.camera_to_worlds.numpy()[:, :, 3].astype(np.float64))
    given = {Path(f["file_path"]).stem: f["transform_matrix"] for f in scene.meta["frames"]}
    expected = np.array([given[name] for name in names(outputs)])[:, :3, 3]
    np.testing.assert_allclose(centres, expected, rtol=0, atol=1e-5)


def test_near_the_origin_the_box_is_centred_to_the_last_digit(scene_folder):
    outputs = parse(scene_folder(scene_box=[[0.1, -1.3, 0.7], [2.3, 0.4, 1.9]]).path)
    low, high = outputs.scene_box.aabb
    assert torch.equal(low, -high)


@pytest.mark.parametrize(
    ("method", "second"),
    [
        ("vertical", [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]),  # of two cameras at right angles
        ("up", [[-1, 0, 0], [0, -1, 0], [0, 0, 1]]),  # one of them held upside down
    ],
)
def test_two_cameras_that_do_not_tell_where_up_is_are_refused(scene_folder, method, second):
    scene = scene_folder(frames=2, names=["frame_train_0", "frame_eval_0"])
    for frame, rotation in zip(scene.meta["frames"], (np.eye(3), np.array(second))):
        frame["transform_matrix"] = np.column_stack([rotation, 4.0 * rotation[:, 2]]).tolist()
    scene.rewrite()
    with pytest.raises(SceneError, match=f"2 cameras that do not, by {method}.*--orientation-method none"):
        parse(scene.path, orientation_method=method)
    assert len(parse(scene.path).image_filenames) == 1


def test_train_and_eval_share_world_and_range(scene_folder):
    scene = scene_folder(suffix=".npy", bounds=False, counts=lambda i, s: np.full(s, 10.0 + i) + np.eye(*s))
    train, evaluate = parse(scene.path), parse(scene.path, "val")
    assert train.dataparser_scale == evaluate.dataparser_scale
    assert torch.equal(train.dataparser_transform, evaluate.dataparser_transform)
    assert torch.equal(train.scene_box.aabb, evaluate.scene_box.aabb)
    assert train.metadata["temperature_range"] == evaluate.metadata["temperature_range"] == TemperatureRange(10, 20)


def test_temperature_range_from_bounds_even_if_swapped(scene_folder, capsys):
    scene = scene_folder()
    assert parse(scene.path).metadata["temperature_range"] == TemperatureRange(10.0, 30.0)
    write_bounds(30.0, 10.0)(scene)
    assert parse(scene.path).metadata["temperature_range"] == TemperatureRange(10.0, 30.0)
    assert "read as 10 to 30 C" in " ".join(capsys.readouterr().out.split())


def write_bounds(low, high):
    names = ("absolute_min_temperature", "absolute_max_temperature")
    return lambda scene: (scene.path / BOUNDS_NAME).write_text(json.dumps(dict(zip(names, (low, high)))))


# --- Boxes that are not given ---


def write_ply(path: Path, points: np.ndarray) -> None:
    header = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    path.write_text(header + "\n".join(" ".join(map(str, point)) for point in points))


def test_box_from_sparse_points_ignores_strays(scene_folder):
    scene = scene_folder(ply_file_path="points.ply", scene_box=None)
    points = np.random.default_rng(3).uniform([-1, -0.5, -0.25], [1, 0.5, 0.25], (4000, 3))
    points[:15] *= 400.0
    write_ply(scene.path / "points.ply", points)
    outputs = parse(scene.path)
    sides = (outputs.scene_box.aabb[1] - outputs.scene_box.aabb[0]) / outputs.dataparser_scale
    torch.testing.assert_close(sides, torch.tensor([2.32, 1.32, 0.82]), atol=0.05, rtol=0)


def test_points_behind_all_cameras_do_not_count(scene_folder):
    frames = read_scene_file(scene_folder(frames=1, names=["one"]).path).frames
    cloud = np.random.default_rng(0).uniform(-1, 1, (500, 3))
    behind = cloud[:200] + 3.0 * frames[0].pose[:3, 3]
    box = box_of_points(np.concatenate([cloud, behind]), frames, np.eye(3))
    assert (np.abs(box) < 1.2).all() and (np.abs(box) > 1.0).all()


def test_flat_scene_gets_some_depth(scene_folder):
    frames = read_scene_file(scene_folder().path).frames
    wall = np.random.default_rng(0).uniform(-1, 1, (500, 3)) * [1, 1, 0]
    box = box_of_points(wall, frames, np.eye(3))
    assert box[1, 2] == pytest.approx(0.16, abs=0.01) and box[0, 2] == -box[1, 2]


def test_box_from_cameras_is_where_they_look(scene_folder):
    scene = scene_folder(scene_box=None)
    frames = read_scene_file(scene.path).frames
    box = box_of_cameras(frames, np.eye(3))
    distance = np.sqrt(17.0)
    np.testing.assert_allclose(box, np.outer([-1, 1], np.full(3, distance * 24 / (1.1 * 24) / 2)), atol=1e-9)
    torch.testing.assert_close(parse(scene.path).scene_box.aabb, torch.tensor([[-1.0] * 3, [1.0] * 3]))


def test_parallel_cameras_need_a_box(scene_folder):
    scene = scene_folder(scene_box=None)
    for frame in scene.meta["frames"]:
        matrix = np.array(frame["transform_matrix"])
        matrix[:3, :3] = np.eye(3)
        frame["transform_matrix"] = matrix.tolist()
    scene.rewrite()
    with pytest.raises(SceneError, match=r"parallel.*--scene-box"):
        parse(scene.path)


@pytest.mark.parametrize("legacy", [False, True])
def test_box_from_colmap_follows_the_worlds_axes(scene_folder, legacy):
    """The model is in COLMAP's world; the json may have other axes, as old ns-process-data wrote it."""
    pycolmap = pytest.importorskip("pycolmap")
    scene = scene_folder(scene_box=None)
    axes = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]], float) if legacy else np.eye(3)
    points = np.random.default_rng(3).uniform([-1, -0.6, -0.3], [1, 0.6, 0.3], (800, 3))
    folder = scene.path / "colmap" / "sparse" / "0"
    folder.mkdir(parents=True)
    (folder / "cameras.txt").write_text("1 PINHOLE 24 18 26 26 12 9\n")
    lines = []
    for number, frame in enumerate(scene.meta["frames"], 1):
        centre = axes.T @ np.array(frame["transform_matrix"])[:3, 3]
        name = Path(frame["file_path"]).name
        lines += [f"{number} 1 0 0 0 {-centre[0]} {-centre[1]} {-centre[2]} 1 {name}", ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    rows = [" ".join(map(str, [i + 1, *(axes.T @ p), 0, 0, 0, 0.5])) for i, p in enumerate(points)]
    (folder / "points3D.txt").write_text("\n".join(rows) + "\n")
    assert len(pycolmap.Reconstruction(str(folder)).images) == 10
    scene.rewrite()
    outputs = parse(scene.path)
    sides = (outputs.scene_box.aabb[1] - outputs.scene_box.aabb[0]) / outputs.dataparser_scale
    torch.testing.assert_close(sides, torch.tensor([2.32, 1.52, 0.92]), atol=0.05, rtol=0)
    for frame in scene.meta["frames"]:
        frame["transform_matrix"][0][3] += 1.0
    scene.rewrite()
    with pytest.raises(SceneError, match="at other places"):
        parse(scene.path)


@pytest.mark.parametrize(
    "box", [[[0, 0, 0], [1, 1, 0]], [[0, 0, 0], [0, 0, 0]], [[1, 0, 0], [0, 1, 1]], [[0, 0, 0], [1, 1, "x"]], [1, 2]]
)
def test_boxes_without_volume_are_refused(scene_folder, box):
    with pytest.raises(SceneError, match=r"scene_box.*two corners"):
        parse(scene_folder(scene_box=box).path)


# --- Cameras and photographs ---


def test_other_resolution_gives_scaled_thermal_cameras(scene_folder):
    outputs = parse(scene_folder(size=(120, 90), thermal_size=(4, 3), distortion={"k1": 0.02}).path)
    colour, thermal = outputs.cameras, outputs.metadata["thermal_cameras"]
    assert (int(thermal.width[0]), int(thermal.height[0])) == (4, 3)
    for name in ("fx", "fy", "cx", "cy"):
        torch.testing.assert_close(getattr(thermal, name), getattr(colour, name) / 30)
    assert torch.equal(thermal.distortion_params, colour.distortion_params)
    assert torch.equal(thermal.camera_to_worlds, colour.camera_to_worlds)


def test_frames_may_have_intrinsics_of_their_own(scene_folder):
    scene = scene_folder()
    for number, frame in enumerate(scene.meta["frames"]):
        frame["fl_x"] = 30.0 + number
    scene.rewrite()
    assert parse(scene.path, "val").cameras.fx.flatten().tolist() == [32.0, 37.0]


def test_downscaled_photographs_are_block_means_with_matching_intrinsics(scene_folder):
    scene = scene_folder(size=(25, 18), thermal_size=(25, 18))
    outputs = parse(scene.path, downscale_factor=2)
    assert (int(outputs.cameras.width[0]), int(outputs.cameras.height[0])) == (12, 9)
    torch.testing.assert_close(outputs.cameras.cx[0], torch.tensor([0.48 * 25 / 2]))
    full = np.asarray(Image.open(outputs.image_filenames[0])).astype(float)
    got = ThermalDataset(outputs).get_data(0, "uint8")["image"].numpy()
    np.testing.assert_allclose(
        got, full[:, :24].reshape(9, 2, 12, 2, 3).mean(axis=(1, 3)), atol=1.01
    )  # Pillow rounds twice
    thermal = outputs.metadata["thermal_cameras"]
    assert thermal is not None and int(thermal.width[0]) == 25


def test_dataset_item(scene_folder):
    scene = scene_folder(own_camera=True, thermal_size=(12, 10))
    data = ThermalDataset(parse(scene.path))[1]
    assert data["image"].shape == (18, 24, 3) and data["image"].dtype == torch.float32
    assert data["thermal"].shape == (10, 12, 1) == data["thermal_valid"].shape
    assert data["thermal_camera"].shape == (1,) and int(data["thermal_camera"].width) == 12
    picture = np.asarray(Image.open(scene.path / "images" / "frame_train_001.png"))
    np.testing.assert_array_equal(np.rint(data["image"].numpy() * 255), picture)


def test_masks_reach_the_item(scene_folder):
    scene = scene_folder()
    mask = scene.add_masks()
    got = ThermalDataset(parse(scene.path))[0]["mask"]
    np.testing.assert_array_equal(got[..., 0].numpy(), mask > 0)
    del scene.meta["frames"][0]["mask_path"]
    scene.rewrite()
    with pytest.raises(SceneError, match="9 masks for 10 frames"):
        parse(scene.path)


def test_partner_by_path_in_another_folder(scene_folder):
    scene = scene_folder()
    (scene.path / "thermal").rename(scene.path / "infrared")
    for frame, name in zip(scene.meta["frames"], scene.names):
        frame["thermal_file_path"] = f"infrared/{name}.png"
    scene.rewrite()
    (scene.path / "transforms.json").rename(scene.path / "transforms_thermal.json")
    assert parse(scene.path).metadata["thermal_filenames"][0] == scene.path / "infrared" / "frame_train_000.png"


# --- Errors ---


def test_missing_thermal_partner_stops_or_is_left_out(scene_folder):
    scene = scene_folder()
    (scene.path / "thermal" / "frame_train_003.png").unlink()
    with pytest.raises(SceneError, match=r"frame_train_003.*9 files in thermal/.*--missing-thermal skip"):
        parse(scene.path)
    assert "frame_train_003" not in names(parse(scene.path, missing_thermal="skip"))


def test_thermal_images_without_photographs_are_a_mismatch(scene_folder):
    scene = scene_folder()
    (scene.path / "thermal" / "extra.png").write_bytes((scene.path / "thermal" / "frame_train_000.png").read_bytes())
    with pytest.raises(SceneError, match=r"11 thermal images, 1 of them without a photograph.*extra"):
        parse(scene.path)
    assert len(names(parse(scene.path, missing_thermal="skip"))) == 8


def test_unposed_pairs_are_no_mismatch(scene_folder):
    scene = scene_folder()
    del scene.meta["frames"][0]
    scene.rewrite()
    assert len(names(parse(scene.path))) == 7


def test_no_json_and_broken_json(scene_folder, tmp_path):
    with pytest.raises(SceneError, match=r"transforms\.json or transforms_thermal\.json"):
        parse(tmp_path)
    with pytest.raises(SceneError, match="no such folder"):
        parse(tmp_path / "nowhere")
    scene = scene_folder()
    for text, words in (
        ("{", ""),
        ("[]", ""),
        ('{"frames": []}', ""),
        ('{"w": 3}', ""),
        ("[" * 200_000, "readable json file"),
    ):
        (scene.path / "transforms.json").write_text(text)
        with pytest.raises(SceneError, match=rf"transforms\.json.*{words}"):
            parse(scene.path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: f.pop("transform_matrix"), "frame 3.*transform_matrix"),
        (lambda f: f["transform_matrix"][1].__setitem__(3, float("nan")), "frame 3.*NaN"),
        (lambda f: f.update(transform_matrix=[[1, 2], [3, 4]]), "frame 3.*4 x 4"),
        (lambda f: f.update(transform_matrix=np.diag([2.0, 2.0, 2.0, 1.0]).tolist()), "frame 3.*rotation"),
        (lambda f: f.update(thermal_transform_matrix=np.eye(4).tolist()), "frame 3.*thermal_camera"),
        (lambda f: f.update(file_path="images/gone.png"), r"frame 3.*gone\.png"),
        (lambda f: f.pop("file_path"), "frame 3.*file_path"),
        (lambda f: f.update(w=25), "frame 3.*25 x 18"),
        (lambda f: f.update(fl_x=0.0), "frame 3.*positive focal"),
        (lambda f: f.update(camera_model="ORTHOPHOTO"), "frame 3.*ORTHOPHOTO"),
        (lambda f: f.update(thermal_camera={"w": 9, "h": 9}), "frame 3.*no fl_x"),
        (lambda f: f.update(thermal_camera=dict(w=13, h=10, fl_x=9, fl_y=9, cx=6, cy=5)), "13 x 10"),
        (lambda f: f.update(mask_path=None), "frame 3.*mask_path.*None"),
        (lambda f: f.update(cx=1e9), "frame 3.*principal point in or near the image.*got cx 1e"),
        (lambda f: f.update(fl_x=1e308), "frame 3.*focal lengths of a lens.*got fl_x 1e"),
        (lambda f: f.update(k1=1e6), r"frame 3.*where they can be, got k1 1e\+06"),
        (lambda f: f.update(fl_x=True), "frame 3.*numbers as intrinsics.*got true or false"),
        (lambda f: f["transform_matrix"][0].__setitem__(3, 1e30), r"frame 3.*within 1e\+08 units of the origin"),
        (lambda f: f.update(file_path="a" * 300), "a{200}.*File name too long. Check permissions and names"),
    ],
)
def test_bad_frames_are_named(scene_folder, change, message):
    scene = scene_folder()
    change(scene.meta["frames"][3])
    scene.rewrite()
    with pytest.raises(SceneError, match=message):
        parse(scene.path)


def look_away(scene) -> None:
    for frame in scene.meta["frames"]:
        frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ np.diag([-1.0, 1.0, -1.0, 1.0])).tolist()


def turn_photograph(scene) -> None:
    """As a phone stores it that was held upright."""
    scene.meta["frames"][3]["file_path"] = "images/turned.jpg"
    tags = Image.Exif()
    tags[0x0112] = 6
    Image.new("RGB", (18, 24)).save(scene.path / "images" / "turned.jpg", exif=tags)
    (scene.path / "thermal" / "frame_train_003.png").rename(scene.path / "thermal" / "turned.png")


def give_twice(scene) -> None:
    frames = scene.meta["frames"]
    frames.append(dict(frames[0], file_path="./images/../images/frame_train_000.png"))


def half_in_kelvin(scene) -> None:
    (scene.path / "temperature_bounds.json").unlink()
    for number, frame in enumerate(scene.meta["frames"]):
        name = Path(frame["file_path"]).stem
        frame["thermal_file_path"] = f"thermal/{name}.npy"
        np.save(scene.path / "thermal" / f"{name}.npy", np.eye(18, 24) + 20.0 + 273.15 * (number >= 5))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            look_away,
            r"cameras: expected photographs that look at the scene box, from .*got 0.0% of .*and 100% of the 8",
        ),
        (give_twice, r"frame_train_000\.png more than once"),
        (turn_photograph, "frame 3.*EXIF orientation 6: it is stored on its side.*mogrify -auto-orient"),
        (half_in_kelvin, "one unit in all files, got 4 of 8 files 273 degrees above the others.*Subtract 273.15"),
    ],
)
def test_what_is_odd_is_named_as_what_it_is(scene_folder, change, message):
    scene = scene_folder()
    change(scene)
    scene.rewrite()
    with pytest.raises(SceneError, match=message):
        parse(scene.path)


def test_kelvins_that_are_meant_are_read(scene_folder):
    scene = scene_folder()
    half_in_kelvin(scene)
    scene.rewrite()
    found = parse(scene.path, valid_range_c=(-100.0, 1999.0)).metadata["temperature_range"]
    assert found.max_c == pytest.approx(294.15)


def test_a_file_that_may_not_be_read_is_not_called_damaged(scene_folder, monkeypatch):
    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    scene = scene_folder()
    monkeypatch.setattr(Path, "read_text", refuse)
    with pytest.raises(SceneError, match=r"transforms.json: expected a file that can be read.*Check its permissions"):
        parse(scene.path)
    monkeypatch.undo()
    monkeypatch.setattr(Path, "iterdir", refuse)
    with pytest.raises(SceneError, match=r"scene folder: expected a file or folder that can be read.*permissions"):
        parse(scene.path)


def test_other_aspect_needs_a_thermal_camera(scene_folder):
    with pytest.raises(SceneError, match="thermal_camera"):
        parse(scene_folder(thermal_size=(12, 12)).path)


def test_corrupt_photograph_and_thermal_file(scene_folder):
    scene = scene_folder()
    path = scene.path / "images" / "frame_train_001.png"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(SceneError, match=r"frame_train_001\.png.*readable photograph"):
        ThermalDataset(parse(scene.path))[1]
    path.write_bytes(b"no picture")
    with pytest.raises(SceneError, match="frame_train_001"):
        parse(scene.path)
    path.write_bytes(whole)
    (scene.path / "thermal" / "frame_eval_002.png").write_bytes(b"")
    with pytest.raises(ThermalFileError, match="frame_eval_002"):
        parse(scene.path)


def test_thermal_image_without_one_valid_pixel(scene_folder):
    with pytest.raises(ThermalFileError, match="no valid pixel"):
        parse(scene_folder(suffix=".npy", bounds=False, counts=lambda i, s: np.full(s, np.nan)).path)


def test_transparent_photograph_is_refused(scene_folder):
    scene = scene_folder()
    pixels = np.zeros((18, 24, 4), np.uint8)
    Image.fromarray(pixels).save(scene.path / "images" / "frame_train_000.png")
    with pytest.raises(SceneError, match="opaque"):
        ThermalDataset(parse(scene.path))[0]


def test_bad_bounds_and_units(scene_folder):
    scene = scene_folder()
    (scene.path / "temperature_bounds.json").write_text('{"absolute_min_temperature": 3}')
    with pytest.raises(SceneError, match="temperature_bounds"):
        parse(scene.path)
    scene.meta["thermal_unit"] = {"celsius_per_count": 0, "celsius_offset": 1}
    scene.rewrite()
    (scene.path / "temperature_bounds.json").unlink()
    with pytest.raises(SceneError, match="thermal_unit"):
        parse(scene.path)


def frame_3(change):
    return lambda scene: change(scene.meta["frames"][3])


def bounds_that_are_a_folder(scene) -> None:
    (scene.path / BOUNDS_NAME).unlink()
    (scene.path / BOUNDS_NAME).mkdir()


def one_of_another_size(scene) -> None:
    Image.fromarray(np.arange(12 * 9, dtype=np.uint16).reshape(9, 12)).save(
        scene.path / "thermal" / "frame_train_003.png"
    )


def all_in(suffix: str, values: np.ndarray):
    def change(scene) -> None:
        for frame in scene.meta["frames"]:
            frame["thermal_file_path"] = f"thermal/{Path(frame['file_path']).stem}{suffix}"
            write_counts(scene.path / frame["thermal_file_path"], values)

    return change


def a_name_of_two_lines(scene) -> None:
    scene.meta["frames"][3]["file_path"] = "images/two\nlines.png"


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (write_bounds(-300.0, 20.0), BOUNDS_NAME),
        (write_bounds(10.0, math.inf), BOUNDS_NAME),
        (write_bounds("10", 20.0), BOUNDS_NAME),
        (bounds_that_are_a_folder, f"{BOUNDS_NAME}: .* a folder"),
        (lambda scene: scene.meta.update(metres_per_unit=-1), "metres_per_unit"),
        (lambda scene: scene.meta.update(metres_per_unit="x"), "metres_per_unit"),
        (lambda scene: scene.meta.update(up=[0, 0, 0]), "up"),
        (lambda scene: scene.meta.update(up="z"), "up"),
        (
            lambda scene: scene.meta.update(thermal_unit={"celsius_per_count": True, "celsius_offset": 0}),
            "thermal_unit",
        ),
        (frame_3(lambda f: f["transform_matrix"].__setitem__(3, [0, 0, 0, 2])), "frame 3.*last row"),
        (frame_3(lambda f: f["transform_matrix"][0].__setitem__(3, True)), "frame 3.*True"),
        (frame_3(lambda f: f["transform_matrix"][0].__setitem__(3, "abc")), "frame 3.*'abc'"),
        (frame_3(lambda f: f.update(w=24.5)), r"frame 3.*24\.5"),
        (one_of_another_size, "frame_train_003.*12 x 9"),
        (all_in(".tiff", np.eye(18, 24, dtype=np.uint16)), "thermal_unit"),
        (all_in(".npy", np.eye(18, 24) + 293.15), f"{BOUNDS_NAME}.*293.15 C"),
        (all_in(".png", np.full((18, 24), 65535, np.uint16)), "frame_eval_002.png: .*65535"),
        (lambda scene: scene.meta.update(test_filenames=[]), "test_filenames"),
        (lambda scene: scene.meta.update(test_filenames=["images/gone.png"]), r"test_filenames: .*gone\.png"),
        (a_name_of_two_lines, r"frame 3 \(images/two\\nlines\.png\)"),
    ],
)
def test_what_no_scene_means_is_refused(scene_folder, change, named):
    scene = (
        scene_folder(names=[f"frame_{number:03d}" for number in range(10)]) if "filenames" in named else scene_folder()
    )
    change(scene)
    scene.rewrite()
    with pytest.raises(SceneError, match=named) as caught:
        parse(scene.path)
    assert "\n" not in str(caught.value)


def test_a_box_that_was_found_is_the_same_when_it_is_given(scene_folder):
    scene = scene_folder(scene_box=None)
    found = parse(scene.path)
    given = parse(scene.path, scene_box=found.metadata["input_box"])
    assert torch.equal(found.scene_box.aabb, given.scene_box.aabb)
    assert found.dataparser_scale == given.dataparser_scale
    assert torch.equal(found.dataparser_transform, given.dataparser_transform)
    tilt = np.array([[1.0, 0, 0, 0], [0, 0.8, -0.6, 0], [0, 0.6, 0.8, 0], [0, 0, 0, 1]])
    for frame in scene.meta["frames"]:
        frame["transform_matrix"] = (tilt @ frame["transform_matrix"]).tolist()
    scene.rewrite()
    assert parse(scene.path, orientation_method="up").metadata["input_box"] is None


def test_a_sky_far_below_the_bounds_is_no_other_unit(scene_folder):
    scene = scene_folder()
    all_in(".npy", np.eye(18, 24) - 80.0)(scene)
    scene.rewrite()
    assert parse(scene.path).metadata["temperature_range"].min_c == pytest.approx(-80.0)


def test_bounds_in_kelvins_beside_files_in_degrees_are_refused(scene_folder):
    scene = scene_folder()
    all_in(".npy", np.eye(18, 24) + 20.0)(scene)
    (scene.path / "temperature_bounds.json").write_text(
        json.dumps({"absolute_min_temperature": 283.0, "absolute_max_temperature": 303.0})
    )
    scene.rewrite()
    with pytest.raises(SceneError, match=r"20\.00 C in the middle"):
        parse(scene.path)


def test_bad_options(scene_folder):
    scene = scene_folder()
    for option in ({"downscale_factor": 0}, {"scale_factor": 0.0}, {"eval_mode": "interval", "eval_interval": 1}):
        with pytest.raises(SceneError, match=next(iter(option)) if len(option) == 1 else "eval_interval"):
            parse(scene.path, **option)
    for limits in ((math.nan, 30.0), (30.0, -100.0), (-300.0, 10.0)):
        with pytest.raises(SceneError, match="valid_range_c: expected a lower and a higher temperature"):
            parse(scene.path, valid_range_c=limits)


def test_config_is_read_from_the_command_line():
    arguments = ["--scene-box", *"000123", "--downscale-factor", "4", "--missing-thermal", "skip", "--data", "x"]
    box = ((0.0, 0.0, 0.0), (1.0, 2.0, 3.0))
    expected = ThermalDataParserConfig(data=Path("x"), scene_box=box, downscale_factor=4, missing_thermal="skip")
    assert tyro.cli(ThermalDataParserConfig, args=arguments) == expected


@pytest.mark.real_data
def test_real_room_corner(shared_data):
    config = ThermalDataParserConfig(data=shared_data / "arco")
    parser = config.setup()
    train, evaluate = parser.get_dataparser_outputs("train"), parser.get_dataparser_outputs("val")
    everything = sorted(path.name for path in (shared_data / "arco" / "visible").glob("*.jpg"))
    assert [path.name for path in evaluate.image_filenames] == everything[4::8] and len(train.image_filenames) == 35
    assert not {p.name for p in train.image_filenames} & {p.name for p in evaluate.image_filenames}
    thermal = train.metadata["thermal_cameras"]
    assert (int(thermal.width[0]), int(thermal.height[0])) == (640, 512)
    baseline = (thermal.camera_to_worlds - train.cameras.camera_to_worlds)[:, :, 3].norm(dim=1)
    torch.testing.assert_close(baseline / train.dataparser_scale, torch.full((35,), 0.1324), atol=1e-3, rtol=0)
    box = train.scene_box.aabb
    assert torch.isfinite(box).all() and float(box.abs().max()) == pytest.approx(1.0)
    assert 1 / train.dataparser_scale == pytest.approx(9.4, abs=1.0)
    temperatures = train.metadata["temperature_range"]
    assert 4 < temperatures.min_c < 10 and 80 < temperatures.max_c < 90
