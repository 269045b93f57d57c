"""Every layout of scene folders, made by its writer: recognised by itself, and read as the same scene."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import torch
from PIL import Image

from tests.support.camera_card import FlirFile, smooth_counts
from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.data import layouts
from thermoxels_ns.data.dataparser import ThermalDataParserConfig
from thermoxels_ns.data.dataset import ThermalDataset
from thermoxels_ns.data.scene_file import BOUNDS_NAME, read_scene_file
from thermoxels_ns.data.tracks import find_tracks
from thermoxels_ns.radiometry.flir_rjpeg import read_flir_jpeg
from thermoxels_ns.synthetic import scene_folder

NAMES = get_args(layouts.LayoutName)


def parsed(folder: Path, split: str = "train", **options):
    options = {"scene_box": ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)), "refine_poses": "given", "tracks": "off"} | options
    return ThermalDataParserConfig(data=folder, **options).setup().get_dataparser_outputs(split)


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> Callable[[str], Path]:
    """The folder of a small scene in a layout, written once."""
    root, scene = tmp_path_factory.mktemp("layouts"), scene_folder.make_scene("hot-object")

    def folder(layout: str) -> Path:
        if not (root / layout).is_dir():
            own = layout == "thermalnerf"
            options = {"layout": layout, "own_thermal_camera": own, "photo_format": "png", "progress": False}
            scene_folder.write_scene(scene, root / layout, 5, 2, 40, 30, **options)
        return root / layout

    return folder


@pytest.fixture
def copied(written, tmp_path) -> Callable[[str], Path]:
    return lambda layout: Path(shutil.copytree(written(layout), tmp_path / layout))


@pytest.mark.parametrize("layout", NAMES)
def test_a_layout_loads_by_name_alone(written, layout, capsys):
    assert set(NAMES) == set(get_args(scene_folder.LayoutName)) == {one.name for one in layouts.LAYOUTS}
    usual, found = written("thermoscenes"), read_scene_file(written(layout))
    assert found.layout.startswith(f"{layout}: ") and found.left_out == []
    by_stem = {frame.image.stem: frame for frame in read_scene_file(usual).frames}
    assert sorted(by_stem) == sorted(frame.image.stem for frame in found.frames)
    for frame in found.frames:
        other = by_stem[frame.image.stem]
        np.testing.assert_allclose(frame.pose, other.pose, atol=1e-9)
        assert frame.intrinsics == other.intrinsics
        assert layout == "rgb" if frame.thermal is None else frame.thermal.stem == frame.image.stem
        assert (frame.thermal_pose is not None) == (frame.thermal_intrinsics is not None) == (layout == "thermalnerf")
    for split in ("train", "val"):
        outputs, expected = parsed(written(layout), split), parsed(usual, split)
        assert [path.stem for path in outputs.image_filenames] == [path.stem for path in expected.image_filenames]
    dataset, same = ThermalDataset(outputs), ThermalDataset(expected)
    assert torch.equal(dataset.get_data(0)["image"], same.get_data(0)["image"])
    if layout == "rgb":
        assert dataset.temperature_range is None and not dataset.get_data(0)["thermal_valid"].any()
    elif layout != "thermalnerf":  # whose thermal camera is another one
        warm = [one.temperature_range.to_celsius(one.get_thermal(0)[0]) for one in (dataset, same)]
        torch.testing.assert_close(warm[0], warm[1], atol=2e-3, rtol=0)
    assert f"Layout {layout}: " in capsys.readouterr().out
    tracks = find_tracks(found)
    assert (tracks is not None) == (layout in ("rgbt-scenes", "thermalmix", "colmap"))
    if tracks is not None:  # photographs see points of the exact surface
        surface = scene_folder.make_scene("hot-object").solid.signed_distance(tracks.points)
        assert len(surface) > 20 and np.abs(surface).max() < 1e-9


def rgbt(folder: Path) -> Path:
    """Make the thermal pictures false-colour ones, as published, and put the camera's files beside them."""
    (folder / "raw_images").mkdir()
    (folder / BOUNDS_NAME).unlink()
    for path in folder.glob("thermal/*/*.png"):
        Image.fromarray(np.random.default_rng(0).integers(0, 255, (30, 40, 3), dtype=np.uint8)).save(path)
        (folder / "raw_images" / f"{path.stem}.jpg").write_bytes(FlirFile(smooth_counts()).jpeg())
    return folder


def test_degrees_come_from_the_cameras_own_files(copied):
    folder = rgbt(copied("rgbt-scenes"))
    assert "raw_images/" in read_scene_file(folder).layout
    dataset = ThermalDataset(parsed(folder))
    expected = read_flir_jpeg(next(folder.glob("raw_images/*"))).temperature_c()
    found = dataset.temperature_range.to_celsius(dataset.get_thermal(0)[0])[..., 0].numpy()
    np.testing.assert_allclose(found, expected, atol=1e-3)


def test_a_grey_palette_needs_its_bounds(copied):
    folder = copied("rgbt-scenes")
    bounds = json.loads((folder / BOUNDS_NAME).read_text()).values()
    expected = parsed(folder).metadata["temperature_range"]
    (folder / BOUNDS_NAME).unlink()
    with pytest.raises(SceneError, match="--thermal-bounds"):
        parsed(folder)
    assert parsed(folder, thermal_bounds=tuple(bounds)).metadata["temperature_range"] == expected


def no_raw(folder: Path) -> None:
    shutil.rmtree(rgbt(folder) / "raw_images")


def jpeg_ls(folder: Path) -> None:
    file = FlirFile(smooth_counts())
    record = file.raw_record()[:32] + b"\xff\xd8\xff\xf7" + bytes(200)
    file.raw_record = lambda: record  # type: ignore[method-assign]
    (rgbt(folder) / "raw_images" / "frame_train_00002.jpg").write_bytes(file.jpeg())


def lose_frame(folder: Path) -> None:
    content = json.loads((folder / "transforms.json").read_text())
    content["frames"].pop()
    (folder / "transforms.json").write_text(json.dumps(content))


def lose(pattern: str) -> Callable[[Path], object]:
    return lambda folder: [path.unlink() for path in folder.glob(pattern)]


def twice(folder: Path) -> None:
    (folder / "images").rename(folder / "thermal" / "again")
    for name in ("once", "twice"):
        shutil.copytree(folder / "thermal" / "again", folder / "images" / name)


@pytest.mark.parametrize(
    ("layout", "change", "named", "helps"),
    [
        ("rgbt-scenes", no_raw, "false-colour.*R-JPEG.*--layout rgb", {"layout": "rgb"}),
        ("rgbt-scenes", jpeg_ls, r"frame_train_00002\.jpg.*JPEG-LS.*--missing-thermal skip", None),
        ("thermoscenes", lose("thermal/*"), "none with one.*--layout rgb", {"layout": "rgb"}),
        ("thermalmix", lose("warped_thermal/*00001.npy"), "--missing-thermal", {"missing_thermal": "skip"}),
        ("thermalnerf", lose_frame, "7 photographs and 6 thermal", {"layout": "rgb"}),
        ("thermalnerf", lose(BOUNDS_NAME), "--thermal-bounds", {"thermal_bounds": (10.0, 30.0)}),
        ("colmap", twice, "photographs in .*images", None),
        ("colmap", lose("images/*"), "photographs in .*images", None),
        ("colmap", lose("sparse/0/points3D.txt"), "COLMAP model in sparse/0", None),
    ],
)
def test_what_is_refused_has_a_reason_and_a_remedy_that_works(copied, layout, change, named, helps):
    folder = copied(layout)
    change(folder)
    with pytest.raises(SceneError, match=named):
        parsed(folder)
    if helps is not None:
        assert len(parsed(folder, **helps).image_filenames) >= 4


@pytest.mark.parametrize("wrong", [{"layout": "rgbt-scenes"}, {"thermal_bounds": (30.0, 10.0)}])
def test_options_that_do_not_fit_are_refused(written, wrong):
    with pytest.raises(SceneError, match=next(iter(wrong))):
        parsed(written("nerfstudio"), **wrong)


def test_photographs_that_only_the_model_has_are_named(copied):
    folder = copied("colmap")
    (folder / "images" / "frame_train_00002.png").unlink()
    assert read_scene_file(folder).left_out == ["frame_train_00002.png"]


def test_thermal_images_of_other_names_are_paired_in_their_order(copied):
    folder = copied("thermalnerf")
    for path in folder.glob("images_thermal/*"):
        path.rename(path.with_name(f"warm_{path.name}"))
    text = (folder / "transforms.json").read_text().replace("images_thermal/", "images_thermal/warm_")
    (folder / "transforms.json").write_text(text)
    for frame in read_scene_file(folder).frames:
        assert frame.thermal is not None and frame.thermal.name == f"warm_{frame.image.name}"


def test_a_writer_refuses_what_its_layout_cannot_say(tmp_path, written):
    scene = scene_folder.make_scene("sphere")
    with pytest.raises(SceneError, match="own_thermal_camera"):
        scene_folder.write_scene(scene, tmp_path, 3, 1, 40, 30, own_thermal_camera=True, layout="colmap")
    folder = Path(shutil.copytree(written("colmap"), tmp_path / "scene"))
    scene_folder.write_scene(scene, folder, 3, 1, 40, 30, layout="nerfstudio", progress=False)
    assert read_scene_file(folder).layout.startswith("nerfstudio: ") and len(read_scene_file(folder).frames) == 4
    (folder / "truth.json").unlink()
    with pytest.raises(SceneError, match="other photographs"):
        scene_folder.write_scene(scene, folder, 3, 1, 40, 30, layout="colmap")


def test_a_held_out_thermal_image_holds_its_pair_out(copied):
    folder = copied("thermalnerf")
    content = json.loads((folder / "transforms.json").read_text())
    warm = [frame["file_path"] for frame in content["frames"] if frame.get("is_thermal")]
    cold = [frame["file_path"] for frame in content["frames"] if not frame.get("is_thermal")]
    (folder / "transforms.json").write_text(json.dumps(content | {"test_filenames": [cold[0], f"./{warm[2]}"]}))
    named = {path.name for path in parsed(folder, "test", eval_mode="lists").image_filenames}
    assert named == {Path(cold[0]).name, Path(cold[2]).name}
    assert named.isdisjoint(path.name for path in parsed(folder, eval_mode="lists").image_filenames)


def test_a_json_without_frames_says_what_a_colmap_model_cannot(copied):
    folder = copied("colmap")
    (folder / "transforms.json").write_text(json.dumps({"metres_per_unit": 2.0, "scene_box": [[-2.0] * 3, [2.0] * 3]}))
    found = read_scene_file(folder)
    assert found.layout.startswith("colmap: ") and found.meta["metres_per_unit"] == 2.0 and len(found.frames) == 7


def test_thermal_images_that_no_layout_reads_are_not_passed_over(copied):
    folder = copied("rgb")
    (folder / "images_thermal").mkdir()
    with pytest.raises(SceneError, match="beside images_thermal/"):
        read_scene_file(folder)
    assert read_scene_file(folder, layout="rgb").layout.startswith("rgb: ")


@pytest.mark.parametrize(
    ("first", "then"), [("thermoscenes", "rgb"), ("rgbt-scenes", "colmap"), ("thermalmix", "colmap")]
)
def test_a_scene_may_be_written_again_in_another_layout(tmp_path, first, then):
    for layout in (first, then):
        scene_folder.write_scene(
            scene_folder.make_scene("hot-object"), tmp_path, 2, 1, 40, 30, layout=layout, progress=False
        )
    assert read_scene_file(tmp_path).layout.startswith(f"{then}: ")


def test_another_cameras_thermal_image_is_no_partner(copied):
    folder = copied("thermoscenes")
    names = sorted(path.name for path in (folder / "thermal").iterdir())
    (folder / "thermal" / "preview").mkdir()
    shutil.copy(folder / "thermal" / names[0], folder / "thermal" / "preview" / names[0])
    assert read_scene_file(folder).frames[0].thermal.parent.name == "thermal"
    content = json.loads((folder / "transforms.json").read_text())
    (folder / "thermal" / "right").mkdir()
    (folder / "images" / "right").mkdir()
    first, last = content["frames"][0], content["frames"][-1]
    image = folder / "images" / "right" / Path(last["file_path"]).name
    shutil.move(folder / last["file_path"], image)
    last |= {"file_path": f"images/right/{image.name}"}
    last.pop("thermal_file_path", None), first.pop("thermal_file_path", None)
    name = Path(first["file_path"]).stem + ".png"
    shutil.rmtree(folder / "thermal" / "preview")
    shutil.move(folder / "thermal" / name, folder / "thermal" / "right" / name)
    (folder / "transforms.json").write_text(json.dumps(content))
    assert first["file_path"] in read_scene_file(folder, missing_thermal="skip").left_out
