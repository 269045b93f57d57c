"""Fixtures that the hard cases share with the tests of each room."""

from __future__ import annotations

import runpy
from pathlib import Path

scene_folder = runpy.run_path(str(Path(__file__).parents[1] / "data" / "conftest.py"))["scene_folder"]
