"""The command `thermoxels heat`: from the files of an export to answers, a series, pictures and a report."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import pyvista as pv

from tests.scene_bodies import room, wall
from thermoxels_ns import cli
from thermoxels_ns.errors import HeatError, OutputError, ThermoxelsError
from thermoxels_ns.heat_command import Heat
from thermoxels_ns.heat_pictures import PICTURES, cut_open, plot_over_time
from thermoxels_ns.heat_report import HeatReport, Section, Table, build_report
from thermoxels_ns.heat_run import compute_heat, run_heat
from thermoxels_ns.mesh.formats import write_mesh

TRANSIENT = """
description: A <cold> & windy hour
materials: {"*": concrete}
initial: {temperature_c: 15.0}
time: {duration_s: 3600.0, tolerance_k: 0.05, outputs: 3}
inside_air: {air_c: 20.0, coefficient: iso-6946-combined}
outside_air: {air_c: -5.0, coefficient: thermoxels-original, wind_m_s: 5.0}
radiation:
  - {patches: ["exterior-up"], emissivity: 1.0e-6, surroundings_c: -20.0}
internal_heat:
  - {regions: [solid], source_w_m3: 40.0}
"""
STEADY = """
materials: {"*": {conductivity_w_mk: 0.8, density_kg_m3: 1500.0, specific_heat_j_kgk: 900.0}}
steady: true
inside_air: {air_c: 20.0, coefficient_w_m2k: 7.7}
outside_air: {air_c: -10.0, coefficient_w_m2k: 25.0}
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """An exported room, an exported wall, and two scenes."""
    folder = tmp_path_factory.mktemp("heat")
    for name, mesh in (("room", room()), ("wall", wall())):
        (folder / name).mkdir()
        write_mesh(folder / name / "mesh.vtu", mesh)
    (folder / "hour.yaml").write_text(TRANSIENT)
    (folder / "steady.yaml").write_text(STEADY)
    return folder


@pytest.fixture(scope="module")
def hour(folder) -> Path:
    """Results of the transient scene."""
    words = ["heat", str(folder / "room" / "mesh.vtu"), "--scene", str(folder / "hour.yaml")]
    probes = ["--probes", "0.5", "2", "2", "3.9", "2", "0.1"]
    assert cli.main([*words, "--output-dir", str(folder / "hour"), *probes]) == 0
    return folder / "hour"


def answers(folder: Path) -> dict:
    return json.loads((folder / "answers.json").read_text())


def test_the_u_value_of_an_exported_wall(folder, capsys) -> None:
    """1 / (1/7.7 + 0.2/0.8 + 1/25) = 2.381689 W/(m2 K); f_Rsi = 1 - U / 7.7."""
    words = ["heat", str(folder / "wall" / "mesh.vtu"), "--scene", str(folder / "steady.yaml"), "--pictures", "False"]
    assert cli.main([*words, "--output-dir", str(folder / "u")]) == 0
    found = answers(folder / "u")
    u = 1.0 / (1 / 7.7 + 0.2 / 0.8 + 1 / 25)
    assert found["wall"]["u_value_w_m2k"] == pytest.approx(u, rel=1e-9) and u == pytest.approx(2.381689, abs=1e-6)
    assert found["wall"]["temperature_factor"] == pytest.approx(1.0 - u / 7.7, rel=1e-9)
    assert found["steady"] is True and found["balance"]["unit"] == "W" and found["steps"] == 0
    assert "mass" not in found["assembled"] and "radiation" not in found["assembled"]
    assert sorted(path.name for path in (folder / "u").iterdir()) == [
        *("answers.json", "heat.vtu", "report.html", "series.csv")
    ]
    page = (folder / "u" / "report.html").read_text()
    assert f"{u:.3f} W/(m" in page and "Nothing could be left out" in page
    assert "Written to" in capsys.readouterr().out


def test_answers_series_and_temperatures_agree(hour) -> None:
    found = answers(hour)
    with (hour / "series.csv").open() as file:
        rows = list(csv.reader(file))
    head, table = rows[0], rows[1:]
    assert head[:6] == ["time_s", "min_c", "mean_c", "max_c", "probe 1 [C]", "probe 2 [C]"]
    assert [float(row[0]) for row in table] == found["times_s"] == [0.0, 1200.0, 2400.0, 3600.0]
    assert float(table[0][2]) == pytest.approx(15.0, abs=1e-12) and table[0][6] == ""
    for number, effect in enumerate(found["effects"]):
        flows = [float(row[6 + number]) for row in table[1:]]
        assert head[6 + number] == f"{effect['effect']} [W]"
        assert np.mean(flows) == pytest.approx(effect["heat_w"], rel=1e-12)
    assert [float(row[5]) for row in table] == found["probes"][1]["temperature_c"]
    index = (hour / "heat.pvd").read_text()
    assert re.findall(r'timestep="([^"]*)"', index) == ["0.0", "1200.0", "2400.0", "3600.0"]
    last = pv.read(hour / "heat" / "step-0003.vtu")
    assert last.point_data["temperature_c"].min() == float(table[-1][1])
    assert found["coldest"]["temperature_c"] <= float(table[-1][1]) < 15.0
    balance = found["balance"]
    assert abs(balance["residual"]) < 1e-9 * (balance["into_body"] + balance["out_of_body"])


def test_what_does_not_matter_is_left_out_and_said_so(hour) -> None:
    found = answers(hour)
    left = found["left_out"]
    assert [entry["effect"] for entry in left] == ["radiation on exterior-up"]
    assert 0.0 < left[0]["bound_k"] <= 0.01 and found["left_out_bound_k"] == left[0]["bound_k"]
    assert found["newton_iterations"] == 0 and "radiation" not in found["assembled"]
    assert [entry["effect"] for entry in found["built"]] == [
        *("convection on interior-*", "convection on exterior-*", "internal heat on solid")
    ]
    assert found["seconds_saved"] >= 0.0
    page = (hour / "report.html").read_text()
    assert "radiation on exterior-up" in page and left[0]["reason"] in page and "saved about" in page


def test_everything_is_built_at_a_tolerance_of_0(folder) -> None:
    mesh, scene = folder / "room" / "mesh.vtu", str(folder / "hour.yaml")
    run = compute_heat(Heat(mesh, scene, folder, leave_out_below_k=0.0))
    assert run.screening.left_out == () and len(run.answers.effects) == 4
    assert run.solution.assembled.counts["radiation"] > 0 and run.seconds_saved is None
    less = compute_heat(Heat(mesh, scene, folder))
    difference = np.abs(run.solution.temperature_c - less.solution.temperature_c).max()
    assert 0.0 < difference <= less.screening.bound_k + 1e-9


def test_the_report_is_one_page_that_fetches_nothing(hour) -> None:
    page = (hour / "report.html").read_text()
    assert page.startswith("<!doctype html>") and "<script" not in page
    assert "A &lt;cold&gt; &amp; windy hour" in page and "<cold>" not in page
    sources = re.findall(r'(?:src|href)="([^"#]{0,30})', page)
    assert len([s for s in sources if s.startswith("data:image/png;base64,")]) == 4
    assert all(source == "" or source.startswith("data:image/png;base64,") for source in sources)  # "": in the page
    assert page.count("<svg") == 1 and "url(http" not in page
    for words in ("What was asked", "What was built and left out", "Energy balance", "exterior-side", "Over time"):
        assert words in page
    assert (hour / PICTURES[3]).stat().st_size > 10_000


def test_a_second_run_replaces_the_first(folder, hour) -> None:
    steady = Heat(folder / "room" / "mesh.vtu", str(folder / "steady.yaml"), hour, pictures=False)
    before = {path.name for path in hour.iterdir()}
    assert {"heat.pvd", "heat", *PICTURES} <= before
    run_heat(steady)
    assert sorted(path.name for path in hour.iterdir()) == ["answers.json", "heat.vtu", "report.html", "series.csv"]


def test_a_failing_run_leaves_the_old_results(folder, tmp_path) -> None:
    options = Heat(folder / "wall" / "mesh.vtu", str(folder / "steady.yaml"), tmp_path, pictures=False)
    run_heat(options)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(HeatError, match="probe 1: expected a point inside the body"):
        run_heat(replace(options, probes=((9.0, 9.0, 9.0),)))
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_an_export_without_scale_is_refused_and_its_up_is_used(folder, tmp_path) -> None:
    write_mesh(tmp_path / "mesh.vtu", wall())
    options = Heat(tmp_path / "mesh.vtu", str(folder / "steady.yaml"), tmp_path / "out")
    (tmp_path / "summary.json").write_text(json.dumps({"length_unit": "input unit", "up": [0, 0, 1]}))
    with pytest.raises(HeatError, match=r"scale of the mesh: expected an export in metres.*--metres-per-unit"):
        compute_heat(options)
    (tmp_path / "summary.json").write_text(json.dumps({"length_unit": "m", "up": [0, 2, 0]}))
    assert compute_heat(options).problem.up == (0.0, 1.0, 0.0)
    assert compute_heat(replace(options, up=(1.0, 0.0, 0.0))).problem.up == (1.0, 0.0, 0.0)
    (tmp_path / "summary.json").write_text("{")
    with pytest.raises(ThermoxelsError, match="expected the summary of an export"):
        compute_heat(options)


def test_bad_input_is_one_sentence_and_exit_status_1(folder, tmp_path, capsys) -> None:
    words = ["heat", str(folder / "room" / "mesh.vtu"), "--output-dir", str(tmp_path / "out")]
    for more, message in (
        (["--scene", "summer-nite"], "heat scene: expected one of"),
        (["--scene", "original", "--leave-out-below-k", "-1"], "leave-out-below-k: expected a number of at least 0"),
    ):
        assert cli.main([*words, *more]) == 1
        shown = capsys.readouterr().err.splitlines()
        assert len(shown) == 1 and shown[0].startswith(f"Error: {message}"), shown
    (tmp_path / "out" / "report.html").mkdir(parents=True)
    with pytest.raises(OutputError, match=r"no folder in the place of a file.*got report\.html"):
        run_heat(Heat(folder / "wall" / "mesh.vtu", str(folder / "steady.yaml"), tmp_path / "out"))


def test_help_says_what_it_writes(capsys) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main(["heat", "--help"])
    assert stop.value.code == 0
    words = capsys.readouterr().out
    assert all(word in words for word in ("--scene", "--probes", "--leave-out-below-k", "report.html", "[K]"))


def test_a_cut_body_is_half_of_it() -> None:
    mesh = room()
    values = mesh.points_m @ np.array([1.0, 2.0, 3.0])
    half, cut_c, view = cut_open(mesh, values, (0.0, 0.0, 1.0))
    np.testing.assert_allclose(cut_c, half.points_m @ np.array([1.0, 2.0, 3.0]), atol=1e-5)
    corner = half.points_m[half.facets]
    area = 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1).sum()
    # Back 16, cut 16 - 4, sides 4 x 8; of the room inside: back 4, sides 4 x 2.
    assert area == pytest.approx(16.0 + 12.0 + 32.0 + 4.0 + 8.0, rel=1e-5)
    assert np.ptp(half.points_m, axis=0).min() == pytest.approx(2.0) and view[2] < 0.0


def test_the_plot_is_the_same_for_the_same_figures(folder) -> None:
    run = compute_heat(Heat(folder / "room" / "mesh.vtu", str(folder / "hour.yaml"), folder, ((0.5, 2.0, 2.0),)))
    first = plot_over_time(run.solution, run.mean_c, run.probes_c, ["middle"])
    assert first == plot_over_time(run.solution, run.mean_c, run.probes_c, ["middle"])
    assert first.startswith("<svg") and first.endswith("</svg>")


def test_pictures_that_are_none_are_refused() -> None:
    page = HeatReport("t", "s", (), (Section("p", pictures=((b"GIF89a", "a cat"),)),))
    with pytest.raises(ThermoxelsError, match="a cat: expected the content of a PNG file, got 6 bytes"):
        build_report(page)


def test_tables_without_rows_are_left_out() -> None:
    section = Section("one", tables=(Table(("a", "b"), ()), Table(("c", "d"), (("<1>", "2"),))))
    page = build_report(HeatReport("t", "s", (("3 W", "loss"),), (section,)))
    assert page.count("<table>") == 1 and "&lt;1&gt;" in page and "<strong>3 W</strong>" in page


def test_a_body_that_conducts_well_is_lumped_and_says_so(folder, tmp_path) -> None:
    copper = TRANSIENT.replace("concrete", "copper").replace("thermoxels-original, wind_m_s: 5.0", "iso-6946-combined")
    (tmp_path / "copper.yaml").write_text(copper.split("radiation:")[0].replace("-5.0", "15.5"))
    options = Heat(folder / "wall" / "mesh.vtu", str(tmp_path / "copper.yaml"), tmp_path / "out", pictures=False)
    run = run_heat(replace(options, leave_out_below_k=0.5))
    found = answers(tmp_path / "out")
    assert found["lumped_model"]["used"] is True and found["lumped_model"]["biot"] < 0.1 and found["steps"] == 0
    assert "lumped model" in found["status"] and "one temperature per connected piece, was used" in (
        (tmp_path / "out" / "report.html").read_text()
    )
    full = compute_heat(replace(options, leave_out_below_k=0.0))
    assert full.lumped is None and full.answers.status.startswith("All")
    difference = np.abs(full.solution.temperature_c - run.solution.temperature_c).max()
    assert difference <= found["lumped_model"]["bound_k"] + found["left_out_bound_k"] + 0.05
