"""Names that files give of other files: none leads out of the folder that the user handed over."""

from __future__ import annotations

from pathlib import Path, PureWindowsPath

from thermoxels_ns.core.errors import SceneError

_SHOWN = 200
"""Letters of a name that a message repeats."""


def path_inside(folder: Path, name: str, where: str) -> Path:
    """Turn a file name found in a json or in metadata into a path inside a folder.

    Args:
        folder: The folder that it must lie in.
        name: The name as it was found, relative to `folder`, with forward or backward slashes.
        where: What names it, for the message, such as ``transforms.json: frame 3``.

    Returns:
        The path, resolved; it need not exist.

    Raises:
        SceneError: The name is empty or absolute, climbs out, has a drive, or a link on its way leads out.
    """
    windows = PureWindowsPath(name)
    root = folder.resolve()
    got = None
    if not name.strip() or "\0" in name:
        got = repr(name)
    elif Path(name).is_absolute() or windows.drive or windows.root:
        got = f"the absolute path {name!r}"
    elif ".." in windows.parts:
        got = f"{name!r}, which climbs out"
    else:
        try:
            path = (root / Path(*windows.parts)).resolve()
            path.exists()
        except (OSError, RuntimeError) as problem:  # a link to itself, or a name longer than names can be
            got = f"{name[:_SHOWN]!r} ({problem.strerror if isinstance(problem, OSError) else 'a link to itself'})"
        else:
            if path.is_relative_to(root):
                return path
            got = f"{name!r}, a link to {path}"
    raise SceneError(
        where,
        expected=f"a file inside {folder}",
        got=got,
        remedy="Copy the file into the folder and name it relative to it.",
    )
