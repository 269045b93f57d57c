"""A tiny scene, trained once for all integration tests by the real commands."""

from collections.abc import Callable
from pathlib import Path
from subprocess import CompletedProcess

import pytest

from tests.integration.commands import SHORT_TRAINING, Trained, run, run_forked
from tests.support.short_training import write_boxed_scene
from thermoxels_ns.synthetic.scene_folder import make_scene


@pytest.fixture(scope="session")
def tiny_scene(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("scene") / "hot"
    return write_boxed_scene(make_scene("hot-object"), folder, 10, 2, width=64, height=48)


@pytest.fixture(scope="session")
def trained(tiny_scene, tmp_path_factory) -> Trained:
    return train("thermoxels", tiny_scene, tmp_path_factory.mktemp("outputs"), run)


@pytest.fixture(scope="session")
def thermal_trained(tiny_scene, tmp_path_factory) -> Trained:
    """The baseline without colour."""
    return train("plenoxels-t", tiny_scene, tmp_path_factory.mktemp("thermal"), run_forked)


def train(method: str, scene: Path, outputs: Path, how: Callable[..., CompletedProcess[str]]) -> Trained:
    result = how(
        *("ns-train", method, "--output-dir", str(outputs), "--experiment-name", "tiny", "--timestamp", "run"),
        *SHORT_TRAINING,
        *("thermal-data", "--data", str(scene)),
    )
    assert result.returncode == 0, result.stdout
    return Trained(scene, outputs / "tiny" / method / "run", result.stdout)
