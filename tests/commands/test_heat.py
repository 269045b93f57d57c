import csv
import json
import re
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import pyvista as pv
import tyro

from tests.support.heat_bodies import room, tagged_body, wall
from tests.support.unreadable import contents, files_end_after
from thermoxels_ns import cli
from thermoxels_ns.commands.heat import Heat, compute_heat, resistances_of_audit, run_heat
from thermoxels_ns.commands.installed_commands import command_of
from thermoxels_ns.core.errors import HeatError, OutputError, ThermoxelsError
from thermoxels_ns.fem.linear_tets import refine_mesh
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.heat.run import place_probes
from thermoxels_ns.heat.scene import load_heat_scene
from thermoxels_ns.mesh.files.formats import write_mesh
from thermoxels_ns.mesh.files.vtu import read_mesh
from thermoxels_ns.reports.mesh_pictures import HEAT_PICTURES, cut_open

TRANSIENT = """
description: A <script>cold</script> & windy hour
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
PROBES = ["--probes", "0.5", "2", "2", "3.9", "2", "0.1"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """An exported room, an exported wall, and two scenes."""
    folder = tmp_path_factory.mktemp("heat")
    named = replace(wall(), region_names=("<script>", "slab"))
    for name, mesh in (("room", room()), ("wall", named)):
        (folder / name).mkdir()
        write_mesh(folder / name / "mesh.vtu", mesh)
    (folder / "hour.yaml").write_text(TRANSIENT)
    (folder / "steady.yaml").write_text(STEADY)
    return folder


@pytest.fixture(scope="module")
def hour(folder) -> Path:
    """Results of the transient scene."""
    words = ["heat", str(folder / "room" / "mesh.vtu"), "--scene", str(folder / "hour.yaml")]
    assert cli.main([*words, "--output-dir", str(folder / "hour"), *PROBES]) == 0
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
    assert sorted(path.name for path in (folder / "u").iterdir()) == [
        *("answers.json", "heat.vtu", "report.html", "series.csv")
    ]
    page = (folder / "u" / "report.html").read_text()
    assert f"{u:.2f} W/(m" in page and "Nothing was left out" in page
    assert "&lt;script&gt;" in page and "<script" not in page
    # What the reader asked stands first, how it was solved last.
    assert page.index("W, all by convection on exterior-") < page.index("The inner surface is coldest at")
    assert re.findall(r"<h2>(.*?)</h2>", page) == [
        *("As a wall", "Answers", "What was asked", "Energy balance", "What was built and left out", "How it was made")
    ]
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
    assert re.findall(r'timestep="([^"]*)"', index) == ["0.0", "3600.0"]
    last = pv.read(hour / "heat" / "step-0001.vtu")
    assert last.point_data["temperature_c"].min() == float(table[-1][1])
    assert found["coldest"]["temperature_c"] <= float(table[-1][1]) < 15.0
    balance = found["balance"]
    assert abs(balance["residual"]) < 1e-9 * (balance["into_body"] + balance["out_of_body"])
    (left,) = found["left_out"]  # what does not matter
    assert left["effect"] == "radiation on exterior-up" and left["heat_w"] > 0.0 and 0.0 < left["share"] <= 0.005
    assert found["newton_iterations"] == 0
    assert found["built"] == ["convection on interior-*", "convection on exterior-*", "internal heat on solid"]


def test_the_report_is_one_page_that_fetches_nothing(hour) -> None:
    page = (hour / "report.html").read_text()
    assert page.startswith("<!doctype html>") and "<script" not in page
    assert "A &lt;script&gt;cold&lt;/script&gt; &amp; windy hour" in page
    sources = re.findall(r'(?:src|href)="([^"#]{0,30})', page)
    assert len([s for s in sources if s.startswith("data:image/png;base64,")]) == 2
    assert all(source == "" or source.startswith("data:image/png;base64,") for source in sources)  # "": in the page
    assert page.count("<svg") == 1 and "url(http" not in page
    for words in ("What was asked", "What was built and left out", "Energy balance", "exterior-side", "Over time"):
        assert words in page
    assert "radiation on exterior-up" in page  # left out
    assert (hour / HEAT_PICTURES[1]).stat().st_size > 10_000


@pytest.mark.parametrize(
    ("size_bytes", "broken"),
    [(450, "series.csv"), (1000, "step-0000.vtu"), (15_000, "surface-end.png"), (200_000, "report.html")],
)
def test_a_full_disk_is_one_line_and_leaves_no_half_of_a_file(folder, hour, tmp_path, capsys, size_bytes, broken):
    shutil.copytree(hour, tmp_path / "out")
    (tmp_path / "out" / "mine.txt").write_text("mine")
    whole = contents(tmp_path / "out")
    words = ["heat", str(folder / "room" / "mesh.vtu"), "--scene", str(folder / "hour.yaml"), *PROBES]
    capsys.readouterr()
    with files_end_after(size_bytes):
        assert cli.main([*words, "--output-dir", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and broken in said and "space" in said, said
    left = contents(tmp_path / "out")
    assert left.pop("mine.txt") == b"mine" and set(left) < set(whole) - {"answers.json"}
    assert {name: whole[name] for name in left} == left  # the same again, whether they are old or new


def test_a_second_run_replaces_the_first(folder, hour) -> None:
    steady = Heat(folder / "room" / "mesh.vtu", str(folder / "steady.yaml"), hour, pictures=False)
    before = {path.name for path in hour.iterdir()}
    assert {"heat.pvd", "heat", *HEAT_PICTURES} <= before
    run_heat(steady)
    assert sorted(path.name for path in hour.iterdir()) == ["answers.json", "heat.vtu", "report.html", "series.csv"]


@pytest.mark.parametrize("name", ["heat.pvd", "heat/step-0001.vtu", "report.html"])
def test_files_of_others_are_not_removed(folder, tmp_path, name) -> None:
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("mine")
    options = Heat(folder / "room" / "mesh.vtu", str(folder / "steady.yaml"), tmp_path, pictures=False)
    with pytest.raises(OutputError, match=f"got {name}"):
        run_heat(options)
    assert (tmp_path / name).read_text() == "mine"


def test_what_an_export_says_of_its_mesh_is_used(folder, tmp_path) -> None:
    write_mesh(tmp_path / "mesh.vtu", wall())
    options = Heat(tmp_path / "mesh.vtu", str(folder / "steady.yaml"), tmp_path / "out")
    shell = {"options": {"interior": "hollow", "wall_thickness": None}, "mesh": {"volume": 3.0, "area": 60.0}}
    (tmp_path / "summary.json").write_text(json.dumps({"length_unit": "m", "up": [0, 2, 0], **shell}))
    run = compute_heat(options)
    assert run.problem.up == (0.0, 1.0, 0.0)
    assert any(line.startswith("The mesh is a shell (--interior hollow), 0.1 m thick") for line in run.warnings)
    assert compute_heat(replace(options, up=(1.0, 0.0, 0.0))).problem.up == (1.0, 0.0, 0.0)
    lines: list[str] = []
    compute_heat(replace(options, mesh=folder / "wall" / "mesh.vtu"), lines.append)
    assert any("summary.json is missing; the mesh is taken to be in metres" in line for line in lines)


ROOM, WALL, HOUR = "room/mesh.vtu", "wall/mesh.vtu", "hour.yaml"


@pytest.mark.parametrize(
    ("mesh", "scene", "more", "summary", "name"),
    [
        (WALL, "steady.yaml", {}, {"length_unit": "input unit", "up": [0, 0, 1]}, "^scale of the mesh: expected"),
        (WALL, "steady.yaml", {}, [1, 2], "^.*summary.json: expected"),
        (WALL, "steady.yaml", {}, {"up": [0, 1]}, "^.*summary.json: up: expected"),
        (ROOM, HOUR, {"leave_out_below": -1.0}, None, "leave_out_below: expected"),
        (ROOM, HOUR, {"tolerance": 0.1, "leave_out_below": 0.1}, None, "leave_out_below: expected"),
        (ROOM, HOUR, {"memory_gb": 1e-5}, None, "memory of the heat problem: expected"),
        (ROOM, HOUR, {"probes": ((9.0, 9.0, 9.0),)}, None, "^probe 1: expected"),
    ],
)
def test_what_cannot_be_used_is_refused_and_leaves_the_old_results(folder, tmp_path, mesh, scene, more, summary, name):
    for path in (folder / mesh).parent.iterdir():
        shutil.copy(path, tmp_path)
    if summary is not None:
        (tmp_path / "summary.json").write_text(json.dumps(summary))
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "series.csv").write_text("old")  # marks results of this command
    with pytest.raises(ThermoxelsError, match=name):
        run_heat(Heat(tmp_path / "mesh.vtu", str(folder / scene), tmp_path / "out", **more))
    assert contents(tmp_path / "out") == {"series.csv": b"old"}


def test_bad_input_is_one_sentence_and_exit_status_1(folder, tmp_path, capsys) -> None:
    words = ["heat", str(folder / "room" / "mesh.vtu"), "--output-dir", str(tmp_path / "out")]
    assert cli.main([*words, "--scene", "summer-nite"]) == 2
    shown = capsys.readouterr().err.splitlines()
    assert len(shown) == 1 and shown[0].startswith("Error: heat scene: expected"), shown
    (tmp_path / "out" / "report.html").mkdir(parents=True)
    with pytest.raises(OutputError, match=r"^output folder: expected"):
        run_heat(Heat(folder / "wall" / "mesh.vtu", str(folder / "steady.yaml"), tmp_path / "out"))


def test_a_tolerance_is_met_on_a_finer_mesh_and_everything_is_that_of_it(folder) -> None:
    """The room's steady state to a tolerance that linear tetrahedra on its mesh are far from."""
    words = ["heat", str(folder / "room" / "mesh.vtu"), "--scene", str(folder / "steady.yaml"), "--pictures", "False"]
    words += ["--tolerance", "0.5", "--probes", "0.5", "2", "2"]
    assert cli.main([*words, "--output-dir", str(folder / "tolerated")]) == 0
    found = answers(folder / "tolerated")
    accuracy, levels = found["accuracy"], found["accuracy"]["levels"]
    assert accuracy["met"] is True and accuracy["estimated_k"] <= accuracy["tolerance_k"] == 0.5
    assert accuracy["order"] == 2 and accuracy["refinements"] >= 1 and len(levels) > 2
    assert [level["order"] for level in levels[:2]] == [1, 2] and all(level["seconds"] > 0.0 for level in levels)
    fine = given = read_mesh(folder / "room" / "mesh.vtu")
    for _ in range(accuracy["refinements"] + 1):
        fine = refine_mesh(fine)
    exact_c = solve_steady(load_heat_scene(str(folder / "steady.yaml")).problem(fine), order=2).temperature_c
    written = pv.read(folder / "tolerated" / "heat.vtu")
    assert written.n_points == found["solved"]["unknowns"] == len(fine.points_m) > found["solved"]["nodes"]
    error = np.abs(np.asarray(written.point_data["temperature_c"]) - exact_c)[: len(given.points_m)].max()
    assert error <= 0.5 and 1 / 3 < accuracy["estimated_k"] / error < 3
    assert found["probes"][0]["temperature_c"][0] == pytest.approx(
        float((place_probes(fine, [(0.5, 2.0, 2.0)]) @ exact_c)[0]), abs=0.5
    )
    assert found["coldest"]["temperature_c"] == pytest.approx(float(written.point_data["temperature_c"].min()))
    # Flows of quadratic tetrahedra agree by effect, by patch, by region and as a wall.
    into = {entry["effect"]: entry["heat_w"] for entry in found["effects"]}
    assert found["wall"]["heat_w"] == pytest.approx(into["convection on interior-*"], rel=1e-9)
    for flows in (found["patches"], found["regions"]):
        assert sum(one["heat_w"] for one in flows) == pytest.approx(0.0, abs=1e-6 * found["wall"]["heat_w"])
    page = (folder / "tolerated" / "report.html").read_text()
    assert "<h2>Accuracy</h2>" in page and "--tolerance 0.5" in page


def test_a_tolerance_in_time_keeps_the_scenes_times(folder, tmp_path) -> None:
    steps = TRANSIENT.replace("duration_s: 3600.0, tolerance_k: 0.05, outputs: 3", "steps: 3, step_seconds: 1200.0")
    (tmp_path / "hour.yaml").write_text(steps.split("radiation:")[0])
    options = Heat(folder / "wall" / "mesh.vtu", str(tmp_path / "hour.yaml"), tmp_path, tolerance=0.2, pictures=False)
    lines: list[str] = []
    run = run_heat(options, lines.append)
    found = answers(tmp_path)
    assert found["times_s"] == [0.0, 1200.0, 2400.0, 3600.0]
    assert run.accuracy is not None and run.accuracy.met and found["accuracy"]["step_tolerance_k"] > 0.0
    assert any(line.endswith(" at most.") and "needs about" in line for line in lines)
    assert any(line.startswith("Within 0.2 K") for line in lines)
    assert "in steps chosen by the tolerance" in (tmp_path / "report.html").read_text()


def test_a_tolerance_that_does_not_fit_is_said_and_written_if_allowed(folder, tmp_path) -> None:
    options = Heat(folder / "room" / "mesh.vtu", str(folder / "steady.yaml"), tmp_path, tolerance=1e-4, pictures=False)
    small = replace(options, memory_gb=0.003)
    with pytest.raises(HeatError, match="Not within"):
        run_heat(small)
    assert list(tmp_path.iterdir()) == []
    run_heat(replace(small, allow_unmet=True))
    assert answers(tmp_path)["accuracy"]["met"] is False
    page = (tmp_path / "report.html").read_text()
    assert "NOT within the tolerance" in page and "Not met: a tolerance of 0.0001 K." in page
    assert "--allow-unmet True" in page


def test_the_command_in_the_report_is_the_one_that_was_typed() -> None:
    options = Heat(
        Path("a b/mesh.vtu"),
        "winter-night",
        Path("out"),
        probes=((1234.5678, 0.12345678, -1234567.8),),
        tolerance=0.0123456789,
        pictures=False,
    )
    words = shlex.split(command_of("heat", options))
    assert words[:2] == ["thermoxels", "heat"]
    assert tyro.cli(Heat, args=words[2:], config=(tyro.conf.FlagConversionOff,)) == options


def test_no_u_value_where_more_than_two_airs_acts(folder, tmp_path) -> None:
    """40 W/m3 inside a wall of 0.2 m would make it 0.8 W/(m2 K) better than it is."""
    scene = STEADY + "internal_heat: [{regions: ['*'], source_w_m3: 40.0}]\n"
    (tmp_path / "warm.yaml").write_text(scene)
    options = Heat(folder / "wall" / "mesh.vtu", str(tmp_path / "warm.yaml"), tmp_path / "out", pictures=False)
    assert run_heat(options).wall is None
    page = (tmp_path / "out" / "report.html").read_text()
    assert "There is no U-value, because its heat would count in it: internal heat" in page
    assert answers(tmp_path / "out")["wall"] is None and "internal heat" in answers(tmp_path / "out")["no_wall"]


def test_a_cut_body_is_half_of_it() -> None:
    mesh = room()
    values = mesh.points_m @ np.array([1.0, 2.0, 3.0])
    points, facets, cut_c, view = cut_open(mesh, values, (0.0, 0.0, 1.0))
    np.testing.assert_allclose(cut_c, points @ np.array([1.0, 2.0, 3.0]), atol=1e-5)
    corner = points[facets]
    area = 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1).sum()
    # Back 16, cut 16 - 4, sides 4 x 8; of the room inside: back 4, sides 4 x 2.
    assert area == pytest.approx(16.0 + 12.0 + 32.0 + 4.0 + 8.0, rel=1e-5)
    assert np.ptp(points, axis=0).min() == pytest.approx(2.0) and view[2] < 0.0


def test_the_page_says_what_it_rests_on_and_has_no_headline_on_an_unfit_mesh(folder, hour, tmp_path) -> None:
    """A solid block has no rooms: what it would lose stands in no card, and the first lines say why."""
    solid = tagged_body(np.ones((3, 3, 3), dtype=bool), 1.0, np.pad(np.ones((5, 5, 4), bool), ((0, 0), (0, 0), (1, 0))))
    write_mesh(tmp_path / "mesh.vtu", solid)
    for mesh, fit in ((folder / "room" / "mesh.vtu", True), (tmp_path / "mesh.vtu", False)):
        run = run_heat(Heat(mesh, str(folder / "steady.yaml"), tmp_path / str(fit), pictures=False))
        page = (tmp_path / str(fit) / "report.html").read_text()
        assert (run.unfit == ()) == fit == ("class=cards" in page) == ("As a wall" in page)
        assert page.index("No measured temperature enters") < page.index("</header>") < page.index("Answers")
        assert fit or page.index("no rooms") < page.index("Answers")
    assert "No measured temperature" in (hour / "report.html").read_text()  # initial: {temperature_c: 15}


def test_an_example_of_a_scene_is_written_and_read(folder, tmp_path, capsys) -> None:
    words = ["heat", "--write-scene", str(tmp_path / "mine.yaml")]
    assert cli.main(words) == 0 and "pass it with --scene" in capsys.readouterr().out
    assert load_heat_scene(tmp_path / "mine.yaml") == load_heat_scene("all-effects")
    assert cli.main(words) == 2 and "a name that is free" in capsys.readouterr().err


def test_an_audits_resistances_become_layers(folder, tmp_path) -> None:
    """(20 - 5) K / 30 W/m2 = 0.5 m2 K/W behind the outer surface; a bound gives none, an inside audit is refused."""
    loss = {"value": 300.0, "low": 200.0, "high": 400.0}
    patch = {"name": "exterior-side", "area_m2": 10.0, "surface_c": {"value": 5.0}, "loss_w": loss}
    bound = {**patch, "name": "exterior-up", "loss_w": {**loss, "low": -1.0}}
    audit = {"conditions": {"side": "outside", "inside": {"air": {"value": 20.0}}}, "patches": [patch, bound]}
    path = tmp_path / "answers.json"
    path.write_text(json.dumps(audit))
    assert resistances_of_audit(path) == {"exterior-side": pytest.approx(0.5)}
    options = Heat(folder / "wall" / "mesh.vtu", str(folder / "steady.yaml"), tmp_path / "out", from_audit=path)
    run = run_heat(replace(options, pictures=False))
    assert run.wall is not None and run.wall.u_value_w_m2k == pytest.approx(1.0 / (0.5 + 1.0 / 25.0), rel=1e-9)
    (layer,) = answers(tmp_path / "out")["layers"]
    assert layer["layer_m2k_w"] == pytest.approx(0.5 - 1.0 / 7.7 - 0.2 / 0.8)
    for wrong in ({**audit, "conditions": {**audit["conditions"], "side": "inside"}}, {"patches": []}):
        path.write_text(json.dumps(wrong))
        with pytest.raises(HeatError, match=r"answers\.json: expected"):
            resistances_of_audit(path)
