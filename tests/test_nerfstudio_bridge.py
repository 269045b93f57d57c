import os
import subprocess
import sys
from copy import deepcopy
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
import tyro
import yaml
from nerfstudio.configs.method_configs import all_methods

from thermoxels_ns import nerfstudio_bridge
from thermoxels_ns.core.errors import CheckpointError
from thermoxels_ns.training.pipeline import load_checkpoint

HEAVY = ("pyvista", "vtk", "vtkmodules", "skfem", "open3d", "pymeshlab", "pycolmap", "numba")
OURS = [f"thermoxels_ns.{name}" for name in ("mesh", "fem", "heat", "commands", "reports", "cli")]
PLUGIN = """
from nerfstudio.plugins.types import MethodSpecification
from thermoxels_ns import nerfstudio_bridge

nerfstudio_bridge.install()
nerfstudio_bridge.install()

def method():
    from nerfstudio.engine.trainer import TrainerConfig
    return MethodSpecification(TrainerConfig(method_name="bridge-probe"), description="probe")
"""

ANOTHER_COMMAND = """
import sys
import nerfstudio.scripts.train
print("\\n".join(sys.modules))
"""


def printed(folder: Path, code: str) -> str:
    """What a process prints whose nerfstudio loads a plugin that installs the bridge."""
    (folder / "bridge_probe.py").write_text(PLUGIN)
    plugin = {"NERFSTUDIO_METHOD_CONFIGS": "bridge-probe=bridge_probe:method", "COLUMNS": "160"}
    path = os.pathsep.join(filter(None, [str(folder), os.environ.get("PYTHONPATH")]))
    environment = {**os.environ, **plugin, "PYTHONPATH": path}
    command = [sys.executable, "-c", code]
    return subprocess.run(command, capture_output=True, text=True, check=True, cwd=folder, env=environment).stdout


def test_other_commands_load_nothing_heavy(tmp_path) -> None:
    """Every ``ns-*`` command imports the plugin, also where pyvista or open3d cannot be imported."""
    loaded = printed(tmp_path, ANOTHER_COMMAND).split()
    assert {"thermoxels_ns.nerfstudio_bridge", "thermoxels_ns.config"} <= {*loaded}
    assert [name for name in (*HEAVY, *OURS) if name in loaded] == []


def test_a_script_that_runs_as_a_module_is_hooked_too(monkeypatch) -> None:
    script = ModuleType("__main__")
    vars(script).update(tyro=tyro, __spec__=ModuleSpec("nerfstudio.scripts.exporter", None))
    monkeypatch.setitem(sys.modules, "__main__", script)
    nerfstudio_bridge.extend_commands()
    assert vars(script)["tyro"] is not tyro


def test_numpy_scalars_load_with_weights_only(tmp_path) -> None:
    numbers = [np.float64(1e-3), np.float32(0.5), np.int64(7), np.int32(-7), np.bool_(True)]
    path = tmp_path / "step-000000001.ckpt"
    torch.save({"schedulers": {"_last_lr": numbers}, "step": 1, "weights": torch.ones(2)}, path)
    nerfstudio_bridge.allow_checkpoint_globals()
    loaded = torch.load(path, weights_only=True)["schedulers"]["_last_lr"]
    assert loaded == numbers and [type(one) for one in loaded] == [type(one) for one in numbers]


@pytest.mark.parametrize(
    "line",
    [
        "!!python/object/apply:os.mkdir [harmful]",
        "{fine: 1, ? !!python/object/apply:os.mkdir [harmful] : 1}",
        "!<tag:yaml.org,2002:python/object/apply:os.mkdir> [harmful]",
        "!!python/object/new:os.mkdir [harmful]",
        "!!python/object/apply:eval [1]",
        "!!python/object:subprocess.Popen {}",
        "!!python/object:nerfstudio.engine.trainer.Trainer {}",
        "!!python/object/apply:nerfstudio.utils.scripts.run_command [mkdir harmful]",
        "!!python/name:nerfstudio.utils.scripts.run_command",
        "!!python/name:nerfstudio.utils.writer.Path",
        "!!python/name:thermoxels_ns.no_such_module.Config",
        "!!python/module:this",
        "[" * 5000,
    ],
)
def test_a_config_that_could_run_code_is_refused(tmp_path, monkeypatch, line):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(CheckpointError, match=r"load_config: expected a config\.yml that"):
        yaml.load(line, Loader=yaml.Loader)
    assert not Path("harmful").exists()


def test_configs_of_all_methods_are_read():
    configs = deepcopy(list(all_methods.values()))  # what they share is written once
    for config in configs:
        vars(config).pop("_folder", None)  # that of a training in the same process
    text = yaml.dump(configs)
    again = yaml.load(text, Loader=yaml.Loader)
    # Equality of dataclasses does not look at what a subclass compares by identity: look at the text as well.
    assert again == configs and yaml.dump(again) == text


class Harmful:
    def __reduce__(self):
        return (os.mkdir, ("harmful",))


@pytest.mark.parametrize("content", ["harmful", "damaged", "empty"])
def test_a_refused_checkpoint_is_one_line_whatever_the_default_of_torch(tmp_path, monkeypatch, content):
    """Torch up to 2.5 loads anything by default, and newer ones advise to."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD", "1")
    torch.save({"lr": Harmful()}, "bad.ckpt")
    if content != "harmful":
        Path("bad.ckpt").write_bytes(b"PK" if content == "damaged" else b"")
    with pytest.raises(CheckpointError, match=r"^bad.ckpt: expected a checkpoint") as caught:
        load_checkpoint(Path("bad.ckpt"), map_location="cpu")
    said = str(caught.value)
    assert "weights" not in said and "\n" not in said and not Path("harmful").exists()
    assert (content == "harmful") == ("mkdir, which could run code" in said)
