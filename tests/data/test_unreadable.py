"""What may not be read is named as such, not as damaged."""

from pathlib import Path

import pytest

from tests.support.unreadable import forbid
from thermoxels_ns.capture.folder_scan import identify
from thermoxels_ns.capture.photograph import open_photograph
from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.core.json_values import read_json_object
from thermoxels_ns.core.yaml_records import read_yaml
from thermoxels_ns.data.colmap_model import read_model
from thermoxels_ns.data.dataparser import ThermalDataParserConfig
from thermoxels_ns.data.dataset import ThermalDataset
from thermoxels_ns.data.scene_box import _read_ply
from thermoxels_ns.radiometry.thermogram import read_thermogram
from thermoxels_ns.training.pipeline import load_checkpoint

READERS = {
    "points.ply": _read_ply,
    "any.json": read_json_object,
    "any.yaml": read_yaml,
    "thermal.csv": read_thermogram,
    "thermal.jpg": read_thermogram,
    "thermal.tiff": read_thermogram,
    "thermal.npy": read_thermogram,
    "card.jpg": lambda path: identify(path, path.parent),
    "card.png": lambda path: identify(path, path.parent),
    "photograph.jpg": open_photograph,
    "cameras.bin": lambda path: read_model(path.parent),
    "cameras.txt": lambda path: read_model(path.parent),
    "step.ckpt": load_checkpoint,
}


def refused(read) -> None:
    with pytest.raises(ThermoxelsError) as caught:
        read()
    said = str(caught.value)
    assert "Permission denied" in said and "permissions" in said and "\n" not in said, said
    assert "damaged" not in said and "Write it again" not in said, said


@pytest.mark.parametrize("name", READERS)
def test_a_file_that_may_not_be_read(tmp_path: Path, monkeypatch, name) -> None:
    path = tmp_path / name
    path.write_text("1,2\n3,4\n")
    forbid(monkeypatch, name)
    refused(lambda: READERS[name](path))


@pytest.mark.parametrize("name", ["images/{}.png", "thermal/{}.png", "mask_{}.png"])
def test_images_of_a_scene(scene_folder, monkeypatch, name) -> None:
    scene = scene_folder(frames=5)
    if "mask" in name:
        scene.add_masks()
    forbid(monkeypatch, name.format(scene.names[0]))

    def read() -> None:
        data = ThermalDataset(ThermalDataParserConfig(data=scene.path).setup().get_dataparser_outputs("train"))
        for number in range(len(data)):
            data[number]

    refused(read)
