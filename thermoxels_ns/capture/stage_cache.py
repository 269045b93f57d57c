"""Keeps the results of stages and runs again only what has changed.

A result is a dataclass, kept as one .npz file of its arrays and a json text of the rest.
"""

from __future__ import annotations

import hashlib
import io
import json
import shutil
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from types import NoneType
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

import numpy as np

from thermoxels_ns import __version__
from thermoxels_ns.capture.settings import StageName
from thermoxels_ns.core.checks import hold_folder, plain_os_errors, remove_file, replace_when_done, writable_folder
from thermoxels_ns.core.errors import OutputError, SceneError, ThermoxelsError
from thermoxels_ns.core.json_values import write_json

STAGES: tuple[StageName, ...] = get_args(StageName)
CACHE_FOLDER = ".capture"
LOCK_FILE = "lock"
_FORMAT = 3  # of the results; raised when they are kept in another way, so that earlier ones are made again
_KEY_FILE, _DONE_FILE, _RESULT_FILE = "key.txt", "done.json", "result.npz"
_REST = "rest"  # name of the json text beside the arrays of a result, whose names are numbers

_Record = TypeVar("_Record")


@dataclass
class StageCache:
    """Runs stages in order and keeps what they found in ``.capture/`` of the output folder.

    A stage's key is a hash of its name, its options, the files it reads and the key of the stage before it. A stage
    whose key is the same as last time is not run again. One that was interrupted finds its folder as it left it.
    """

    folder: Path  # the capture's output folder
    from_stage: StageName | None = None  # run this stage and all later ones, also where nothing has changed
    say: Callable[[str], None] = lambda _: None  # told one line per stage
    source: Path | None = None  # the camera's files; they and `folder` may be moved between two captures
    seconds: list[tuple[str, float]] = field(default_factory=list)
    """Stages in order and the time each took, also where it was taken from the cache, [s]."""
    _previous: str = ""

    def run(
        self, name: StageName, depends_on: Mapping[str, Any], work: Callable[[Path], None], writes: Sequence[Path] = ()
    ) -> Path:
        """Run a stage, or take its earlier result; return the folder with the result.

        Stages come once each, in order. `depends_on` is everything but the earlier stages that the result depends on,
        as json can hold it. `work` writes the result into the folder that it is given; that may hold what an
        interrupted run with the same key left. `writes` are files and folders that the stage writes elsewhere; where
        one of them, or a file in one, is gone or has another size than the stage gave it, the stage runs again.

        Raises:
            OutputError: An earlier result cannot be removed, or the new one cannot be written.
        """
        content = json.dumps([__version__, _FORMAT, name, self._previous, depends_on], sort_keys=True, default=str)
        key = hashlib.sha256(content.encode()).hexdigest()
        self._previous = key
        folder = self.folder / CACHE_FOLDER / name
        forced = self.from_stage is not None and STAGES.index(name) >= STAGES.index(self.from_stage)
        title = _title(name)
        stale = forced or _read(folder / _KEY_FILE) != key
        done = None if stale else _read_done(folder, self.folder, writes)
        if done is not None:
            self.say(f"{title}: as before")
            self.seconds.append((name, done))
            return folder
        remove_file(folder / _DONE_FILE)
        if stale:
            # The key goes before the files: whoever is killed between them leaves nothing that is taken for whole.
            remove_file(folder / _KEY_FILE)
            with plain_os_errors(folder, "an earlier result of the capture, which can be removed"):
                shutil.rmtree(folder, ignore_errors=not folder.exists())
        writable_folder(folder)
        with replace_when_done(folder / _KEY_FILE) as temporary:
            temporary.write_text(key, encoding="utf-8")
        self.say(title)
        start = time.monotonic()
        work(folder)
        took = time.monotonic() - start
        write_json(folder / _DONE_FILE, {"seconds": took, "written": _sizes(self.folder, writes)})
        self.seconds.append((name, took))
        return folder

    def result(
        self, name: StageName, depends_on: Mapping[str, Any], kind: type[_Record], work: Callable[[Path], _Record]
    ) -> _Record:
        """Run a stage as `run` does; its result is the dataclass that `work` returns, now or in an earlier capture."""
        roots = [self.folder] if self.source is None else [self.folder, self.source]
        folder = self.run(name, depends_on, lambda folder: save(folder / _RESULT_FILE, work(folder), roots))
        return load(folder / _RESULT_FILE, kind, roots)

    def leave_out(self, name: StageName, why: str) -> None:
        """Say that a stage has nothing to do, so that the numbers of the others have no gap."""
        self.say(f"{_title(name)}: left out, {why}")


def save(path: Path, record: Any, roots: Sequence[Path] = ()) -> None:
    """Write a dataclass as .npz, whole or not at all.

    Its fields are arrays, numbers, texts, paths, None, and tuples, mappings by text and dataclasses of these. Paths in
    one of the `roots` are kept relative to it, so that both may be moved.
    """
    arrays: dict[str, np.ndarray] = {}
    real_roots = [root.resolve() for root in roots]

    def plain(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            name = str(len(arrays))
            arrays[name] = value
            return name
        if isinstance(value, Path):
            real = value.resolve()
            number = next((n for n, root in enumerate(real_roots) if real.is_relative_to(root)), None)
            return [number, (real if number is None else real.relative_to(real_roots[number])).as_posix()]
        if is_dataclass(value):
            return {each.name: plain(getattr(value, each.name)) for each in fields(value)}
        if isinstance(value, Mapping):
            return {key: plain(entry) for key, entry in value.items()}
        return [plain(entry) for entry in value] if isinstance(value, (tuple, list)) else value

    arrays[_REST] = np.asarray(json.dumps(plain(record)))
    packed = io.BytesIO()  # in memory, because numpy's half-made files complain later
    np.savez(packed, **arrays)  # type: ignore[arg-type]
    with replace_when_done(path) as temporary:
        temporary.write_bytes(packed.getbuffer())


def load(path: Path, kind: type[_Record], roots: Sequence[Path] = ()) -> _Record:
    """Read a dataclass that `save` wrote; a `ThermoxelsError` where the file is missing or damaged."""

    def restored(value: Any, hint: Any) -> Any:
        """What was kept, in the type of its field."""
        origin, parts = get_origin(hint), get_args(hint)
        if value is None:
            return None
        if NoneType in parts:
            return restored(value, next(part for part in parts if part is not NoneType))
        if origin is np.ndarray:
            return arrays[value]
        if hint is Path:
            number, name = value
            return Path(name) if number is None else roots[number] / name
        if is_dataclass(hint):
            return hint(**{name: restored(value[name], own) for name, own in get_type_hints(hint).items()})  # type: ignore[operator]
        if origin is tuple:
            each = parts[:1] * len(value) if parts[-1] is Ellipsis else parts
            return tuple(restored(entry, own) for entry, own in zip(value, each))
        if isinstance(value, dict):
            return {key: restored(entry, parts[1]) for key, entry in value.items()}
        return value

    try:
        with np.load(path, allow_pickle=False) as opened:
            arrays = {name: opened[name] for name in opened.files}
        return restored(json.loads(arrays[_REST].item()), kind)
    except (OSError, EOFError, ValueError, KeyError, TypeError, IndexError, zipfile.BadZipFile) as problem:
        expected, remedy = "what an earlier stage of the capture wrote", "Run it again with --from-stage pairs."
        raise ThermoxelsError(str(path), expected=expected, got=repr(problem), remedy=remedy) from problem


def _title(name: StageName) -> str:
    return f"{STAGES.index(name) + 1}/{len(STAGES)} {name}"


def fingerprint(paths: Sequence[Path], root: Path) -> list[tuple[str, int, int]]:
    """Name, size and time of change of files: enough to notice that one was replaced."""
    rows = []
    for path in sorted(set(paths)):
        status = path.stat()
        name = path.relative_to(root).as_posix() if path.is_relative_to(root) else str(path)
        rows.append((name, status.st_size, status.st_mtime_ns))
    return rows


def given_fingerprints(paths: Sequence[Path | None]) -> list[tuple[str, int, int]]:
    """Fingerprints of files that the user names (None: of none); a `SceneError` where one is not there."""
    there = [path for path in paths if path is not None]
    for path in there:
        if not path.is_file():
            remedy = "Check the path, or leave it out."
            raise SceneError(str(path), expected="a file", got="nothing there", remedy=remedy)
    return fingerprint(there, Path("/")) if there else []


def files_of(path: Path) -> list[Path]:
    """All files of a folder and the folders in it, or the file itself."""
    return sorted(each for each in path.rglob("*") if each.is_file()) if path.is_dir() else [path]


def prepare_output(folder: Path) -> Path:
    """Make the output folder, or take that of an earlier capture; an `OutputError` where it holds other files."""
    folder = writable_folder(folder)
    if not (folder / CACHE_FOLDER).is_dir() and any(folder.iterdir()):
        remedy, got = "Pass another folder with --output.", f"{folder}, which holds other files"
        raise OutputError("output", expected="an empty folder or one of an earlier capture", got=got, remedy=remedy)
    writable_folder(folder / CACHE_FOLDER)
    return folder


@contextmanager
def locked(output: Path, say: Callable[[str], None] = lambda _: None) -> Iterator[None]:
    """Hold the output folder of a capture for the block; an `OutputError` where another capture holds it."""
    remedy = "Wait until it ends, or pass another folder with --output."
    lock = hold_folder(output / CACHE_FOLDER / LOCK_FILE, remedy, say)
    try:
        yield
    finally:
        lock.release()


def _read(file: Path) -> str | None:
    try:
        return file.read_text(encoding="utf-8")
    except OSError:
        return None


def _read_done(folder: Path, output: Path, writes: Sequence[Path]) -> float | None:
    """Seconds that a stage took; None where it did not end, or where what it wrote elsewhere is no longer whole."""
    try:
        done = json.loads((folder / _DONE_FILE).read_text(encoding="utf-8"))
        seconds = float(done["seconds"])
        return seconds if done["written"] == _sizes(output, writes) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _sizes(output: Path, writes: Sequence[Path]) -> dict[str, int]:
    """Bytes of every file that a stage wrote, by its name in the output folder."""
    files = [each for path in writes for each in ([path] if path.is_file() else path.rglob("*")) if each.is_file()]
    return {path.relative_to(output).as_posix(): path.stat().st_size for path in sorted(files)}
