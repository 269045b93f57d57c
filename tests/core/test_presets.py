import zipfile
from importlib.metadata import entry_points
from pathlib import Path

import numpy as np
import pytest
from nerfstudio.configs.method_configs import all_methods

from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.core.json_values import read_json_object, write_json
from thermoxels_ns.core.yaml_records import read_yaml, with_overrides

ROOT = Path(__file__).resolve().parents[2]
METHODS = {
    point.name: point.load()
    for point in entry_points(group="nerfstudio.method_configs")
    if point.module.startswith("thermoxels_ns.")
}

FILES = sorted(path.stem for path in (ROOT / "configs").glob("*.yaml"))
OTHERS = ("patches-", "scene-", "conditions-", "house-corner-", "materials")
METHOD_FILES = [name for name in FILES if not name.startswith(OTHERS)]


@pytest.mark.parametrize("name", METHOD_FILES)
def test_a_method_has_the_values_of_its_file(name: str) -> None:
    settings, method = read_yaml(ROOT / "configs" / f"{name}.yaml"), METHODS[name]
    assert method.description == settings.pop("description") and method.config.method_name == name
    assert with_overrides(method.config, settings) == method.config


def test_methods_share_no_configuration() -> None:
    assert set(METHOD_FILES) == set(METHODS) - {"thermoxels"}
    seen: set[int] = set()
    for name, method in METHODS.items():
        assert all_methods[name] == method.config  # what ns-train offers
        pipeline = method.config.pipeline
        parts = {id(pipeline), id(pipeline.datamanager), id(pipeline.datamanager.dataparser), id(pipeline.model)}
        assert len(parts) == 4
        assert not parts & seen
        seen |= parts


def test_an_installed_package_brings_the_presets(tmp_path: Path) -> None:
    """The wheel holds configs/ inside the package, where `configs_folder` looks first."""
    from hatchling.builders.wheel import WheelBuilder

    (wheel,) = WheelBuilder(str(ROOT)).build(directory=str(tmp_path), versions=["standard"])
    with zipfile.ZipFile(wheel) as archive:
        held = {Path(name).stem for name in archive.namelist() if name.startswith("thermoxels_ns/configs/")}
    assert set(FILES) <= held


@pytest.mark.parametrize("text", ["a: " + "[" * 5000, "[a]: 1\n[a]: 2", "k: 1\nk: 2", "- a"])
def test_yaml_that_cannot_be_used_is_refused(tmp_path, text):
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(ThermoxelsError, match=r"a\.yaml: expected"):
        read_yaml(tmp_path / "a.yaml")


@pytest.mark.parametrize("read", [read_yaml, read_json_object])
def test_a_key_given_twice_is_found_among_many(tmp_path, read):
    rows = [f'"k{number}": 1' for number in [*range(3000), 7]]
    text = "{" + ", \n".join(rows) + "}" if read is read_json_object else "\n".join(rows)
    (tmp_path / "a").write_text(text)
    with pytest.raises(ThermoxelsError, match=r"a: expected a .*, got the key k7 twice"):
        read(tmp_path / "a")


def test_json_keeps_order_names_that_are_not_utf_8_and_degree_signs_and_converts_numpy(tmp_path):
    figures = {"volume": np.float32(0.5), "counts": {"tets": np.int64(6)}, "bounds": np.eye(2), "run": Path("a/b")}
    write_json(tmp_path / "summary.json", {**figures, "unit": "°C", "left_out": "caf\udce9.jpg"})
    text, read = (tmp_path / "summary.json").read_text(encoding="utf-8"), read_json_object(tmp_path / "summary.json")
    assert list(read) == [*figures, "unit", "left_out"] and "°C" in text and '\n "volume": 0.5' in text
    assert (read["counts"], read["bounds"], read["run"]) == ({"tets": 6}, [[1.0, 0.0], [0.0, 1.0]], "a/b")
    assert read["left_out"] == "caf\udce9.jpg"
