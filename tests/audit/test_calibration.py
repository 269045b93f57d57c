"""Walls whose construction is known are calibrated from their surface temperatures."""

import re
from dataclasses import replace

import numpy as np
import pytest

from tests.support.audited_wall import (
    CONDUCTIVITY,
    STATED,
    SURE,
    UP,
    Truth,
    audited_wall,
    calibrated,
    calibrated_after,
    photographed,
    solve_wall,
    true_draws,
)
from thermoxels_ns.audit.calibration import Calibration
from thermoxels_ns.audit.conditions import Calibrate, Camera, Film, Layer, Unknown, Weather
from thermoxels_ns.audit.run import audit
from thermoxels_ns.core.errors import AuditError
from thermoxels_ns.core.measured import Measured

STEP_M = 0.2
OFFSET_ALONE = replace(STATED, camera=Camera(Measured(0.0, 0.3), Measured(0.0)))
WALL = Calibrate({"wall": Measured(0.9)}, (Unknown("conductivity", "wall"),), behind=("room",))


@pytest.fixture(scope="module")
def walls() -> dict[str, Truth]:
    """A plain wall and one with a window, as stated."""
    draws = true_draws(STATED, None)
    meshes = {"plain": audited_wall(STEP_M, slab=False, window=False), "window": audited_wall(STEP_M, slab=False)}
    return {name: solve_wall(mesh, STATED, draws) for name, mesh in meshes.items()}


def calibrate(truth: Truth, asked: Calibrate, conditions=OFFSET_ALONE, seed: int | None = None) -> Calibration:
    found = audit(photographed(truth, conditions, seed), replace(conditions, calibrate=asked), UP).calibration
    return found


def test_exact_readings_give_the_true_conductivity(walls) -> None:
    """The map of what remains is zero."""
    found = calibrate(walls["plain"], WALL)
    value = found.found["conductivity of wall"]
    assert value.value == pytest.approx(CONDUCTIVITY["wall"], rel=1e-3)
    assert value.low < CONDUCTIVITY["wall"] < value.high and found.refused == ""
    assert found.misfit_k < 1e-6 and found.moved_most_by == {"conductivity of wall": "outside air"}
    counted = np.isfinite(found.difference_k)
    assert counted.any() and np.abs(found.difference_k[counted]).max() < 1e-2


def test_two_materials_are_told_apart_where_each_has_a_surface(walls) -> None:
    both = {"wall": Measured(0.6), "glazing": Measured(0.18)}
    unknown = tuple(Unknown("conductivity", name) for name in both)
    found = calibrate(walls["window"], replace(WALL, conductivity=both, unknown=unknown), seed=2)
    for name in both:
        assert found.found[f"conductivity of {name}"].value == pytest.approx(CONDUCTIVITY[name], rel=0.25)


def test_an_offset_of_the_camera_counts_once_for_all_readings(walls) -> None:
    """Drawn from -0.3 to 0.3 K: a twentieth of the draws is above 0.27 K, and so is a twentieth of the results."""
    stated = calibrate(walls["plain"], WALL, replace(SURE, camera=OFFSET_ALONE.camera))
    shifted = replace(SURE, camera=Camera(Measured(0.27), Measured(0.0)))
    mesh = photographed(walls["plain"], OFFSET_ALONE)
    warmer = audit(mesh, replace(shifted, calibrate=WALL), UP).calibration
    ends = [one.found["conductivity of wall"] for one in (stated, warmer)]
    assert ends[0].high == pytest.approx(ends[1].value, rel=0.01) and ends[1].value > 1.05 * ends[0].value


def test_each_formula_of_convection_is_followed_to_a_conductivity_of_its_own(walls) -> None:
    """Two formulas, in 1/4 and 3/4 of the draws: the ends of the interval are the values by one alone."""
    films = (Film(weights={"iso-6946": 1.0, "watmuff": 3.0}), Film("iso-6946"), Film("watmuff"))
    warm = replace(
        walls["plain"], mesh=replace(walls["plain"].mesh, temperature_c=walls["plain"].mesh.temperature_c + 1.0)
    )
    both, iso, watmuff = (calibrate(warm, WALL, replace(SURE, film=film)).found for film in films)
    interval, ends = both["conductivity of wall"], [one["conductivity of wall"].value for one in (watmuff, iso)]
    assert (interval.low, interval.high) == pytest.approx(ends, rel=5e-3) and ends[0] < 0.95 * ends[1]


def test_what_is_known_to_a_range_widens_the_answer(walls) -> None:
    """The wall and plaster of 0.1 +- 0.05 m2 K / W together resist as the true wall; 90 % of draws are within 0.045."""
    layers = {"plaster": Layer(("room",), Measured(0.02, 0.01), Measured(0.2))}
    found = calibrate(walls["plain"], replace(WALL, layers=layers), SURE).found["conductivity of wall"]
    for value, plaster in ((found.low, 0.055), (found.value, 0.1), (found.high, 0.145)):
        assert 0.3 / value + plaster == pytest.approx(0.3 / CONDUCTIVITY["wall"], rel=2e-3)


def insulation(thickness_m: float, *unknown: tuple[str, str], wall: float = 0.9) -> dict:
    return {
        "conductivity": {"wall": Measured(wall)},
        "layers": {"insulation": Layer(("room",), Measured(thickness_m), Measured(0.04))},
        "unknown": tuple(Unknown(*one) for one in unknown),
    }


BOTH = ("conductivity", "insulation"), ("thickness", "insulation")


@pytest.mark.parametrize(
    ("changes", "offset_k", "said"),
    [
        # With a wall of 0.6 W/(m K) the layer must resist 0.5 m2 K / W.
        (insulation(0.1, *BOTH, wall=0.6), 0.0, r"conductivity of insulation.* their ratio is, 2.*W/\(m K\) per m"),
        (
            insulation(0.02, ("conductivity", "wall"), ("thickness", "insulation")),
            0.0,
            "conductivity of wall and thickness of insulation cannot be told apart",
        ),
        ({}, 25.0, "No conductivity of wall explains the readings: however large"),
    ],
)
def test_what_readings_do_not_tell_is_refused(walls, changes, offset_k, said) -> None:
    stated = replace(OFFSET_ALONE, camera=Camera(Measured(offset_k, 0.3), Measured(0.0)))
    mesh = photographed(walls["plain"], OFFSET_ALONE)
    found = audit(mesh, replace(stated, calibrate=replace(WALL, **changes)), UP).calibration
    assert found is not None and found.found == {} and re.search(said, found.refused), found.refused


@pytest.mark.parametrize("side", ["outside", "inside"])
def test_intervals_hold_the_truth_though_all_is_off(side) -> None:
    """A small version of ``tests/benchmarks/audit_truth.py --calibrate``."""
    held = [low.low <= true <= low.high for seed in (2, 5, 8) for _, true, low in calibrated(side, seed, STEP_M)]
    assert sum(held) >= len(held) - 1


def test_with_the_history_of_the_air_a_wall_after_a_warm_day_comes_out_right(tmp_path) -> None:
    """One seed of ``tests/benchmarks/audit_truth.py --calibrate --history-h 48``."""
    true = CONDUCTIVITY["wall"]
    found, calibration = calibrated_after("outside", 0, tmp_path)
    steady, _ = calibrated_after("outside", 0, tmp_path, steady=True)
    assert found.low <= true <= found.high and calibration.history_h == 48.0 and calibration.doubt == ""
    assert abs(np.log(found.value / true)) < abs(np.log(steady.value / true))


def test_a_history_shorter_than_what_the_wall_remembers_leaves_a_doubt_with_its_size(tmp_path) -> None:
    found, calibration = calibrated_after("outside", 0, tmp_path, 6.0)
    assert calibration.history_h == 6.0 and found.low < CONDUCTIVITY["wall"] < found.high
    assert re.search(r"begins 6 h before .*conductivity of wall by \d+ %", calibration.doubt)


CAPACITY = {"heat_capacity": {"wall": Measured(1600.0)}}


def test_what_a_history_needs_is_said(walls, tmp_path) -> None:
    with pytest.raises(AuditError, match=r"^heat_capacity: expected one for each of wall, got brick[^\n]*$"):
        replace(WALL, heat_capacity={"brick": Measured(1600.0)})
    with pytest.raises(AuditError, match=r"^calibrate: heat_capacity: expected weather beside it[^\n]*$"):
        calibrate(walls["plain"], replace(WALL, **CAPACITY))
    (tmp_path / "weather.csv").write_text("hours,wind_m_s\n-5,1\n0,1\n")
    conditions = replace(OFFSET_ALONE, weather=Weather(str(tmp_path / "weather.csv")))
    with pytest.raises(AuditError, match=r"^weather: file: expected a column outside_c[^\n]*$"):
        calibrate(walls["plain"], replace(WALL, **CAPACITY), conditions)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"unknown": ()}, "unknown"),
        ({"unknown": (*WALL.unknown, *WALL.unknown)}, "unknown"),
        ({"unknown": (Unknown("thickness", "wall"),)}, "unknown"),
        ({"conductivity": {"wall": Measured(0.1, 0.1)}}, "conductivity: wall"),
        ({"layers": {"wall": Layer(("room",), Measured(0.1), Measured(1.0))}}, "layers"),
    ],
)
def test_what_cannot_be_asked_is_said(changes, named) -> None:
    with pytest.raises(AuditError, match=f"^{named}: expected"):
        replace(WALL, **changes)


@pytest.mark.parametrize(
    ("wall", "changes", "named"),
    [
        ("plain", {"conductivity": {"wal": Measured(1.0)}, "unknown": (Unknown("conductivity", "wal"),)}, "conduct"),
        ("plain", {"behind": ("rom",)}, "behind: expected patches out of .*room.*, got 'rom'"),
        ("plain", {"behind": ("room", "facade")}, "behind: expected another side"),
        ("plain", {"layers": {"x": Layer(("facade",), Measured(0.1), Measured(1.0))}}, "layers: x"),
        ("window", {}, "conductivity: .*got none for glazing"),
    ],
)
def test_what_does_not_fit_the_mesh_is_said(walls, wall, changes, named) -> None:
    with pytest.raises(AuditError, match=f"^calibrate: {named}"):
        calibrate(walls[wall], replace(WALL, **changes))
