"""Fixtures for all tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real photographs beside the project; skips the test where it is absent."""
    folder = Path(os.environ.get("THERMOXELS_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"real data not found at {folder}; set THERMOXELS_DATA to the folder that holds arco/")
    return folder
