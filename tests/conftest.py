"""Fixtures for all tests."""

from __future__ import annotations

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
