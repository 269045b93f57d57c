"""The command ``thermoxels batch``: many buildings from photographs to audits, their stages run by Snakemake."""

from __future__ import annotations

# Only light imports at the top, so that ``thermoxels --help`` answers at once.
import csv
import json
import math
import os
import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import tyro

from thermoxels_ns.commands.installed_commands import PLAIN_TRAINING, CommandFailed, run_command
from thermoxels_ns.core.checks import hold_folder, remove_file, writable_folder
from thermoxels_ns.core.errors import BAD_DATA, CRASH, LACK_OF_MEMORY, SceneError, ThermoxelsError
from thermoxels_ns.core.json_values import write_json

BATCH, PAGE = "batch.json", "index.html"
_ENDED = 137  # Status of a stage that was ended from outside, as by a scheduler's limit of memory or time
_WHY = {BAD_DATA: "input", LACK_OF_MEMORY: "memory", _ENDED: "from outside"}
_TRIED_AGAIN = LACK_OF_MEMORY, _ENDED


class Needs(NamedTuple):
    """What a stage asks of the scheduler: processors, memory at first [MB], and time [minutes]."""

    threads: int
    memory_mb: int
    minutes: int


STAGES: Mapping[str, Needs] = {
    "scene": Needs(2, 4000, 240),
    "model": Needs(2, 4000, 240),
    "scores": Needs(2, 3000, 60),
    "mesh": Needs(1, 3000, 60),
    "heat": Needs(1, 3000, 120),
    "audit": Needs(1, 3000, 60),
}
"""Stages in order. One that ran out of memory, or was ended from outside, is tried again with twice memory and time."""
AFTER = {"model": "scene", "scores": "model", "mesh": "model", "heat": "mesh", "audit": "mesh"}  # Stage needed before


@dataclass(frozen=True)
class Building:
    """A line of the list: a building, and which files its stages read."""

    name: str
    """Name of the building and of its folder: letters, digits, - and _."""
    photographs: str = ""
    """Folder of a memory card, for `thermoxels capture`; this or `scene`."""
    scene: str = ""
    """Scene folder, for `ns-train`."""
    patches: str = ""
    """File that names patches, for the export."""
    heat: str = ""
    """Heat scene by name or .yaml file; empty: no heat."""
    conditions: str = ""
    """Conditions of the survey; empty: no audit."""
    train: str = ""
    """Further options of ns-train, such as --quality draft."""
    export: str = ""
    """Further options of ns-export, such as --metres-per-unit 1."""


class Stage(NamedTuple):
    """A stage of one building: its command, and the files that must exist before it begins."""

    command: list[str]
    inputs: list[str]


@dataclass
class Batch:
    """Take many buildings from photographs to a mesh, heat and an audit; one that fails does not stop the others.

    The list is a csv file with the columns name, scene or photographs, and, where wanted, patches, heat, conditions,
    train and export (see docs/batch.md). Snakemake runs the stages; if interrupted, the same command continues them.
    """

    list: tyro.conf.Positional[Path]
    """File with one line per building."""
    output_dir: Path = Path("batch")
    """Folder with one folder per building, and index.html over all of them."""
    cores: int = 2
    """Processors that all stages together use on this machine, or jobs at once on a cluster."""
    memory_gb: float | None = None
    """Memory that all stages together may ask for on this machine, [1e9 bytes]; default: no limit."""
    executor: str = ""
    """Where stages run: this machine, or what an installed plugin of Snakemake offers, such as slurm."""
    dry_run: bool = False
    """Print what would be run, with the resources asked for, and stop."""

    def main(self) -> None:
        """Run all stages and write the page; raises `ThermoxelsError` for a wrong list, or a building not finished."""
        from thermoxels_ns.reports.page import build_page, write_page

        say = partial(print, flush=True)
        if self.cores < 1 or not (self.memory_gb is None or 0.0 < self.memory_gb < math.inf):
            got, remedy = f"{self.cores} and {self.memory_gb} GB", "Leave them out for the defaults."
            raise ThermoxelsError("batch", expected="at least one processor and some memory", got=got, remedy=remedy)
        buildings = read_list(self.list)
        if find_spec("snakemake") is None:
            remedy = "Install it, with Python 3.11 or newer: pip install 'snakemake>=9'"
            raise ThermoxelsError("snakemake", expected="a package of this Python", got="none", remedy=remedy)
        folder = writable_folder(self.output_dir).resolve()
        with hold_folder(folder / ".batch.lock", "Wait for it, or pass another --output-dir.", say) as lock:
            write_json(folder / BATCH, {name: asdict(one) for name, one in buildings.items()})
            for note in () if self.dry_run else folder.glob("*/logs/*.failed.json"):
                remove_file(note)  # of an earlier start
            command = [
                *(sys.executable, "-m", "snakemake", "--directory", str(folder)),
                *("--snakefile", str(Path(__file__).parents[1] / "workflow" / "Snakefile")),
                *("--cores" if not self.executor else "--jobs", str(self.cores)),
                # Retries are not in the Snakefile: a job of a cluster would repeat its stage within its own memory.
                *("--keep-going", "--rerun-incomplete", "--retries=1", "--nolock"),
                *("--rerun-triggers", "mtime", "params"),
                *(() if self.memory_gb is None else ("--resources", f"mem_mb={int(1e3 * self.memory_gb)}")),
                *(("--executor", self.executor) if self.executor else ()),
                *(("--dry-run",) if self.dry_run else ("--quiet", "rules")),
            ]
            say(f"$ {shlex.join(command)}")
            # Snakemake inherits the lock: while it runs, also without this process, no other batch begins here.
            held = lock._context.lock_file_fd
            process = subprocess.Popen(command, pass_fds=[held] if held is not None and os.name == "posix" else [])
            try:
                process.wait()
            except KeyboardInterrupt:
                process.wait()  # it ends its jobs, also those on a cluster
                raise
            rows = [] if self.dry_run else [_row(folder, name, building) for name, building in buildings.items()]
            if process.returncode and not any(row["failed"] for row in rows):
                remedy = "Its output says why."
                raise ThermoxelsError("snakemake", expected="exit status 0", got=process.returncode, remedy=remedy)
            if self.dry_run:
                return
            rows.sort(key=lambda one: (one["finished"], -((one["loss_w"] or {}).get("value") or 0.0), one["name"]))
            write_page(folder / PAGE, build_page("batch.html.j2", rows=rows, stages=list(STAGES)))
        say(f"All buildings: {folder / PAGE}")
        missing = [row for row in rows if not row["finished"]]
        if missing:
            got = "; ".join(f"{row['name']}: {row['why'][0]}" for row in missing[:5])
            remedy = f"Correct what {folder / PAGE} names; the same command then goes on."
            raise ThermoxelsError("batch", expected=f"{len(rows)} buildings finished", got=got, remedy=remedy)


def read_list(path: Path) -> dict[str, Building]:
    """Return the buildings of a csv file by their names; paths in it are relative to the folder of the file.

    Raises `SceneError` with all mistakes if the file cannot be read, or if columns or lines are wrong.
    """
    known = [field.name for field in fields(Building)]
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            columns = reader.fieldnames or []
            lines = [(reader.line_num, line) for line in reader]
    except (OSError, UnicodeDecodeError, csv.Error) as problem:
        raise SceneError(str(path), expected="a csv file", got=str(problem), remedy="Pass the list.") from problem
    wrong = [f"unknown column {name!r}" for name in columns if name not in known]
    wrong += [f"column {name!r} twice" for name in set(columns) if list(columns).count(name) > 1]
    wrong += [] if "name" in columns else ["no column 'name'"]
    buildings: dict[str, Building] = {}
    for number, line in [] if wrong else lines:
        values = {name: (line.get(name) or "").strip() for name in columns}
        mistakes = [] if not any(line.get(None, ())) else ["more entries than columns"]  # type: ignore[call-overload]
        for name, is_there in _PLACES.items():
            if values.get(name) and (name != "heat" or values[name].endswith((".yaml", ".yml"))):
                place = path.parent.resolve() / values[name]
                mistakes += [] if is_there(place) else [f"{name}: no {place}"]
                values[name] = str(place)
        one = Building(**values)
        mistakes += [] if _KNOWN_NAME.fullmatch(one.name) else [f"name {one.name!r} is not of letters, digits, - and _"]
        mistakes += [f"name {one.name!r} is there twice"] if one.name in buildings else []
        mistakes += ["needs either photographs or a scene"] if bool(one.photographs) == bool(one.scene) else []
        if one.heat and not one.heat.endswith((".yaml", ".yml")):
            from thermoxels_ns.heat.scene import heat_scene_names

            if one.heat not in (scenes := heat_scene_names()):
                mistakes.append(f"heat: {one.heat!r} is neither a .yaml file nor one of {', '.join(scenes)}")
        for name in ("train", "export"):
            try:
                shlex.split(getattr(one, name))
            except ValueError as problem:
                mistakes.append(f"{name}: {problem}")
        wrong += [f"line {number}: {mistake}" for mistake in mistakes]
        buildings[one.name] = one
    if wrong or not buildings:
        got = "; ".join(wrong) or "no building"
        expected = f"a line per building, its entries apart by commas, with the columns {', '.join(known)}"
        raise SceneError(str(path), expected=expected, got=got, remedy="Correct the list.")
    return buildings


_KNOWN_NAME = re.compile(r"[A-Za-z0-9][\w-]*", re.ASCII)
_PLACES = {
    **{"photographs": Path.is_dir, "scene": Path.exists},
    **{"patches": Path.is_file, "conditions": Path.is_file, "heat": Path.is_file},
}


def read_batch(folder: Path) -> dict[str, Building]:
    """Return the buildings of a batch from its folder, by their names."""
    content = json.loads((folder / BATCH).read_text(encoding="utf-8"))
    return {name: Building(**values) for name, values in content.items()}


def plan_of(building: Building, folder: Path) -> dict[str, Stage]:
    """Return the stages of a building by name, in order; inputs hold the marker file of the stage in `AFTER`."""
    scene = building.scene or str(folder / "scene")
    config = str(folder / "outputs" / "building" / "thermoxels" / "run" / "config.yml")
    mesh = str(folder / "mesh" / "mesh.vtu")
    capture = ["thermoxels", "capture", building.photographs, "--output", scene]
    options = shlex.split(building.train)
    threads = [] if "--pipeline.cpu-threads" in options else ["--pipeline.cpu-threads", str(STAGES["model"].threads)]
    train = [
        *("ns-train", "thermoxels", "--output-dir", str(folder / "outputs"), "--experiment-name", "building"),
        *(*PLAIN_TRAINING, *threads, *options, "thermal-data", "--data", scene),
    ]
    export = ["ns-export", "thermoxels-mesh", "--load-config", config, "--output-dir", str(folder / "mesh")]
    export += [*(["--patches", building.patches] if building.patches else []), *shlex.split(building.export)]
    audit = ["thermoxels", "audit", mesh, "--conditions", building.conditions, "--scene", scene]
    for name, count in (("--layout", 1), ("--thermal-bounds", 2)):  # how the scene's thermal images are read
        if name in options:
            audit += options[options.index(name) : options.index(name) + 1 + count]
    commands = {
        "scene": capture if building.photographs else [],
        "model": train,
        "scores": ["ns-eval", "--load-config", config, "--output-path", str(folder / "eval.json")],
        "mesh": export,
        "heat": ["thermoxels", "heat", mesh, "--scene", building.heat, "--output-dir", str(folder / "heat")],
        "audit": [*audit, "--output-dir", str(folder / "audit")],
    }
    wanted = {"scene": building.photographs, "heat": building.heat, "audit": building.conditions}
    stages = {name: command for name, command in commands.items() if wanted.get(name, "yes")}
    reads = {"mesh": building.patches, "heat": building.heat, "audit": building.conditions}
    plan = {}
    for name, command in stages.items():
        markers = [f"{folder.as_posix()}/{AFTER[name]}.json"] if AFTER.get(name) in stages else []
        files = [file for file in [reads.get(name, "")] if Path(file).is_absolute()]
        plan[name] = Stage(command, markers + files)
    return plan


def run_stage(name: str, stage: str, attempt: int) -> int:
    """Run a stage of building `name` and return its exit status; the caller must be in the folder of the batch.

    If attempt 1 failed by itself and not for lack of memory, attempt 2 runs nothing and returns the earlier status. If
    this process is killed, STAGE.failed.json is left behind, which says that the stage was ended from outside.
    """
    folder = writable_folder(Path(name) / "logs").parent
    failed, log = folder / "logs" / f"{stage}.failed.json", folder / "logs" / f"{stage}.log"
    earlier = _read(failed).get("status", _ENDED)
    if attempt > 1 and earlier not in _TRIED_AGAIN:
        return earlier
    write_json(failed, {"status": _ENDED, "why": "ended from outside, as by a limit of memory or time"})
    command = plan_of(read_batch(Path())[name], Path(name))[stage].command
    try:
        cost = run_command(command, log)
        peak = cost.peak_memory_gb if math.isfinite(cost.peak_memory_gb) else None
        write_json(folder / f"{stage}.json", {"seconds": cost.seconds, "peak_memory_gb": peak})
    except (ThermoxelsError, OSError) as problem:
        told = (problem.exit_status, problem.last_line) if isinstance(problem, CommandFailed) else (CRASH, str(problem))
        write_json(failed, dict(zip(("status", "why"), told)))
        return told[0]
    remove_file(failed)
    return 0


def _row(folder: Path, name: str, building: Building) -> dict[str, Any]:
    """Return what the page says of a building: finished stages, errors, costs, and the main figures of its audit."""
    own, plan = folder / name, plan_of(building, Path(name))
    costs = {stage: cost for stage in plan if (cost := _read(own / f"{stage}.json"))}
    notes = {stage: _read(own / "logs" / f"{stage}.failed.json") for stage in plan if stage not in costs}
    said = {stage: note for stage, note in notes.items() if note}
    why = [f"{stage}: {one['why']} ({_WHY.get(one['status'], 'crash')})" for stage, one in said.items()]
    answers = _read(own / "audit" / "answers.json") if "audit" in costs else {}
    memory = [cost["peak_memory_gb"] for cost in costs.values() if cost["peak_memory_gb"] is not None]
    return {
        **{"name": name, "finished": len(costs) == len(plan), "failed": bool(said)},
        "why": why or [f"{stage}: not run" for stage in plan if stage not in costs],
        "logs": [f"{name}/logs/{stage}.log" for stage in said],
        "scores": _read(own / "eval.json").get("results", {}) if "scores" in costs else {},
        "seconds": {stage: cost["seconds"] for stage, cost in costs.items()},
        "peak_gb": max(memory, default=None),
        "loss_w": answers.get("whole", {}).get("loss_w"),
        "bridges": sum(not one["not_counted"] for one in answers.get("defects", ())) if answers else None,
        "pages": [
            (stage, f"{name}/{page}")
            for stage, page in (("audit", "audit/audit.html"), ("heat", "heat/report.html"))
            if stage in costs
        ],
    }


def _read(path: Path) -> dict[str, Any]:
    """Return the content of a json file; {} if there is no file or its text is not complete json."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(_ENDED))  # ends the command of the stage, too
    sys.exit(run_stage(sys.argv[1], sys.argv[2], int(sys.argv[3])))
