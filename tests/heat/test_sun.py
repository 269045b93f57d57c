from datetime import datetime, timedelta, timezone

import numpy as np
import pytest

from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.quantities import Places
from thermoxels_ns.heat.effects import AbsorbedSolar
from thermoxels_ns.heat.sun import (
    Sunlight,
    SunPosition,
    air_mass,
    facet_irradiance,
    fixed_sun,
    meinel_clear_sky,
    moving_sun,
    sun_coordinates,
    sun_position,
    towards_sun,
)

UTC = timezone.utc
ARC_MINUTE = 1.0 / 60.0
Z_UP, NORTH = (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)


@pytest.mark.parametrize(
    ("moment", "right_ascension_deg", "declination_deg"),
    [
        # J. Meeus, Astronomical Algorithms, example 25.a.
        (datetime(1992, 10, 13, tzinfo=UTC), 198.38083, -7.78507),
        # Reda and Andreas, NREL/TP-560-34302, appendix A.5.
        (datetime(2003, 10, 17, 19, 30, 30, tzinfo=UTC), 202.22741, -9.31434),
        # US Naval Observatory, MICA.
        (datetime(2016, 10, 26, 21, tzinfo=UTC), 211.63, -12.807),
    ],
)
def test_almanac_coordinates(moment: datetime, right_ascension_deg: float, declination_deg: float) -> None:
    sun = sun_coordinates(moment)
    assert sun.right_ascension_deg == pytest.approx(right_ascension_deg, abs=ARC_MINUTE)
    assert sun.declination_deg == pytest.approx(declination_deg, abs=ARC_MINUTE)


def test_position_of_the_published_example() -> None:
    """NREL/TP-560-34302, appendix A.5: Golden, Colorado; azimuth 194.34024, elevation without refraction 39.872046."""
    local = datetime(2003, 10, 17, 12, 30, 30, tzinfo=timezone(timedelta(hours=-7)))
    sun = sun_position(local, 39.742476, -105.1786)
    assert sun.azimuth_deg == pytest.approx(194.34024, abs=0.02)
    assert sun.elevation_deg == pytest.approx(39.872046, abs=0.02)
    assert sun.distance_au == pytest.approx(0.9965422974, abs=1e-4)
    # The zenith angle of the example is refracted (its equation 42) by air of 820 hPa and 11 C.
    height = np.radians(sun.elevation_deg + 10.3 / (sun.elevation_deg + 5.11))
    refraction_deg = 820.0 / 1010.0 * 283.0 / (273.0 + 11.0) * 1.02 / (60.0 * np.tan(height))
    assert 90.0 - sun.elevation_deg - refraction_deg == pytest.approx(50.11162, abs=0.005)


def test_the_sun_goes_from_east_over_south_to_west_and_over_north_beyond_the_equator() -> None:
    def azimuths(latitude: float) -> list[float]:
        return [
            sun_position(datetime(2025, 3, 20, hour, tzinfo=UTC), latitude, 0.0).azimuth_deg for hour in (7, 12, 17)
        ]

    east, south, west = azimuths(50.0)
    assert 90 < east < 120 and 170 < south < 190 and 240 < west < 270
    east, north, west = azimuths(-50.0)
    assert 60 < east < 90 and (north < 10 or north > 350) and 270 < west < 300


def test_overhead_at_the_tropic_and_no_day_in_polar_winter() -> None:
    noon = [datetime(2025, 6, 21, 12, minute, tzinfo=UTC) for minute in range(5)]
    assert max(sun_position(moment, 23.44, 0.0).elevation_deg for moment in noon) > 89.7
    assert sun_position(datetime(2025, 12, 21, 12, tzinfo=UTC), 80.0, 0.0).elevation_deg < -10.0


def test_directions_in_the_mesh() -> None:
    def towards(azimuth: float, elevation: float, up, north) -> np.ndarray:
        return np.round(towards_sun(SunPosition(azimuth, elevation, 1.0), up, north), 12)

    np.testing.assert_array_equal(towards(90.0, 0.0, Z_UP, NORTH), [1.0, 0.0, 0.0])
    np.testing.assert_array_equal(towards(180.0, 90.0, Z_UP, NORTH), [0.0, 0.0, 1.0])
    np.testing.assert_allclose(towards(180.0, 30.0, Z_UP, NORTH), [0.0, -(0.75**0.5), 0.5])
    # y up, z south: the east is x.
    np.testing.assert_array_equal(towards(90.0, 0.0, (0, 2.0, 0), (0, 0, -3.0)), [1.0, 0.0, 0.0])
    # North that is not level is made so.
    np.testing.assert_array_equal(towards(0.0, 0.0, Z_UP, (0.0, 1.0, 5.0)), [0.0, 1.0, 0.0])
    with pytest.raises(HeatError, match="a direction other than up"):
        towards(0.0, 0.0, Z_UP, (0.0, 0.0, 2.0))


def test_air_mass() -> None:
    """Kasten and Young 1989: 1 in the zenith, 1.994 at 60 degrees from it, about 38 at the horizon."""
    assert air_mass(90.0) == pytest.approx(1.0, abs=5e-4)
    assert air_mass(30.0) == pytest.approx(1.994, abs=1e-3)
    assert air_mass(0.0) == pytest.approx(37.92, abs=0.01)


def test_clear_sky() -> None:
    """In the zenith 70 % of the light comes through: 947 W/m2, and 0.271 - 0.294 * 0.7 of it is scattered down."""
    zenith = meinel_clear_sky(90.0)
    assert zenith.direct_w_m2 == pytest.approx(1353.0 * 0.7, rel=1e-3)
    assert zenith.diffuse_w_m2 == pytest.approx(1353.0 * 0.0652, rel=1e-3)
    assert meinel_clear_sky(90.0, 1.02).direct_w_m2 == pytest.approx(zenith.direct_w_m2 / 1.02**2)
    heights = np.linspace(0.01, 90.0, 50)
    direct = [meinel_clear_sky(height).direct_w_m2 for height in heights]
    assert np.all(np.diff(direct) > 0.0)
    assert direct[0] < 0.03 * direct[-1]
    assert meinel_clear_sky(-0.1) == meinel_clear_sky(-90.0) == Sunlight(0.0, 0.0)


def test_facets_by_orientation() -> None:
    """Sun 30 degrees high in the south: of the direct light a roof gets half, a south wall cos 30, a north wall 0."""
    towards = (0.0, -(0.75**0.5), 0.5)
    normals = np.array([[0, 0, 1.0], [0, -1, 0], [0, 1, 0], [0, 0, -1], towards])
    got = facet_irradiance(normals, Z_UP, towards, Sunlight(800.0, 100.0))
    np.testing.assert_allclose(got, [400 + 100, 800 * 0.75**0.5 + 50, 50, 0, 800 + 75])
    reflected = facet_irradiance(normals, Z_UP, towards, Sunlight(800.0, 100.0), 0.2) - got
    np.testing.assert_allclose(reflected, 0.2 * 500 * np.array([0.0, 0.5, 0.5, 1.0, 0.25]), atol=1e-9)
    below_the_horizon = (0.99, 0.0, -0.14)
    assert not facet_irradiance(np.eye(3)[:1], Z_UP, below_the_horizon, Sunlight(800.0, 100.0), 0.2).any()


def test_a_sun_that_moves() -> None:
    """Walls get the sun in turn, and as much over a day in the east as in the west."""
    start = datetime(2025, 6, 21, tzinfo=UTC)
    effect = AbsorbedSolar(("*",), 0.5, moving_sun(start, 47.0, 0.0, NORTH))
    irradiance = effect.bounded("irradiance_w_m2")
    assert irradiance.in_time
    walls = Places(np.zeros((2, 3)), np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]), Z_UP)
    hours = np.arange(0.0, 24.0, 0.1)
    day = np.array([irradiance.at(walls, 3600.0 * hour) for hour in hours])
    assert day[np.searchsorted(hours, 8.0), 0] > 3.0 * day[np.searchsorted(hours, 8.0), 1] > 0.0
    assert day[:20].max() == 0.0
    east, west = day.sum(axis=0)
    assert east == pytest.approx(west, rel=0.01)
    given = moving_sun(start, 47.0, 0.0, NORTH, Sunlight(0.0, 100.0))
    # Given light shines as long as the sun is up: a wall sees half of the sky.
    assert np.asarray(given.function(walls, 43200.0)).tolist() == [50.0, 50.0]
    assert np.asarray(given.function(walls, 0.0)).tolist() == [0.0, 0.0]


def test_a_sun_that_stands_still() -> None:
    effect = AbsorbedSolar(("*",), 0.5, fixed_sun((3.0, 0.0, 4.0), Sunlight(1000.0, 0.0)))
    irradiance = effect.bounded("irradiance_w_m2")
    assert not irradiance.in_time
    places = Places(np.zeros((2, 3)), np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), Z_UP)
    np.testing.assert_allclose(irradiance.at(places, 0.0), [600.0, 800.0])


def test_a_time_without_a_date_is_refused() -> None:
    sun = moving_sun(datetime(2026, 1, 1, tzinfo=UTC), 50.0, 0.0, NORTH)
    with pytest.raises(HeatError, match=r"time of the sun: expected a date of the years 1 to 9999, got 1e\+12 s"):
        sun.function(Places(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]), Z_UP), 1e12)
