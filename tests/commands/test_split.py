"""`thermoxels split` on a drawn scene: blocks are scenes whose lattices coincide."""

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from thermoxels_ns.cli import main
from thermoxels_ns.commands.batch import read_list
from thermoxels_ns.commands.split import LIST, boxes_of_blocks, photographs_of
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.data.dataparser import ThermalDataParserConfig
from thermoxels_ns.data.scene_file import Frame, read_scene_file
from thermoxels_ns.synthetic.drawn_scenes import make_scene
from thermoxels_ns.synthetic.scene_folder import write_scene


@pytest.mark.parametrize("count", [2, 3, 7])
@pytest.mark.parametrize("sides", [(60.0, 9.0, 8.0), (3.0, 2.9, 2.8), (12.0, 1.0, 11.9)])
@pytest.mark.parametrize("resolution", [64, 128, 200])
def test_voxels_of_neighbours_coincide_and_blocks_cover_the_box(count, sides, resolution) -> None:
    box = np.array([[-7.0, 3.0, 0.4], [-7.0 + sides[0], 3.0 + sides[1], 0.4 + sides[2]]])
    boxes = boxes_of_blocks(box, count)
    lattices = [Lattice.covering(*one, resolution) for one in boxes.astype(np.float32)]
    first = lattices[0]
    places = np.array([first.world_to_index(one.lo) for one in lattices])
    assert np.abs(places - places.round()).max() < 0.01, "voxels"
    assert {one.shape for one in lattices} == {first.shape}
    assert (boxes[1:, 0, 0] < boxes[:-1, 1, 0]).all(), "overlap"
    assert (boxes[0, 0] <= box[0] + 1e-3).all() and (boxes[-1, 1] >= box[1] - 1e-3).all()


@pytest.fixture(scope="module")
def blocks(tmp_path_factory):
    folder = tmp_path_factory.mktemp("split")
    write_scene(make_scene("house-corner"), folder / "scene", 12, 3, 96, 72, progress=False, own_thermal_camera=True)
    path = folder / "scene" / "transforms.json"
    content = json.loads(path.read_text())
    names = [frame["file_path"] for frame in content["frames"]]
    content |= {"k3": 0.002, "k4": -0.001, "val_filenames": [f"./{names[0]}", names[-1]]}
    content["thermal_camera"]["k3"] = 0.003
    path.write_text(json.dumps(content))
    (folder / "blocks" / "block-1").mkdir(parents=True)
    (folder / "blocks" / LIST).write_text("of an earlier run")
    assert main(["split", str(folder / "scene"), "--blocks", "2", "--output-dir", str(folder / "blocks")]) == 0
    return folder


def test_blocks_are_scenes_of_the_photographs_that_show_them(blocks) -> None:
    whole = {frame.image: frame for frame in read_scene_file(blocks / "scene").frames}
    with (blocks / "blocks" / LIST).open(newline="") as file:
        lines = list(csv.DictReader(file))
    assert [line["name"] for line in lines] == ["block-1", "block-2"]
    assert [*read_list(blocks / "blocks" / LIST)] == ["block-1", "block-2"], "a list for thermoxels batch"
    used = set()
    for line in lines:
        file = read_scene_file(blocks / "blocks" / line["scene"])
        assert file.bounds_c == pytest.approx((-20.0, 15.0)) and file.meta["metres_per_unit"] == 1.0
        assert [Path(name).stem for name in file.meta["val_filenames"]] == ["frame_train_00001", "frame_eval_00003"]
        for frame in file.frames:
            same = whole[frame.image]
            used.add(frame.image)
            np.testing.assert_allclose(frame.pose, same.pose)
            np.testing.assert_allclose(frame.thermal_pose, same.thermal_pose)
            assert frame.thermal == same.thermal
            assert (frame.intrinsics, frame.thermal_intrinsics) == (same.intrinsics, same.thermal_intrinsics)
    assert used == set(whole), "the house is small: some photograph shows each part"


@pytest.mark.parametrize("factor", [1, 2])
def test_trainings_of_blocks_get_voxels_of_one_size_and_keep_their_poses(blocks, monkeypatch, factor) -> None:
    monkeypatch.setattr("thermoxels_ns.data.dataparser.refine_poses", lambda *_: pytest.fail("poses of a block alone"))
    found = []
    for name in ("block-1", "block-2"):
        parser = ThermalDataParserConfig(data=blocks / "blocks" / name, downscale_factor=factor).setup()
        outputs = parser.get_dataparser_outputs("train")
        found.append((outputs.metadata["pixel_size"], outputs.dataparser_scale))
        given = json.loads((blocks / "blocks" / name / "transforms.json").read_text())
        assert outputs.metadata["pixel_size"] / outputs.dataparser_scale == pytest.approx(given["pixel_size"])
    assert found[0] == pytest.approx(found[1], rel=1e-6)


def test_a_scene_that_is_in_the_way_stays(blocks, capsys, tmp_path) -> None:
    (tmp_path / "block-2").mkdir()
    (tmp_path / "block-2" / "transforms.json").write_text("mine")
    assert main(["split", str(blocks / "scene"), "--blocks", "2", "--output-dir", str(tmp_path)]) == 2
    assert "block-2/transforms.json" in capsys.readouterr().err
    assert (tmp_path / "block-2" / "transforms.json").read_text() == "mine"


def test_nothing_of_an_earlier_split_stays(blocks, tmp_path) -> None:
    scene = tmp_path / "scene"
    shutil.copytree(blocks / "scene", scene)
    words = ["split", str(scene), "--blocks", "2", "--output-dir", str(tmp_path / "blocks")]
    assert main(words) == 0 and read_scene_file(tmp_path / "blocks" / "block-1").bounds_c is not None
    (scene / "temperature_bounds.json").unlink()
    assert main(words) == 0 and read_scene_file(tmp_path / "blocks" / "block-1").bounds_c is None


def test_a_photograph_of_everything_is_in_its_best_block() -> None:
    points = np.stack([np.linspace(0.5, 19.5, 200), *np.zeros((2, 200))], axis=1)
    pose = np.eye(4)
    pose[:3, 3] = 10.0, 0.0, 40.0
    camera = Camera(100, 100, 150.0, 150.0, 50.0, 50.0)
    frame = Frame("a", Path("a"), None, None, pose, camera, None, None)
    box = np.array([[0.0, -1.0, -1.0], [20.0, 1.0, 1.0]])
    near = replace(frame, pose=np.array([[1.0, 0, 0, 10], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]))
    away = replace(frame, pose=frame.pose @ np.diag([-1.0, 1.0, -1.0, 1.0]))
    everything, close, nothing = photographs_of([frame, near, away], points, boxes_of_blocks(box, 20)).T
    assert everything.any(), "its best block, although each holds less than a tenth of what it shows"
    assert 1 < close.sum() < 6 and not nothing.any()


@pytest.mark.parametrize("value", ["0.02 m", -1.0, True])
def test_a_wrong_pixel_size_is_refused(blocks, tmp_path, value) -> None:
    shutil.copytree(blocks / "blocks" / "block-1", tmp_path / "block")
    path = tmp_path / "block" / "transforms.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"pixel_size": value}))
    with pytest.raises(SceneError, match="pixel_size"):
        ThermalDataParserConfig(data=tmp_path / "block").setup().get_dataparser_outputs("train")


@pytest.mark.parametrize(("count", "said"), [("1", "2 to 1000"), ("40", "photographs of each block")])
def test_a_wrong_number_of_blocks_is_refused(blocks, capsys, tmp_path, count, said) -> None:
    words = ["split", str(blocks / "scene"), "--blocks", count, "--output-dir", str(tmp_path / "out")]
    assert main(words) == 2
    assert said in capsys.readouterr().err and not (tmp_path / "out").exists()
