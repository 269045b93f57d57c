from dataclasses import fields
from datetime import datetime, timezone

import numpy as np
import pytest

from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.quantities import Places, Varying
from thermoxels_ns.heat.effects import STEFAN_BOLTZMANN_W_M2K4
from thermoxels_ns.heat.scene_fields import (
    InsideAir,
    Section,
    Sky,
    Sun,
    Surface,
    field_bounds,
    inside_coefficient,
    outside_coefficient,
    radiative_coefficient,
)

SECTIONS = Section.__subclasses__()
NOON = datetime(2025, 6, 21, 12, tzinfo=timezone.utc)
PLACE = {"latitude_deg": 47.0, "longitude_deg": 8.0, "north": (0.0, 1.0, 0.0)}


@pytest.mark.parametrize("section", SECTIONS, ids=lambda section: section.__name__)
def test_every_number_has_a_range_by_its_unit(section: type[Section]) -> None:
    numbers = [field.name for field in fields(section) if "float" in str(field.type)]  # type: ignore[arg-type]
    assert numbers
    for name in numbers:
        bounds = field_bounds(name)
        assert bounds.name == name
        with pytest.raises(HeatError, match=f"^{name}: expected a finite number"):
            bounds.check(-1e9)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: InsideAir(20.0), "coefficient or coefficient_w_m2k: expected one of .*, got none. Add coefficient"),
        (
            lambda: InsideAir(20.0, "iso-6946-combined", 8.0),
            "got coefficient and coefficient_w_m2k. Remove all but one",
        ),
        (lambda: InsideAir(20.0, "iso-6946-separate"), "emissivity: expected a number, because iso-6946-separate"),
        (lambda: InsideAir(20.0, "iso-6946-combined", patches=()), "patches: expected a list of names"),
        (lambda: Surface(), "surface: expected emissivity, absorptivity or both, got neither"),
        (lambda: Sky(below_air_k=-6.0), r"below_air_k: .* at least 0 \[kelvin\]"),
        (lambda: Sun(start=NOON, clear_sky="meinel"), "start: expected latitude_deg beside it"),
        (lambda: Sun(start=NOON, **PLACE), "clear_sky or direct_w_m2: expected one of"),
        (
            lambda: Sun(start=NOON.replace(tzinfo=None), **PLACE, clear_sky="meinel"),
            r"start: expected a date and time with a time zone, got 2025-06-21T12:00:00",
        ),
        (
            lambda: Sun(towards=(0.0, 0.0, 1.0), latitude_deg=47.0, direct_w_m2=800.0),
            "latitude_deg: expected a date and time in start beside it",
        ),
    ],
)
def test_sections_say_what_is_wrong(make, message: str) -> None:
    with pytest.raises(HeatError, match=message):
        make()


Z_UP = (0.0, 0.0, 1.0)
CEILING, WALL, FLOOR = (0.0, 0.0, -1.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)
"""Outward normals of what surrounds a room."""


def at(coefficient: Varying, *normals: tuple[float, float, float], up=Z_UP) -> list[float]:
    places = Places(np.zeros((len(normals), 3)), np.array(normals), up)
    return np.asarray(coefficient.function(places, 0.0)).tolist()


@pytest.mark.parametrize(
    ("mean_c", "published"), [(-10.0, 4.13), (0.0, 4.62), (10.0, 5.15), (20.0, 5.71), (30.0, 6.32)]
)
def test_radiation_made_linear(mean_c: float, published: float) -> None:
    assert round(radiative_coefficient(mean_c, 1.0), 2) == published
    assert radiative_coefficient(mean_c, 0.5) == 0.5 * radiative_coefficient(mean_c, 1.0)


def test_the_linear_form_is_the_slope_of_the_fourth_power() -> None:
    kelvin, step = 283.15, 1e-3
    slope = STEFAN_BOLTZMANN_W_M2K4 * ((kelvin + step) ** 4 - (kelvin - step) ** 4) / (2.0 * step)
    assert radiative_coefficient(10.0, 1.0) == pytest.approx(slope, rel=1e-9)


def test_separate_parts_make_up_the_combined_resistances() -> None:
    """The standard's Rsi and Rse are its separate parts, rounded: emissivity 0.9, 20 C inside, 0 C and 4 m/s out."""
    inside = at(inside_coefficient("iso-6946-separate", mean_c=20.0, emissivity=0.9), CEILING, WALL, FLOOR)
    assert [round(1.0 / value, 2) for value in inside] == [0.10, 0.13, 0.17]
    assert round(1.0 / outside_coefficient("iso-6946-separate", 4.0, 0.0, 0.9), 2) == 0.04


def test_horizontal_reaches_to_30_degrees() -> None:
    def leaning(degrees: float) -> tuple[float, float, float]:
        return float(np.cos(np.radians(degrees))), 0.0, float(np.sin(np.radians(degrees)))

    found = at(
        inside_coefficient("iso-6946-convection", "out-of-body"),
        *(leaning(angle) for angle in (-31, -30, -29, 29, 30, 31)),
    )
    assert found == [0.7, 2.5, 2.5, 2.5, 2.5, 5.0]
