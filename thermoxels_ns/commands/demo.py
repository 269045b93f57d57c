"""The command ``thermoxels demo``: run all steps from photographs to heat flow, and compare with the exact scene."""

from __future__ import annotations

# Only light imports at the top, so that ``thermoxels --help`` answers at once.
import shlex
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from thermoxels_ns.commands.installed_commands import PLAIN_TRAINING, run_command
from thermoxels_ns.core.checks import writable_folder
from thermoxels_ns.core.errors import OutputError, ThermoxelsError

_MARKER = ".thermoxels-demo"
_WRITTEN = (
    *("index.html", "scene", "outputs", "eval.json", "eval", "renders", "export", "survey", "audit", "walls", "heat"),
    "logs",
)
_TRAIN_VIEWS, _HELD_OUT_VIEWS, _WIDTH, _HEIGHT = 42, 6, 320, 240
_SCENE = "house-corner"  # The scene whose U-values are known


@dataclass
class Demo:
    """Photograph a synthetic house, train, evaluate, export, simulate, audit, and compare all with the exact truth."""

    output_dir: Path = Path("demo")
    """Folder for all results; made if it does not exist. An earlier demo in the folder is replaced."""

    def main(self) -> None:
        """Run the demo; raises `ThermoxelsError` if a command fails, a target is missed, or the folder is in use."""
        from thermoxels_ns.commands.demo_results import audit_target, compare, demo_page, read_results
        from thermoxels_ns.core.yaml_records import configs_folder
        from thermoxels_ns.reports.page import write_page
        from thermoxels_ns.synthetic.scene_folder import make_scene, write_scene

        folder = prepare_folder(self.output_dir)
        logs = writable_folder(folder / "logs")
        commands = demo_commands(folder)
        patches = folder / "survey" / "patches.yaml"
        seconds: list[tuple[str, float]] = []

        @contextmanager
        def step(name: str) -> Iterator[None]:
            """Announce a step and append the seconds that its body takes to `seconds`."""
            print(f"\n{len(seconds) + 1}/{len(commands) + 2}  {name}", flush=True)
            start = time.monotonic()
            yield
            seconds.append((name, time.monotonic() - start))

        photograph = shlex.join(["thermoxels", "synthetic", _SCENE, "--output-dir", str(folder / "scene")])
        with step("Photograph the synthetic scene"):
            print(f"$ {photograph}", flush=True)
            write_scene(make_scene(_SCENE), folder / "scene", _TRAIN_VIEWS, _HELD_OUT_VIEWS, _WIDTH, _HEIGHT)
            for name in ("patches.yaml", "conditions.yaml"):
                shutil.copyfile(configs_folder() / f"{_SCENE}-{name}", writable_folder(patches.parent) / name)
        for name, command in commands.items():
            with step(name):
                log = logs / f"{command[1] if command[0] == 'thermoxels' else command[0]}.log"
                run_command(command, log.with_stem(f"{log.stem}-walls") if log.exists() else log, sys.stdout)
        with step("Compare with the truth"):
            targets = read_results(folder / "eval.json", folder / "export" / "summary.json")
            compared = compare(folder / "audit" / "answers.json", patches)
            targets += (audit_target(compared),)
            for one in targets:
                print(f"{one.name}: {one.measured_text}, target {one.bound_text}, {'met' if one.met else 'not met'}")

        index, shown = folder / "index.html", [photograph, *map(shlex.join, commands.values())]
        page = demo_page(folder, targets, compared, seconds, shown)
        write_page(index, page)
        print(f"All pictures and figures: {index}")
        missed = [f"{t.name} {t.measured_text} (target {t.bound_text})" for t in targets if not t.met]
        if missed:
            remedy = f"See {index} for pictures."
            raise ThermoxelsError("demo", expected="every target met", got="; ".join(missed), remedy=remedy)


def prepare_folder(path: Path) -> Path:
    """Make the folder of a demo, delete the results of an earlier demo in it, and return the folder.

    Raises `OutputError` if the folder holds files but not the mark of a demo, or cannot be written to.
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


def demo_commands(folder: Path) -> dict[str, list[str]]:
    """Return the commands of the demo in order, by the title of their step."""
    config = str(folder / "outputs" / "demo" / "thermoxels" / "run" / "config.yml")
    scene, audited, survey = str(folder / "scene"), str(folder / "audit"), folder / "survey"
    export = ["ns-export", "thermoxels-mesh", "--load-config", config, "--patches", str(survey / "patches.yaml")]
    return {
        "Train": [
            *("ns-train", "thermoxels", "--output-dir", str(folder / "outputs"), "--experiment-name", "demo"),
            *(*PLAIN_TRAINING, "thermal-data", "--data", scene),
        ],
        "Evaluate": [
            *("ns-eval", "--load-config", config, "--output-path", str(folder / "eval.json")),
            *("--render-output-path", str(folder / "eval")),
        ],
        "Render": [
            *("ns-render", "dataset", "--load-config", config, "--split", "test"),
            *("--rendered-output-names", "gt-rgb", "rgb", "gt-thermal", "thermal"),
            *("--image-format", "png", "--colormap-options.colormap", "inferno"),
            *("--output-path", str(folder / "renders")),
        ],
        "Export the mesh": [*(*export, "--metres-per-unit", "1", "--output-dir", str(folder / "export"))],
        "Audit the house": [
            *("thermoxels", "audit", str(folder / "export" / "mesh.vtu")),
            *("--conditions", str(survey / "conditions.yaml"), "--scene", scene),
            *("--output-dir", audited, "--pdf", "True"),
        ],
        "Export the house with rooms": [
            *(*export, "--output-dir", str(folder / "walls"), "--metres-per-unit", "1"),
            *("--interior", "hollow", "--wall-thickness", "0.3"),
        ],
        "Let a winter night act on the house": [
            *("thermoxels", "heat", str(folder / "walls" / "mesh.vtu"), "--scene", "winter-night"),
            *("--from-audit", f"{audited}/answers.json", "--output-dir", str(folder / "heat")),
        ],
    }
