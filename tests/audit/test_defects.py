from dataclasses import replace

import numpy as np
import pytest

from tests.support.audited_wall import STATED, UP
from tests.support.heat_meshes import box_mesh, planes
from thermoxels_ns.audit.conditions import Camera
from thermoxels_ns.audit.defects import find_defects, undisturbed_temperature
from thermoxels_ns.audit.draws import interval_of
from thermoxels_ns.audit.run import audit, incidence_factor
from thermoxels_ns.audit.surface import audited_surface
from thermoxels_ns.core.measured import Measured


@pytest.fixture(scope="module")
def plate():
    """A plate of 3 m by 3 m seen from y < 0."""
    mesh = box_mesh(planes(0, 3, step=0.05), [0.0, 0.2], planes(0, 3, step=0.05), temperature_c=2.0)
    front = mesh.boundary.patch == mesh.boundary.patch_names.index("y0")
    return replace(mesh, boundary=replace(mesh.boundary, seen=front))


def painted(plate, where, value: float = 4.0):
    return replace(plate, temperature_c=np.where(where(plate.points_m), value, 2.0))


def strip(p):
    return (np.abs(p[:, 2] - 1.5) < 0.06) & (p[:, 0] > 0.4) & (p[:, 0] < 2.6)


def spot(p):
    return np.hypot(p[:, 0] - 1.0, p[:, 2] - 1.0) < 0.16


def block(p):
    return (np.abs(p[:, 0] - 1.5) < 0.52) & (np.abs(p[:, 2] - 1.5) < 0.52)


def frame(p):
    wide = np.maximum(np.abs(p[:, 0] - 1.5), np.abs(p[:, 2] - 1.5))
    return (wide > 0.62) & (wide < 0.73)


@pytest.mark.parametrize(
    ("where", "kind", "length"),
    [(strip, "line", 2.2), (spot, "point", 0.35), (block, "area", 1.05 * 2**0.5), (frame, "line", 4 * 1.35)],
)
def test_lines_points_and_areas_are_told_apart(plate, where, kind, length) -> None:
    (found,) = audit(painted(plate, where), STATED, UP).defects
    assert found.kind == kind
    assert found.length_m == pytest.approx(length, rel=0.15)
    assert found.departure_k == pytest.approx(2.0 / 0.93, rel=0.02)


def test_cold_places_are_no_defects_from_outside_and_are_from_inside(plate) -> None:
    cold = painted(plate, block, 0.5)
    surface = audited_surface(cold, STATED, UP)
    assert audit(cold, STATED, UP).defects == ()
    found = find_defects(surface, surface.reading_c, False, 0.2)
    assert [one.kind for one in found] == ["area"]


def test_noise_and_drift_make_no_defect(plate) -> None:
    generator = np.random.default_rng(5)
    for _ in range(5):
        drift = 0.2 * np.sin(plate.points_m @ generator.uniform(-2, 2, 3) + generator.uniform(0, 6))
        noisy = replace(plate, temperature_c=2.0 + drift + generator.normal(0, 0.15, len(drift)))
        assert audit(noisy, STATED, UP).defects == ()


def test_a_bridge_weaker_than_the_slow_changes_of_a_wall_is_found(plate) -> None:
    """A wall 1 K warmer at its foot than at its top: the strip is 0.6 K warmer than what is beside it."""
    slow = 2.0 + plate.points_m[:, 2] / 3.0
    weak = replace(plate, temperature_c=slow + np.where(strip(plate.points_m), 0.6, 0.0))
    (found,) = audit(weak, STATED, UP).defects
    assert found.kind == "line" and found.length_m == pytest.approx(2.2, rel=0.1)
    assert found.departure_k == pytest.approx(0.6 / 0.93, rel=0.1)
    assert audit(replace(plate, temperature_c=slow), STATED, UP).defects == ()


def test_what_departs_less_than_readings_repeat_is_none(plate) -> None:
    faint = painted(plate, block, 2.5)
    assert len(audit(faint, STATED, UP).defects) == 1
    coarse = replace(STATED, camera=Camera(Measured(0.0, 1.0), Measured(0.0, 0.4)))
    assert audit(faint, coarse, UP).defects == ()


def test_two_bridges_stay_two_and_lose_nothing_to_each_other(plate) -> None:
    def two(p):
        return spot(p) | (np.hypot(p[:, 0] - 2.2, p[:, 2] - 2.2) < 0.16)

    found = audit(painted(plate, two), STATED, UP).defects
    assert [one.kind for one in found] == ["point", "point"]
    one = audit(painted(plate, spot), STATED, UP).defects[0]
    assert sum(each.extra_w.value for each in found) == pytest.approx(2.0 * one.extra_w.value, rel=0.02)


def test_incidence_is_the_published_one() -> None:
    """Ti 20, T_1D 18.5; equal areas 60 at 18.5, 20 at 18.0, 20 at 17.0 C: 1.26667."""
    mean, calm = np.full(3, 0.6 * 18.5 + 0.2 * 18.0 + 0.2 * 17.0), np.full(3, 18.5)
    found = incidence_factor(mean, calm, np.full(3, 20.0))
    assert found is not None and found.value == pytest.approx(1.26667, abs=5e-6)
    assert incidence_factor(mean, calm, np.array([18.6, 18.4, 18.6])) is None


def test_the_undisturbed_temperature_is_that_of_the_larger_part() -> None:
    generator = np.random.default_rng(0)
    values = np.concatenate([generator.normal(3.0, 0.1, 600), generator.uniform(3.5, 9.0, 400)])
    temperature_c, least_departure_k = undisturbed_temperature(values, np.ones(1000))
    assert temperature_c == pytest.approx(3.0, abs=0.05)
    assert 0.25 < least_departure_k < 0.6  # three standard deviations, a little more for what is mixed in


def test_intervals_hold_nine_tenths_of_the_draws() -> None:
    values = np.random.default_rng(1).normal(2.0, 1.0, 4001)
    found = interval_of(np.concatenate([[7.0], values]))
    assert found.value == 7.0 and np.mean((values > found.low) & (values < found.high)) == pytest.approx(0.9, abs=1e-3)
