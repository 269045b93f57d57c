"""Figures of published formulas, to their digits."""

import numpy as np
import pytest

from thermoxels_ns.audit.heat_flow import (
    FILMS,
    fourth_power,
    net_radiation_w_m2,
    reading_k,
    sky_emissivity,
    surface_temperature_k,
    temperature_factor,
    view_shares,
)

K = 273.15


def radiation(emissivity: float, warm_c: float, cold_c: float) -> float:
    """Radiation between a surface and its surroundings, [W/m2]."""
    return net_radiation_w_m2(emissivity, warm_c + K, fourth_power(cold_c + K))


@pytest.mark.parametrize(
    ("flow_w_m2", "published_u"),
    [
        (radiation(0.93, 2.0, 1.0) + 8.0 * 2.0, 1.01851),  # Fokaides and Kalogirou
        (radiation(0.93, 2.0, 0.0) + 2.0 * FILMS["outside"]["albatici-tonelli"].w_m2k(1.0, 2.0, 0.0), 0.81515),
        (2.0 * FILMS["outside"]["dallo"].w_m2k(1.0, 2.0, 0.0), 0.96054),
        (radiation(0.9, 19.5, 18.0) + 2.0 * FILMS["inside"]["madding"].w_m2k(0.0, -2.0, 0.0), 0.54583),
    ],
)
def test_u_values_between_20_and_0_c_after_published_formulas(flow_w_m2, published_u) -> None:
    """Publications round the constant of radiation, and make radiation linear: a ten-thousandth."""
    assert flow_w_m2 / 20.0 == pytest.approx(published_u, rel=1e-4)


@pytest.mark.parametrize(
    ("side", "name", "wind_m_s", "warmer_k", "published"),
    [
        ("outside", "iso-6946", 2.0, 1.0, 12.0),
        ("outside", "jurges", 2.0, 1.0, 13.68),
        ("outside", "mcadams", 2.0, 1.0, 13.3),
        ("outside", "watmuff", 2.0, 1.0, 8.8),
        ("outside", "mowitt-windward", 0.0, -8.0, 1.68),  # calm air: natural convection alone
        ("outside", "mowitt-leeward", 1.0, 0.0, 3.55),
        ("outside", "tarp-windward", 2.0, 0.0, 2.537 * 1.67),
        ("outside", "tarp-leeward", 0.0, 8.0, 2.62),
        ("outside", "emmel-windward", 1.0, 1.0, 5.15 + 1.31),
        ("outside", "emmel-leeward", 4.0, 0.0, 3.54 * 4.0**0.76),
        ("inside", "iso-6946", 0.0, -1.0, 2.5),
        ("inside", "walton", 0.0, -8.0, 2.62),
        ("inside", "khalifa", 0.0, -1.0, 2.30),
        ("inside", "iso-6946-combined", 0.0, -1.0, 1.0 / 0.13),
    ],
)
def test_convection_on_a_wall_after_published_formulas(side, name, wind_m_s, warmer_k, published) -> None:
    found = FILMS[side][name].w_m2k(wind_m_s, warmer_k, np.zeros(1))
    assert np.ravel(found).item() == pytest.approx(published, abs=1e-3)


def test_temperature_factors_of_a_known_wall() -> None:
    """Plaster .015/.40, concrete .20/2.0, insulation .12/.035, mortar .01/1.0: R 3.576071; 20 and -10 C."""
    to_outside = 0.015 / 0.40 + 0.20 / 2.0 + 0.12 / 0.035 + 0.01 / 1.0 + 0.04
    assert to_outside - 0.04 == pytest.approx(3.576071, abs=5e-7)
    for resistance, factor, inner_c in ((0.13, 0.965297, 18.9589), (0.25, 0.935335, 18.0600)):
        found = temperature_factor(to_outside, resistance)
        assert found == pytest.approx(factor, abs=5e-7)
        assert -10.0 + 30.0 * found == pytest.approx(inner_c, abs=5e-5)


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
    up, wall, down = view_shares(np.array([1.0, 0.0, -1.0]))
    assert up == pytest.approx([1.0, 0.0, 0.0]) and down == pytest.approx([0.0, 0.0, 1.0])
    assert wall == pytest.approx([0.5**1.5, 0.5 - 0.5**1.5, 0.5])
