import io
import json
import math
import types
from contextlib import redirect_stdout
from pathlib import Path

import pytest

from thermoxels_ns import cli
from thermoxels_ns.commands.cost import FIGURES, Cost, cheapest, table_of
from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.training.schedule import schedule_for

# The evaluation improves with the steps.
NS_TRAIN = """
run = pathlib.Path(value("--output-dir"), value("--experiment-name"), sys.argv[1], value("--timestamp"))
run.mkdir(parents=True)
steps = int(value("--max-num-iterations", {"draft": 50, "standard": 200}.get(value("--quality"), 0)))
(run / "config.yml").write_text(json.dumps({"steps": steps, "method": sys.argv[1]}))
"""
NS_EVAL = """
run = json.loads(pathlib.Path(value("--load-config")).read_text())
results = {"thermal_mae_c": 80 / run["steps"], "half_transparent": 0.02, "thermal_mae_c_std": 1.0}
if run["method"] == "thermoxels":
    results |= {"psnr": 20 + run["steps"] / 20, "ssim": 0.9}
results |= {name: 0.9 for name in ("fscore", "precision", "recall", "fscore_128")}
pathlib.Path(value("--output-path")).write_text(json.dumps({"results": results}))
"""
PRELUDE = """
import json, os, pathlib, sys
def value(option, default=None):
    return sys.argv[sys.argv.index(option) + 1] if option in sys.argv else default
with open(pathlib.Path(__file__).parent / "calls", "a") as calls:
    print(*[pathlib.Path(sys.argv[0]).name, *sys.argv[1:]], file=calls)
"""


@pytest.fixture
def commands(tmp_path, fake_command):
    """Fake ns-train and ns-eval; gives a function that replaces one, and one that lists what was called."""

    def write(name: str, body: str) -> None:
        fake_command(name, f"{PRELUDE}\n{body}")

    def calls() -> list[list[str]]:
        path = tmp_path / "bin" / "calls"
        lines = path.read_text().splitlines() if path.is_file() else []
        path.unlink(missing_ok=True)
        return [line.split() for line in lines]

    write("ns-train", NS_TRAIN)
    write("ns-eval", NS_EVAL)
    return types.SimpleNamespace(write=write, calls=calls)


@pytest.fixture
def scene(tmp_path) -> Path:
    folder = tmp_path / "scene [1] <b>"
    folder.mkdir()
    (folder / "transforms.json").write_text("{}")
    return folder


@pytest.fixture
def start(scene, tmp_path, commands):
    """Gives a function that runs the command and returns what it printed."""

    def run(**options) -> str:
        defaults = {"settings": ("32:100", "64:400"), "qualities": ()}
        with redirect_stdout(io.StringIO()) as screen:
            Cost(**({"scene": scene, "output_dir": tmp_path / "cost"} | defaults | options)).main()
        return screen.getvalue()

    return run


def kept(tmp_path: Path) -> list[dict]:
    return [*json.loads((tmp_path / "cost" / "cost.json").read_text()).values()]


def test_settings_qualities_and_methods_are_what_a_user_would_type(start, commands):
    start(settings=("64:800",), qualities=("draft",), methods=("thermoxels", "plenoxels-t"))
    typed = [" ".join(call) for call in commands.calls() if call[0] == "ns-train"]
    at = schedule_for(64, 800)
    refine, prune, thin = (" ".join(map(str, steps)) for steps in (at.refine_at, at.prune_at, at.thin_at))
    assert [" ".join(words.split()[:2]) for words in typed] == 2 * ["ns-train thermoxels"] + 2 * [
        "ns-train plenoxels-t"
    ]
    assert " --max-num-iterations 800 --optimizers.density.scheduler.max-steps 800" in typed[0]
    assert (
        f"--pipeline.model.resolutions 32 64 --pipeline.model.refine-at {refine} --pipeline.model.prune-at " in typed[0]
    )
    assert f"--pipeline.model.prune-at {prune} --pipeline.model.thin-at {thin} " in typed[0]
    assert typed[0].endswith(f"--pipeline.model.view-dependence-from {at.view_dependence_from}")
    assert typed[1].endswith(" --quality draft") and typed[3].endswith(" --quality draft")


@pytest.mark.parametrize(
    ("options", "name"),
    [
        *(({"settings": (text,)}, "settings") for text in ("64", "0:800", "64:0", "64:8e2", "64:800:2", " 64:800", "")),
        ({"settings": (), "qualities": ()}, "settings"),
        ({"methods": ()}, "methods"),
        ({"target_mae": math.nan}, "target_mae"),
        ({"scene": Path("nowhere")}, "scene"),
    ],
)
def test_options_that_cannot_work_are_refused_before_anything_runs(start, commands, options, name):
    with pytest.raises(ThermoxelsError, match=f"^{name}: expected"):
        start(**options)
    assert commands.calls() == []


def test_figures_of_the_runs_reach_the_table_and_models_go(start, scene, tmp_path, commands):
    shown = start(methods=("thermoxels", "plenoxels-t"), target_mae=0.5)
    folder = tmp_path / "cost"
    small, large, other, _ = kept(tmp_path)
    assert (small["psnr"], large["psnr"], other["psnr"]) == (25, 40, None)
    assert (small["thermal_mae_c"], small["fscore_128"], small["half_transparent"]) == (0.8, 0.9, 0.02)
    assert small["seconds"] > 0
    assert (
        "| 32:100 | " in shown and " | 25.0 dB | 0.80 °C | 0.90 | 2.0% |" in shown and "| 64:400, plenoxels-t" in shown
    )
    assert "Cheapest setting with a thermal MAE of at most 0.5 °C: 64:400" in shown and "Train with: ns-train " in shown
    assert {path.name for path in folder.iterdir()} == {"cost.json", "logs", ".lock"}
    assert {path.name for path in (folder / "logs").iterdir()} >= {"32-100-train.log", "32-100-eval.log"}
    train, evaluate = map(" ".join, commands.calls()[:2])
    models = train.removeprefix(f"ns-train thermoxels --data {scene} --output-dir ").partition(" ")[0]
    assert Path(models).parent == folder
    assert evaluate.startswith(f"ns-eval --load-config {models}/32-100/thermoxels/run/config.yml --output-path ")


def test_finished_runs_are_not_run_again_and_an_interrupted_start_goes_on(start, commands, tmp_path):
    commands.write("ns-eval", NS_EVAL.replace("results =", "assert run['steps'] < 400\nresults =", 1))
    with pytest.raises(ThermoxelsError, match=r"(?s)^cost: .*64:400: ns-eval: expected exit status 0.*Assert"):
        start()
    assert len(kept(tmp_path)) == 1  # what was measured is kept all the same
    commands.calls()
    commands.write("ns-eval", NS_EVAL)
    shown = start()
    assert [call[0] for call in commands.calls()] == ["ns-train", "ns-eval"] and len(kept(tmp_path)) == 2
    assert "32:100 is in " in shown and "| 64:400 |" in shown
    before = (tmp_path / "cost" / "cost.json").read_text()
    assert "| 64:400 |" not in start(settings=("32:100",)) and commands.calls() == []
    assert (tmp_path / "cost" / "cost.json").read_text() == before
    (tmp_path / "cost" / "cost.json").write_text(before[:-9])
    with pytest.raises(ThermoxelsError, match=r"cost\.json: expected .*Remove the file"):
        start()


def test_the_command_line(commands, scene, tmp_path, capsys):
    words = ["cost", str(scene), "--output-dir", str(tmp_path / "c"), "--settings", "32:100", "--qualities"]
    words += ["--target-mae", "1"]
    assert cli.main(words) == 0
    assert "a thermal MAE of at most 1 °C: 32:100" in " ".join(capsys.readouterr().out.split())
    assert cli.main([*words[:5], "32"]) == 2
    assert "Error: settings: expected voxels and steps" in capsys.readouterr().err


def row(seconds: float, mae: float) -> dict:
    return {**dict.fromkeys(FIGURES), "training": "ns-train thermoxels", "seconds": seconds, "thermal_mae_c": mae}


FOUR = {"draft": row(10, 0.9), "standard": row(30, 0.35), "fine": row(60, 0.30), "odd": row(20, 0.32)}


def test_the_cheapest_setting_keeps_the_target_and_the_table_has_only_columns_with_figures():
    for target_mae, name in ((0.4, "odd"), (0.9, "draft"), (0.3, "fine")):  # a bound is kept where it is reached
        assert f"°C: {name}. " in cheapest(FOUR, target_mae)
    said = cheapest(FOUR, 0.1)
    assert said.startswith("No measured setting has ") and "--settings" in said
    lines = table_of({"draft": FOUR["draft"]})
    assert lines == ["| setting | ns-train | thermal MAE |", "|---|---:|---:|", "| draft | 10 s | 0.90 °C |"]
