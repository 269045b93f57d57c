import json
import subprocess
import sys
import warnings

import pytest
import torch

from thermoxels_ns import cli
from thermoxels_ns.commands.installed_commands import CommandFailed
from thermoxels_ns.core.errors import HeatMemoryError, MemoryBudgetError, SceneError, exit_status
from thermoxels_ns.core.quiet_warnings import PROGRAMMERS_WARNINGS
from thermoxels_ns.synthetic.scene_folder import load_truth

SMALL = ["--num-train", "3", "--num-eval", "1", "--width", "16", "--height", "12"]


def test_help_loads_nothing_heavy():
    script = (
        "import sys\n"
        "from thermoxels_ns import cli\n"
        "try:\n    cli.main(['--help'])\nexcept SystemExit as stop:\n    assert stop.code == 0\n"
        "heavy = {'torch', 'nerfstudio', 'pyvista', 'matplotlib', 'scipy', 'skfem', 'cv2', 'PIL'} & set(sys.modules)\n"
        "print('loaded:', *sorted(heavy))\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert "synthetic" in done.stdout
    assert done.stdout.splitlines()[-1] == "loaded:"


def test_synthetic_writes_the_scene_that_was_asked_for(tmp_path, capsys):
    folder = tmp_path / "scene [1]"
    options = ["--noise-k", "0.5", "--drift-k", "1", "--seed", "3"]
    assert cli.main(["synthetic", "sphere", "--output-dir", str(folder), *SMALL, *options]) == 0
    content = json.loads((folder / "transforms.json").read_text())
    assert (content["w"], content["h"], len(content["frames"])) == (16, 12, 4)
    written = json.loads((folder / "truth.json").read_text())
    assert (written["seed"], written["imperfections"]["noise_k"], len(written["drift_k"])) == (3, 0.5, 4)
    assert "thermal_camera" not in content
    truth = load_truth(folder)
    assert truth is not None and truth.name == "sphere"
    assert f"Train with: ns-train thermoxels --data '{folder}'" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("problem", "status", "said"),
    [
        (KeyboardInterrupt(), 130, "Interrupted.\n"),
        (MemoryError("Unable to allocate 8 TiB"), 3, "Error: memory does not suffice: Unable to allocate 8 TiB\n"),
    ],
)
def test_an_interrupt_and_a_lack_of_memory_are_one_sentence(monkeypatch, capsys, problem, status, said):
    def main(self) -> None:
        raise problem

    monkeypatch.setattr(cli.Demo, "main", main)
    assert cli.main(["demo"]) == status
    assert capsys.readouterr().err == said


@pytest.mark.parametrize(("asked", "seen"), [([], ["another"]), (["default"], ["`torch.jit.script` is deprecated: x"])])
def test_warnings_for_programmers_are_not_shown_unless_warnings_are_asked_for(monkeypatch, asked, seen):
    def warn() -> int:
        for begin, kind in PROGRAMMERS_WARNINGS:
            warnings.warn(f"{begin}: x", kind, stacklevel=1)
        warnings.warn("another", FutureWarning, stacklevel=1)
        return 0

    monkeypatch.setattr(cli, "main", warn)
    monkeypatch.setattr(sys, "warnoptions", asked)
    with warnings.catch_warnings(record=True) as caught, pytest.raises(SystemExit):
        warnings.simplefilter("always")
        cli.entrypoint()
    assert [str(one.message) for one in caught][: len(seen)] == seen


def test_the_entry_point_hands_the_status_to_the_shell(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("")
    done = subprocess.run(
        [sys.executable, "-m", "thermoxels_ns.cli", "synthetic", "sphere", "--output-dir", str(blocked)],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2
    assert done.stderr.startswith("Error: output folder: expected a folder that can be written to")
    assert "Traceback" not in done.stderr


def test_a_reader_that_has_seen_enough_ends_the_help_without_a_traceback():
    command = [sys.executable, "-m", "thermoxels_ns.cli", "synthetic", "--help"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()  # before anything is written
        assert process.stderr.read() == b""


@pytest.mark.parametrize(
    ("problem", "status"),
    [
        (SceneError("scene", expected="x", got="y", remedy="z"), 2),
        (MemoryBudgetError("memory", expected="x", got="y", remedy="z"), 3),
        (HeatMemoryError("memory", expected="x", got="y", remedy="z"), 3),
        (MemoryError(), 3),
        (torch.OutOfMemoryError("CUDA out of memory"), 3),
        (CommandFailed("ns-train", 1, ["crash"]), 1),
        (CommandFailed("ns-train", -9, ["step 3"]), 3),
        (CommandFailed("ns-train", 2, ["Error: scene"]), 2),
        (ValueError("x"), 1),
    ],
)
def test_what_ended_a_command_is_its_exit_status(problem, status):
    assert exit_status(problem) == status
