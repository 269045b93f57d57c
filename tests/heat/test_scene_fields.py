from datetime import datetime, timezone

import numpy as np
import pytest

from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.quantities import Places, Varying
from thermoxels_ns.heat.scene_fields import (
    InsideAir,
    Sky,
    Sun,
    Surface,
    inside_coefficient,
    outside_coefficient,
    radiative_coefficient,
)

NOON = datetime(2025, 6, 21, 12, tzinfo=timezone.utc)
PLACE = {"latitude_deg": 47.0, "longitude_deg": 8.0, "north": (0.0, 1.0, 0.0)}


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: InsideAir(20.0), "coefficient or coefficient_w_m2k"),
        (lambda: InsideAir(20.0, "iso-6946-combined", 8.0), "coefficient or coefficient_w_m2k"),
        (lambda: InsideAir(20.0, "iso-6946-separate"), "emissivity"),
        (lambda: InsideAir(20.0, "iso-6946-combined", patches=()), "patches"),
        (lambda: InsideAir(-300.0, "iso-6946-combined"), "air_c"),
        (lambda: InsideAir(float("nan"), "iso-6946-combined"), "air_c"),
        (lambda: InsideAir(True, "iso-6946-combined"), "air_c"),
        (lambda: Surface(), "expected emissivity, absorptivity"),
        (lambda: Surface(emissivity=1.5), "emissivity"),
        (lambda: Sky(below_air_k=-6.0), "below_air_k"),
        (lambda: Sun(start=NOON, clear_sky="meinel"), "start"),
        (lambda: Sun(start=NOON, **PLACE), "clear_sky or direct_w_m2"),
        (lambda: Sun(start=NOON.replace(tzinfo=None), **PLACE, clear_sky="meinel"), "start"),
        (lambda: Sun(start=NOON, **{**PLACE, "north": (0.0, 0.0, 0.0)}, clear_sky="meinel"), "north"),
        (lambda: Sun(towards=(0.0, 0.0, 1.0), latitude_deg=47.0, direct_w_m2=800.0), "latitude_deg"),
    ],
)
def test_sections_say_what_is_wrong(make, named: str) -> None:
    with pytest.raises(HeatError, match=f"^{named}"):
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
