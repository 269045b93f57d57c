import os
from pathlib import Path

# Before torch is loaded: its threads gain nothing on small tests and wait for each other on a busy machine.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest

# Fixtures of all rooms: tiny scene folders, bodies for the heat solver, trained fields made by hand.
pytest_plugins = ("tests.support.scene_folders", "tests.support.heat_bodies", "tests.support.small_fields")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real photographs beside the project; skips the test where it is absent."""
    folder = Path(os.environ.get("THERMOXELS_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"real data not found at {folder}; set THERMOXELS_DATA to the folder that holds arco/")
    return folder


LONGEST_FIRST = ("tests/integration", "tests/capture", "tests/training", "tests/stability", "tests/multiview")
"""Whole commands and trainings: a worker that began one at the end would be waited for."""


def pytest_collection_modifyitems(items) -> None:
    """Run the folders with the longest tests first."""
    items.sort(key=lambda item: not item.nodeid.startswith(LONGEST_FIRST))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Give workers whole files (``--dist loadfile``) in the order above; those that share a training go together."""
    from xdist.scheduler import LoadFileScheduling

    class ByTraining(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = super()._split_scope(nodeid)
            return "trained" if file.startswith("tests/integration/") and "capture" not in file else file

    if config.getvalue("dist") != "loadfile":
        return None
    config.option.loadscopereorder = False
    return ByTraining(config, log)
