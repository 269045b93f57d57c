import dataclasses
import re
from dataclasses import dataclass, field

import pytest
import tyro
from nerfstudio.engine.trainer import TrainerConfig

from thermoxels_ns import cli
from thermoxels_ns.config import thermoxels
from thermoxels_ns.core.option_help import join_help_lines

LONG = "Every option's text is one paragraph here, however many lines it takes in the source: 12 of them, or more."


@dataclass
class Below:
    low: int = 1
    """Every option's text is one paragraph here,
    however many lines it takes in the source:
    12 of them, or more."""


@dataclass
class Options(Below):
    high: int = 2
    """Every option's text is one paragraph here, however many lines
    it takes in the source: 12 of them,

    or more."""
    bare: int = 3
    metres: float = field(default=1.0, metadata={"unit": "m"})
    """Length,
    [m]."""


def help_of(program: list[str], columns: int, monkeypatch, capsys) -> str:
    monkeypatch.setenv("COLUMNS", str(columns))
    with pytest.raises(SystemExit):
        cli.main([*program, "--help"])
    return capsys.readouterr().out


def words(text: str) -> str:
    """A help text as the terminal broke it, in one line."""
    return " ".join(re.sub(r"[│╭╮╰╯─]", " ", text).split())


def test_tyro_is_told_what_stands_below_the_fields_of_a_class(monkeypatch, capsys) -> None:
    join_help_lines(Options)
    join_help_lines(Options)
    assert {each.name: dict(each.metadata) for each in dataclasses.fields(Options)} == {
        "low": {},  # of a class that was not named and is not of the package
        "high": {"help": LONG.replace("or more", "\n\nor more").replace(" \n", "\n")},
        "bare": {},
        "metres": {"unit": "m", "help": "Length, [m]."},
    }
    monkeypatch.setenv("COLUMNS", "300")
    with pytest.raises(SystemExit):
        tyro.cli(Options, args=["--help"])
    shown = capsys.readouterr().out
    assert "however many lines it takes in the source: 12 of them," in shown
    assert "however many lines it takes in the source: 12 of them, or more" in words(shown)


@pytest.mark.parametrize("command", ["capture", "demo", "synthetic", "cost", "heat"])
def test_a_wide_terminal_shows_each_text_in_one_line(command, monkeypatch, capsys) -> None:
    shown = help_of([command], 1500, monkeypatch, capsys)
    kinds = {"capture": cli.Capture, "demo": cli.Demo, "synthetic": cli.Synthetic, "cost": cli.Cost, "heat": cli.Heat}
    texts = [each.metadata["help"] for each in dataclasses.fields(kinds[command]) if "help" in each.metadata]
    lines = shown.splitlines()
    assert texts and all(any(text in line for line in lines) for text in texts)


def test_a_narrow_terminal_shows_all_words(monkeypatch, capsys) -> None:
    text = next(each.metadata["help"] for each in dataclasses.fields(cli.Heat) if each.name == "tolerance")
    shown = help_of(["heat"], 60, monkeypatch, capsys)
    assert text in words(shown)
    assert max(map(len, shown.split("options")[-1].splitlines())) <= 60


def test_nerfstudios_own_texts_stay() -> None:
    """Also those of fields that our classes inherit from it; it has none of its own in the metadata of its fields."""
    config = thermoxels.config
    assert any("help" in each.metadata for each in dataclasses.fields(config.pipeline.model))  # ours are joined
    for kind in (TrainerConfig, type(config.machine)):
        assert [each.name for each in dataclasses.fields(kind) if "help" in each.metadata] == []
