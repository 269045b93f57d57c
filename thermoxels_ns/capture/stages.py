"""Stages of a capture: each keeps its result, runs again only when something it depends on has changed."""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

from thermoxels_ns import __version__
from thermoxels_ns.checks import replace_when_done, writable_folder
from thermoxels_ns.errors import OutputError, ThermoxelsError, explain

StageName = Literal["pairs", "temperatures", "poses", "scale", "board", "rig", "drift", "scene", "page"]
"""The stages in order."""
STAGES: tuple[StageName, ...] = get_args(StageName)
CACHE_FOLDER = ".capture"
_KEY_FILE, _DONE_FILE = "key.txt", "done.json"


@dataclass
class StageCache:
    """Runs stages in order and keeps what they found in ``.capture/`` of the output folder.

    A stage's key is a hash of its name, its options, the files it reads and the key of the stage before it. A stage
    whose key is the same as last time is not run again. One that was interrupted finds its folder as it left it.
    """

    folder: Path
    """The capture's output folder."""
    from_stage: StageName | None = None
    """Run this stage and all later ones, also where nothing has changed."""
    say: Callable[[str], None] = lambda _: None
    """Told one line per stage."""
    seconds: list[tuple[str, float]] = field(default_factory=list)
    """Stages in order and the time each took, also where it was taken from the cache, [s]."""
    _previous: str = ""

    def run(
        self,
        name: StageName,
        depends_on: Mapping[str, Any],
        work: Callable[[Path], None],
        writes: Sequence[Path] = (),
    ) -> Path:
        """Run a stage, or take its earlier result.

        Args:
            name: Which stage; each once, in order.
            depends_on: Everything but the earlier stages that its result depends on; json must be able to hold it.
            work: Writes the result into the folder that it is given; that may hold what an interrupted run with the
                same key left.
            writes: Files that the stage writes elsewhere; where one is gone, the stage runs again.

        Returns:
            The folder with the result.
        """
        content = json.dumps([__version__, name, self._previous, depends_on], sort_keys=True, default=str)
        key = hashlib.sha256(content.encode()).hexdigest()
        self._previous = key
        folder = self.folder / CACHE_FOLDER / name
        forced = self.from_stage is not None and STAGES.index(name) >= STAGES.index(self.from_stage)
        title = f"{STAGES.index(name) + 1}/{len(STAGES)} {name}"
        stale = forced or _read_key(folder) != key
        done = None if stale or not all(path.exists() for path in writes) else _read_done(folder)
        if done is not None:
            self.say(f"{title}: as before")
            self.seconds.append((name, done))
            return folder
        if stale:
            shutil.rmtree(folder, ignore_errors=True)
        writable_folder(folder)
        (folder / _DONE_FILE).unlink(missing_ok=True)
        (folder / _KEY_FILE).write_text(key, encoding="utf-8")
        self.say(title)
        start = time.monotonic()
        work(folder)
        took = time.monotonic() - start
        with replace_when_done(folder / _DONE_FILE) as temporary:
            temporary.write_text(json.dumps({"seconds": took}), encoding="utf-8")
        self.seconds.append((name, took))
        return folder


def fingerprint(paths: Sequence[Path], root: Path) -> list[tuple[str, int, int]]:
    """Name, size and time of change of files: enough to notice that one was replaced."""
    rows = []
    for path in sorted(set(paths)):
        status = path.stat()
        name = path.relative_to(root).as_posix() if path.is_relative_to(root) else str(path)
        rows.append((name, status.st_size, status.st_mtime_ns))
    return rows


def prepare_output(folder: Path) -> Path:
    """Make the output folder, or take that of an earlier capture.

    Raises:
        OutputError: It holds something that no capture wrote, or cannot be written to.
    """
    folder = writable_folder(folder)
    if not (folder / CACHE_FOLDER).is_dir() and any(folder.iterdir()):
        raise OutputError(
            explain(
                "output",
                expected="an empty folder or one of an earlier capture",
                got=f"{folder}, which holds other files",
                remedy="Pass another folder with --output.",
            )
        )
    writable_folder(folder / CACHE_FOLDER)
    return folder


def write_json(path: Path, content: Any) -> None:
    """Write json, whole or not at all; numbers must be finite."""
    with replace_when_done(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1, allow_nan=False), encoding="utf-8")


def read_json(path: Path) -> Any:
    """Read json that a stage wrote.

    Raises:
        ThermoxelsError: The file is missing or damaged.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as problem:
        raise ThermoxelsError(
            explain(
                str(path),
                expected="what an earlier stage of the capture wrote",
                got=str(problem),
                remedy="Run it again with --from-stage pairs.",
            )
        ) from problem


def _read_key(folder: Path) -> str | None:
    try:
        return (folder / _KEY_FILE).read_text(encoding="utf-8")
    except OSError:
        return None


def _read_done(folder: Path) -> float | None:
    try:
        return float(json.loads((folder / _DONE_FILE).read_text(encoding="utf-8"))["seconds"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
