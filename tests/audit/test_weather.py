"""The weather before a survey, from csv and .epw files, and what a wall still remembers of it."""

import sys
from dataclasses import replace

import numpy as np
import pytest
import yaml
from scipy.optimize import brentq

from tests.support.audited_wall import UP, audited_wall
from tests.support.epw_file import write_epw
from tests.support.heat_bodies import box_mesh
from thermoxels_ns.audit.conditions import load_conditions
from thermoxels_ns.audit.run import audit
from thermoxels_ns.audit.weather import remembered_share
from thermoxels_ns.core.errors import AuditError
from thermoxels_ns.core.measured import Measured
from thermoxels_ns.fem.problem import HeatProblem, TimeSteps, tabulated
from thermoxels_ns.fem.time_loop import SDIRK2, solve_heat
from thermoxels_ns.heat.effects import Convection
from thermoxels_ns.heat.materials import Material

TAKEN = """
side: outside
inside: {air: "weather ± 0,5 °C"}
outside: {air: weather +- 0.4 C, wind: weather +- 0.5 m/s}
surroundings: {sky: {cloud: weather, dew_point: weather +- 1 C}}
camera: {offset: 0 +- 1 K, repeatability: 0 +- 0.2 K}
surfaces: [{emissivity: 0.93 +- 0.02}]
weather: {file: weather.csv, time_constant: 12 +- 4 h}
"""
FILE = """hours,outside_c,inside_c,wind_m_s,cloud,dew_point_c,sun_w_m2
-48,5,20,1,0.5,-2,0
-12,9,21,1,0.5,-2,300
-2,3,20.5,1,0.5,-2,0
2,-1,20,2,0.3,-4,0
9,50,20,2,0.3,-4,0
"""


@pytest.fixture
def conditions(tmp_path):
    def load(file: str = FILE, **changes):
        (tmp_path / "weather.csv").write_text(file)
        (tmp_path / "conditions.yaml").write_text(yaml.safe_dump(yaml.safe_load(TAKEN) | changes))
        return load_conditions(tmp_path / "conditions.yaml")

    return load


def test_conditions_take_their_values_and_extremes_from_the_weather_at_the_survey(conditions) -> None:
    found = conditions()
    assert found.outside.air == Measured(1.0, 0.4) and found.inside.air == Measured(20.25, 0.5)
    assert found.outside.wind == Measured(1.5, 0.5) and found.surroundings.sky.cloud == Measured(0.4)
    assert found.surroundings.sky.dew_point == Measured(-3.0, 1.0) and found.film.model == "balance"
    assert (found.outside.lowest_24h.value, found.outside.highest_24h.value) == (1.0, 9.0)
    assert found.survey.hours_since_sun == Measured(12.0)


@pytest.mark.parametrize(("file", "too_late"), [(FILE, False), ("hours,outside_c,inside_c\n-9,8,20\n0,0,20\n", True)])
def test_an_audit_says_what_walls_remember_and_what_the_file_is_too_short_for(conditions, file, too_late) -> None:
    """It cools before the survey: the wall still gives off heat, the more the longer it remembers."""
    changes = {"surroundings": {"reflected": "0 C"}, "outside": {"air": "weather", "wind": "1 m/s"}}
    stated = conditions(file, **changes)
    mesh = audited_wall(0.3, slab=False, window=False)
    found = audit(replace(mesh, temperature_c=np.full(len(mesh.points_m), 3.0)), stated, UP)
    assert found.remembered is not None and 0.1 < found.remembered.low < found.remembered.value < found.remembered.high
    told = [one for one in found.check.doubts if "stores heat" in one or "too late" in one]
    assert len(told) == 1 + too_late and f"{100 * found.remembered.high:+.0f} %" in told[0]


def test_an_epw_file_of_the_year_of_the_survey_gives_its_weather(conditions, tmp_path) -> None:
    """Survey at noon of 10 January in Geneva, 228 hours after New Year; south walls get the most sun."""
    write_epw(tmp_path / "geneva.epw", lambda h: 0.05 * h - 10.0, hours=480)
    stated = {"survey": {"date": "2026-01-10T12:00:00+01:00"}, "inside": {"air": "20 C"}}
    found = conditions(weather={"file": "geneva.epw"}, **stated)
    assert found.outside.air.value == pytest.approx(0.05 * 228.0 - 10.0) and found.outside.wind.value == 2.0
    assert found.surroundings.sky.cloud.value == 0.5 and found.outside.lowest_24h.value == pytest.approx(0.2)
    suns = {
        facing: conditions(weather={"file": "geneva.epw", "facing": f"{facing} deg"}, **stated).history()["sun_w_m2"]
        for facing in (0, 180)
    }
    assert len(suns[0]) == 228 and suns[180].max() > 400.0 > 120.0 > suns[0].max() > 40.0
    assert found.history()["sun_w_m2"].max() < suns[180].max()
    night = found.history()["hours"] % 24.0 == 12.0  # midnight
    assert night.any() and not suns[180][night].any()


@pytest.mark.parametrize(
    ("date", "hours", "mixed"),
    [
        ("2025-01-10T12:00:00", 480, False),
        ("2026-03-10T12:00:00", 480, False),
        (None, 480, False),
        ("2026-02-10T12:00:00", 1440, True),
        ("2026-01-10T12:00:00", 0, False),
    ],
)
def test_an_epw_file_that_does_not_know_the_survey_is_one_clear_error(conditions, tmp_path, date, hours, mixed) -> None:
    write_epw(tmp_path / "geneva.epw", lambda h: 0.0, hours=hours, mixed_years=mixed)
    with pytest.raises(AuditError, match=r"^weather: file: .*geneva\.epw: expected [^\n]*$"):
        conditions(weather={"file": "geneva.epw"}, survey={"date": date} if date else {})


def test_without_pvlib_an_epw_file_asks_for_it(conditions, tmp_path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "pvlib", None)
    write_epw(tmp_path / "geneva.epw", lambda h: 0.0, hours=480)
    with pytest.raises(AuditError, match="pip install pvlib"):
        conditions(weather={"file": "geneva.epw"}, survey={"date": "2026-01-10T12:00:00"})


@pytest.mark.parametrize(
    ("file", "changes", "named"),
    [
        ("", {}, r"weather: file"),
        ("time,outside_c\n-1,2\n0,2\n", {}, r"weather: file"),
        ("hours,outside_c\n-1,2\n0,x\n", {}, r"weather: file"),
        ("hours,outside_c\n-1,2,3\n0,2,3\n", {}, r"weather: file"),
        ("hours,outside_c\n-1,2\n-0.5,2\n", {}, r"weather: file"),
        ("hours,outside_c\n-1,2\n0,2\n", {}, r"inside: air"),
        (FILE, {"weather": {"file": "none.csv"}}, r"weather: file"),
        (
            FILE,
            {"weather": {"file": "weather.csv", "time_constant": "0 h"}},
            r"conditions\.yaml: weather: time_constant",
        ),
        (FILE, {"outside": {"air": "weather +- 0.4 C", "wind": "weather +- 2 km/h"}}, r"outside: wind"),
        (FILE, {"weather": None}, r"conditions\.yaml: inside: air"),
    ],
)
def test_weather_that_is_unfit_is_one_clear_error(conditions, file, changes, named) -> None:
    with pytest.raises(AuditError, match=rf"(?m)^{named}"):
        conditions(file, **changes)


@pytest.mark.parametrize(
    ("outside_c", "inside_c"),
    [
        (lambda h: 5.0 * np.sin(2.0 * np.pi * h / 24.0 + 2.0), lambda h: 20.0 + 0.0 * h),
        (lambda h: 0.1 * h, lambda h: np.where(h < -8.0, 17.0, 20.0)),
    ],
)
def test_what_a_wall_remembers_is_what_its_heat_flow_differs_from_the_steady_one(outside_c, inside_c) -> None:
    """A wall of 1 m2 K/W, by finite elements; its time constant is that of the slowest mode, by its equation."""
    hours, conductivity, depth, capacity = np.linspace(-72.0, 0.0, 289), 0.3, 0.3, 0.9e6
    film_out, film_in = 1.0 / 0.04, 1.0 / 0.13

    def vanishes(x: float) -> float:
        return (x**2 * conductivity**2 / depth**2 - film_out * film_in) * np.sin(x) - x * conductivity / depth * (
            film_out + film_in
        ) * np.cos(x)

    x = brentq(vanishes, 1.6, 3.1)
    time_constant_h = depth**2 * capacity / conductivity / x**2 / 3600.0
    series = {"hours": hours, "outside_c": outside_c(hours), "inside_c": inside_c(hours)}
    begin = (series["inside_c"][0] - series["outside_c"][0]) / 1.17
    mesh = box_mesh(np.linspace(0.0, depth, 41), [0.0, 0.1], [0.0, 0.1])
    start_c = series["outside_c"][0] + begin * (0.04 + mesh.points_m[:, 0] / conductivity)
    airs = [tabulated(3600.0 * (hours + 72.0), series[name]) for name in ("outside_c", "inside_c")]
    effects = (Convection(("x0",), film_out, airs[0]), Convection(("x1",), film_in, airs[1]))
    problem = HeatProblem(mesh, Material("wall", conductivity, 1000.0, capacity / 1000.0), start_c, effects)
    end_c = solve_heat(problem, TimeSteps(720, 360.0), scheme=SDIRK2).temperature_c[-1]
    difference_k = float(20.0 - series["outside_c"][-1])
    for inside, film, at, air_c in ((False, film_out, 0.0, series["outside_c"][-1]), (True, -film_in, depth, 20.0)):
        found = remembered_share(series, difference_k, time_constant_h, 0.6, inside)
        exact = film * (end_c[mesh.points_m[:, 0] == at].mean() - air_c) * 1.17 / difference_k - 1.0
        assert found == pytest.approx(exact, abs=0.01) and abs(exact) > 0.01
