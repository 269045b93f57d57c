"""The command ``thermoxels demo``: run all steps from photographs to heat flow, and compare with the exact scene."""

from __future__ import annotations

# Only light imports at the top, so that ``thermoxels --help`` answers at once.
import shutil
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from thermoxels_ns.commands.installed_commands import PLAIN_TRAINING, command_line, run_command
from thermoxels_ns.core.checks import writable_folder
from thermoxels_ns.core.errors import OutputError, ThermoxelsError

if TYPE_CHECKING:
    from rich.console import Console

    from thermoxels_ns.commands.demo_results import Target

SceneName = Literal["hot-object", "house-corner", "sphere", "courtyard", "pipes"]
"""Names of the synthetic scenes."""

_MARKER = ".thermoxels-demo"
_WRITTEN = (
    *("index.html", "scene", "outputs", "eval.json", "eval", "renders", "export", "survey", "audit", "walls", "heat"),
    "logs",
)
_TRAIN_VIEWS, _HELD_OUT_VIEWS, _WIDTH, _HEIGHT = 42, 6, 320, 240
_AUDITED: SceneName = "house-corner"  # The scene whose U-values are known
_WALLS = ("--metres-per-unit", "1", "--interior", "hollow", "--wall-thickness", "0.3")  # Options that make rooms


@dataclass
class Demo:
    """Make a synthetic scene, train, evaluate, export, simulate and audit, and compare all with the exact truth."""

    output_dir: Path = Path("demo")
    """Folder for all results; made if it does not exist. An earlier demo in the folder is replaced."""
    scene: SceneName = "house-corner"
    """Synthetic scene to photograph."""
    iterations: int | None = None
    """Training steps; the default of the method if left out."""

    def main(self) -> None:
        """Run the demo; raises `ThermoxelsError` if a command fails, a target is missed, or the folder is in use."""
        from rich.console import Console

        run_demo(self, Console(highlight=False))


def run_demo(demo: Demo, console: Console) -> None:
    """Run all steps of a `Demo`, and write its page."""
    from thermoxels_ns.commands.demo_results import audit_target, compare, demo_page, read_results
    from thermoxels_ns.core.yaml_records import configs_folder
    from thermoxels_ns.reports.page import write_page
    from thermoxels_ns.synthetic.scene_folder import make_scene, write_scene

    if demo.iterations is not None and demo.iterations < 1:
        remedy = "Leave it out for the default."
        raise ThermoxelsError("iterations", expected="1 or more", got=demo.iterations, remedy=remedy)
    folder = prepare_folder(demo.output_dir)
    logs = writable_folder(folder / "logs")
    commands = demo_commands(folder, demo.scene, demo.iterations)
    patches = folder / "survey" / "patches.yaml"
    seconds: list[tuple[str, float]] = []

    @contextmanager
    def step(name: str) -> Iterator[None]:
        """Announce a step and append the seconds that its body takes to `seconds`."""
        console.rule(f"[bold]{len(seconds) + 1}/{len(commands) + 1}  {name}")
        start = time.monotonic()
        yield
        seconds.append((name, time.monotonic() - start))

    with step("Photograph the synthetic scene"):
        console.print(f"$ {command_line(commands[0])}", style="bold", markup=False, soft_wrap=True)
        write_scene(make_scene(demo.scene), folder / "scene", _TRAIN_VIEWS, _HELD_OUT_VIEWS, _WIDTH, _HEIGHT)
        for name in ("patches.yaml", "conditions.yaml") if demo.scene == _AUDITED else ():
            shutil.copyfile(configs_folder() / f"{_AUDITED}-{name}", writable_folder(patches.parent) / name)
    names = (
        *("Train", "Evaluate", "Render", "Export the mesh and let heat flow", "Audit the house"),
        *("Export the house with rooms", "Let a winter night act on the house"),
    )
    for name, command in zip(names, commands[1:]):
        with step(name):
            log = command[1] if command[0] == "thermoxels" else command[0]
            log += "-walls" * (logs / f"{log}.log").exists()
            run_command(command, logs / f"{log}.log", console)
    with step("Compare with the truth"):
        targets, others = read_results(folder / "eval.json", folder / "export" / "summary.json")
        compared = compare(folder / "audit" / "answers.json", patches) if demo.scene == _AUDITED else ()
        targets += (audit_target(compared),) if compared else ()
        print_targets(targets, console)

    index, shown = folder / "index.html", [command_line(command) for command in commands]
    page = demo_page(folder, demo.scene, targets, others, compared, seconds, shown)
    write_page(index, page)
    console.print(f"All pictures and figures: {index}", markup=False, soft_wrap=True)
    missed = [f"{t.name} {t.measured_text} (target {t.bound_text})" for t in targets if not t.met]
    if missed:
        remedy = f"See {index} for pictures."
        raise ThermoxelsError("demo", expected="every target met", got="; ".join(missed), remedy=remedy)


def prepare_folder(path: Path) -> Path:
    """Make the folder of a demo, remove the results of an earlier demo, and return the folder.

    Only results in a folder that an earlier demo has marked are removed. Raises `OutputError` if the folder holds files
    but no such mark, or if it cannot be written to.
    """
    folder = writable_folder(path)
    marker = folder / _MARKER
    if not marker.is_file() and any(folder.iterdir()):
        remedy = "Pass another folder with --output-dir."
        got = f"{folder}, which holds other files"
        raise OutputError("output_dir", expected="an empty folder or one of an earlier demo", got=got, remedy=remedy)
    marker.write_text("Made by `thermoxels demo`, which replaces: " + ", ".join(_WRITTEN) + "\n")
    for name in _WRITTEN:
        old = folder / name
        if old.is_dir() and not old.is_symlink():
            shutil.rmtree(old)
        else:
            old.unlink(missing_ok=True)
    return folder


def demo_commands(folder: Path, scene: str, iterations: int | None = None) -> list[list[str]]:
    """Return the commands of the demo in order; house-corner's go on with an audit, an export with rooms, and heat."""
    config = str(folder / "outputs" / "demo" / "thermoxels" / "run" / "config.yml")
    survey = folder / "survey"
    patches = ["--patches", str(survey / "patches.yaml")] if scene == _AUDITED else []
    audit = [
        *("thermoxels", "audit", str(folder / "export" / "mesh.vtu"), "--conditions", str(survey / "conditions.yaml")),
        *("--scene", str(folder / "scene"), "--output-dir", str(folder / "audit"), "--pdf", "True"),
    ]
    walls, night = folder / "walls", ["--scene", "winter-night", "--from-audit", str(folder / "audit" / "answers.json")]
    export = ["ns-export", "thermoxels-mesh", "--load-config", config, "--output-dir", str(walls), *_WALLS]
    heat = ["thermoxels", "heat", str(walls / "mesh.vtu"), *night, "--output-dir", str(folder / "heat")]
    steps = [] if iterations is None else ["--max-num-iterations", str(iterations)]
    return [
        ["thermoxels", "synthetic", scene, "--output-dir", str(folder / "scene")],
        [
            *("ns-train", "thermoxels", "--output-dir", str(folder / "outputs"), "--experiment-name", "demo"),
            *(*PLAIN_TRAINING, *steps, "thermal-data", "--data", str(folder / "scene")),
        ],
        [
            *("ns-eval", "--load-config", config, "--output-path", str(folder / "eval.json")),
            *("--render-output-path", str(folder / "eval")),
        ],
        [
            *("ns-render", "dataset", "--load-config", config, "--split", "test"),
            *("--rendered-output-names", "gt-rgb", "rgb", "gt-thermal", "thermal"),
            *("--image-format", "png", "--colormap-options.colormap", "inferno"),
            *("--output-path", str(folder / "renders")),
        ],
        [
            *("ns-export", "thermoxels-mesh", "--load-config", config),
            *("--output-dir", str(folder / "export"), "--metres-per-unit", "1", *patches),
        ],
        *([audit, [*export, "--steps", "1", *patches], heat] if scene == _AUDITED else []),
    ]


def print_targets(targets: Iterable[Target], console: Console) -> None:
    """Print a table of measured figures, their targets, and whether each target is met."""
    from rich.table import Column, Table

    table = Table("", Column("measured", justify="right"), Column("target", justify="right"), "met")
    for target in targets:
        met = "[green]yes[/green]" if target.met else "[bold red]no[/bold red]"
        table.add_row(target.name, target.measured_text, target.bound_text, met)
    console.print(table)
