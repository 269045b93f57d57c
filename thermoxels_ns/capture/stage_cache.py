"""Keeps the results of the stages that take minutes, and runs again only what has changed."""

from __future__ import annotations

import hashlib
import io
import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import astuple
from pathlib import Path
from typing import Any

import numpy as np

from thermoxels_ns.capture.rig_types import RigEstimate
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.core.checks import remove_file, replace_when_done, writable_folder
from thermoxels_ns.core.errors import OutputError, ThermoxelsError
from thermoxels_ns.core.version import __version__
from thermoxels_ns.radiometry.decoders import errors_name

CACHE_FOLDER = ".capture"
_FORMAT = 6  # number of the results' file format; a higher number makes all earlier results invalid
_KEY_FILE, _DONE_FILE = "key.txt", "done"


def run_stage(
    folder: Path,
    depends_on: Mapping[str, Any],
    work: Callable[[Path], None],
    again: bool = False,
    say: Callable[[str], None] = lambda _: None,
) -> str:
    """Run a stage in a folder of its own, unless its earlier result is still valid; return the key of the result.

    The key is a hash of the folder's name and of `depends_on`. The caller must put everything that the result depends
    on into `depends_on`, as values for json. A finished stage with an unchanged key is not run, unless `again` is True.
    `work` gets `folder` and writes the result there; files of an interrupted run with the same key are still in it.
    Raises `OutputError` if the result cannot be written.
    """
    content = json.dumps([__version__, _FORMAT, folder.name, depends_on], sort_keys=True, default=str)
    key = hashlib.sha256(content.encode()).hexdigest()
    kept = folder / _KEY_FILE
    stale = again or not kept.is_file() or kept.read_text(encoding="utf-8") != key
    if not stale and (folder / _DONE_FILE).is_file():
        say(f"{folder.name}: as before")
        return key
    remove_file(folder / _DONE_FILE)
    if stale:
        # The key is removed first, so that a process killed in between leaves no folder that seems valid.
        remove_file(kept)
        if folder.is_dir():
            shutil.rmtree(folder)
    writable_folder(folder)
    with replace_when_done(kept) as temporary:
        temporary.write_text(key, encoding="utf-8")
    work(folder)
    (folder / _DONE_FILE).touch()
    return key


def fingerprint(paths: Sequence[Path], root: Path) -> list[tuple[str, int, int]]:
    """Return the name (relative to `root`), size [bytes] and time of the last change [ns] of each file."""
    found = ((path.relative_to(root).as_posix(), path.stat()) for path in paths)
    return [(name, status.st_size, status.st_mtime_ns) for name, status in found]


def prepare_output(folder: Path) -> Path:
    """Make the output folder and return its path; raise `OutputError` if it has files but no earlier capture."""
    folder = writable_folder(folder)
    if not (folder / CACHE_FOLDER).is_dir() and any(folder.iterdir()):
        remedy, got = "Pass another folder with --output.", f"{folder}, which holds other files"
        raise OutputError("output", expected="an empty folder or one of an earlier capture", got=got, remedy=remedy)
    writable_folder(folder / CACHE_FOLDER)
    return folder


def save_rig(path: Path, rig: RigEstimate) -> None:
    """Write a rig as .npz, atomically."""
    packed = io.BytesIO()  # on a full disk, numpy's archive object would raise a second error when it is deleted
    np.savez_compressed(packed, **{**vars(rig), "thermal_camera": np.array(astuple(rig.thermal_camera))})
    with replace_when_done(path) as temporary:
        temporary.write_bytes(packed.getvalue())  # no view: one in an error's traceback crashed Python 3.12


def load_rig(path: Path) -> RigEstimate:
    """Return a rig that `save_rig` wrote; raise `ThermoxelsError` if the file is missing or damaged."""
    with errors_name(path, "what an earlier capture wrote", "Run it with --from-stage rig.", ThermoxelsError):
        with np.load(path, allow_pickle=False) as opened:
            values = {name: opened[name].tolist() if opened[name].ndim < 2 else opened[name] for name in opened.files}
        width, height, *numbers = values["thermal_camera"]
        return RigEstimate(**{**values, "thermal_camera": Camera(int(width), int(height), *numbers)})
