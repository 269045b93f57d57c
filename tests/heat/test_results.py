import dataclasses
import json

import numpy as np
import pytest
import pyvista

from tests.support.heat_bodies import CONCRETE, box_mesh, planes
from thermoxels_ns.commands.heat import remove_heat_series, write_heat_series
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem, TimeSteps
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.time_loop import solve_heat
from thermoxels_ns.heat.effects import AbsorbedSolar, Convection, FixedTemperature, HeatFlux, InternalHeat, Radiation
from thermoxels_ns.heat.materials import Material
from thermoxels_ns.heat.results import heat_results, wall_result

BRICK, WOOL = Material("brick", 0.7, 1600.0, 940.0), Material("wool", 0.04, 30.0, 1030.0)


def two_walls() -> HeatProblem:
    """Side by side and 0.2 m thick: 1 m of brick and 3 m of wool with an insulated gap between them, 2 m high."""
    mesh = box_mesh(
        planes(0.0, 0.2, step=0.1),
        planes(0.0, 1.0, 1.5, 4.5, step=1.0),
        planes(0.0, 2.0, step=1.0),
        keep=lambda p: (p[..., 1] < 1.0) | (p[..., 1] > 1.5),
        regions={"brick": lambda p: p[..., 1] < 1.0, "wool": lambda p: p[..., 1] > 1.0},
    )
    effects = (Convection(("x0",), 8.0, 20.0), Convection(("x1",), 25.0, -10.0))
    return HeatProblem(mesh, {"brick": BRICK, "wool": WOOL}, effects=effects)


def test_u_values_and_the_worst_spot_of_two_walls_side_by_side() -> None:
    """U = 1 / (1/8 + 0.2/k + 1/25): 2.21878 of brick, 0.19361 of wool; f_Rsi = 1 - U / 8 at the worse one."""
    problem = two_walls()
    wall = wall_result(problem, solve_steady(problem), ("x0",), 20.0, -10.0)
    u = {name: 1.0 / (1 / 8 + 0.2 / k + 1 / 25) for name, k in (("brick", 0.7), ("wool", 0.04))}
    assert u == pytest.approx({"brick": 2.218700, "wool": 0.193611}, abs=1e-6)
    assert {part.name: part.u_value_w_m2k for part in wall.regions} == pytest.approx(u, rel=1e-9)
    assert {part.name: part.area_m2 for part in wall.regions} == pytest.approx({"brick": 2.0, "wool": 6.0})
    assert [(part.name, part.area_m2) for part in wall.patches] == [("x0", pytest.approx(8.0))]
    assert wall.u_value_w_m2k == pytest.approx((2.0 * u["brick"] + 6.0 * u["wool"]) / 8.0, rel=1e-9)
    assert wall.coupling_w_k == pytest.approx(8.0 * wall.u_value_w_m2k, rel=1e-9)
    assert wall.heat_w == pytest.approx(30.0 * wall.coupling_w_k, rel=1e-12)
    assert wall.temperature_factor == pytest.approx(1.0 - u["brick"] / 8.0, rel=1e-9)
    assert wall.coldest.point_m[0] == 0.0 and wall.coldest.point_m[1] <= 1.0 and wall.coldest.patches[0] == "x0"
    # Of a cooled room the warmest spot is the worst.
    effects = (Convection(("x0",), 8.0, 5.0), Convection(("x1",), 25.0, 35.0))
    problem = dataclasses.replace(problem, effects=effects)
    wall = wall_result(problem, solve_steady(problem), ("x0",), 5.0, 35.0)
    assert wall.temperature_factor == pytest.approx(1.0 - u["brick"] / 8.0, rel=1e-9)
    assert wall.coldest.temperature_c == pytest.approx(5.0 + 30.0 * u["brick"] / 8.0, rel=1e-9)
    assert wall.coldest.point_m[1] <= 1.0 and wall.heat_w < 0.0


def test_heat_by_patch_effect_and_region_of_a_steady_state() -> None:
    problem = two_walls()
    results = heat_results(problem, solve_steady(problem))
    patches = {result.patch: result for result in results.patches}
    through = 30.0 * (2.0 * 2.2187005 + 6.0 * 0.1936108)
    assert [patches["x0"].heat_w, patches["x1"].heat_w] == pytest.approx([through, -through], rel=1e-6)
    assert patches["x1"].heat_w_m2 == pytest.approx(-through / 8.0, rel=1e-6)
    assert patches["other"].heat_w == 0.0 and patches["x0"].last_heat_w == patches["x0"].heat_w
    assert [effect.area_m2 for effect in results.effects] == pytest.approx([8.0, 8.0])
    assert results.effects[1].groups == pytest.approx({"x1": -through}, rel=1e-6)
    regions = {result.region: result for result in results.regions}
    # What comes in through brick leaves through brick.
    assert [regions["brick"].heat_w, regions["wool"].heat_w] == pytest.approx([0.0, 0.0], abs=1e-8)
    assert [regions["brick"].volume_m3, regions["wool"].volume_m3] == pytest.approx([0.4, 1.2])
    assert [regions["brick"].material, regions["wool"].material] == ["brick", "wool"]
    # Temperature is linear across each wall: its mean is that of its sides.
    flux = 30.0 * 0.1936108
    assert regions["wool"].mean_c == pytest.approx(0.5 * (20.0 - flux / 8.0 - 10.0 + flux / 25.0), abs=1e-5)
    balance = results.balance
    assert (balance.unit, balance.stored) == ("W", 0.0) and balance.into_body == pytest.approx(through, rel=1e-6)
    assert abs(balance.residual) < 1e-9 * through and balance.relative_residual < 1e-10
    assert json.loads(json.dumps(dataclasses.asdict(results)))["patches"][0]["patch"] == "x0"


@pytest.mark.parametrize("time", [TimeSteps(6, 600.0), AdaptiveSteps(3600.0, 0.1, outputs=6)])
def test_energy_balance_through_time(time) -> None:
    axes = planes(0.0, 0.3, step=0.1), [0.0, 0.2, 0.4], [0.0, 0.3]
    mesh = box_mesh(*axes, temperature_c=lambda p: 10.0 + 30.0 * p[:, 0])
    effects = (
        Convection(("x0",), 8.0, 20.0),
        Radiation(("x1",), 0.9, -20.0),
        AbsorbedSolar(("x1",), 0.5, 300.0),
        HeatFlux(("y0",), -15.0),
        FixedTemperature(("z0",), 12.0),
        InternalHeat(("*",), 500.0),
    )
    problem = HeatProblem(mesh, CONCRETE, effects=effects)
    solution = solve_heat(problem, time)
    results = heat_results(problem, solution)
    balance, duration = results.balance, 3600.0
    exchanged = balance.into_body + balance.out_of_body
    assert balance.unit == "J" and abs(balance.residual) < 1e-9 * exchanged
    assert balance.into_body > 1e3 and balance.out_of_body > 1e3
    assert balance.stored == pytest.approx(duration * sum(effect.heat_w for effect in results.effects), rel=1e-9)
    surface = sum(effect.heat_w for effect in results.effects if effect.area_m2 is not None)
    assert sum(patch.heat_w for patch in results.patches) == pytest.approx(surface, rel=1e-9)
    assert results.effects[5].area_m2 is None and results.effects[5].groups == pytest.approx({"solid": 500.0 * 0.036})
    assert results.effects[2].heat_w == pytest.approx(150.0 * 0.12)
    assert results.effects[2].area_m2 == pytest.approx(0.12)
    assert results.times_s[-1] == 3600.0 and len(results.times_s) == 7


def test_hottest_and_coldest_spots_are_where_they_are() -> None:
    mesh = box_mesh(planes(0.0, 0.4, step=0.1), [0.0, 0.1, 0.2], [0.0, 0.1, 0.2], temperature_c=20.0)
    corner = np.flatnonzero(np.all(mesh.points_m == [0.4, 0.2, 0.2], axis=1))[0]
    start = np.full(len(mesh.points_m), 20.0)
    start[corner] = 50.0
    problem = HeatProblem(mesh, CONCRETE, start, effects=(FixedTemperature(("x0",), 5.0),))
    results = heat_results(problem, solve_heat(problem, TimeSteps(3, 1e4)))
    assert results.hottest.temperature_c == 50.0 and results.hottest.node == corner
    assert results.hottest.point_m == (0.4, 0.2, 0.2) and results.hottest.patches == ("x1", "y1", "z1")
    assert results.hottest.time_s == 0.0
    assert results.coldest.temperature_c == 5.0 and results.coldest.patches[0] == "x0"
    last = {patch.patch: patch for patch in results.patches}
    assert last["x1"].hottest.time_s == 3e4 and last["x1"].hottest.temperature_c < 50.0
    assert last["x0"].mean_c == pytest.approx(5.0) and last["x1"].coldest.temperature_c > 5.0


def test_heat_of_triangles_agrees_with_the_heat_of_effects() -> None:
    mesh = box_mesh(planes(0.0, 0.3, step=0.1), planes(0.0, 0.2, step=0.1), planes(0.0, 0.2, step=0.1))
    effects = (
        Convection(("x0",), 8.0, 20.0),
        Radiation(("x1", "y0"), 0.9, -20.0),
        HeatFlux(("y1",), 40.0),
        FixedTemperature(("z0",), 12.0),
    )
    problem = HeatProblem(mesh, CONCRETE, effects=effects)
    solution = solve_steady(problem)

    of_triangles = dict(zip(mesh.boundary.patch_names, np.bincount(mesh.boundary.patch, solution.facet_heat_w)))
    of_effects = {one.patch: one.heat_w for one in heat_results(problem, solution).patches}
    assert len(of_effects) == 6
    assert {name: of_triangles[name] for name in of_effects} == pytest.approx(of_effects, rel=1e-9, abs=1e-9)


def test_an_insulated_body_has_results() -> None:
    mesh = box_mesh([0.0, 0.1], [0.0, 0.1], [0.0, 0.1], temperature_c=lambda p: 100.0 * p[:, 0])
    problem = HeatProblem(mesh, CONCRETE)
    results = heat_results(problem, solve_heat(problem, TimeSteps(2, 60.0)))
    assert results.effects == () and [patch.heat_w for patch in results.patches] == [0.0] * 6
    assert results.balance.into_body == results.balance.out_of_body == 0.0
    assert results.regions[0].mean_c == pytest.approx(5.0)


def test_a_series_reads_back_and_only_it_is_removed(tmp_path, random_body) -> None:
    solution = solve_heat(HeatProblem(random_body, CONCRETE), TimeSteps(3, 20.0))
    for states in ([0, 1, 2, 3], [0, 1, 3]):  # the second one is shorter
        write_heat_series(tmp_path / "heat.pvd", random_body, solution, states)
    names = sorted(path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file())
    assert names == ["heat.pvd", *(f"heat/step-{number:04d}.vtu" for number in range(3))]
    reader = pyvista.PVDReader(tmp_path / "heat.pvd")
    assert reader.time_values == [0.0, 20.0, 60.0]
    for number in (0, 1, 3):
        reader.set_active_time_value(solution.times_s[number])
        grid = reader.read()[0]
        np.testing.assert_array_equal(grid.point_data["temperature_c"], solution.temperature_c[number])
        np.testing.assert_array_equal(grid.points, random_body.points_m)
        assert grid.n_cells == len(random_body.tets)
    note = tmp_path / "heat" / "note.txt"
    note.write_text("mine")
    remove_heat_series(tmp_path / "heat.pvd")
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["note.txt"]
