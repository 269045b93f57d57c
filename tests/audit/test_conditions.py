from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from thermoxels_ns.audit.conditions import EXAMPLE, load_conditions
from thermoxels_ns.audit.run import check_survey
from thermoxels_ns.core.errors import AuditError
from thermoxels_ns.core.measured import Measured
from thermoxels_ns.core.yaml_records import configs_folder, write_example

PLAIN = """
side: outside
inside: {air: 20 +- 0.5 C}
outside: {air: 0 +- 0.5 C, wind: 1 +- 0.5 m/s}
surroundings: {reflected: -3 +- 3 C}
film: {model: iso-6946, factor: 1.0 +- 0.2}
camera: {offset: 0 +- 1 K, repeatability: 0 +- 0.2 K}
surfaces: [{emissivity: 0.93 +- 0.02}]
"""


AIRS, DAYS = {"inside": "20 C", "heating_limit": "15 C"}, {"degree_hours": "3000 K d"}


@pytest.fixture
def changed(tmp_path: Path):
    """Write conditions in which one entry is another one, given by its path; None removes it."""

    def change(*keys: str, value: object, **more: object) -> Path:
        content = yaml.safe_load(PLAIN) | more
        at = content
        for key in keys[:-1]:
            at = at[int(key)] if isinstance(at, list) else at.setdefault(key, {})
        at[keys[-1]] = value
        if value is None:
            del at[keys[-1]]
        path = tmp_path / "conditions.yaml"
        path.write_text(yaml.safe_dump(content))
        return path

    return change


def test_the_example_is_read_and_lacks_nothing_that_en_13187_asks_for(tmp_path) -> None:
    write_example(tmp_path / "new" / "mine.yaml", EXAMPLE, AuditError)
    conditions = load_conditions(tmp_path / "new" / "mine.yaml")
    assert conditions == load_conditions(configs_folder() / EXAMPLE)
    found = check_survey(conditions)
    assert (found.forbidden, found.missing) == ((), ())
    assert conditions.film.model == "balance" and conditions.survey.date.hour == 6


@pytest.mark.parametrize(
    ("keys", "value", "named"),
    [
        (("inside", "air"), "0.5 C", r"inside: air: .*no U-value follows"),
        (("inside", "air"), "-300 C", r"inside: air"),
        (("inside", "air"), "1e9 C", r"inside: air"),
        (("inside", "air"), "20 +- 0.5 K", r"inside: air: .*'20 \+- 0\.5 K', which is -253\.15"),
        (("outside", "air"), "5 +- 0.5 K", r"outside: air: .*which is -268\.15"),
        (("inside",), {"air": "20 C", "lowest_24h": "22 C", "highest_24h": "18 C"}, r"inside: lowest_24h"),
        (("outside",), {"air": "0 C", "lowest_24h": "9 C", "highest_24h": "8 C"}, r"outside: lowest_24h"),
        (("inside", "air"), 20.0, r"inside: air: .* Write 20\.0 C\."),
        (("outside", "wind"), "-1 m/s", r"outside: wind"),
        (("outside", "wind"), None, r"outside: wind"),
        (("outside",), {"wind": "1 m/s"}, r"outside: air"),
        (("surfaces", "0", "emissivity"), "0.99 +- 0.02", r"surfaces entry 1: emissivity"),
        (("surfaces", "0", "emisivity"), 0.9, r"surfaces entry 1: .*Did you mean emissivity"),
        (
            ("surroundings",),
            {"ground": "1 C"},
            r"surroundings: reflected or sky: expected one of reflected, sky, got none",
        ),
        (("surroundings", "ground"), "1 C", r"surroundings: ground"),
        (("surroundings",), {"sky": {"cloud": 2, "dew_point": "0 C"}}, r"surroundings: sky: cloud"),
        (("film", "model"), "madding", r"film: model"),
        (("film", "model"), "given", r"film: coefficient"),
        (("film", "factor"), "0.1 +- 0.2", r"film: factor"),
        (("film", "weights"), {"watmuff": 1}, r"film: weights: .*got weights beside iso-6946"),
        (("film",), {"weights": {"watmuff": 0}}, r"film: weights: .*got none above 0"),
        (("film",), {"weights": {"watt": 1}}, r"film: weights: .*got watt"),
        (("film",), {"model": "watt"}, r"film: model"),
        (("camera", "offset"), None, r"camera: expected the key offset"),
        (("camera", "emissivity"), 0.95, r"camera: reflected"),
        (("references",), [{"at": [float("nan"), 0.0, 1.2], "temperature": "1.4 C"}], r"references entry 1: at"),
        (("limits", "u"), {"*": "0.3 W"}, r"limits: u: \*"),
        (("energy",), {"currency": "EUR"}, "energy: climate or degree_hours: expected one of climate, degree_hours"),
        (
            ("energy",),
            {"climate": "a", "degree_hours": "8 K h", **AIRS},
            "energy: climate or degree_hours: expected one",
        ),
        (("energy",), {"climate": "a.epw", "inside": "20 C"}, "energy: heating_limit: expected one"),
        (
            ("energy",),
            {"degree_hours": "8 K h", "inside": "20 C"},
            "energy: inside: expected none, because degree_hours",
        ),
        (("energy",), {"climate": "a.epw", **AIRS, "heating_limit": "21 C"}, "energy: heating_limit: expected surely"),
        (("energy",), {"degree_hours": "80000"}, "energy: degree_hours: expected"),
        (("energy",), {"degree_hours": "3000 K d", "price": "12 EUR"}, "energy: price: expected"),
        (("energy",), DAYS | {"measures": {"x": {"patches": ["*"]}}}, "energy: measures: x: expected the key u"),
        (("energy",), DAYS | {"measures": {"x": {"patches": [], "u": "1 W/(m2 K)"}}}, "energy: measures: x: patches"),
    ],
)
def test_bad_conditions_are_one_clear_error(changed, keys, value, named) -> None:
    with pytest.raises(AuditError, match=rf"(?m)^conditions\.yaml: {named}"):
        load_conditions(changed(*keys, value=value))


def test_a_sky_is_none_of_a_room(changed) -> None:
    film, sky = {"model": "madding", "factor": 1.0}, {"sky": {"cloud": 0.5, "dew_point": "0 C"}}
    with pytest.raises(AuditError, match=r"surroundings: expected a reflected temperature inside"):
        load_conditions(changed("surroundings", value=sky, side="inside", film=film))


@pytest.mark.parametrize(
    ("keys", "value", "words"),
    [
        (("inside", "air"), "9 +- 0.5 C", "during the survey: 9 K. EN 13187 asks for at least 10 K."),
        (("survey",), {"least_difference_24h": "7 K"}, "all the last 24 hours: 7 K"),
        (("outside", "wind"), "6 m/s", "Wind: 6 m/s. EN 13187 asks for at most 5 m/s."),
        (("survey",), {"hours_since_sun": "1 h"}, "Time since the sun shone on the surface: 1 h"),
        (("survey",), {"hours_dry": "3 h"}, "Time since the surface was wet: 3 h"),
    ],
)
def test_what_en_13187_forbids_is_named(changed, keys, value, words) -> None:
    found = check_survey(load_conditions(changed(*keys, value=value))).forbidden
    assert len(found) == 1 and words in found[0]


def test_what_is_missing_and_what_is_doubtful_is_named(changed) -> None:
    conditions = load_conditions(changed("camera", "offset", value="0 K"))
    found = check_survey(conditions)
    assert {"client", "serial number of the camera", "wind direction", "pressure difference"} <= set(found.missing)
    assert any("Taken as exact" in one and "camera offset" in one and "inside air" not in one for one in found.doubts)
    assert sum("Heat flow is taken as steady" in one for one in found.doubts) == 2
    swung = replace(conditions.outside, lowest_24h=Measured(-8.0), highest_24h=Measured(4.0))
    doubts = check_survey(replace(conditions, outside=swung)).doubts
    assert any("The air outside changed by 12.0 K within 24 hours, 60 % of" in one for one in doubts)
