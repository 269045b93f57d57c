"""Heat, money and carbon dioxide of a year: degree hours by hand, the same draws before and after measures."""

from dataclasses import replace

import numpy as np
import pytest

from tests.support.audited_wall import STATED
from tests.support.epw_file import write_epw
from thermoxels_ns.audit.conditions import Energy, Measure
from thermoxels_ns.audit.draws import Draws, Interval
from thermoxels_ns.audit.energy import EnergyResult, year_of
from thermoxels_ns.core.errors import AuditError
from thermoxels_ns.core.measured import Measured

AREA_M2, U = 50.0, 0.8


def year(asked: Energy, u: np.ndarray | None = None) -> EnergyResult:
    """A year of a wall, 50 m2, and a window of 4 m2 and 1.5 W/(m2 K)."""
    draws = Draws({"inside air": np.zeros(2001)})
    walls = np.full(2001, U) if u is None else u
    elements = [("wall-south", AREA_M2, walls), ("window", 4.0, np.full(2001, 1.5))]
    return year_of(replace(STATED, energy=asked), draws, elements)


def outside_c(hour: float) -> float:
    return 17.0 if hour % 4 == 0 else 4.0


@pytest.fixture
def climate(tmp_path):
    lines = [f"{hour},{outside_c(hour)}" for hour in range(8760)]
    (tmp_path / "place.csv").write_text("\n".join(["hours,outside_c", *lines]))
    return {"csv": str(tmp_path / "place.csv"), "epw": str(write_epw(tmp_path / "place.epw", outside_c))}


@pytest.mark.parametrize("kind", ["csv", "epw"])
@pytest.mark.parametrize(("limit_c", "by_hand"), [(15.0, 6570 * 16.0), (18.0, 6570 * 16.0 + 2190 * 3.0)])
def test_heat_is_u_times_area_times_degree_hours_by_hand(climate, kind, limit_c, by_hand) -> None:
    asked = Energy(climate=climate[kind], inside=Measured(20.0), heating_limit=Measured(limit_c), price=Measured(0.1))
    found = year(asked)
    assert found.degree_hours_kh == Interval(*3 * (pytest.approx(by_hand),))
    wall, window = found.elements
    assert wall.heat_kwh.value == wall.heat_kwh.high == pytest.approx(U * AREA_M2 * by_hand / 1000.0)
    assert found.whole.heat_kwh.value == pytest.approx((U * AREA_M2 + 6.0) * by_hand / 1000.0)
    assert window.cost.value == pytest.approx(0.1 * 6.0 * by_hand / 1000.0) and window.co2_kg is None


def test_an_uncertain_air_inside_and_limit_make_an_interval(climate) -> None:
    """Inside 19 to 21 C: 90 % of draws lie within 0.9 K. A limit of 16 to 18 C counts the warm hours half the time."""
    exact = Energy(climate=climate["csv"], inside=Measured(20.0, 1.0), heating_limit=Measured(15.0))
    hours = year(exact).degree_hours_kh
    assert (hours.low, hours.high) == pytest.approx((6570 * 15.1, 6570 * 16.9), rel=0.005)
    hours = year(replace(exact, inside=Measured(20.0), heating_limit=Measured(17.0, 1.0))).degree_hours_kh
    assert (hours.low, hours.high) == pytest.approx((6570 * 16.0, 6570 * 16.0 + 2190 * 3.0))


def test_a_saving_has_the_draws_of_before_and_after() -> None:
    """What is common to both cancels: the saving is as uncertain as the degree hours, the U-value or the new one."""
    asked = Energy(
        Measured(3000.0, 300.0),
        price=Measured(0.1, 0.02),
        co2=Measured(0.2),
        measures={
            "insulate": Measure(("wall-*",), Measured(0.24)),
            "nothing": Measure(("wall-*", "window"), Measured(U)),
        },
    )
    found = year(asked)
    insulate, nothing = found.savings
    gone = (U - 0.24) * AREA_M2 * 72.0
    assert insulate.heat_kwh.value == pytest.approx(gone) and insulate.co2_kg.value == pytest.approx(0.2 * gone)
    assert insulate.heat_kwh.high / gone == pytest.approx(found.degree_hours_kh.high / 72000.0, rel=1e-12)
    assert insulate.heat_kwh.high / gone == pytest.approx(1.09, abs=0.003)
    assert nothing.heat_kwh.value == pytest.approx((1.5 - U) * 4.0 * 72.0)  # of the window alone
    assert insulate.cost.low == pytest.approx(0.1 * gone * 0.79, rel=0.03)
    uncertain = np.linspace(0.6, 1.0, 2001)
    uncertain[0] = U
    exact = replace(asked, degree_hours=Measured(3000.0))
    heat, saved = (one.heat_kwh for one in (year(exact, uncertain).elements[0], year(exact, uncertain).savings[0]))
    assert saved.high == pytest.approx(heat.high - 0.24 * AREA_M2 * 72.0)
    unsure = replace(exact, measures={"insulate": Measure(("wall-*",), Measured(0.24, 0.1))})
    assert year(unsure).savings[0].heat_kwh.low == pytest.approx((U - 0.33) * AREA_M2 * 72.0, rel=0.01)


@pytest.mark.parametrize(
    ("lines", "named"),
    [
        (["hours,wind_m_s", *(f"{h},1" for h in range(8760))], "energy: climate: .*outside_c of one or more"),
        (["hours,outside_c", *(f"{h},1" for h in range(4000))], "energy: climate: .*outside_c of one or more"),
        (["hours,outside_c", "0,1", "8759,2"], "energy: climate: .*without gaps"),
        (["time,outside_c"], "energy: climate: .*a first line of hours"),
    ],
)
def test_a_climate_that_is_no_year_is_one_line(tmp_path, lines, named) -> None:
    (tmp_path / "place.csv").write_text("\n".join(lines))
    airs = {"inside": Measured(20.0), "heating_limit": Measured(15.0)}
    with pytest.raises(AuditError, match=rf"^{named}[^\n]*$"):
        year(Energy(climate=str(tmp_path / "place.csv"), **airs))


def test_a_measure_of_patches_that_were_not_observed_is_one_line() -> None:
    asked = Energy(Measured(3000.0), measures={"roof": Measure(("roof-*",), Measured(0.2))})
    with pytest.raises(AuditError, match=r"^energy: measures: roof: expected patches out of wall-south, window"):
        year(asked)
