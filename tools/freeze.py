"""Write down what a version does, and say what another one does differently: for changes that should change nothing.

    python tools/freeze.py record before.json --work /tmp/before
    python tools/freeze.py compare before.json after.json

`record` runs the console commands of this Python's environment as a user would, on a small synthetic scene (about
ten minutes): every `--help`, a short training, its evaluation, three exports and four heat runs. It keeps the texts of
help, keys and values of the json files, digests of checkpoints and meshes, and seconds and peak memory of each command.
PYTHONPATH chooses another checkout. Kernels compile in a first run: its seconds do not count. `--keep` takes the
checkpoint that the folder of `--work` has already, if this version can read it.

It imports nothing of the package, so that it runs on every version.
"""

from __future__ import annotations

import argparse
import difflib
import hashlib
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

_METHODS = ("thermoxels", "thermoxels-arco", "thermoxels-paper", "plenoxels-t")
_VOLATILE = re.compile(r"(?<!step_)seconds|_gb$|_mb$|memory|peak|per_sec|fps")
"""Keys of figures that differ from run to run: kept, their values not compared."""
_COLUMNS = "120"
"""Width of help texts: one column of options."""
_OPTION = re.compile(r"^│ (?:-h, )?(--[\w.-]+)(.*?)│?$")
_MOST_LINES = 100
_CHANGED = 1e-9
"""Relative change from which a figure counts as changed."""


class Recorder:
    """Runs commands and keeps what they cost and say.

    Args:
        work: Folder of everything that is written.
    """

    def __init__(self, work: Path):
        self.work, self.cost = work, {}
        self.logs = work / "logs"
        self.logs.mkdir(parents=True, exist_ok=True)
        self.environment = {"OMP_NUM_THREADS": "1", **os.environ, "COLUMNS": _COLUMNS, "PYTHONWARNINGS": "ignore"}

    def run(self, name: str, *words: str | Path, must: bool = True) -> str:
        """Run a command beside this Python and return what it prints.

        Args:
            name: Name under which its cost is kept and its log written.
            words: The command.
            must: Whether a failure ends the recording.
        """
        program = str(Path(sys.executable).parent / str(words[0]))
        log = self.logs / f"{name}.txt"
        print(f"{name}: {' '.join(map(str, words))}", flush=True)
        began = time.perf_counter()
        with log.open("w", encoding="utf-8") as out:
            process = subprocess.Popen(
                [program, *map(str, words[1:])], env=self.environment, stdout=out, stderr=subprocess.STDOUT
            )
            _, status, usage = os.wait4(process.pid, 0)
        process.returncode = code = os.waitstatus_to_exitcode(status)
        self.cost[name] = {
            "exit": code,
            "wall_seconds": round(time.perf_counter() - began, 2),
            "processor_seconds": round(usage.ru_utime + usage.ru_stime, 2),
            "peak_mb": round(usage.ru_maxrss / 1024),
        }
        text = log.read_text(encoding="utf-8", errors="replace")
        if must and code:
            raise SystemExit(f"{name} ended with status {code}:\n{text[-3000:]}")
        return text

    def help_of(self, *words: str) -> dict[str, Any]:
        """Options and text of a command's help."""
        name = "help " + " ".join(words)
        text = self.run(name.replace("/", "_"), *words, "--help", must=False)
        lines = [line.replace(str(Path(sys.executable).parent) + os.sep, "").rstrip() for line in text.splitlines()]
        begin = next((i for i, line in enumerate(lines) if line.startswith("usage:")), 0)
        options = {found[1]: found[2].strip().split("  ")[0] for line in lines if (found := _OPTION.match(line))}
        return {"options": options, "text": lines[begin:]}

    def helps(self) -> dict[str, Any]:
        """Help of every command, those of `thermoxels` as its own help lists them."""
        top = self.help_of("thermoxels")
        listed = re.search(r"\{([\w,-]+)\}", top["text"][0])
        commands = [("thermoxels", name) for name in (listed[1].split(",") if listed else ())]
        commands += [("ns-train", method, "--help-all") for method in _METHODS]
        commands += [("ns-train", "thermoxels", "thermal-data"), ("ns-export", "thermoxels-mesh")]
        return {"thermoxels": top, **{" ".join(words): self.help_of(*words) for words in commands}}

    def results(self, keep: bool) -> dict[str, Any]:
        """Run the small scene through all commands and read what they wrote."""
        work = self.work
        run = work / "outputs" / "freeze" / "thermoxels" / "run"
        if not (keep and list(run.glob("nerfstudio_models/*.ckpt"))):
            self.run("synthetic", "thermoxels", "synthetic", "house-corner", "--output-dir", work / "scene")
            self.run(
                "train",
                *("ns-train", "thermoxels", "--output-dir", work / "outputs", "--experiment-name", "freeze"),
                *("--timestamp", "run", "--vis", "tensorboard"),
                *("--quality", "draft", "thermal-data", "--data", work / "scene"),
            )
        config = run / "config.yml"
        self.run("evaluate", "ns-eval", "--load-config", config, "--output-path", work / "eval.json")
        every = ("vtu", "xdmf", "msh", "inp", "glb")
        for name, options in {
            "conforming": ("--formats", *every),
            "voxel": ("--boundary", "voxel", "--formats", *every),
            "walls": ("--wall-thickness", "0.4"),
        }.items():
            self.run(
                f"export-{name}",
                *("ns-export", "thermoxels-mesh", "--load-config", config, "--output-dir", work / f"export-{name}"),
                *("--metres-per-unit", "1", *options),
            )
        for name, mesh, options in (
            ("original", "conforming", ("--scene", "original")),
            ("winter-night", "walls", ("--scene", "winter-night")),
            ("winter-night-voxel", "voxel", ("--scene", "winter-night")),
            ("all-effects", "walls", ("--scene", "all-effects")),
            ("flow-tolerance", "walls", ("--scene", "winter-night", "--flow-tolerance", "0.05")),
        ):
            vtu = work / f"export-{mesh}" / "mesh.vtu"
            self.run(f"heat-{name}", "thermoxels", "heat", vtu, *options, "--output-dir", work / f"heat-{name}")
        return self.read()

    def read(self) -> dict[str, Any]:
        """What the files say: names, json, checkpoints, meshes."""
        work = self.work
        folders = sorted(p for p in work.iterdir() if p.is_dir() and p.name.startswith(("export-", "heat-")))
        found = {p.relative_to(work).as_posix(): p for folder in folders for p in sorted(folder.rglob("*"))}
        files = {name: path for name, path in found.items() if path.is_file()}
        json_files = {name: path for name, path in files.items() if path.suffix == ".json"}
        json_files |= {name: work / name for name in ("eval.json", "scene/transforms.json")}
        checkpoints = sorted((work / "outputs").rglob("*.ckpt"), key=lambda path: path.stat().st_mtime)
        return {
            "files": sorted(files),
            "json": {name: self.without_place(json.loads(path.read_text())) for name, path in json_files.items()},
            "checkpoint": checkpoint_digests(checkpoints[-1]),
            "mesh": {name: mesh_digests(path) for name, path in files.items() if path.suffix in (".vtu", ".vtp")},
            "bytes": {
                name: digest(path.read_bytes())
                for name, path in files.items()
                if path.suffix in (".msh", ".inp", ".glb", ".csv", ".h5", ".xdmf")
            },
            "columns": {n: path.read_text().splitlines()[0] for n, path in files.items() if path.suffix == ".csv"},
        }

    def without_place(self, value: Any) -> Any:
        """A json value whose texts name neither the working folder nor seconds."""
        if isinstance(value, dict):
            return {key: self.without_place(one) for key, one in value.items()}
        if isinstance(value, str):
            return re.sub(r"\d[\d.]* s\b", "N s", value.replace(str(self.work), "WORK"))
        return [self.without_place(one) for one in value] if isinstance(value, list) else value


def digest(content: bytes) -> str:
    """Short sha256."""
    return hashlib.sha256(content).hexdigest()[:16]


def checkpoint_digests(path: Path) -> dict[str, str]:
    """Digest of every tensor of a checkpoint, and its numbers, by place."""
    import numpy as np
    import torch

    scalar = np.float64(0).__reduce__()[0]
    kinds = [type(np.dtype(name)) for name in ("float32", "float64", "int32", "int64", "bool")]
    torch.serialization.add_safe_globals([scalar, np.dtype, *kinds])
    found = {}
    for place, value in flat(torch.load(path, map_location="cpu", weights_only=True)):
        if isinstance(value, torch.Tensor):
            array = np.ascontiguousarray(value.detach().numpy())
            found[place] = f"{array.dtype}{list(array.shape)} {digest(array.tobytes())}"
        else:
            found[place] = repr(value)
    return found


def mesh_digests(path: Path) -> dict[str, Any]:
    """Counts and digests of the points, cells and arrays of a vtk file."""
    import numpy as np
    import pyvista

    mesh: Any = pyvista.read(path)
    cells = mesh.cells if path.suffix == ".vtu" else mesh.faces
    arrays = {"points": mesh.points, "cells": cells}
    arrays |= {f"point {name}": mesh.point_data[name] for name in mesh.point_data}
    arrays |= {f"cell {name}": mesh.cell_data[name] for name in mesh.cell_data}
    digests = {name: f"{a.dtype} {digest(np.ascontiguousarray(a).tobytes())}" for name, a in arrays.items()}
    return {"num_points": mesh.n_points, "num_cells": mesh.n_cells, "arrays": digests}


def flat(value: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    """Leaves of nested dicts and lists with their places, such as ``heat/steps/0``."""
    children = (
        value.items() if isinstance(value, dict) else enumerate(value if isinstance(value, (list, tuple)) else ())
    )
    if not isinstance(value, (dict, list, tuple)) or not value:
        yield place, value
    for key, child in children:
        yield from flat(child, f"{place}/{key}" if place else str(key))


def compare(a: dict[str, Any], b: dict[str, Any]) -> Iterator[str]:
    """Lines that say what differs."""
    yield from _compare_helps(a["help"], b["help"])
    for kind in ("files", "columns", "json", "mesh", "bytes", "checkpoint"):
        old, new = a["results"][kind], b["results"][kind]
        old, new = ({name: "" for name in one} if kind == "files" else dict(flat(one)) for one in (old, new))
        lines = list(_compare_leaves(old, new))
        same = len(old.keys() & new.keys()) - sum(" changed" in line for line in lines)
        yield f"== {kind}: {same} of {len(old)} the same"
        yield from lines[:_MOST_LINES]
        if len(lines) > _MOST_LINES:
            yield f"... and {len(lines) - _MOST_LINES} more"
    yield "== cost (ratios mean something only if both ran on an idle machine, with kernels compiled)"
    for name in (name for name in a["cost"] if name in b["cost"]):
        old, new = a["cost"][name], b["cost"][name]
        if name.startswith("help") and old["exit"] == new["exit"]:
            continue
        ratios = (f"{key} {old[key]} -> {new[key]} (x {new[key] / max(old[key], 0.01):.2f})" for key in list(old)[1:])
        yield f"{name}: {'; '.join(ratios)}" + (f"; exit {old['exit']} -> {new['exit']}" * (old["exit"] != new["exit"]))


def _compare_helps(a: dict[str, Any], b: dict[str, Any]) -> Iterator[str]:
    yield "== help"
    for name in sorted(a.keys() | b.keys()):
        if name not in a or name not in b:
            yield f"command {'added' if name in b else 'removed'}: {name}"
            continue
        old, new = a[name]["options"], b[name]["options"]
        yield from (f"{name}: option removed: {one} {old[one]}" for one in old if one not in new)
        yield from (f"{name}: option added: {one} {new[one]}" for one in new if one not in old)
        for line in difflib.unified_diff(a[name]["text"], b[name]["text"], n=0, lineterm=""):
            if line[0] in "+-" and line[:3] not in ("+++", "---"):
                yield f"{name}: {line}"


def _compare_leaves(old: dict[str, Any], new: dict[str, Any]) -> Iterator[str]:
    gone, come = (sorted(one.keys() - other.keys()) for one, other in ((old, new), (new, old)))
    for name in gone:
        twins = [other for other in come if isinstance(old[name], str) and old[name] and new[other] == old[name]]
        yield f"removed: {name} = {_short(old[name])}" + (f" (there is the same as {twins[0]})" if twins else "")
    yield from (f"added: {name} = {_short(new[name])}" for name in come)
    for name in sorted(old.keys() & new.keys()):
        one, other = old[name], new[name]
        if one == other or _VOLATILE.search(name.partition(".json/")[2]) or (one != one and other != other):
            continue
        if all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in (one, other)):
            change = (other - one) / abs(one) if one else float("inf")
            if not abs(change) < _CHANGED:
                yield f"{name} changed: {one:.10g} -> {other:.10g} ({change:+.2g})"
        else:
            yield f"{name} changed: {_short(one)} -> {_short(other)}"


def _short(value: Any) -> str:
    text = str(value)
    return text if len(text) < 160 else text[:150] + "..."


def main() -> None:
    """Record or compare."""
    parser = argparse.ArgumentParser(description="See the top of this file.")
    commands = parser.add_subparsers(dest="command", required=True)
    record = commands.add_parser("record", help="run the commands and write what they do")
    record.add_argument("out", type=Path)
    record.add_argument("--work", type=Path, help="folder for all results; default: one that is deleted")
    record.add_argument("--keep", action="store_true", help="take the checkpoint that the folder has, if it has one")
    against = commands.add_parser("compare", help="print what differs")
    against.add_argument("before", type=Path)
    against.add_argument("after", type=Path)
    options = parser.parse_args()
    if options.command == "compare":
        print("\n".join(compare(*(json.loads(path.read_text()) for path in (options.before, options.after)))))
        return
    with tempfile.TemporaryDirectory() as temporary:
        recorder = Recorder((options.work or Path(temporary)).resolve())
        place = recorder.run("place", "python", "-c", "import thermoxels_ns as t; print(t.__file__)").split()[-1]
        print(f"package: {place}", flush=True)
        content = {"package": place, "help": recorder.helps(), "results": recorder.results(options.keep)}
        content["cost"] = recorder.cost
    options.out.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
