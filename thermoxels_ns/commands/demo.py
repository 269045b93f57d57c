"""The command ``thermoxels demo``: photographs to heat flow, held against the truth."""

from __future__ import annotations

# Only light imports at the top, so that ``thermoxels --help`` answers at once.
import shutil
import time
import webbrowser
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from thermoxels_ns.core.checks import writable_folder
from thermoxels_ns.core.errors import OutputError, ThermoxelsError
from thermoxels_ns.core.json_values import read_json

if TYPE_CHECKING:
    from rich.console import Console

    from thermoxels_ns.commands.demo_results import DemoResults
    from thermoxels_ns.reports.demo_page import ColourBar, DemoPage

SceneName = Literal["hot-object", "house-corner", "sphere", "courtyard", "pipes"]
"""The synthetic scenes."""

_MARKER = ".thermoxels-demo"
_WRITTEN = ("index.html", "scene", "outputs", "eval.json", "eval", "renders", "export", "survey", "audit", "logs")
_TRAIN_VIEWS, _HELD_OUT_VIEWS, _WIDTH, _HEIGHT = 42, 6, 320, 240
_INPUTS_SHOWN = 6
_BUILDINGS: tuple[SceneName, ...] = ("house-corner", "courtyard")
_AUDITED: SceneName = "house-corner"  # The scene whose U-values are known
_AUDIT_FILES = (
    ("audit/audit.html", "heat loss, U-values and thermal bridges, as a page to hand over"),
    ("survey/", "which part of the surface is which element, and the conditions of the survey"),
)
_COLOUR_MAP = "inferno"
_COLOUR_STOPS = 17


@dataclass
class Demo:
    """Make a synthetic scene, train, evaluate, export, simulate and audit, and compare all with the exact truth."""

    output_dir: Path = Path("demo")
    """Folder for all results; made if it does not exist. An earlier demo in it is replaced."""
    scene: SceneName = "house-corner"
    """Synthetic scene to photograph."""
    iterations: int | None = None
    """Training steps; the default of the method if left out."""
    open_browser: bool = False
    """Show the page in a web browser at the end."""

    def main(self) -> None:
        """Run the demo; raises `ThermoxelsError` for another's folder, a command that failed, or a target missed."""
        from rich.console import Console

        run_demo(self, Console(highlight=False))


@dataclass
class _Steps:
    """Announces steps and remembers how long each took."""

    console: Console
    count: int
    seconds: list[tuple[str, float]] = field(default_factory=list)

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Announce a step and time what happens in it."""
        self.console.rule(f"[bold]{len(self.seconds) + 1}/{self.count}  {name}")
        start = time.monotonic()
        yield
        self.seconds.append((name, time.monotonic() - start))


def run_demo(demo: Demo, console: Console) -> None:
    """Run all steps; see `Demo`."""
    from thermoxels_ns.commands.demo_audit import audit_section, audit_target, compare, write_survey
    from thermoxels_ns.commands.demo_results import read_results
    from thermoxels_ns.commands.installed_commands import command_line, run_command
    from thermoxels_ns.reports.demo_page import build_page
    from thermoxels_ns.reports.page import write_page
    from thermoxels_ns.synthetic.scene_folder import make_scene, write_scene

    if demo.iterations is not None and demo.iterations < 1:
        remedy = "Leave it out for the default."
        raise ThermoxelsError("iterations", expected="1 or more", got=demo.iterations, remedy=remedy)
    folder = prepare_folder(demo.output_dir)
    logs = writable_folder(folder / "logs")
    commands = demo_commands(folder, demo.scene, demo.iterations)
    steps = _Steps(console, len(commands) + 1)
    audited = demo.scene == _AUDITED

    with steps.step("Photograph the synthetic scene"):
        console.print(f"$ {command_line(commands[0])}", style="bold", markup=False, soft_wrap=True)
        write_scene(make_scene(demo.scene), folder / "scene", _TRAIN_VIEWS, _HELD_OUT_VIEWS, _WIDTH, _HEIGHT)
        if audited:
            write_survey(folder)
    names = ("Train", "Evaluate", "Render", "Export the mesh and let heat flow", "Audit the house")
    for name, command in zip(names, commands[1:]):
        with steps.step(name):
            run_command(command, logs / f"{command[0].replace('thermoxels', 'audit')}.log", console)
    with steps.step("Compare with the truth"):
        results = read_results(folder / "eval.json", folder / "export" / "summary.json")
        compared = compare(folder / "audit" / "answers.json") if audited else ()
        if audited:
            results = replace(results, targets=(*results.targets, audit_target(compared)))
        print_results(results, console)

    shown = [command_line(command) for command in commands]
    page = assemble_page(folder, demo.scene, results, steps.seconds, shown)
    if audited:
        page = replace(page, sections=(audit_section(compared),), files=(*page.files, *_AUDIT_FILES))
    index = folder / "index.html"
    write_page(index, build_page(page))
    console.print(f"All pictures and figures: {index}", markup=False, soft_wrap=True)
    if demo.open_browser:
        webbrowser.open(index.resolve().as_uri())
    missed = [f"{t.name} {t.measured_text} (target {t.bound_text})" for t in results.targets if not t.met]
    if missed:
        remedy = f"See {index} for pictures."
        raise ThermoxelsError("demo", expected="every target met", got="; ".join(missed), remedy=remedy)


def prepare_folder(path: Path) -> Path:
    """Make the folder of a demo, without the results of an earlier demo.

    Only what a demo writes is deleted, and only in a folder that a demo has marked as its own; raises `OutputError` for
    one that holds something else, or cannot be written to.
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
    """The commands of the demo in order: synthetic, ns-train, ns-eval, ns-render, ns-export, and audit of the house."""
    config = str(folder / "outputs" / "demo" / "thermoxels" / "run" / "config.yml")
    survey = folder / "survey"
    patches = ["--patches", str(survey / "patches.yaml")] if scene == _AUDITED else []
    audit = [
        *("thermoxels", "audit", str(folder / "export" / "mesh.vtu"), "--conditions", str(survey / "conditions.yaml")),
        *("--scene", str(folder / "scene"), "--output-dir", str(folder / "audit")),
    ]
    steps = [] if iterations is None else ["--max-num-iterations", str(iterations)]
    return [
        ["thermoxels", "synthetic", scene, "--output-dir", str(folder / "scene")],
        [
            *("ns-train", "thermoxels", "--output-dir", str(folder / "outputs")),
            *("--experiment-name", "demo", "--timestamp", "run", "--vis", "tensorboard", *steps),
            # One line every hundred steps instead of a block that is drawn over and over.
            *("--logging.steps-per-log", "100", "--logging.local-writer.max-log-size", "0"),
            *("--logging.profiler", "none", "thermal-data", "--data", str(folder / "scene")),
        ],
        [
            *("ns-eval", "--load-config", config, "--output-path", str(folder / "eval.json")),
            *("--render-output-path", str(folder / "eval")),
        ],
        [
            *("ns-render", "dataset", "--load-config", config, "--split", "test"),
            *("--rendered-output-names", "gt-rgb", "rgb", "gt-thermal", "thermal"),
            *("--image-format", "png", "--colormap-options.colormap", _COLOUR_MAP),
            *("--output-path", str(folder / "renders")),
        ],
        [
            *("ns-export", "thermoxels-mesh", "--load-config", config),
            *("--output-dir", str(folder / "export"), "--metres-per-unit", "1", *patches),
        ],
        *([audit] if scene == _AUDITED else []),
    ]


def print_results(results: DemoResults, console: Console) -> None:
    """Print the figures with a target as a table."""
    from rich.table import Table

    table = Table()
    table.add_column("")
    table.add_column("measured", justify="right")
    table.add_column("target", justify="right")
    table.add_column("met")
    for target in results.targets:
        met = "[green]yes[/green]" if target.met else "[bold red]no[/bold red]"
        table.add_row(target.name, target.measured_text, target.bound_text, met)
    console.print(table)


def assemble_page(
    folder: Path, scene: str, results: DemoResults, seconds: Sequence[tuple[str, float]], commands: Sequence[str]
) -> DemoPage:
    """Gather the pictures of a demo run for its page; raises `ThermoxelsError` if one is missing."""
    from thermoxels_ns.commands.installed_commands import command_line
    from thermoxels_ns.reports.demo_page import Check, DemoPage, HeldOutView
    from thermoxels_ns.reports.page import Picture, Table

    bar = _colour_bar(folder / "scene")
    renders = folder / "renders" / "test"
    names = sorted(f"{path.stem}.png" for path in (folder / "scene" / "images").glob("frame_eval_*"))
    export = folder / "export"
    before, after, change = _panels(export / "heat.png", 3)
    pairs = tuple(_training_pairs(folder / "scene"))
    return DemoPage(
        title=f"Thermoxels demo: {scene}",
        summary=(
            f"{_TRAIN_VIEWS} photographs and their thermal images became a model, a tetrahedral mesh with temperatures "
            "and a heat computation. The scene is synthetic: its shape and temperature are known exactly, so the "
            "result can be measured."
        ),
        at_a_glance=(
            Picture(pairs[0][0], f"In: {_TRAIN_VIEWS} photographs"),
            Picture(pairs[0][1], "In: their thermal images"),
            Picture(_picture(export / "mesh.png"), "Out: a solid in which heat can flow"),
        ),
        checks=tuple(Check(t.name, t.measured_text, t.bound_text, t.met, t.meaning) for t in results.targets),
        more_figures=Table(("", ""), results.others, summary="More figures"),
        training_pairs=pairs,
        views=tuple(
            HeldOutView(
                Path(name).stem, *(_picture(renders / o / name) for o in ("gt-rgb", "rgb", "gt-thermal", "thermal"))
            )
            for name in names
        ),
        colour_bar=bar,
        mesh_pictures=(
            Picture(before, "Before: the temperatures that the photographs gave."),
            Picture(after, "After: heat has flowed through the solid. Both in one range of colours."),
            Picture(change, "The change, on a scale of its own."),
            Picture(
                _picture(export / "mesh-measured.png"), "Grey: no thermal ray saw the surface; it is interpolated."
            ),
        ),
        next_steps=(
            (
                command_line(["ns-viewer", "--load-config", folder / "outputs/demo/thermoxels/run/config.yml"]),
                "Walk around the trained model in a browser:",
            ),
            *heat_steps(folder, scene),
            (
                command_line(["thermoxels", "capture", "PHOTOGRAPHS", "--output", "SCENE"]),
                "Make a scene of your own from a folder of photographs and thermal images:",
            ),
            ("ns-train thermoxels --data SCENE", "Train on it, and then go on with ns-export as above:"),
        ),
        seconds=tuple(seconds),
        commands=tuple(commands),
        files=(
            ("scene/", "the synthetic photographs, thermal images and camera poses"),
            ("outputs/demo/thermoxels/run/config.yml", "the training run; ns-viewer --load-config shows it"),
            ("eval.json", "figures of the held-out views"),
            ("renders/test/", "rendered and measured held-out views"),
            ("export/mesh.vtu", "the mesh with temperatures, for ParaView or a solver"),
            ("export/mesh.glb", "its surface, for a browser or a phone"),
            ("export/quality.png", "how good its tetrahedra are"),
            ("export/heat.pvd", "temperatures over time, for ParaView"),
            ("export/summary.json", "figures of mesh, heat and truth, and all options"),
            ("logs/", "what every command said"),
        ),
    )


def heat_steps(folder: Path, scene: str) -> Iterator[tuple[str, str]]:
    """Commands that lead to a heat report: of a building with walls, of anything else as it was exported."""
    from thermoxels_ns.commands.installed_commands import command_line

    config = folder / "outputs" / "demo" / "thermoxels" / "run" / "config.yml"
    mesh, weather, said = folder / "export" / "mesh.vtu", "original", "ten windy, sunny minutes"
    if scene in _BUILDINGS:
        mesh, weather, said = folder / "walls" / "mesh.vtu", "winter-night", "a winter night"
        yield (
            command_line(
                [
                    *("ns-export", "thermoxels-mesh", "--load-config", config, "--output-dir", mesh.parent),
                    *("--metres-per-unit", "1", "--interior", "hollow", "--wall-thickness", "0.3"),
                ]
            ),
            "Export the building with rooms; photographs do not show how thick its walls are, so say it:",
        )
    yield (
        command_line(["thermoxels", "heat", mesh, "--scene", weather, "--output-dir", folder / "heat"]),
        f"Let {said} act on it; report.html says how much heat goes where:",
    )


def _picture(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as problem:
        expected, remedy = "a picture that the demo's commands write", "Run the demo again."
        got = problem.strerror or str(problem)
        raise ThermoxelsError(str(path), expected=expected, got=got, remedy=remedy) from problem


def _panels(path: Path, count: int) -> list[bytes]:
    """Cut a picture of panels side by side, so that a narrow screen can show one below the other."""
    from io import BytesIO

    from PIL import Image

    panels = []
    with Image.open(BytesIO(_picture(path))) as whole:
        for number in range(count):
            file = BytesIO()
            left, right = number * whole.width // count, (number + 1) * whole.width // count
            whole.crop((left, 0, right, whole.height)).save(file, format="PNG")
            panels.append(file.getvalue())
    return panels


def _colour_bar(scene: Path) -> ColourBar:
    """The colours in which ns-render draws normalised temperatures 0 to 1, the scene's bounds."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    from thermoxels_ns.reports.demo_page import ColourBar

    bounds = read_json(scene / "temperature_bounds.json")
    stops = (n / (_COLOUR_STOPS - 1) for n in range(_COLOUR_STOPS))
    return ColourBar(
        tuple(to_hex(colormaps[_COLOUR_MAP](stop)) for stop in stops),
        float(bounds["absolute_min_temperature"]),
        float(bounds["absolute_max_temperature"]),
    )


def _training_pairs(scene: Path) -> Iterator[tuple[bytes, bytes]]:
    """Some training photographs from all around, each with its thermal image in the page's colours."""
    import numpy as np
    from matplotlib import colormaps
    from PIL import Image

    from thermoxels_ns.reports.capture_pictures import jpeg_of

    photographs = sorted((scene / "images").glob("frame_train_*"))
    for number in range(_INPUTS_SHOWN):
        path = photographs[number * len(photographs) // _INPUTS_SHOWN]
        with Image.open(path) as photograph:
            rgb = np.asarray(photograph.convert("RGB"))
        with Image.open(scene / "thermal" / f"{path.stem}.png") as counts:  # 16 bits that span the bounds
            normalised = np.asarray(counts, dtype=np.float64) / 65535.0
        colours = np.round(255.0 * colormaps[_COLOUR_MAP](normalised)[..., :3]).astype(np.uint8)
        yield jpeg_of(rgb, 88), jpeg_of(colours, 88)
