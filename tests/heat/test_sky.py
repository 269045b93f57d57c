from datetime import datetime, timedelta, timezone

import numpy as np
import pytest

from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.problem import Varying, values_at
from thermoxels_ns.fem.selection import Places
from thermoxels_ns.heat.effects import STEFAN_BOLTZMANN_W_M2K4, AbsorbedSolar, Radiation
from thermoxels_ns.heat.scene_fields import Sun
from thermoxels_ns.heat.sky import (
    Sunlight,
    SunPosition,
    air_mass,
    facet_irradiance,
    meinel_clear_sky,
    outdoor_radiation,
    sun_position,
    towards_sun,
)

UTC = timezone.utc

Z_UP, NORTH = (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)


def test_position_of_the_published_example() -> None:
    """NREL/TP-560-34302, appendix A.5: Golden, Colorado; azimuth 194.34024, elevation without refraction 39.872046."""
    local = datetime(2003, 10, 17, 12, 30, 30, tzinfo=timezone(timedelta(hours=-7)))
    sun = sun_position(local, 39.742476, -105.1786)
    assert sun.azimuth_deg == pytest.approx(194.34024, abs=0.02)
    assert sun.elevation_deg == pytest.approx(39.872046, abs=0.02)
    assert sun.distance_au == pytest.approx(0.9965422974, abs=1e-4)


def test_the_sun_goes_from_east_over_south_to_west_and_over_north_beyond_the_equator() -> None:
    def azimuths(latitude: float) -> list[float]:
        return [
            sun_position(datetime(2025, 3, 20, hour, tzinfo=UTC), latitude, 0.0).azimuth_deg for hour in (7, 12, 17)
        ]

    east, south, west = azimuths(50.0)
    assert 90 < east < 120 and 170 < south < 190 and 240 < west < 270
    east, north, west = azimuths(-50.0)
    assert 60 < east < 90 and (north < 10 or north > 350) and 270 < west < 300


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
    effect = AbsorbedSolar(("*",), 0.5, Sun(start, 47.0, 0.0, NORTH, clear_sky="meinel").irradiance())
    irradiance = effect.irradiance_w_m2
    assert isinstance(irradiance, Varying) and irradiance.in_time
    walls = Places(np.zeros((2, 3)), np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]), Z_UP)
    hours = np.arange(0.0, 24.0, 0.1)
    day = np.array([values_at(irradiance, walls, 3600.0 * hour) for hour in hours])
    assert day[np.searchsorted(hours, 8.0), 0] > 3.0 * day[np.searchsorted(hours, 8.0), 1] > 0.0
    assert day[:20].max() == 0.0
    east, west = day.sum(axis=0)
    assert east == pytest.approx(west, rel=0.01)
    given = Sun(start, 47.0, 0.0, NORTH, direct_w_m2=0.0, diffuse_w_m2=100.0).irradiance()
    # Given light shines as long as the sun is up: a wall sees half of the sky.
    assert np.asarray(given.function(walls, 43200.0)).tolist() == [50.0, 50.0]
    assert np.asarray(given.function(walls, 0.0)).tolist() == [0.0, 0.0]


def loss_w_m2(surface_k: float, places: Places, **temperatures: float) -> np.ndarray:
    effect = Radiation(("*",), *outdoor_radiation(0.8, **temperatures))
    emissivity = values_at(effect.emissivity, places, 0.0)
    around_k = values_at(effect.surroundings_c, places, 0.0) + 273.15
    return STEFAN_BOLTZMANN_W_M2K4 * emissivity * (surface_k**4 - around_k**4)


def test_sky_and_ground_together_are_the_sum_of_both() -> None:
    directions = np.random.default_rng(3).normal(size=(20, 3))
    normals = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    places = Places(np.zeros((20, 3)), normals, Z_UP)
    both = loss_w_m2(290.0, places, sky_c=-20.0, ground_c=5.0)
    alone = loss_w_m2(290.0, places, sky_c=-20.0) + loss_w_m2(290.0, places, ground_c=5.0)
    np.testing.assert_allclose(both, alone, rtol=1e-11)
