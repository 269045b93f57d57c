"""Figures of published formulas, to their digits."""

import numpy as np
import pytest

from thermoxels_ns.audit.heat_flow import (
    albatici_tonelli_w_m2,
    dallo_w_m2,
    madding_w_m2,
    radiation_w_m2,
    reading_k,
    sky_emissivity,
    surface_temperature_k,
    temperature_factor,
    view_shares,
)

K = 273.15


def outside_u(surface: float = 2.0, reflected: float = 1.0, coefficient: float = 8.0, inside: float = 20.0) -> float:
    flow = radiation_w_m2(0.93, surface + K, reflected + K) + coefficient * (surface - 0.0)
    return flow / (inside - 0.0)


def test_u_from_outside_after_fokaides_and_kalogirou() -> None:
    assert outside_u() == pytest.approx(1.01851, abs=5e-6)


@pytest.mark.parametrize(
    ("change", "percent"),
    [({"surface": 2.1}, 6.1), ({"reflected": 2.0}, -21.5), ({"coefficient": 9.0}, 9.8), ({"inside": 21.0}, -4.8)],
)
def test_what_it_is_sensitive_to(change, percent) -> None:
    assert 100.0 * (outside_u(**change) / outside_u() - 1.0) == pytest.approx(percent, abs=0.05)


def test_u_from_outside_after_albatici_and_tonelli_and_dallo() -> None:
    assert albatici_tonelli_w_m2(0.93, 1.0, 2.0 + K, K) / 20.0 == pytest.approx(0.81515, abs=5e-6)
    assert dallo_w_m2(1.0, 2.0 + K, K) / 20.0 == pytest.approx(0.96054, abs=5e-6)


def test_u_from_inside_after_madding() -> None:
    assert madding_w_m2(0.9, 18.0 + K, 19.5 + K, 20.0 + K) / 20.0 == pytest.approx(0.54583, abs=5e-6)


def test_convection_inside_changes_its_sign_with_the_difference() -> None:
    warm, cold = (madding_w_m2(1e-12, 293.15 + step, 293.15, 293.15) for step in (2.0, -2.0))
    assert warm == pytest.approx(-cold, rel=1e-9) and warm == pytest.approx(-1.31 * 2.0 ** (4 / 3), rel=1e-9)


def test_temperature_factors_of_a_known_wall() -> None:
    """Plaster .015/.40, concrete .20/2.0, insulation .12/.035, mortar .01/1.0: R 3.576071; 20 and -10 C."""
    to_outside = 0.015 / 0.40 + 0.20 / 2.0 + 0.12 / 0.035 + 0.01 / 1.0 + 0.04
    assert to_outside - 0.04 == pytest.approx(3.576071, abs=5e-7)
    for resistance, factor, inner_c in ((0.13, 0.965297, 18.9589), (0.25, 0.935335, 18.0600)):
        found = temperature_factor(to_outside, resistance)
        assert found == pytest.approx(factor, abs=5e-7)
        assert -10.0 + 30.0 * found == pytest.approx(inner_c, abs=5e-5)


def test_a_reading_of_a_black_surface_is_its_temperature() -> None:
    assert surface_temperature_k(281.3, 1.0, 250.0**4, 1.0, 0.0) == pytest.approx(281.3, rel=1e-12)


def test_a_reading_set_to_the_true_emissivity_and_reflection_is_the_temperature() -> None:
    assert surface_temperature_k(281.3, 0.9, 265.0**4, 0.9, 265.0) == pytest.approx(281.3, rel=1e-12)


def test_readings_come_back_from_what_a_surface_emits_and_reflects() -> None:
    surface, around, emissivity = 279.0, 262.0, 0.8
    reading = (emissivity * surface**4 + (1.0 - emissivity) * around**4) ** 0.25
    assert reading_k(surface, emissivity, around**4, 1.0, 0.0) == pytest.approx(reading, rel=1e-12)
    told = reading_k(surface, emissivity, around**4, 0.95, 290.0)
    assert surface_temperature_k(told, emissivity, around**4, 0.95, 290.0) == pytest.approx(surface, rel=1e-12)
    assert surface_temperature_k(reading, emissivity, around**4, 1.0, 0.0) == pytest.approx(surface, rel=1e-12)


def test_the_radiation_of_a_clear_sky() -> None:
    """293 K, dew point 283 K: 340.34 W/m2 with the constant of 5.6697e-8 that EnergyPlus has."""
    emissivity = float(sky_emissivity(283.0 - K, 0.0))
    assert emissivity == pytest.approx(0.815, abs=6e-4)
    assert emissivity * 5.6697e-8 * 293.0**4 == pytest.approx(340.34, abs=0.005)
    assert sky_emissivity(5.0, 1.0) > sky_emissivity(5.0, 0.5) > sky_emissivity(5.0, 0.0)


def test_a_roof_sees_the_sky_a_wall_a_part_of_it_and_a_ceiling_the_ground() -> None:
    up, wall, down = view_shares(np.array([[0, 0, 1.0], [0.6, 0.8, 0], [0, 0, -1.0]]), (0.0, 0.0, 1.0))
    assert up == pytest.approx([1.0, 0.0, 0.0]) and down == pytest.approx([0.0, 0.0, 1.0])
    assert wall == pytest.approx([0.5**1.5, 0.5 - 0.5**1.5, 0.5])
