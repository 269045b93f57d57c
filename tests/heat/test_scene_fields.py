from __future__ import annotations

from dataclasses import fields
from datetime import datetime, timezone

import pytest

from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.heat.scene_fields import Ground, InsideAir, OutsideAir, Section, Sky, Sun, Surface, field_bounds

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
        (
            lambda: InsideAir(-300.0, "iso-6946-combined"),
            r"air_c: expected a finite number of at least -273.15 \[degrees",
        ),
        (lambda: InsideAir(True, "iso-6946-combined"), "air_c: .* got True"),
        (lambda: InsideAir(None, "iso-6946-combined"), "air_c: .* got None"),  # type: ignore[arg-type]
        (lambda: InsideAir(20.0, "windy"), "coefficient: expected one of iso-6946-combined"),  # type: ignore[arg-type]
        (lambda: InsideAir(20.0, None, -1.0), r"coefficient_w_m2k: .* at least 0 \[W/\(m2 K\)\], got -1"),
        (lambda: InsideAir(20.0, "iso-6946-separate"), "emissivity: expected a number, because iso-6946-separate"),
        (lambda: InsideAir(20.0, "iso-6946-combined", emissivity=0.9), "emissivity: expected none, because iso-6946-c"),
        (lambda: InsideAir(20.0, "iso-6946-combined", heat_flow="in"), "heat_flow"),  # type: ignore[arg-type]
        (lambda: InsideAir(20.0, "iso-6946-combined", patches=()), "patches: expected a list of names"),
        (lambda: InsideAir(20.0, None, 8.0, patches="interior-up"), "patches: .* got 'interior-up'"),  # type: ignore[arg-type]
        (lambda: OutsideAir(0.0, "thermoxels-original"), "wind_m_s: expected a number, because thermoxels-original"),
        (lambda: OutsideAir(0.0, "iso-6946-combined", wind_m_s=4.0), "wind_m_s: expected none.*got 4. Remove wind_m_s"),
        (lambda: OutsideAir(0.0, None, 25.0, 4.0), "wind_m_s: expected none, because coefficient_w_m2k"),
        (lambda: OutsideAir(0.0, "iso-6946-convection", wind_m_s=-4.0), r"wind_m_s: .*\[m/s\], got -4"),
        (lambda: OutsideAir(0.0, "iso-6946-separate", wind_m_s=4.0), "emissivity: expected a number"),
        (lambda: Surface(), "surface: expected emissivity, absorptivity or both, got neither"),
        (lambda: Surface(emissivity=1.01), "emissivity: .* at most 1"),
        (lambda: Sky(), "temperature_c or model or below_air_k: expected one of .*, got none"),
        (lambda: Sky(temperature_c=0.0, below_air_k=6.0), "got temperature_c and below_air_k"),
        (lambda: Sky(below_air_k=-6.0), r"below_air_k: .* at least 0 \[kelvin\]"),
        (lambda: Ground(), "ground: expected surface_c, reflectance or both"),
        (lambda: Ground(reflectance=2.0), "reflectance"),
        (lambda: Sun(direct_w_m2=800.0), "start or towards: expected one of start, towards, got none"),
        (lambda: Sun(start=NOON, clear_sky="meinel"), "start: expected latitude_deg beside it"),
        (lambda: Sun(start=NOON, **{**PLACE, "north": None}, clear_sky="meinel"), "start: expected north beside it"),
        (lambda: Sun(start=NOON, **PLACE), "clear_sky or direct_w_m2: expected one of"),
        (lambda: Sun(start=NOON, **PLACE, clear_sky="meinel", diffuse_w_m2=50.0), "diffuse_w_m2: expected none"),
        (lambda: Sun(start=NOON, **{**PLACE, "latitude_deg": 95.0}, clear_sky="meinel"), "latitude_deg"),
        (
            lambda: Sun(start=NOON, **{**PLACE, "north": (0.0, 0.0, 0.0)}, direct_w_m2=1.0),
            "north: expected a direction",
        ),
        (
            lambda: Sun(start=NOON.replace(tzinfo=None), **PLACE, clear_sky="meinel"),
            r"start: expected a date and time with a time zone, got 2025-06-21T12:00:00",
        ),
        (
            lambda: Sun(towards=(0.0, 0.0, 1.0), latitude_deg=47.0, direct_w_m2=800.0),
            "latitude_deg: expected a date and time in start beside it",
        ),
        (lambda: Sun(towards=(0.0, 0.0, 1.0), clear_sky="meinel"), "clear_sky: expected a date and time in start"),
    ],
)
def test_sections_say_what_is_wrong(make, message: str) -> None:
    with pytest.raises(HeatError, match=message):
        make()


def test_sections_that_are_complete() -> None:
    assert InsideAir(20, "iso-6946-separate", emissivity=0.9).air_c == 20.0
    assert OutsideAir(0.0, "iso-6946-separate", wind_m_s=4.0, emissivity=0.9).patches == ("exterior-*",)
    assert Sky(model="swinbank").needs_air and not Sky(temperature_c=-5.0).needs_air
    assert Sun(start=NOON, **PLACE, clear_sky="meinel").diffuse_w_m2 == 0.0
    assert Sun(towards=(0.0, 0.0, 2.0), direct_w_m2=800.0, diffuse_w_m2=100.0).start is None
