"""The weather before a survey, from csv and .epw files."""

import sys

import pytest
import yaml

from tests.support.epw_file import write_epw
from thermoxels_ns.audit.conditions import load_conditions
from thermoxels_ns.core.errors import AuditError
from thermoxels_ns.core.measured import Measured

TAKEN = """
side: outside
inside: {air: "weather ± 0,5 °C"}
outside: {air: weather +- 0.4 C, wind: weather +- 0.5 m/s}
surroundings: {sky: {cloud: weather, dew_point: weather +- 1 C}}
camera: {offset: 0 +- 1 K, repeatability: 0 +- 0.2 K}
surfaces: [{emissivity: 0.93 +- 0.02}]
weather: {file: weather.csv}
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
            {"weather": {"file": "weather.csv", "absorptance": "2"}},
            r"conditions\.yaml: weather: absorptance",
        ),
        (FILE, {"outside": {"air": "weather +- 0.4 C", "wind": "weather +- 2 km/h"}}, r"outside: wind"),
        (FILE, {"weather": None}, r"conditions\.yaml: inside: air"),
    ],
)
def test_weather_that_is_unfit_is_one_clear_error(conditions, file, changes, named) -> None:
    with pytest.raises(AuditError, match=rf"(?m)^{named}"):
        conditions(file, **changes)
