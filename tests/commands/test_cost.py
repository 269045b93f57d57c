import csv
import io
import json
import math
import types
from pathlib import Path

import pytest
from rich.console import Console

from thermoxels_ns import cli
from thermoxels_ns.commands.cost import (
    Cost,
    parse_setting,
    planned_settings,
    read_evaluation,
    read_runs,
    run_cost,
    scene_fingerprint,
    training_options,
    training_seconds,
)
from thermoxels_ns.core.errors import SceneError, ThermoxelsError
from thermoxels_ns.training.schedule import schedule_for

# A training takes `steps` / 100 seconds by its files' times; the evaluation improves with the steps.
NS_TRAIN = """
folder = value("--output-dir"), value("--experiment-name"), sys.argv[1], value("--timestamp")
run = pathlib.Path(*folder)
(run / "nerfstudio_models").mkdir(parents=True)
steps = int(value("--max-num-iterations", {"draft": 50, "standard": 200}.get(value("--quality"), 0)))
(run / "config.yml").write_text(json.dumps({"steps": steps, "method": sys.argv[1], "words": sys.argv[1:]}))
start, end = run / "dataparser_transforms.json", run / "nerfstudio_models" / "step-000000001.ckpt"
for path, when in ((start, 1000.0), (end, 1000.0 + steps / 100)):
    path.write_text("")
    os.utime(path, (when, when))
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
        console = Console(file=io.StringIO(), width=200)
        defaults = {"settings": ("32:100", "64:400"), "qualities": (), "warm_up": False}
        run_cost(Cost(scene, tmp_path / "cost", **(defaults | options)), console)
        assert isinstance(console.file, io.StringIO)
        return console.file.getvalue()

    return run


def table(folder: Path) -> dict[str, dict[str, str]]:
    with (folder / "cost.csv").open(newline="") as file:
        return {row["setting"]: row for row in csv.DictReader(file)}


def test_a_setting_becomes_the_options_of_its_schedule():
    assert parse_setting("64:800") == (64, 800)
    words = training_options(64, 800)
    text = " ".join(words)
    assert text.startswith("--max-num-iterations 800 --optimizers.density.scheduler.max-steps 800 ")
    schedule = schedule_for(64, 800)
    refine, prune, thin = (" ".join(map(str, at)) for at in (schedule.refine_at, schedule.prune_at, schedule.thin_at))
    assert f"--pipeline.model.resolutions 32 64 --pipeline.model.refine-at {refine} --pipeline.model.prune-at " in text
    assert f"--pipeline.model.prune-at {prune} --pipeline.model.thin-at {thin} " in text
    assert text.endswith(f"--pipeline.model.view-dependence-from {schedule.view_dependence_from}")
    assert all(" " not in word for word in words)


@pytest.mark.parametrize("text", ["64", "64:", ":800", "0:800", "64:0", "-64:800", "64:8e2", "64:800:2", " 64:800", ""])
def test_what_is_no_setting_is_refused(text):
    with pytest.raises(ThermoxelsError, match=r"settings: expected voxels and steps, such as 64:800"):
        parse_setting(text)


def test_the_rows_of_settings_qualities_methods_and_recipes():
    cost = Cost(
        Path("s"),
        settings=("32:100",),
        qualities=("draft", "standard"),
        methods=("thermoxels", "plenoxels-t"),
        recipes=("default", "paper"),
        train_options="--pipeline.model.seed 7",
    )
    rows, baseline = planned_settings(cost)
    assert baseline == "standard"
    assert {row.name: row.training for row in rows[1:]} == {
        "draft": "ns-train thermoxels --quality draft --pipeline.model.seed 7",
        "standard": "ns-train thermoxels --quality standard --pipeline.model.seed 7",
        "standard, plenoxels-t": "ns-train plenoxels-t --quality standard --pipeline.model.seed 7",
        "standard, recipe paper": (
            "ns-train thermoxels --quality standard --pipeline.model.recipe paper --pipeline.model.seed 7"
        ),
    }
    assert rows[0].training.startswith("ns-train thermoxels --max-num-iterations 100 ")
    assert len({row.file_name for row in rows}) == len(rows)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"settings": (), "qualities": ()}, "expected a setting or a quality"),
        ({"baseline": "best"}, r"baseline: expected one of 32:100, 64:400, got best"),
        ({"train_options": "'"}, "train_options: expected words as in a shell"),
        ({"repeats": 0}, "repeats: expected 1 or more, got 0"),
        ({"target_psnr": math.nan}, "target_psnr: expected a finite number above 0"),
    ],
)
def test_options_that_cannot_work_are_refused_before_anything_runs(start, commands, options, message):
    with pytest.raises(ThermoxelsError, match=message):
        start(**options)
    assert commands.calls() == []


def test_a_scene_that_is_not_there_is_named(tmp_path, commands):
    with pytest.raises(SceneError, match="scene: expected a scene folder, got none at"):
        run_cost(Cost(tmp_path / "nowhere", tmp_path / "cost", qualities=()), Console(file=io.StringIO()))


def test_figures_of_the_runs_reach_all_files(start, scene, tmp_path):
    shown = start(methods=("thermoxels", "plenoxels-t"), target_mae=0.5, target_psnr=30.0)
    folder = tmp_path / "cost"
    rows = table(folder)
    assert list(rows) == ["32:100", "64:400", "64:400, plenoxels-t"]
    small, large, other = rows.values()
    assert (float(small["training_seconds"]), float(large["training_seconds"])) == (1.0, 4.0)
    assert (float(small["psnr"]), float(large["psnr"]), other["psnr"]) == (25.0, 40.0, "")
    assert (small["thermal_mae_c"], small["fscore"], small["half_transparent"]) == ("0.8", "0.9", "0.02")
    assert float(small["seconds"]) > 0
    assert float(large["time_ratio"]) == 1.0 and large["baseline"] == "64:400"
    assert float(small["time_ratio"]) == pytest.approx(float(small["seconds"]) / float(large["seconds"]), rel=1e-4)
    page = (folder / "cost.md").read_text()
    assert page.startswith("| setting | training | ns-train | time / 64:400 | RGB PSNR | thermal MAE |")
    assert "scene [1] &lt;b&gt;: one run each" in page
    verdict = "Cheapest setting with a thermal MAE of at most 0.5 °C and an RGB PSNR of at least 30 dB: 64:400 "
    assert verdict in page and verdict in shown
    assert "| 32:100 | 1 s |" in shown
    assert (folder / "cost.png").stat().st_size > 10_000
    assert not any((folder / "models").iterdir())
    assert {path.name for path in (folder / "logs").iterdir()} >= {"32-100-1-train.log", "32-100-1-eval.log"}


def test_the_real_commands_get_what_they_need(start, scene, tmp_path, commands):
    start(settings=("64:400",), train_options="thermal-data --downscale-factor 2")
    train, evaluate = commands.calls()
    text = " ".join(train)
    assert text.startswith(f"ns-train thermoxels --data {scene} --output-dir {tmp_path / 'cost' / 'models'} ")
    assert " ".join(training_options(64, 400)) in text
    assert text.endswith("thermal-data --downscale-factor 2")
    config = tmp_path / "cost" / "models" / "64-400-1" / "thermoxels" / "run" / "config.yml"
    assert " ".join(evaluate).startswith(f"ns-eval --load-config {config} --output-path ")


def test_finished_runs_are_not_run_again(start, commands, tmp_path):
    start()
    before = (tmp_path / "cost" / "runs.csv").read_text()
    assert len(commands.calls()) == 4
    shown = start()
    assert commands.calls() == []
    assert (tmp_path / "cost" / "runs.csv").read_text() == before
    assert "2 of 2 runs are in" in shown and "| 64:400 |" in shown
    start(settings=("32:100", "48:200"))
    assert [call[0] for call in commands.calls()] == ["ns-train", "ns-eval"]
    assert list(table(tmp_path / "cost")) == ["32:100", "48:200"]
    assert [run.setting for run in read_runs(tmp_path / "cost" / "runs.csv")] == ["32:100", "64:400", "48:200"]
    start(again=True)
    assert len(commands.calls()) == 4
    assert sorted(run.setting for run in read_runs(tmp_path / "cost" / "runs.csv")) == ["32:100", "48:200", "64:400"]


@pytest.mark.parametrize("change", ["scene", "options"])
def test_runs_of_another_scene_or_with_other_options_do_not_count(start, commands, scene, change):
    start(settings=("32:100",))
    commands.calls()
    if change == "scene":
        (scene / "transforms.json").write_text("[]")
    start(settings=("32:100",), train_options="--pipeline.model.seed 1" if change == "options" else "")
    assert len(commands.calls()) == 2


def test_an_interrupted_start_goes_on_where_it_stopped(start, commands, tmp_path):
    commands.write("ns-eval", NS_EVAL.replace("results =", "assert run['steps'] < 400\nresults =", 1))
    with pytest.raises(ThermoxelsError, match=r"(?s)1 that did not.*64:400: ns-eval: expected exit status 0.*Assert"):
        start()
    # What was measured is reported all the same.
    assert list(table(tmp_path / "cost")) == ["32:100"]
    commands.calls()
    commands.write("ns-eval", NS_EVAL)
    start()
    assert [call[0] for call in commands.calls()] == ["ns-train", "ns-eval"]
    assert list(table(tmp_path / "cost")) == ["32:100", "64:400"]


def test_repeats_are_run_in_turns_and_their_medians_shown(start, commands, tmp_path):
    shown = start(repeats=3)
    steps = [call[call.index("--max-num-iterations") + 1] for call in commands.calls() if call[0] == "ns-train"]
    assert steps == ["100", "400"] * 3
    seconds = [r.figures["seconds"] for r in read_runs(tmp_path / "cost" / "runs.csv") if r.setting == "32:100"]
    row = table(tmp_path / "cost")["32:100"]
    assert row["repeats"] == "3"
    assert float(row["seconds"]) == pytest.approx(sorted(seconds)[1], rel=1e-5)
    assert "medians of 3 runs" in shown


def test_the_warm_up_is_the_first_setting_and_does_not_count(start, commands, tmp_path):
    start(settings=("32:100", "64:400"), qualities=("draft",), warm_up=True)
    trained = [call for call in commands.calls() if call[0] == "ns-train"]
    assert len(trained) == 4
    assert trained[0][trained[0].index("--max-num-iterations") + 1] == "100"
    assert len(read_runs(tmp_path / "cost" / "runs.csv")) == 3
    assert not any((tmp_path / "cost" / "models").iterdir())
    start(settings=("32:100", "64:400"), qualities=("draft",), warm_up=True)
    assert commands.calls() == []


def test_models_are_kept_on_request(start, tmp_path):
    start(settings=("32:100",), keep_models=True)
    assert (tmp_path / "cost" / "models" / "32-100-1" / "thermoxels" / "run" / "config.yml").is_file()


def test_a_damaged_list_of_runs_is_named(start, tmp_path):
    start(settings=("32:100",))
    path = tmp_path / "cost" / "runs.csv"
    for content in ("setting,repeat\n32:100,1\n", path.read_text().replace(",0.9,", ",much,"), "\0"):
        path.write_text(content)
        with pytest.raises(ThermoxelsError, match=r"runs\.csv: expected the finished runs of an earlier start"):
            start(settings=("32:100",))


def test_a_fingerprint_changes_with_files_and_json(scene):
    seen = {scene_fingerprint(scene)}
    (scene / "images").mkdir()
    (scene / "images" / "a.png").write_bytes(b"1234")
    seen.add(scene_fingerprint(scene))
    (scene / "images" / "a.png").write_bytes(b"12345")
    seen.add(scene_fingerprint(scene))
    (scene / "transforms.json").write_text("[]")  # as long as before
    seen.add(scene_fingerprint(scene))
    assert len(seen) == 4
    assert scene_fingerprint(scene) in seen


def test_runs_without_results_are_named(tmp_path):
    with pytest.raises(ThermoxelsError, match=r"expected dataparser_transforms\.json and a checkpoint"):
        training_seconds(tmp_path)
    with pytest.raises(ThermoxelsError, match="expected the results of ns-eval"):
        read_evaluation(tmp_path / "none.json")
    (tmp_path / "eval.json").write_text(json.dumps({"results": [1]}))
    with pytest.raises(ThermoxelsError, match="expected the results of ns-eval"):
        read_evaluation(tmp_path / "eval.json")


def test_the_command_line(commands, scene, tmp_path, capsys):
    words = ["cost", str(scene), "--output-dir", str(tmp_path / "c"), "--settings", "32:100", "--qualities"]
    words += ["--warm-up", "False", "--train-options=--pipeline.model.seed 3", "--target-psnr", "24"]
    assert cli.main(words) == 0
    assert "an RGB PSNR of at least 24 dB: 32:100" in " ".join(capsys.readouterr().out.split())
    assert commands.calls()[0][-2:] == ["--pipeline.model.seed", "3"]
    assert cli.main([*words[:5], "32"]) == 1
    assert "Error: settings: expected voxels and steps" in capsys.readouterr().err
