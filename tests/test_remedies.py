import ast
import contextlib
import io
import re
from copy import deepcopy
from pathlib import Path

import pytest
import tyro
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion, all_methods

import thermoxels_ns
from thermoxels_ns import cli
from thermoxels_ns.commands.export import ExportThermoxelsMesh
from thermoxels_ns.commands.train_help import TASKS, print_first_page
from thermoxels_ns.config import thermoxels
from thermoxels_ns.core.config_loader import typed
from thermoxels_ns.nerfstudio_bridge import METHODS, _with_dataparser_last

PACKAGE = Path(thermoxels_ns.__file__).parent
OPTION = re.compile(r"(?<![\\w-])--[a-z][a-z0-9.-]*[a-z0-9]")
ELSEWHERE = {"--output-path", "--use-sfm-depth", "--jaxtyping-packages"}
"""Options of commands that are not ours."""


def advice() -> set[tuple[str, str]]:
    """Options in remedies, with the file."""
    found = set()
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            keyword = isinstance(node, ast.keyword) and node.arg == "remedy"
            named = isinstance(node, ast.Assign) and "remedy" in "".join(map(ast.unparse, node.targets)).lower()
            for part in ast.walk(node) if keyword or named else ():
                if isinstance(part, ast.Constant) and isinstance(part.value, str):
                    found |= {(option, path.name) for option in OPTION.findall(part.value)}
    return found


def options_of(command, words: list[str], **more) -> set[str]:
    shown = io.StringIO()
    with contextlib.redirect_stdout(shown), pytest.raises(SystemExit):
        tyro.cli(command, args=[*words, "--help"], config=(tyro.conf.FlagConversionOff,), **more)
    return set(OPTION.findall(shown.getvalue()))


def test_every_option_in_a_remedy_is_one_of_a_command(monkeypatch):
    monkeypatch.setenv("COLUMNS", "300")
    config = deepcopy(thermoxels.config)
    there = options_of(type(config), [], default=config) | options_of(type(config), ["thermal-data"], default=config)
    there |= options_of(ExportThermoxelsMesh, [])
    for name in ("capture", "demo", "synthetic", "cost", "heat", "audit", "batch", "split"):
        there |= options_of(cli.Commands, [name])
    advised = advice()
    assert len(advised) > 50
    assert sorted(pair for pair in advised if pair[0] not in there | ELSEWHERE) == []


def test_the_first_page_of_help_is_one_screen_of_options_that_there_are(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "300")
    config = deepcopy(thermoxels.config)
    there = options_of(type(config), [], default=config) | options_of(type(config), ["thermal-data"], default=config)
    named = {option for options in TASKS.values() for example in options for option in OPTION.findall(example)}
    assert len(named) > 15 and sorted(named - there) == []
    monkeypatch.setenv("COLUMNS", "100")
    print_first_page("thermoxels")
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 40 and len(next(iter(TASKS.values()))) == 5


@pytest.mark.parametrize(
    "advised",
    [
        "--missing-thermal skip",
        "--scene-box -1 -1 -1 1 1 1",
        "--eval-mode interval --eval-interval 2",
        "--downscale-factor=2",
        "--thermal_bounds -10 300",
    ],
)
@pytest.mark.parametrize("around", ["thermoxels {} --data S --vis tensorboard", "plenoxels-t --data S thermal-data {}"])
def test_advice_on_the_scene_may_stand_anywhere(advised, around):
    """The whole of ns-train's command line is parsed."""
    words = _with_dataparser_last(around.format(advised).split())
    parser = tyro.cli(AnnotatedBaseConfigUnion, args=words).pipeline.datamanager.dataparser
    assert (
        parser != all_methods["thermoxels"].pipeline.datamanager.dataparser and type(parser).__name__[:7] == "Thermal"
    )


@pytest.mark.parametrize(
    "words", ["", "nerfacto --downscale-factor 2", "thermoxels --data S", "thermoxels colmap --data S"]
)
def test_other_words_stay_where_they_are(words):
    assert _with_dataparser_last(words.split()) == words.split()


def test_our_methods_are_known_by_name():
    ours = {name for name, method in all_methods.items() if type(method).__module__.startswith("thermoxels_ns")}
    assert set(METHODS) == ours


def test_typed_options_are_found(monkeypatch):
    monkeypatch.setattr("sys.argv", ["ns-train", "--load_dir", "x", "--optimizers.sh.scheduler.max-steps=3"])
    assert typed("--load-dir") and typed("--optimizers.sh.scheduler") and not typed("--load-step")
