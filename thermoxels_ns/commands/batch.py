"""The command ``thermoxels batch``: many buildings from photographs to audits, their stages run by Snakemake."""

from __future__ import annotations

# Only light imports at the top, so that ``thermoxels --help`` answers at once.
import csv
import json
import re
import shlex
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import tyro

from thermoxels_ns.commands.installed_commands import PLAIN_TRAINING, CommandFailed, run_command
from thermoxels_ns.core.checks import hold_folder, remove_file, replace_when_done, writable_folder
from thermoxels_ns.core.errors import BAD_DATA, LACK_OF_MEMORY, SceneError, ThermoxelsError

BATCH, PAGE = "batch.json", "index.html"
_WHY = {BAD_DATA: "input", LACK_OF_MEMORY: "memory"}


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
"""Stages in the order in which they follow. Memory is asked for once more, doubled, where a stage ran out of it."""


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
    """Heat scene by name or file; empty: no heat."""
    conditions: str = ""
    """Conditions of the survey; empty: no audit."""
    train: str = ""
    """Further options of ns-train, such as --quality draft."""
    export: str = ""
    """Further options of ns-export, such as --metres-per-unit 1."""


class Stage(NamedTuple):
    """A stage of one building: its command, and the files that must be there before."""

    command: list[str]
    inputs: list[str]


@dataclass
class Batch:
    """Take many buildings from photographs to a mesh, heat and an audit; goes on past those that fail.

    The list is a csv file with the columns name, scene or photographs, and, where wanted, patches, heat, conditions,
    train and export (see docs/batch.md). Snakemake runs the stages; the same command goes on where it was interrupted.
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
        """Run all stages, and write the page; raises `ThermoxelsError` if any building is not finished."""
        from rich.console import Console

        run_batch(self, Console(highlight=False))


def run_batch(batch: Batch, console: Any) -> None:
    """Run a `Batch`: read the list, start Snakemake, and write the page over all buildings."""
    if batch.cores < 1 or (batch.memory_gb is not None and not batch.memory_gb > 0):
        got, remedy = f"{batch.cores} and {batch.memory_gb} GB", "Leave them out for the defaults."
        raise ThermoxelsError("batch", expected="at least one processor and some memory", got=got, remedy=remedy)
    buildings = read_list(batch.list)
    if find_spec("snakemake") is None:
        remedy = "Install it: pip install 'snakemake>=9'"
        raise ThermoxelsError("snakemake", expected="a package of this Python", got="none", remedy=remedy)
    folder = writable_folder(batch.output_dir).resolve()
    lock = hold_folder(folder / ".batch.lock", "Wait for it, or pass another --output-dir.", console.print)
    with lock:
        with replace_when_done(folder / BATCH) as temporary:
            content = {name: asdict(one) for name, one in buildings.items()}
            temporary.write_text(json.dumps(content, indent=1), encoding="utf-8")
        command = [
            *(sys.executable, "-m", "snakemake", "--snakefile", str(_snakefile()), "--directory", str(folder)),
            *("--cores" if not batch.executor else "--jobs", str(batch.cores)),
            *("--keep-going", "--rerun-incomplete", "--rerun-triggers", "mtime", "--nolock"),
            *(() if batch.memory_gb is None else ("--resources", f"mem_mb={int(1e3 * batch.memory_gb)}")),
            *(("--executor", batch.executor) if batch.executor else ()),
            *(("--dry-run",) if batch.dry_run else ("--quiet", "rules")),
        ]
        console.print(f"$ {shlex.join(command)}", style="bold", markup=False, soft_wrap=True)
        ended = subprocess.run(command, check=False)
        if batch.dry_run:
            if ended.returncode:
                remedy = "Its output says why."
                raise ThermoxelsError("snakemake", expected="exit status 0", got=ended.returncode, remedy=remedy)
            return
        rows = [_row(folder, name, building) for name, building in buildings.items()]
        _write_page(folder / PAGE, rows)
    console.print(f"All buildings: {folder / PAGE}", markup=False, soft_wrap=True)
    missing = [row for row in rows if not row["finished"]]
    if missing:
        got = "; ".join(f"{row['name']}: {row['why']}" for row in missing[:5])
        remedy = f"Correct what {folder / PAGE} names; the same command then goes on."
        raise ThermoxelsError("batch", expected=f"{len(rows)} buildings finished", got=got, remedy=remedy)


def read_list(path: Path) -> dict[str, Building]:
    """Return the buildings of a csv file by their names; files are read beside the list.

    Raises:
        SceneError: The file cannot be read, has unknown columns, or lines that do not say a building; all are named.
    """
    known = [field.name for field in fields(Building)]
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            columns, lines = reader.fieldnames or [], list(reader)
    except (OSError, UnicodeDecodeError, csv.Error) as problem:
        raise SceneError(str(path), expected="a csv file", got=str(problem), remedy="Pass the list.") from problem
    wrong = [f"unknown column {name!r}" for name in columns if name not in known]
    wrong += [] if "name" in columns else ["no column 'name'"]
    buildings: dict[str, Building] = {}
    for number, line in enumerate([] if wrong else lines, start=2):
        values = {name: (line.get(name) or "").strip() for name in columns}
        for name in ("photographs", "scene", "patches", "conditions", "heat"):
            there = path.parent.resolve() / values.get(name, "")
            if values.get(name) and (there.exists() or name != "heat"):  # heat scenes have names of their own
                wrong += [] if there.exists() else [f"line {number}: {name}: no {there}"]
                values[name] = str(there)
        one = Building(**values)
        if not re.fullmatch(r"[A-Za-z0-9][\w-]*", one.name, re.ASCII):
            wrong.append(f"line {number}: name {one.name!r} is not of letters, digits, - and _")
        if one.name in buildings:
            wrong.append(f"line {number}: name {one.name!r} is there twice")
        if bool(one.photographs) == bool(one.scene):
            wrong.append(f"line {number}: needs either photographs or a scene")
        if None in line:
            wrong.append(f"line {number}: more entries than columns")
        buildings[one.name] = one
    if wrong or not buildings:
        got = "; ".join(wrong) or "no building"
        expected = f"a line per building with the columns {', '.join(known)}"
        raise SceneError(str(path), expected=expected, got=got, remedy="Correct the list.")
    return buildings


def read_batch(folder: Path) -> dict[str, Building]:
    """Return the buildings of a batch from its folder, by their names."""
    content = json.loads((folder / BATCH).read_text(encoding="utf-8"))
    return {name: Building(**values) for name, values in content.items()}


def plan_of(building: Building, folder: Path) -> dict[str, Stage]:
    """Return the stages of a building by name, in order; each needs the marker of the one before it."""
    scene = building.scene or str(folder / "scene")
    config = str(folder / "outputs" / "building" / "thermoxels" / "run" / "config.yml")
    mesh = str(folder / "mesh" / "mesh.vtu")
    capture = ["thermoxels", "capture", building.photographs, "--output", scene]
    train = [
        *("ns-train", "thermoxels", "--output-dir", str(folder / "outputs"), "--experiment-name", "building"),
        *(*PLAIN_TRAINING, *shlex.split(building.train), "thermal-data", "--data", scene),
    ]
    export = ["ns-export", "thermoxels-mesh", "--load-config", config, "--output-dir", str(folder / "mesh")]
    export += [*(["--patches", building.patches] if building.patches else []), *shlex.split(building.export)]
    audit = ["thermoxels", "audit", mesh, "--conditions", building.conditions, "--scene", scene]
    commands = {
        "scene": capture if building.photographs else [],
        "model": train,
        "scores": ["ns-eval", "--load-config", config, "--output-path", str(folder / "eval.json")],
        "mesh": export,
        "heat": ["thermoxels", "heat", mesh, "--scene", building.heat, "--output-dir", str(folder / "heat")],
        "audit": [*audit, "--output-dir", str(folder / "audit")],
    }
    after = {"model": "scene", "scores": "model", "mesh": "model", "heat": "mesh", "audit": "mesh"}
    wanted = {"scene": building.photographs, "heat": building.heat, "audit": building.conditions}
    stages = {name: command for name, command in commands.items() if wanted.get(name, "yes")}
    return {
        name: Stage(command, [f"{folder.as_posix()}/{after[name]}.json"] if after.get(name) in stages else [])
        for name, command in stages.items()
    }


def run_stage(name: str, stage: str, attempt: int) -> int:
    """Run a stage of a building in the folder of the batch, and return its exit status.

    A stage that ended for another reason than memory is not tried a second time: `attempt` 2 then ends as it did.
    """
    from rich.console import Console

    folder = writable_folder(Path(name) / "logs").parent
    failed, done = folder / "logs" / f"{stage}.failed.json", folder / f"{stage}.json"
    if attempt > 1 and failed.is_file():
        earlier = int(json.loads(failed.read_text(encoding="utf-8"))["status"])
        if earlier != LACK_OF_MEMORY:
            return earlier
    remove_file(failed)
    log = folder / "logs" / f"{stage}.log"
    with (folder / "logs" / f"{stage}.shown").open("w", encoding="utf-8") as shown:
        try:
            cost = run_command(plan_of(read_batch(Path())[name], Path(name))[stage].command, log, Console(file=shown))
        except CommandFailed as problem:
            content = {"status": problem.exit_status, "why": problem.last_line}
            failed.write_text(json.dumps(content), encoding="utf-8")
            return problem.exit_status
    with replace_when_done(done) as temporary:
        temporary.write_text(json.dumps(cost._asdict()), encoding="utf-8")
    return 0


def _snakefile() -> Path:
    return Path(__file__).parents[1] / "workflow" / "Snakefile"


def _row(folder: Path, name: str, building: Building) -> dict[str, Any]:
    """Return what the page says of a building: how far it came, what it cost, and the main figures of its audit."""
    own, plan = folder / name, plan_of(building, Path(name))
    costs = {stage: _read(own / f"{stage}.json") for stage in plan}
    failed = {stage: _read(own / "logs" / f"{stage}.failed.json") for stage in plan}
    stopped = next((stage for stage in plan if failed[stage]), next((s for s in plan if not costs[s]), ""))
    said, answers = failed.get(stopped) or {}, _read(own / "audit" / "answers.json")
    results = _read(own / "eval.json").get("results", {})
    kind = _WHY.get(said.get("status", 0), "crash")
    why = f"{stopped}: {said['why']} ({kind})" if said else f"{stopped}: not run"
    memory = [cost["peak_memory_gb"] for cost in costs.values() if cost and cost["peak_memory_gb"] is not None]
    return {
        **{"name": name, "finished": not stopped, "why": why if stopped else "", "psnr": results.get("psnr")},
        "log": f"{name}/logs/{stopped}.log" if said else "",
        "seconds": {stage: cost["seconds"] for stage, cost in costs.items() if cost},
        "peak_gb": max((gb for gb in memory if gb == gb), default=None),
        "loss_w": answers.get("whole", {}).get("loss_w"),
        "bridges": sum(not one["not_counted"] for one in answers.get("defects", ())) if answers else None,
        "pages": [
            (words, f"{name}/{page}")
            for words, page in (("audit", "audit/audit.html"), ("heat", "heat/report.html"))
            if (own / page).is_file()
        ],
    }


def _read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}


def _write_page(path: Path, rows: list[dict[str, Any]]) -> None:
    from thermoxels_ns.reports.page import build_page, write_page

    rows = sorted(rows, key=lambda row: (row["finished"], -((row["loss_w"] or {}).get("value") or 0.0), row["name"]))
    write_page(path, build_page("batch.html.j2", rows=rows, stages=list(STAGES)))


if __name__ == "__main__":
    sys.exit(run_stage(sys.argv[1], sys.argv[2], int(sys.argv[3])))
