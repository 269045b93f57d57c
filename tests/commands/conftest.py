import stat
import sys
from collections.abc import Callable

import pytest


@pytest.fixture
def fake_command(tmp_path, monkeypatch) -> Callable[[str, str], None]:
    """Gives a function that writes a command, by its name, beside a Python of its own."""
    folder = tmp_path / "bin"
    folder.mkdir()
    python = sys.executable
    monkeypatch.setattr("thermoxels_ns.commands.installed_commands.sys.executable", str(folder / "python"))

    def write(name: str, body: str) -> None:
        path = folder / name
        path.write_text(f"#!{python}\nimport json, os, pathlib, sys, time\n{body}\n")
        path.chmod(path.stat().st_mode | stat.S_IXUSR)

    return write
