import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from tests.support.scene_folders import write_counts
from thermoxels_ns.core.errors import SceneError
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


def test_transform_moves_poses_points_and_box_alike(scene_folder):
    """p_ns = scale * (R p + t): the input poses come back through nerfstudio's own inverse."""
    scene = scene_folder(own_camera=True, thermal_size=(12, 10), scene_box=[[-1, -2, -1], [1, 1, 1]])
    outputs = parse(scene.path)
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
    torch.testing.assert_close(outputs.scene_box.get_center(), torch.zeros(3), atol=1e-6, rtol=0)


def test_far_from_the_origin_the_way_back_is_as_exact(scene_folder):
    """In national coordinates (easting, northing in metres) single precision is half a metre wide."""
    shift = np.array([450_000.3, 5_200_000.4, 300.0])
    scene = scene_folder(scene_box=[(shift - 4.0).tolist(), (shift + 4.0).tolist()])
    for frame in scene.meta["frames"]:
        pose = np.array(frame["transform_matrix"])
        pose[:3, 3] += shift
        frame["transform_matrix"] = pose.tolist()
    scene.rewrite()
    outputs = parse(scene.path)
    to_input = input_from_world(outputs.dataparser_transform.numpy(), outputs.dataparser_scale)
    centres = apply_transform(to_input, outputs.cameras.camera_to_worlds.numpy()[:, :, 3].astype(np.float64))
    given = {Path(f["file_path"]).stem: f["transform_matrix"] for f in scene.meta["frames"]}
    expected = np.array([given[name] for name in names(outputs)])[:, :3, 3]
    np.testing.assert_allclose(centres, expected, rtol=0, atol=1e-5)


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
    assert "swapped" not in capsys.readouterr().out
    write_bounds(30.0, 10.0)(scene)
    assert parse(scene.path).metadata["temperature_range"] == TemperatureRange(10.0, 30.0)
    assert f"the two keys of {BOUNDS_NAME} swapped" in " ".join(capsys.readouterr().out.split())


def write_bounds(low, high):
    names = ("absolute_min_temperature", "absolute_max_temperature")
    return lambda scene: (scene.path / BOUNDS_NAME).write_text(json.dumps(dict(zip(names, (low, high)))))


def test_box_from_sparse_points_ignores_strays(scene_folder):
    scene = scene_folder(ply_file_path="points.ply", scene_box=None)
    points = np.random.default_rng(3).uniform([-1, -0.5, -0.25], [1, 0.5, 0.25], (4000, 3))
    points[:15] *= 400.0
    header = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    (scene.path / "points.ply").write_text(header + "\n".join(" ".join(map(str, point)) for point in points))
    outputs = parse(scene.path)
    sides = (outputs.scene_box.aabb[1] - outputs.scene_box.aabb[0]) / outputs.dataparser_scale
    torch.testing.assert_close(sides, torch.tensor([2.32, 1.32, 0.82]), atol=0.05, rtol=0)


def test_points_behind_all_cameras_do_not_count(scene_folder):
    frames = read_scene_file(scene_folder(frames=1, names=["one"]).path).frames
    cloud = np.random.default_rng(0).uniform(-1, 1, (500, 3))
    behind = cloud[:200] + 3.0 * frames[0].pose[:3, 3]
    box = box_of_points(np.concatenate([cloud, behind]), frames)
    assert (np.abs(box) < 1.2).all() and (np.abs(box) > 1.0).all()


def test_box_from_cameras_is_where_they_look(scene_folder):
    scene = scene_folder(scene_box=None)
    frames = read_scene_file(scene.path).frames
    box = box_of_cameras(frames)
    distance = np.sqrt(17.0)
    np.testing.assert_allclose(box, np.outer([-1, 1], np.full(3, distance * 24 / (1.1 * 24) / 2)), atol=1e-9)
    found = parse(scene.path)
    torch.testing.assert_close(found.scene_box.aabb, torch.tensor([[-1.0] * 3, [1.0] * 3]))
    given = parse(scene.path, scene_box=found.metadata["input_box"])  # the same
    assert torch.equal(found.scene_box.aabb, given.scene_box.aabb)
    assert found.dataparser_scale == given.dataparser_scale
    assert torch.equal(found.dataparser_transform, given.dataparser_transform)


def test_other_resolution_gives_scaled_thermal_cameras(scene_folder):
    outputs = parse(scene_folder(size=(120, 90), thermal_size=(4, 3), distortion={"k1": 0.02}).path)
    colour, thermal = outputs.cameras, outputs.metadata["thermal_cameras"]
    assert (int(thermal.width[0]), int(thermal.height[0])) == (4, 3)
    for name in ("fx", "fy", "cx", "cy"):
        torch.testing.assert_close(getattr(thermal, name), getattr(colour, name) / 30)
    assert torch.equal(thermal.distortion_params, colour.distortion_params)
    assert torch.equal(thermal.camera_to_worlds, colour.camera_to_worlds)


def test_downscaled_photographs_are_block_means_with_matching_intrinsics(scene_folder):
    scene = scene_folder(size=(25, 18), thermal_size=(25, 18))
    outputs = parse(scene.path, downscale_factor=2)
    assert (int(outputs.cameras.width[0]), int(outputs.cameras.height[0])) == (12, 9)
    torch.testing.assert_close(outputs.cameras.cx[0], torch.tensor([0.48 * 25 / 2]))
    full = np.asarray(Image.open(outputs.image_filenames[0])).astype(float)
    got = ThermalDataset(outputs).get_data(0, "uint8")["image"].numpy()
    means = full[:, :24].reshape(9, 2, 12, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(got, means, atol=1.01)  # Pillow rounds twice
    thermal = outputs.metadata["thermal_cameras"]
    assert thermal is not None and int(thermal.width[0]) == 25


@pytest.mark.parametrize("thermal_size", [(25, 18), (12, 9)])
def test_photographs_that_need_more_memory_than_they_may_are_averaged_for_training_alone(scene_folder, thermal_size):
    scene = scene_folder(size=(25, 18), thermal_size=thermal_size)
    degrees = np.random.default_rng(0).uniform(12.0, 28.0, thermal_size[::-1])
    degrees[:3, :3], degrees[4, 4] = np.nan, np.nan
    np.save(scene.path / "thermal" / "frame_train_000.npy", degrees)
    frame = next(frame for frame in scene.meta["frames"] if "train_000" in frame["file_path"])
    frame["thermal_file_path"] = "thermal/frame_train_000.npy"
    scene.rewrite()
    plain = parse(scene.path)
    room = 8 * 8 * 25 * 18 / 7.0 / 1e9  # of eight photographs with a seventh of their pixels
    given = ThermalDataset(plain), ThermalDataset(parse(scene.path, photographs_gb=room))
    (full, thermal, valid), (small, averaged, where) = (
        [one[0][key].numpy().astype(float) for key in ("image", "thermal", "thermal_valid")] for one in given
    )
    np.testing.assert_allclose(small, full[:, :24].reshape(6, 3, 8, 3, 3).mean(axis=(1, 3)), atol=2 / 255)
    if thermal_size == (25, 18):  # one ray carries both, so both have the same pixels
        assert given[1].thermal_cameras is None
        blocks = (valid[:, :24].reshape(6, 3, 8, 3), (valid * thermal)[:, :24].reshape(6, 3, 8, 3))
        count, total = (block.sum(axis=(1, 3)) for block in blocks)
        assert {0, 8, 9} == set(count.ravel().tolist())
        np.testing.assert_array_equal(where[..., 0], count > 0)
        np.testing.assert_allclose(averaged[..., 0], total / np.maximum(count, 1), atol=1e-6)
    else:
        assert given[1].thermal_cameras is not None and averaged.shape == thermal.shape
    assert given[1].thermal_report() == given[0].thermal_report() and given[0].thermal_report().startswith("10 of ")
    held_out = parse(scene.path, "val", photographs_gb=room)
    assert int(held_out.cameras.width[0]) == 25 and held_out.metadata["image_scale"] == 1.0
    typed = parse(scene.path, photographs_gb=room, downscale_factor=1)
    assert int(typed.cameras.width[0]) == 25, "all pixels, as asked"


def test_partner_by_path_in_another_folder(scene_folder):
    scene = scene_folder()
    (scene.path / "thermal").rename(scene.path / "infrared")
    for frame, name in zip(scene.meta["frames"], scene.names):
        frame["thermal_file_path"] = f"infrared/{name}.png"
    scene.rewrite()
    (scene.path / "transforms.json").rename(scene.path / "transforms_thermal.json")
    assert parse(scene.path).metadata["thermal_filenames"][0] == scene.path / "infrared" / "frame_train_000.png"


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


def test_kelvins_that_are_meant_and_a_sky_far_below_the_bounds_are_read(scene_folder):
    scene = scene_folder()
    half_in_kelvin(scene)
    scene.rewrite()
    assert parse(scene.path, thermal_bounds=(10.0, 300.0)).metadata["temperature_range"].max_c == 300.0
    with_bounds(10.0, 30.0, np.eye(18, 24) - 80.0)(scene)
    scene.rewrite()
    assert parse(scene.path).metadata["temperature_range"].min_c == pytest.approx(-80.0)


def test_a_damaged_photograph_or_one_with_an_alpha_channel_is_refused(scene_folder):
    scene = scene_folder()
    path = scene.path / "images" / "frame_train_001.png"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(SceneError, match=r"frame_train_001\.png.*readable photograph"):
        ThermalDataset(parse(scene.path))[1]
    Image.fromarray(np.zeros((18, 24, 4), np.uint8)).save(path)
    with pytest.raises(SceneError, match="opaque"):
        ThermalDataset(parse(scene.path))[1]


def bounds_that_are_a_folder(scene) -> None:
    (scene.path / BOUNDS_NAME).unlink()
    (scene.path / BOUNDS_NAME).mkdir()


def all_in(suffix: str, values: np.ndarray):
    def change(scene) -> None:
        for frame in scene.meta["frames"]:
            frame["thermal_file_path"] = f"thermal/{Path(frame['file_path']).stem}{suffix}"
            write_counts(scene.path / frame["thermal_file_path"], values)

    return change


def of_frame_3(**values):
    """Change the entry of a frame; a value is set, or called with the entry."""

    def change(scene) -> None:
        frame = scene.meta["frames"][3]
        for key, value in values.items():
            value(frame) if callable(value) else frame.__setitem__(key, value)

    return change


def cell(row: int, column: int, value):
    return of_frame_3(pose=lambda frame: frame["transform_matrix"][row].__setitem__(column, value))


def without(key: str):
    return of_frame_3(entry=lambda frame: frame.pop(key))


def of_scene(**values):
    return lambda scene: scene.meta.update(values)


def written(text: str):
    def change(scene) -> None:
        scene.rewrite = lambda: (scene.path / "transforms.json").write_text(text)

    return change


def thermal_of(name: str, counts: np.ndarray):
    return lambda scene: write_counts(scene.path / "thermal" / f"{name}.png", counts)


def content_of(name: str, content: bytes):
    return lambda scene: (scene.path / name).write_bytes(content)


def parallel(scene) -> None:
    del scene.meta["scene_box"]
    for frame in scene.meta["frames"]:
        for row, axis in zip(frame["transform_matrix"], np.eye(3).tolist()):
            row[:3] = axis


def with_bounds(low: float, high: float, values: np.ndarray):
    return lambda scene: (all_in(".npy", values)(scene), write_bounds(low, high)(scene))


def mask_all_but_one(scene) -> None:
    scene.add_masks()
    del scene.meta["frames"][0]["mask_path"]


OWN = {"w": 13, "h": 10, "fl_x": 9, "fl_y": 9, "cx": 6, "cy": 5}


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (without("transform_matrix"), "frame 3.*transform_matrix"),
        (cell(1, 3, float("nan")), "frame 3.*NaN"),
        (cell(0, 3, 1e30), "frame 3.*units of the origin"),
        (cell(0, 3, True), "frame 3.*True"),
        (cell(0, 3, "abc"), "frame 3.*'abc'"),
        (cell(3, 3, 2), "frame 3.*last row"),
        (of_frame_3(transform_matrix=[[1, 2], [3, 4]]), "frame 3.*4 x 4"),
        (of_frame_3(transform_matrix=np.diag([2.0, 2.0, 2.0, 1.0]).tolist()), "frame 3.*rotation"),
        (of_frame_3(thermal_transform_matrix=np.eye(4).tolist()), "frame 3.*thermal_camera"),
        (of_frame_3(file_path="images/gone.png"), r"frame 3.*gone\.png"),
        (of_frame_3(file_path="images/two\nlines.png"), r"frame 3 \(images/two\\nlines\.png\)"),
        (of_frame_3(file_path="a" * 300), "a{200}.*File name too long"),
        (without("file_path"), "frame 3.*file_path"),
        (of_frame_3(w=25), "frame 3.*25 x 18"),
        (of_frame_3(w=24.5), r"frame 3.*24\.5"),
        *((of_frame_3(w=size), "frame 3.*intrinsics") for size in (0, -3, 2_000_000, 10**400)),
        (of_frame_3(fl_x=0.0), "frame 3.*focal"),
        (of_frame_3(fl_x=1e308), "frame 3.*fl_x 1e"),
        (of_frame_3(fl_x=True), "frame 3.*true or false"),
        (of_frame_3(cx=1e9), "frame 3.*cx 1e"),
        (of_frame_3(k1=1e6), r"frame 3.*k1 1e\+06"),
        (of_frame_3(camera_model="ORTHOPHOTO"), "frame 3.*ORTHOPHOTO"),
        (of_frame_3(thermal_camera={"w": 9, "h": 9}), "frame 3.*no fl_x"),
        (of_frame_3(thermal_camera=OWN), "13 x 10"),
        (of_frame_3(mask_path=None), "frame 3.*mask_path.*None"),
        (mask_all_but_one, "mask_path: .*9 masks for 10 frames"),
        # The remedy names no option: none would help.
        (lambda scene: shutil.rmtree(scene.path / "thermal"), "10 frames, none with one .*Put them in thermal/"),
        (thermal_of("frame_train_003", np.eye(9, 12, dtype=np.uint16)), "frame_train_003.*12 x 9"),
        (look_away, "cameras: .*in view"),
        (parallel, "--scene-box"),
        (give_twice, r"frame_train_000\.png more than once"),
        (turn_photograph, "frame 3.*EXIF orientation 6"),
        (half_in_kelvin, r"most of the other files, got 293\.15 C"),
        # In Fahrenheit, and with bounds in kelvins.
        (
            with_bounds(15.0, 25.0, 84.0 + 0.1 * np.eye(18, 24)),
            r"near 15 to 25 C, .* got 84\.00 C in the middle.*correct the bounds",
        ),
        (with_bounds(283.0, 303.0, 20.0 + np.eye(18, 24)), r"20\.00 C in the middle"),
        (content_of("images/frame_train_001.png", b"no picture"), "frame_train_001"),
        (content_of("thermal/frame_eval_002.png", b""), "frame_eval_002"),
        (lambda scene: (scene.path / "thermal" / "frame_train_003.png").unlink(), "frame_train_003.*--missing-thermal"),
        (all_in(".tiff", np.eye(18, 24, dtype=np.uint16)), "thermal_unit"),
        (all_in(".npy", np.eye(18, 24) + 293.15), f"{BOUNDS_NAME}.*293.15 C"),
        (all_in(".npy", np.full((18, 24), np.nan)), "no valid pixel"),
        (all_in(".npy", np.eye(12)), "thermal_camera"),
        (all_in(".png", np.full((18, 24), 65535, np.uint16)), "frame_eval_002.png: .*65535"),
        (write_bounds(-300.0, 20.0), BOUNDS_NAME),
        (write_bounds(10.0, math.inf), BOUNDS_NAME),
        (write_bounds("10", 20.0), BOUNDS_NAME),
        (write_bounds(10.0, None), BOUNDS_NAME),
        (bounds_that_are_a_folder, f"{BOUNDS_NAME}: .* a folder"),
        (of_scene(metres_per_unit=-1), "metres_per_unit"),
        (of_scene(metres_per_unit="x"), "metres_per_unit"),
        (of_scene(up=[0, 0, 0]), "up"),
        (of_scene(up="z"), "up"),
        (of_scene(thermal_unit={"celsius_per_count": True, "celsius_offset": 0}), "thermal_unit"),
        (of_scene(thermal_unit={"celsius_per_count": 0, "celsius_offset": 1}), "thermal_unit"),
        *((of_scene(test_filenames=names), "test_filenames") for names in ([], 5, ["images/a.jpg", 5], "images/a.jpg")),
        (of_scene(test_filenames=["images/gone.png"]), r"test_filenames: .*gone\.png"),
        *(
            (of_scene(scene_box=box), "scene_box.*two corners")
            for box in ([[0, 0, 0], [1, 1, 0]], [[1, 0, 0], [0, 1, 1]], [[0, 0, 0], [1, 1, "x"]], [1, 2])
        ),
        *((written(text), r"transforms\.json") for text in ("{", "[]", '{"frames": []}', '{"w": 3}', "[" * 200_000)),
        (lambda scene: shutil.rmtree(scene.path), "no such folder"),
        (lambda scene: (scene.path / "transforms.json").rename(scene.path / "x"), "transforms_thermal"),
    ],
)
def test_what_no_scene_means_is_refused(scene_folder, change, named):
    own = {"names": [f"frame_{number:03d}" for number in range(10)]} if "filenames" in named else {}
    scene = scene_folder(**own)
    change(scene)
    if (scene.path / "transforms.json").is_file():
        scene.rewrite()
    with pytest.raises(SceneError, match=named) as caught:
        parse(scene.path)
    assert "\n" not in str(caught.value)
    assert "missing-thermal" not in str(caught.value) or (scene.path / "thermal").is_dir()


def test_what_has_no_partner_is_left_out_if_one_asks_for_it(scene_folder):
    scene = scene_folder()
    (scene.path / "thermal" / "frame_train_003.png").rename(scene.path / "thermal" / "extra.png")
    assert names(parse(scene.path, missing_thermal="skip")) == [f"frame_train_00{n}" for n in (0, 1, 4, 5, 6, 8, 9)]


@pytest.mark.parametrize(
    "options", [{"downscale_factor": 0}, {"photographs_gb": 0.0}, {"eval_mode": "interval", "eval_interval": 1}]
)
def test_options_that_cannot_be_are_refused(scene_folder, options):
    with pytest.raises(SceneError, match=list(options)[-1]):
        parse(scene_folder().path, **options)


@pytest.mark.real_data
def test_real_room_corner(shared_data):
    config = ThermalDataParserConfig(data=shared_data / "arco")
    parser = config.setup()
    train, evaluate = parser.get_dataparser_outputs("train"), parser.get_dataparser_outputs("val")
    everything = sorted(path.name for path in (shared_data / "arco" / "visible").glob("*.jpg"))
    assert [path.name for path in evaluate.image_filenames] == everything[4::8] and len(train.image_filenames) == 35
    thermal = train.metadata["thermal_cameras"]
    assert (int(thermal.width[0]), int(thermal.height[0])) == (640, 512)
    baseline = (thermal.camera_to_worlds - train.cameras.camera_to_worlds)[:, :, 3].norm(dim=1)
    torch.testing.assert_close(baseline / train.dataparser_scale, torch.full((35,), 0.1324), atol=1e-3, rtol=0)
    box = train.scene_box.aabb
    assert torch.isfinite(box).all() and float(box.abs().max()) == pytest.approx(1.0)
    assert 1 / train.dataparser_scale == pytest.approx(9.4, abs=1.0)
    temperatures = train.metadata["temperature_range"]
    assert 4 < temperatures.min_c < 10 and 80 < temperatures.max_c < 90
