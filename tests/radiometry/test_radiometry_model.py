import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.optimize import brentq

from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.radiometry.measurement_model import (
    LONG_WAVE,
    AirConstants,
    Conditions,
    PlanckConstants,
    RadiometricModel,
    RadiometryOptions,
    corrected_temperature_c,
)

E60 = PlanckConstants(r1=14985.93, r2=0.0112832, b=1398.1, f=1.0, o=-6233.0)
I7 = PlanckConstants(r1=16327.72, r2=0.0231583, b=1424.8, f=1.35, o=-6872.0)
SENSORS = [E60, I7, LONG_WAVE]
TEMPERATURES_C = np.array([-30.0, -5.0, 0.0, 19.5, 20.0, 36.6, 120.0, 400.0])

emissivities = st.floats(0.3, 1.0)
celsius = st.floats(-20.0, 80.0)
conditions = st.builds(
    Conditions,
    emissivity=emissivities,
    reflected_c=celsius,
    distance_m=st.floats(0.0, 100.0),
    relative_humidity=st.floats(0.0, 1.0),
    air_c=celsius,
    window_transmission=st.floats(0.5, 1.0),
    window_c=celsius,
)


def test_a_count_becomes_the_temperature_computed_by_hand():
    # S + O = 8000: R1 / (R2 * 8000) + F = 167.02 (14985.93 / 90.2656 + 1), and 1398.1 / ln 167.02 = 273.17 K.
    assert E60.temperature_k(14233.0) == pytest.approx(273.17, abs=0.02)


def test_a_signal_of_nothing_has_no_temperature():
    assert np.isnan(E60.temperature_k([6233.0, 6000.0])).all()
    assert np.isfinite(E60.temperature_k([6234.0])).all()
    assert np.isnan(LONG_WAVE.temperature_k([0.0, -1.0])).all()


@pytest.mark.parametrize("sensor", SENSORS, ids=["E60", "i7", "band"])
def test_sensor_curves_rise_and_are_inverted(sensor):
    kelvin = TEMPERATURES_C + 273.15
    signal = sensor.signal(kelvin)
    assert (np.diff(signal) > 0).all()
    np.testing.assert_allclose(sensor.temperature_k(signal), kelvin, rtol=1e-12)


def test_a_camera_without_constants_is_corrected_as_the_band_of_its_sensor_would():
    """Planck's law over 7.5 to 13 micrometres, at 40 degrees C with emissivity 0.9 and reflections of -20 degrees C."""

    def radiance(kelvin: float) -> float:
        def spectral(wavelength_um: float) -> float:
            return wavelength_um**-5 / math.expm1(14387.76877 / (wavelength_um * kelvin))

        return quad(spectral, 7.5, 13.0, epsrel=1e-11)[0]

    of_object = (radiance(313.15) - 0.1 * radiance(253.15)) / 0.9
    exact_k = brentq(lambda kelvin: radiance(kelvin) - of_object, 300.0, 340.0)
    found_c = corrected_temperature_c(40.0, Conditions(emissivity=0.9, reflected_c=-20.0))
    assert found_c + 273.15 == pytest.approx(exact_k, abs=0.05)


@pytest.mark.parametrize("sensor", SENSORS, ids=["E60", "i7", "band"])
def test_a_black_body_close_by_shows_its_apparent_temperature(sensor):
    near = RadiometricModel(Conditions(emissivity=1.0, distance_m=0.0), sensor)
    np.testing.assert_allclose(near.signal(TEMPERATURES_C), sensor.signal(TEMPERATURES_C + 273.15), rtol=1e-14)
    # Reflections, air and humidity cannot matter then.
    other = RadiometricModel(Conditions(1.0, 77.0, 0.0, 0.9, -11.0), sensor)
    np.testing.assert_array_equal(near.signal(TEMPERATURES_C), other.signal(TEMPERATURES_C))


@pytest.mark.parametrize("sensor", SENSORS, ids=["E60", "i7", "band"])
@pytest.mark.parametrize("emissivity", [0.05, 0.6, 0.95, 1.0])
def test_in_surroundings_of_its_own_temperature_nothing_matters(sensor, emissivity):
    """Kirchhoff: in an enclosure of one temperature every surface looks like a black body of it."""
    oven = Conditions(emissivity, 35.0, 20.0, 0.7, 35.0, window_transmission=0.8, window_c=35.0)
    signal = RadiometricModel(oven, sensor).signal(35.0)
    assert signal == pytest.approx(float(sensor.signal(35.0 + 273.15)), rel=1e-12)


@settings(max_examples=60, deadline=None)
@given(conditions, celsius)
def test_what_a_temperature_gives_as_signal_gives_that_temperature(given, temperature_c):
    model = RadiometricModel(given)
    assert model.temperature_c(model.signal(temperature_c)) == pytest.approx(temperature_c, abs=1e-5)


@settings(max_examples=60, deadline=None)
@given(emissivities, celsius, celsius)
def test_a_lower_emissivity_moves_the_object_away_from_what_it_mirrors(emissivity, seen_c, reflected_c):
    object_c = float(corrected_temperature_c(seen_c, Conditions(emissivity=emissivity, reflected_c=reflected_c)))
    if math.isnan(object_c):
        assert reflected_c > seen_c
    else:
        assert (object_c - seen_c) * (seen_c - reflected_c) >= -1e-9


def test_air_lets_everything_through_at_no_distance_and_less_with_every_metre():
    air = AirConstants()
    tau = [air.transmission(d, 20.0, 0.5) for d in (0.0, 1.0, 10.0, 100.0, 1000.0)]
    assert tau[0] == 1.0 and (np.diff(tau) < 0).all() and tau[-1] > 0.5
    assert air.transmission(50.0, 20.0, 0.9) < air.transmission(50.0, 20.0, 0.2)
    assert air.transmission(50.0, 35.0, 0.5) < air.transmission(50.0, 5.0, 0.5)
    # By hand: w = 0.5 exp(1.5587 + 1.3878 - 0.111264 + 0.0054764) = 8.5532, so the rates at sqrt(10) m are
    # 3.16228 (0.006569 - 0.002276 * 2.92458) = -0.0002759 and 3.16228 (0.01262 - 0.00667 * 2.92458) = -0.0217788.
    expected = 1.9 * math.exp(0.0002759) - 0.9 * math.exp(0.0217788)
    assert air.transmission(10.0, 20.0, 0.5) == pytest.approx(expected, abs=1e-5)


def test_air_hides_an_object_behind_its_own_temperature():
    foggy = Conditions(distance_m=2000.0, relative_humidity=1.0, air_c=25.0)
    seen = RadiometricModel(foggy).signal([60.0, -10.0])
    hot, cold = RadiometricModel(Conditions()).temperature_c(seen)
    assert 25.0 < hot < 60.0 and -10.0 < cold < 25.0


@pytest.mark.parametrize(
    ("values", "named"),
    [
        *(({"emissivity": value}, "emissivity") for value in (0.0, 1.01, math.nan)),
        ({"relative_humidity": 50.0}, "relative_humidity"),
        ({"relative_humidity": -0.1}, "relative_humidity"),
        ({"distance_m": -1.0}, "distance_m"),
        ({"distance_m": math.inf}, "distance_m"),
        ({"reflected_c": -300.0}, "reflected_c"),
        ({"air_c": math.nan}, "air_c"),
    ],
)
def test_impossible_settings_are_refused_by_name(values, named):
    for kind in (Conditions, RadiometryOptions):
        with pytest.raises(ThermoxelsError, match=f"{named}: expected.*--{named.replace('_', '-')}"):
            kind(**values)


@pytest.mark.parametrize(
    ("values", "named"),
    [({"emissivity": 0.9}, "reflected_c"), ({"distance_m": 3.0}, "air_c"), ({"window_transmission": 0.9}, "window_c")],
)
def test_a_temperature_that_is_needed_is_asked_for(values, named):
    with pytest.raises(ThermoxelsError, match=f"{named}: expected a temperature, because"):
        Conditions(**values)


def test_air_that_nothing_passes_is_refused():
    with pytest.raises(ThermoxelsError, match="distance_m"):
        RadiometricModel(Conditions(distance_m=1e5, relative_humidity=1.0, air_c=90.0), E60).signal(20.0)


@pytest.mark.parametrize("name", ["r1", "r2", "b", "f", "o"])
def test_constants_that_are_none_are_refused(name):
    values = {"r1": 1.0, "r2": 1.0, "b": 1400.0, "f": 1.0, "o": 0.0, name: math.nan}
    with pytest.raises(ThermoxelsError, match=f"Planck constant {name.upper()}"):
        PlanckConstants(**values)
