import csv
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from thermoxels_ns.reports.cost_report import (
    FIGURES,
    CostRow,
    CostRun,
    CostSetting,
    cheapest,
    draw_plot,
    markdown_table,
    median_rows,
    pareto_front,
    verdict,
    write_csv,
    write_page,
)

NAN = math.nan
NOTHING = dict.fromkeys(FIGURES, NAN)


def setting(name: str, method: str = "thermoxels") -> CostSetting:
    return CostSetting(name, method, ("--quality", name))


def run(name: str, repeat: int = 1, **figures: float) -> CostRun:
    return CostRun(name, repeat, "scene", "1", "ns-train", {**NOTHING, **figures})


def rows(**by_name: tuple[float, float, float]) -> list[CostRow]:
    """Rows of (seconds, psnr, thermal MAE)."""
    names = list(by_name)
    runs = [run(n, seconds=s, psnr=p, thermal_mae_c=m) for n, (s, p, m) in by_name.items()]
    return median_rows([setting(n) for n in names], runs, names[-1])


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5)), min_size=1, max_size=12), st.booleans())
def test_every_point_off_the_front_is_beaten_by_one_on_it_and_none_on_it_is_beaten(points, higher):
    front = pareto_front([c for c, _ in points], [v for _, v in points], higher)

    def beats(a, b):
        better = a[1] >= b[1] if higher else a[1] <= b[1]
        return a[0] <= b[0] and better and a != b

    for point, on in zip(points, front):
        beaten = [other for other, other_on in zip(points, front) if other_on and beats(other, point)]
        assert bool(beaten) != on


def test_medians_and_ratios():
    runs = [run("a", n, seconds=s, psnr=p) for n, (s, p) in enumerate([(10, 20.0), (90, NAN), (12, 22.0)], 1)]
    runs += [run("b", seconds=6.0, psnr=19.0), run("not planned", seconds=1.0, psnr=99.0)]
    a, b = median_rows([setting("a"), setting("b"), setting("never ran")], runs, "b")
    assert (a.repeats, a.figures["seconds"], a.figures["psnr"], a.time_ratio) == (3, 12, 21.0, 2.0)
    assert (b.repeats, b.time_ratio) == (1, 1.0)
    assert math.isnan(a.figures["thermal_mae_c"])
    assert a.fronts == b.fronts == {"psnr"}


def test_the_cheapest_setting_keeps_all_targets():
    measured = rows(draft=(10, 25.0, 0.9), standard=(30, 31.0, 0.35), fine=(60, 33.0, 0.30), odd=(20, 20.0, 0.32))

    def name(**targets):
        best = cheapest(measured, targets)
        return best and best.setting.name

    assert name(thermal_mae_c=0.4) == "odd"
    assert name(psnr=25.0) == "draft"  # a bound is kept where it is reached
    assert name(thermal_mae_c=0.4, psnr=30.0) == "standard"
    assert name(thermal_mae_c=0.3, psnr=33.0) == "fine"
    assert name(thermal_mae_c=0.1) is None
    assert name(psnr=33.01) is None


def test_the_verdict_says_plainly_that_none_will_do():
    measured = rows(draft=(10, 25.0, 0.9), standard=(30, 31.0, 0.35))
    words = verdict(measured, {"psnr": 40.0}, "s")
    assert words.startswith("No measured setting has an RGB PSNR of at least 40 dB.")
    assert "MAE 0.35 °C (standard)" in words and "PSNR 31.0 dB (standard)" in words
    assert "--settings" in words


def test_the_table_has_only_columns_with_figures_and_marks_the_front():
    measured = rows(draft=(10, 25.0, 0.9), slow=(90, 24.0, 0.8), standard=(30, 31.0, 0.35))
    lines = markdown_table(measured, "standard").splitlines()
    assert lines[0] == "| setting | ns-train | time / standard | RGB PSNR | thermal MAE | Pareto front |"
    assert lines[2] == "| draft | 10 s | 0.33 | 25.0 dB | 0.90 °C | MAE, PSNR |"
    assert lines[3] == "| slow | 90 s | 3.00 | 24.0 dB | 0.80 °C |  |"
    assert len({line.count("|") for line in lines}) == 1


def test_the_csv_has_every_figure(tmp_path):
    measured = rows(draft=(10, 25.0, 0.9), standard=(30, 31.0, 0.35))
    write_csv(tmp_path / "cost.csv", measured, "standard")
    with (tmp_path / "cost.csv").open(newline="") as file:
        draft, standard = csv.DictReader(file)
    assert set(FIGURES) < set(draft)
    assert (draft["setting"], draft["seconds"], draft["fscore"], draft["baseline"]) == ("draft", "10", "", "standard")
    assert float(draft["time_ratio"]) == pytest.approx(1 / 3, rel=1e-4)
    assert (standard["front_psnr"], standard["training"]) == ("1", "ns-train thermoxels --quality standard")


@pytest.mark.parametrize("known_truth", [True, False])
def test_the_plot_has_a_panel_for_every_figure_there_is(tmp_path, known_truth):
    runs = [
        run(n, seconds=s, psnr=p, thermal_mae_c=m, peak_memory_gb=1.0, fscore_128=0.9 if known_truth else NAN)
        for n, s, p, m in [("draft", 10, 25.0, 0.9), ("standard", 30, 31.0, 0.35), ("odd", 20, NAN, 0.5)]
    ]
    measured = median_rows([setting(n) for n in ("draft", "standard", "odd")], runs, "standard")
    draw_plot(tmp_path / "cost.png", measured, {"thermal_mae_c": 0.4}, "a scene")
    with Image.open(tmp_path / "cost.png") as picture:
        assert picture.width > 1000 and picture.height > 1000
        right_end, legend = picture.width // 2 + picture.width // 10, picture.height - 100
        corner = picture.convert("L").crop((right_end, picture.height // 2 + 60, picture.width, legend))
        drawn = corner.getextrema()[0] < 128
    assert drawn == known_truth  # without an F-score there are three panels


def test_names_in_the_page_are_no_markup(tmp_path):
    write_page(tmp_path / "cost.md", ["| a | 1 |", "<script>alert(1)</script>: one run each"])
    assert (tmp_path / "cost.md").read_text() == "| a | 1 |\n\n&lt;script&gt;alert(1)&lt;/script&gt;: one run each\n"
