"""The heat page says what is doubtful before it says any figure."""

from __future__ import annotations

from thermoxels_ns.reports.heat_report import HeatReport, Section, build_report


def test_doubts_stand_above_the_figures() -> None:
    report = HeatReport("House", "A body.", (("2,464 W", "heat loss"),), (Section("Answers"),), ("No rooms <here>.",))
    page = build_report(report)
    order = [page.index(text) for text in ("Look at this first", "No rooms &lt;here&gt;.", "2,464 W", "Answers")]
    assert order == sorted(order)


def test_a_page_without_doubts_has_no_heading_for_them() -> None:
    assert "Look at this first" not in build_report(HeatReport("House", "A body.", (), ()))
