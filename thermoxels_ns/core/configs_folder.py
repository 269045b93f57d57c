"""Where the yaml files of the package lie."""

from __future__ import annotations

from pathlib import Path

from thermoxels_ns.core.errors import ThermoxelsError

_PACKAGE = Path(__file__).resolve().parents[1]


def configs_folder() -> Path:
    """Find the folder of the yaml files: inside an installed package, or beside it in a source tree.

    Raises:
        ThermoxelsError: There is neither.
    """
    for folder in (_PACKAGE / "configs", _PACKAGE.parent / "configs"):
        if folder.is_dir():
            return folder
    raise ThermoxelsError(
        "configuration files",
        expected=f"a folder configs in or beside {_PACKAGE}",
        got="none",
        remedy="Install the package again.",
    )
