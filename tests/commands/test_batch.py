import json
import os
import re
import signal
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import pytest

from thermoxels_ns.commands.batch import STAGES, Building, plan_of, read_list
from thermoxels_ns.core.errors import SceneError

STANDS_FOR = """#!/bin/sh
# Stands for all commands: says what it was asked, ends as the file PROGRAM.ends of its scene says, or writes results.
echo "$(basename "$0") $*"
for word in "$@"; do [ -d "$word" ] && scene="$word"; done
ends="${scene:-none}/$(basename "$0").ends"
if [ -s "$ends" ]; then
    status=$(head -n 1 "$ends"); sed -i 1d "$ends"
    if [ "$status" = wait ]; then touch "$scene/waits"; sleep 60; fi
    echo "Error: $(basename "$0"): what is wrong" >&2
    exit "$status"
fi
while [ $# -gt 0 ]; do
    case "$1" in
        --output-path) echo '{"results": {"psnr": 30.5, "fscore_128": 0.875}}' >"$2" ;;
        --output-dir) mkdir -p "$2"; [ "$(basename "$2")" = audit ] && cp "$ANSWERS" "$2/answers.json" ;;
    esac
    shift
done
exit 0
"""


CLUSTER = {  # Stands for SLURM: sbatch runs what it is given on this machine and keeps the job's status for sacct.
    "sbatch": """jobs="$(dirname "$0")/jobs"; mkdir -p "$jobs"; id=$(ls "$jobs" | wc -l)1
echo RUNNING >"$jobs/$id"; echo "$*" >>"$jobs.log"
for word in "$@"; do case "$word" in --wrap=*) what="${word#--wrap=}" ;; esac; done
( sh -c "${what:-$(cat)}" && echo COMPLETED >"$jobs/$id" || echo FAILED >"$jobs/$id" ) >"$jobs.out" 2>&1 &
echo $id""",
    "sacct": """cd "$(dirname "$0")/jobs" 2>/dev/null && for id in *; do echo "$id|$(cat $id)"; done""",
    "srun": """while [ "${1#-}" != "$1" ]; do shift; done; exec "$@\"""",
    "sinfo": "echo PARTITION; echo all",
    **dict.fromkeys(("scancel", "squeue", "scontrol", "sacctmgr", "sshare"), "exit 0"),
}


@pytest.fixture
def commands(tmp_path):
    """A Python beside which all commands are the script above, in an environment that finds our packages."""
    folder = tmp_path / "bin"
    folder.mkdir()
    (folder / "python").symlink_to(sys.executable)
    for name in ("ns-train", "ns-eval", "ns-export", "thermoxels"):
        (folder / name).write_text(STANDS_FOR)
        (folder / name).chmod(0o755)
    answers = tmp_path / "answers.json"
    loss = {"value": 812.0, "low": 700.0, "high": 950.0}
    answers.write_text(json.dumps({"whole": {"loss_w": loss}, "defects": [{"not_counted": ""}, {"not_counted": "x"}]}))
    return folder, {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "ANSWERS": str(answers)}


def listed(tmp_path: Path, **ends: str) -> Path:
    """A list of buildings, each with a scene folder, whose commands end as said: "train=2" or "train=3 3"."""
    lines = ["name,scene,conditions,train"]
    (tmp_path / "conditions.yaml").write_text("air: 0")
    for name, said in ends.items():
        (tmp_path / name).mkdir()
        for word in filter(None, said.split()):
            program, status = word.split("=")
            (tmp_path / name / f"ns-{program}.ends").write_text(status.replace(",", "\n") + "\n")
        lines.append(f"{name},{name},conditions.yaml,--quality draft")
    path = tmp_path / "list.csv"
    path.write_text("\n".join(lines))
    return path


def started(commands, *words: object) -> subprocess.Popen[str]:
    folder, environment = commands
    call = "import sys; from thermoxels_ns.cli import main; sys.exit(main(sys.argv[1:]))"
    return subprocess.Popen(
        [folder / "python", "-c", call, "batch", *map(str, words)],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )


needs_snakemake = pytest.mark.skipif(find_spec("snakemake") is None, reason="Snakemake is not installed")


@needs_snakemake
def test_a_batch_goes_on_past_what_fails_and_from_where_it_was(tmp_path, commands):
    path = listed(tmp_path, good="", wrong="train=2", hungry="train=3", broken="train=1,1")
    out = tmp_path / "out"
    said, _ = (first := started(commands, path, "--output-dir", out)).communicate(timeout=120)
    assert first.returncode == 2, said
    for name, finished in {"good": True, "hungry": True, "wrong": False, "broken": False}.items():
        assert (out / name / "audit.json").is_file() == finished, (name, said)
    statuses = {
        name: json.loads((out / name / "logs" / "model.failed.json").read_text())["status"]
        for name in ("wrong", "broken")
    }
    assert statuses == {"wrong": 2, "broken": 1}
    assert (tmp_path / "broken" / "ns-train.ends").read_text() == "1\n"  # a crash is not tried twice
    page = (out / "index.html").read_text()
    assert "2 finished, 2 not" in page and "model: Error: ns-train: what is wrong (input)" in page
    assert "(crash)" in page and "812" in page and "700 to 950" in page and page.count("<td>30.5</td>") == 2
    assert page.count("<td>0.88</td>") == 2 and page.count("<td></td>") >= 2  # no temperatures in these results
    assert "--quality draft" in (out / "good" / "logs" / "model.log").read_text()

    before = {file: file.stat().st_mtime_ns for file in (out / "good").glob("*.json")}
    for name in ("wrong", "broken"):
        (tmp_path / name / "ns-train.ends").unlink()
    said, _ = (again := started(commands, path, "--output-dir", out)).communicate(timeout=120)
    assert again.returncode == 0, said
    assert before == {file: file.stat().st_mtime_ns for file in (out / "good").glob("*.json")}
    assert "4 finished, 0 not" in (out / "index.html").read_text()

    # Another option trains that building again; its audit and page say nothing of before if it fails.
    path.write_text(path.read_text().replace("good,good,conditions.yaml,--quality draft", "good,good,,--quality high"))
    (tmp_path / "good" / "ns-train.ends").write_text("2\n")
    said, _ = (changed := started(commands, path, "--output-dir", out)).communicate(timeout=120)
    assert changed.returncode == 2, said
    assert "--quality high" in (out / "good" / "logs" / "model.log").read_text()
    page = (out / "index.html").read_text()
    assert "3 finished, 1 not" in page and "good/audit" not in page and page.count("700 to 950") == 3


@needs_snakemake
def test_a_batch_that_was_killed_goes_on(tmp_path, commands):
    path, out = listed(tmp_path, one="train=wait", other=""), tmp_path / "out"
    run = started(commands, path, "--output-dir", out)
    while not ((tmp_path / "one" / "waits").exists() and (out / "other" / "audit.json").exists()):
        assert run.poll() is None
        time.sleep(0.1)
    os.killpg(run.pid, signal.SIGKILL)
    run.communicate()
    assert not (out / "one" / "model.json").exists()
    said, _ = (again := started(commands, path, "--output-dir", out)).communicate(timeout=120)
    assert again.returncode == 0, said
    assert (out / "one" / "model.json").exists() and "2 finished" in (out / "index.html").read_text()

    # Changed conditions are audited again, and nothing else is done.
    before = {name: (out / "one" / f"{name}.json").stat().st_mtime_ns for name in ("model", "mesh", "audit")}
    (tmp_path / "conditions.yaml").write_text("air: 1")
    said, _ = (changed := started(commands, path, "--output-dir", out)).communicate(timeout=120)
    assert changed.returncode == 0, said
    after = {name: (out / "one" / f"{name}.json").stat().st_mtime_ns for name in before}
    assert [name for name in before if after[name] != before[name]] == ["audit"]


@needs_snakemake
def test_a_dry_run_says_what_each_stage_asks_for(tmp_path, commands):
    path, out = listed(tmp_path, one="", other=""), tmp_path / "out"
    said, _ = (run := started(commands, path, "--output-dir", out, "--dry-run", "True")).communicate(timeout=120)
    assert run.returncode == 0, said
    for stage in ("model", "scores", "mesh", "audit"):
        assert said.count(f"rule {stage}:") == 2, said
    assert f"mem_mb={STAGES['model'].memory_mb}" in said and "runtime=" in said
    assert not (out / "one").exists() and not (out / "index.html").exists()


@needs_snakemake
@pytest.mark.skipif(
    find_spec("snakemake_executor_plugin_slurm") is None,
    reason="Snakemake's plugin is not installed: pip install 'snakemake-executor-plugin-slurm<2.6'",
)
def test_stages_are_handed_to_a_cluster(tmp_path, commands):
    folder, environment = commands
    for name, does in CLUSTER.items():
        (folder / name).write_text(f"#!/bin/sh\n{does}\n")
        (folder / name).chmod(0o755)
    (tmp_path / "config.yaml").write_text("slurm-init-seconds-before-status-checks: 2\n")
    environment |= {"PATH": f"{folder}:{os.environ['PATH']}", "SNAKEMAKE_PROFILE": str(tmp_path), "USER": "auditor"}
    path, out = listed(tmp_path, hungry="train=3", wrong="train=2"), tmp_path / "out"
    said, _ = (run := started(commands, path, "--output-dir", out, "--executor", "slurm")).communicate(timeout=400)
    assert run.returncode == 2 and "1 finished, 1 not" in (out / "index.html").read_text(), said
    asked = (folder / "jobs.log").read_text()  # what ran out of memory asks for twice as much
    for attempt in (1, 2):
        asks = f"-t {attempt * STAGES['model'].minutes} --mem {attempt * STAGES['model'].memory_mb} "
        assert re.search(f"rule_model_wildcards_hungry .*{asks}.*--cpus-per-task={STAGES['model'].threads} ", asked), (
            asked
        )


def test_what_is_not_asked_for_is_no_stage():
    plan = plan_of(Building("a", photographs="card"), Path("a"))
    assert list(plan) == ["scene", "model", "scores", "mesh"]
    assert plan["scene"].command[:3] == ["thermoxels", "capture", "card"] and plan["model"].inputs == ["a/scene.json"]
    assert list(plan_of(Building("a", scene="s", heat="winter-night"), Path("a")))[-1] == "heat"
    told = Building("a", scene="s", conditions="/c.yaml", train="--layout colmap --thermal-bounds -5 42")
    audit = plan_of(told, Path("a"))["audit"]
    assert audit.command[6:11] == ["s", "--layout", "colmap", "--thermal-bounds", "-5"]
    assert audit.inputs == ["a/mesh.json", "/c.yaml"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("name,scene\n", "no building"),
        ("scene\n.\n", "no column 'name'"),
        ("name,scene,colour\na,.,red\n", "unknown column 'colour'"),
        ("name,scene\na b,.\n", "line 2: name 'a b' is not of letters"),
        ("name,scene\na,.\na,.\n", "line 3: name 'a' is there twice"),
        ("name,scene\na,nowhere\n", "line 2: scene: no .*nowhere"),
        ("name,scene,photographs\na,.,.\n", "line 2: needs either"),
        ("name,scene\na\n", "line 2: needs either"),
        ("name,scene\na,.,b\n", "line 2: more entries than columns"),
        ("name,scene,scene\na,.,.\n", "column 'scene' twice"),
        ("name,scene,heat\n\na,.,winter-nigth\n", "line 3: heat: 'winter-nigth' is neither"),
        ("name,scene,heat\na,.,none.yaml\n", "line 2: heat: no .*none.yaml"),
        ("name,scene,conditions\na,.,.\n", "line 2: conditions: no "),
        ("name,scene,train\na,.,--x 'y\n", "line 2: train: No closing quotation"),
        ("name,scene\n../a,nowhere\n", r"(?s)no .*nowhere.*name '\.\./a'"),
    ],
)
def test_a_wrong_list_is_refused_with_all_its_mistakes(tmp_path, text, said):
    path = tmp_path / "list.csv"
    path.write_text(text)
    with pytest.raises(SceneError, match=said):
        read_list(path)
    with pytest.raises(SceneError, match="csv file"):
        read_list(tmp_path / "none.csv")
