import numpy as np
import pytest

from thermoxels_ns.fem.quantities import Places
from thermoxels_ns.heat.effects import STEFAN_BOLTZMANN_W_M2K4, Radiation
from thermoxels_ns.heat.sky import ground_view, outdoor_radiation, sky_view, swinbank_sky_c

Z_UP = (0.0, 0.0, 1.0)


def test_swinbank_at_300_kelvin() -> None:
    """0.0552 * 300^1.5 = 286.83 K: 13 K below the air."""
    assert swinbank_sky_c(26.85) == pytest.approx(13.68, abs=0.01)


def test_view_factors_by_tilt() -> None:
    tilt = np.radians([0.0, 60.0, 90.0, 120.0, 180.0])
    normals = np.stack([np.sin(tilt), np.zeros(5), np.cos(tilt)], axis=1)
    np.testing.assert_allclose(sky_view(normals, Z_UP), [1.0, 0.75, 0.5, 0.25, 0.0], atol=1e-15)
    np.testing.assert_allclose(sky_view(normals, Z_UP) + ground_view(normals, Z_UP), 1.0)
    np.testing.assert_allclose(sky_view(normals[:, [2, 0, 1]], (1.0, 0.0, 0.0)), sky_view(normals, Z_UP))


def loss_w_m2(surface_k: float, places: Places, **temperatures: float) -> np.ndarray:
    effect = Radiation(("*",), *outdoor_radiation(0.8, **temperatures))
    emissivity = effect.bounded("emissivity").at(places, 0.0)
    around_k = effect.bounded("surroundings_c").at(places, 0.0) + 273.15
    return STEFAN_BOLTZMANN_W_M2K4 * emissivity * (surface_k**4 - around_k**4)


def test_sky_and_ground_together_are_the_sum_of_both() -> None:
    directions = np.random.default_rng(3).normal(size=(20, 3))
    normals = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    places = Places(np.zeros((20, 3)), normals, Z_UP)
    both = loss_w_m2(290.0, places, sky_c=-20.0, ground_c=5.0)
    alone = loss_w_m2(290.0, places, sky_c=-20.0) + loss_w_m2(290.0, places, ground_c=5.0)
    np.testing.assert_allclose(both, alone, rtol=1e-11)
