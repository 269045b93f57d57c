from __future__ import annotations

import pytest

from thermoxels_ns import heat_solving
from thermoxels_ns.fem.problem import AdaptiveSteps, TimeSteps


class Clock:
    """Stands still until it is told to go on."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def perf_counter(self) -> float:
        return self.now_s


@pytest.fixture
def clock(monkeypatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(heat_solving, "clock", clock)
    return clock


def test_the_first_step_tells_how_long_equal_steps_take(clock) -> None:
    lines: list[str] = []
    progress = heat_solving._Progress(lines.append, TimeSteps(100, 60.0))
    clock.now_s += 3.0
    progress(0.01, 1)
    assert lines == ["The first step took 3.0 s; at that pace about 5 min left."]
    for step in range(2, 12):
        clock.now_s += 2.0
        progress(0.01 * step, step)
    assert lines[1:] == [
        "5% of the time after 5 steps; about 3 min left.",
        "10% of the time after 10 steps; about 3 min left.",
    ]


def test_a_short_solution_says_nothing(clock) -> None:
    lines: list[str] = []
    progress = heat_solving._Progress(lines.append, TimeSteps(10, 60.0))
    for step in range(1, 11):
        clock.now_s += 0.1
        progress(0.1 * step, step)
    assert lines == []


def test_the_first_of_adaptive_steps_promises_nothing(clock) -> None:
    lines: list[str] = []
    progress = heat_solving._Progress(lines.append, AdaptiveSteps(3600.0))
    clock.now_s += 4.0
    progress(2e-5, 1)
    assert lines == ["The first step took 4.0 s, for 0.002% of the time."]


def test_the_next_solution_begins_when_the_last_one_has_ended(clock) -> None:
    """As to a tolerance, where one solution follows another."""
    lines: list[str] = []
    progress = heat_solving._Progress(lines.append, None)
    for step in range(1, 11):
        clock.now_s += 0.9
        progress(0.1 * step, step)
    clock.now_s += 2.0
    progress(0.1, 1)
    clock.now_s += 10.0
    progress(0.5, 2)
    assert lines == [
        "The first step took 2.0 s, for 10% of the time.",
        "50% of the time after 2 steps; about 12 s left.",
    ]


def test_what_is_left_of_adaptive_steps_is_told_by_the_last_ones(clock) -> None:
    """Ever longer steps: at the pace from the start on it would be 160 s where 44 s are left."""
    lines: list[str] = []
    progress = heat_solving._Progress(lines.append, AdaptiveSteps(3600.0))
    for step, share in enumerate((1e-4, 1e-3, 0.02, 0.2), 1):
        clock.now_s += 10.0
        progress(share, step)
    assert lines == [
        "The first step took 10.0 s, for 0.01% of the time.",
        "0.1% of the time after 2 steps; about 3.1 h left.",
        "2% of the time after 3 steps; about 9 min left.",
        "20% of the time after 4 steps; about 44 s left.",
    ]


def test_steps_too_short_to_count_are_no_progress(clock) -> None:
    """As those of a body without heat capacity, of which the share that is done does not change."""
    lines: list[str] = []
    progress = heat_solving._Progress(lines.append, AdaptiveSteps(3600.0))
    for step in range(2, 5):
        clock.now_s += 20.0
        progress(0.25, step)
    assert lines == ["25% of the time after 2 steps; about 60 s left."]
