"""A tiny scene, trained once for all integration tests by the real commands."""

from pathlib import Path

import pytest

from tests.integration.commands import SHORT_TRAINING, Trained, run
from tests.support.boxed_scene import write_boxed_scene
from thermoxels_ns.synthetic.scene_folder import make_scene


@pytest.fixture(scope="session")
def tiny_scene(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("scene") / "hot"
    return write_boxed_scene(make_scene("hot-object"), folder, 10, 2, width=64, height=48)


@pytest.fixture(scope="session")
def trained(tiny_scene, tmp_path_factory) -> Trained:
    outputs = tmp_path_factory.mktemp("outputs")
    result = run(
        *("ns-train", "thermoxels", "--output-dir", str(outputs), "--experiment-name", "tiny", "--timestamp", "run"),
        *SHORT_TRAINING,
        *("thermal-data", "--data", str(tiny_scene)),
    )
    assert result.returncode == 0, result.stdout
    return Trained(tiny_scene, outputs / "tiny" / "thermoxels" / "run", result.stdout)
