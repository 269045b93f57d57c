import dataclasses
import json
import os
import subprocess
import sys
import textwrap
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
import tyro
import yaml
from nerfstudio.configs.method_configs import all_methods

from thermoxels_ns import nerfstudio_bridge
from thermoxels_ns.commands.export import ExportThermoxelsMesh
from thermoxels_ns.core.errors import CheckpointError, OutputError
from thermoxels_ns.training.pipeline import load_checkpoint

STOCK = ("pointcloud", "tsdf", "poisson", "marching-cubes", "cameras", "gaussian-splat")
HEAVY = ("pyvista", "skfem", "vtkmodules", "pycolmap", "open3d", "thermoxels_ns.mesh", "thermoxels_ns.fem")
PLUGIN = """
from nerfstudio.plugins.types import MethodSpecification
from thermoxels_ns import nerfstudio_bridge

nerfstudio_bridge.install()
nerfstudio_bridge.install()

def method():
    from nerfstudio.engine.trainer import TrainerConfig
    return MethodSpecification(TrainerConfig(method_name="bridge-probe"), description="probe")
"""


def run(code: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run python code in a process whose nerfstudio loads a plugin that installs the bridge."""
    (folder / "bridge_probe.py").write_text(PLUGIN)
    return subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)],
        capture_output=True,
        text=True,
        check=False,
        cwd=folder,
        env={
            **os.environ,
            "NERFSTUDIO_METHOD_CONFIGS": "bridge-probe=bridge_probe:method",
            "PYTHONPATH": os.pathsep.join(filter(None, [str(folder), os.environ.get("PYTHONPATH")])),
            "COLUMNS": "160",
        },
    )


ARGUMENTS = {
    "help": ["--help"],
    "our help": ["thermoxels-mesh", "--help"],
    "ours": ["thermoxels-mesh", "--load-config", "missing.yml", "--output-dir", "out"],
    **{name: [name, "--load-config", "missing.yml", "--output-dir", "out"] for name in STOCK},
}
NS_EXPORT = """
import contextlib, io, json, sys
sys.argv = ["ns-export"]
from nerfstudio.scripts.exporter import entrypoint
from nerfstudio.utils.rich_utils import CONSOLE

results = {{}}
for name, arguments in {arguments}.items():
    sys.argv, output = ["ns-export", *arguments], io.StringIO()
    CONSOLE.file = output
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
        try:
            outcome = entrypoint()
        except BaseException as problem:
            outcome = f"{{type(problem).__name__}}: {{problem}}"
    results[name] = [outcome, output.getvalue()]
json.dump(results, open("results.json", "w"))
"""


@pytest.fixture(scope="module")
def ns_export(tmp_path_factory) -> dict[str, list[str]]:
    """What the console script ns-export does for each of `ARGUMENTS`: how it ended, and what it printed."""
    folder = tmp_path_factory.mktemp("export")
    result = run(NS_EXPORT.format(arguments=ARGUMENTS), folder)
    assert result.returncode == 0, result.stderr
    return json.loads((folder / "results.json").read_text())


def test_help_lists_ours_beside_all_stock_subcommands_and_shows_every_option(ns_export) -> None:
    options = ["--" + option.name.replace("_", "-") for option in dataclasses.fields(ExportThermoxelsMesh)]
    for key, words in (("help", [*STOCK, "thermoxels-mesh"]), ("our help", options)):
        outcome, printed = ns_export[key]
        assert outcome == "SystemExit: 0"
        assert [word for word in words if word not in printed] == []


@pytest.mark.parametrize("name", STOCK)
def test_stock_subcommands_still_run(name: str, ns_export) -> None:
    """A missing config gets as far as nerfstudio's own code."""
    assert "FileNotFoundError" in ns_export[name][0] and "missing.yml" in ns_export[name][0], ns_export[name]


def test_ours_reports_a_missing_config_and_exits(ns_export) -> None:
    outcome, printed = ns_export["ours"]
    assert outcome == "SystemExit: 1"
    assert "Error: load_config: expected" in printed and "missing.yml" in printed
    assert "Traceback" not in printed


def test_hook_works_when_the_exporter_runs_as_a_module(tmp_path) -> None:
    """As with python -m nerfstudio.scripts.exporter, where the module's name is __main__."""
    code = """
        import runpy, sys
        sys.argv = ["exporter", "--help"]
        runpy.run_module("nerfstudio.scripts.exporter", run_name="__main__", alter_sys=True)
    """
    result = run(code, tmp_path)
    assert result.returncode == 0, result.stderr
    assert "thermoxels-mesh" in result.stdout and "gaussian-splat" in result.stdout


def test_other_commands_load_nothing_heavy(tmp_path) -> None:
    code = """
        import sys
        import nerfstudio.scripts.train
        print("\\n".join(sys.modules))
    """
    result = run(code, tmp_path)
    assert result.returncode == 0, result.stderr
    loaded = result.stdout.split()
    assert "thermoxels_ns.nerfstudio_bridge" in loaded
    assert not [name for name in loaded if name.startswith((*HEAVY, "thermoxels_ns.commands.export"))]


def stand_in_exporter() -> ModuleType:
    """A module that does what nerfstudio's exporter does, without what it loads."""
    exporter = ModuleType("nerfstudio.scripts.exporter")
    code = """
import tyro
from dataclasses import dataclass
from typing import Annotated, Union

@dataclass
class One:
    deep: bool = False

@dataclass
class Two:
    size: int = 1

Commands = tyro.conf.FlagConversionOff[
    Union[Annotated[One, tyro.conf.subcommand(name="one")], Annotated[Two, tyro.conf.subcommand(name="two")]]
]

def entrypoint(args):
    return tyro.cli(Commands, args=args)
"""
    exec(compile(code, "exporter.py", "exec", dont_inherit=True), vars(exporter))
    return exporter


def test_hook_keeps_members_and_markers(monkeypatch) -> None:
    exporter = stand_in_exporter()
    monkeypatch.setitem(sys.modules, "nerfstudio.scripts.exporter", exporter)
    nerfstudio_bridge.extend_commands()
    hooked = exporter.tyro
    nerfstudio_bridge.extend_commands()
    assert exporter.tyro is hooked is not tyro
    assert exporter.entrypoint(["two", "--size", "5"]) == exporter.Two(5)
    # FlagConversionOff: booleans take a value, for the stock subcommands and for ours.
    assert exporter.entrypoint(["one", "--deep", "True"]) == exporter.One(True)
    ours = exporter.entrypoint(["thermoxels-mesh", "--load-config", "c", "--output-dir", "o", "--pictures", "False"])
    assert ours == ExportThermoxelsMesh(load_config=Path("c"), output_dir=Path("o"), pictures=False)
    # Everything else is tyro's.
    assert hooked.conf is tyro.conf and hooked.MISSING is tyro.MISSING and hooked.extras is tyro.extras
    assert hooked.cli(exporter.Two, args=[]) == exporter.Two()
    with pytest.raises(AttributeError):
        hooked.no_such_name  # noqa: B018


@pytest.mark.parametrize(
    "number",
    [np.float64(1e-3), np.float32(0.5), np.int64(7), np.int32(-7), np.bool_(True)],
    ids=lambda number: type(number).__name__,
)
def test_numpy_scalars_load_with_weights_only(tmp_path, number) -> None:
    path = tmp_path / "step-000000001.ckpt"
    torch.save({"schedulers": {"_last_lr": [number]}, "step": 1, "weights": torch.ones(2)}, path)
    nerfstudio_bridge.allow_checkpoint_globals()
    loaded = torch.load(path, weights_only=True)["schedulers"]["_last_lr"][0]
    assert loaded == number and type(loaded) is type(number)


def stand_in_evaluation() -> ModuleType:
    """A module with the options of ``ns-eval``."""
    script = ModuleType("nerfstudio.scripts.eval")
    code = """
import tyro
from dataclasses import dataclass
from pathlib import Path
from typing import Optional

@dataclass
class ComputePSNR:
    output_path: Path = Path("output.json")
    render_output_path: Optional[Path] = None

    def main(self):
        pass
"""
    exec(compile(code, "eval.py", "exec", dont_inherit=True), vars(script))
    return script


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--output-path", "file/e.json"], "a folder that can be written to at file"),
        (["--output-path", "folder.json"], "no folder in the place of a file"),
        (["--output-path", "results"], r"a name that ends in .json, got 'results'"),
        (["--render-output-path", "file"], "a folder that can be written to at file"),
    ],
)
def test_an_evaluation_finds_out_first_that_it_cannot_write(tmp_path, monkeypatch, options, message):
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    Path("folder.json").mkdir()
    script = stand_in_evaluation()
    monkeypatch.setitem(sys.modules, script.__name__, script)
    nerfstudio_bridge.extend_commands()
    assert script.tyro.cli(script.ComputePSNR, args=["--output-path", "new/e.json"]).output_path.name == "e.json"
    with pytest.raises(OutputError, match=message):
        script.tyro.cli(script.ComputePSNR, args=options)


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
    for config in all_methods.values():
        assert yaml.load(yaml.dump(config), Loader=yaml.Loader) == config


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


def test_other_objects_are_still_refused(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    torch.save({"lr": Harmful()}, "bad.ckpt")
    nerfstudio_bridge.allow_checkpoint_globals()
    with pytest.raises(Exception, match=r"[Ww]eights.only"):
        torch.load("bad.ckpt", weights_only=True)
    assert not Path("harmful").exists()
