"""Units, measured values, the lattice, snapshots on it, and the rename-when-done rule."""

import os
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.looking_cameras import looking_at
from thermoxels_ns.core.checks import remove_file, replace_when_done
from thermoxels_ns.core.errors import MeshError, OutputError, ThermoxelsError
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.measured import read_measured
from thermoxels_ns.core.snapshot import GridSnapshot, RayEvidence, Views
from thermoxels_ns.core.units import TemperatureRange


@pytest.mark.parametrize("bounds", [(20.0, 20.0), (30.0, 20.0), (float("nan"), 1.0), (0.0, float("inf"))])
def test_impossible_ranges_are_refused(bounds):
    with pytest.raises(ThermoxelsError, match=r"^temperature range: "):
        TemperatureRange(*bounds)


def test_interrupted_write_leaves_the_old_file_and_no_rubbish(tmp_path):
    target = tmp_path / "mesh.vtu"
    target.write_text("old")
    (tmp_path / ".mesh.part.vtu").write_text("left by a killed process")
    with pytest.raises(KeyboardInterrupt), replace_when_done(target) as temporary:
        assert temporary.suffix == ".vtu"
        temporary.write_text("half")
        raise KeyboardInterrupt
    assert target.read_text() == "old" and os.listdir(tmp_path) == ["mesh.vtu"]
    with replace_when_done(target) as temporary:
        temporary.write_text("new")
    assert target.read_text() == "new" and os.listdir(tmp_path) == ["mesh.vtu"]


def test_errors_of_the_disk_become_output_errors(tmp_path):
    (tmp_path / "mesh.vtu").mkdir()
    blocked = pytest.raises(OutputError, match=r"mesh\.vtu: expected a file that can be written.*Move away")
    with blocked, replace_when_done(tmp_path / "mesh.vtu") as temporary:
        temporary.write_text("new")
    full = pytest.raises(OutputError, match=r"a\.txt: expected a file that can be written.*No space left")
    with full, replace_when_done(tmp_path / "a.txt"):
        raise OSError(28, "No space left on device")
    with pytest.raises(OutputError, match=r"mesh\.vtu: expected a file that can be removed"):
        remove_file(tmp_path / "mesh.vtu")
    with pytest.raises(MeshError, match="own words"), replace_when_done(tmp_path / "a.txt"):
        raise MeshError("own words")
    assert os.listdir(tmp_path) == ["mesh.vtu"]
    remove_file(tmp_path / "absent")


@pytest.mark.parametrize(
    ("written", "unit", "value", "off_by"),
    [
        ("20.0 +- 0.5 C", "C", 20.0, 0.5),
        ("20 ± .5 °C", "C", 20.0, 0.5),
        ("293.15 +/- 0.5 K", "C", 20.0, 0.5),
        ("-3C", "C", -3.0, 0.0),
        ("20,5 +- 0,5 ºC", "C", 20.5, 0.5),
        ("\N{MINUS SIGN}3 degrees Celsius", "C", -3.0, 0.0),
        ("20°", "C", 20.0, 0.0),
        ("0,578 m/s", "m/s", 0.578, 0.0),
        ("1,5 h", "s", 5400.0, 0.0),
        ("0 +- 1 K", "K", 0.0, 1.0),
        ("1.5 m/s", "m/s", 1.5, 0.0),
        ("3.6 +- 1.8 km/h", "m/s", 1.0, 0.5),
        ("8 +- 1 W/(m² K)", "W/(m2 K)", 8.0, 1.0),
        ("0.5 W/m2K", "W/(m2 K)", 0.5, 0.0),
        ("0.93 +- 0.02", "1", 0.93, 0.02),
        (0.93, "1", 0.93, 0.0),
        (1, "1", 1.0, 0.0),
        ("80 +- 5 %", "1", 0.8, 0.05),
        ("76.8e3 K h", "K d", 3200.0, 0.0),
    ],
)
def test_values_are_read_as_people_write_them(written, unit, value, off_by) -> None:
    found = read_measured("x", written, unit)
    assert (found.value, found.off_by) == (pytest.approx(value, abs=1e-12), pytest.approx(off_by, abs=1e-12))
    assert (found.low, found.high) == (found.value - found.off_by, found.value + found.off_by)


@pytest.mark.parametrize(
    ("written", "unit", "message"),
    [
        (20.0, "C", r"air: expected a number with its unit, C, got 20\.0 without one\. Write 20\.0 C\."),
        ("20 +- 0.5", "C", r"got '20 \+- 0\.5' without one\. Write 20 \+- 0\.5 C\."),
        ("20 F", "C", r"got '20 F'\. Write 20\.0 \+- 0\.5 C, for example\."),
        ("0.9 C", "1", r"expected a number without a unit, or in %, got '0\.9 C'"),
        ("1,500 W", "W", r"air: expected a comma.*, got '1,500 W'\. Write 1500 or 1\.500"),
        ("warm", "C", r"expected a number in C, got 'warm'"),
        (None, "C", r"expected a number in C, got nothing"),
        (True, "1", r"expected a number, got True"),
        ("20 +- -0.5 C", "C", r"behind \+- one of at least 0"),
        ("1e999 C", "C", r"expected a finite number"),
    ],
)
def test_what_is_no_value_is_refused_with_what_helps(written, unit, message) -> None:
    with pytest.raises(ThermoxelsError, match=message):
        read_measured("air", written, unit)


LATTICE = Lattice((-1.0, 0.25, 3.0), 0.5, (4, 3, 5))


def test_corners_and_centres_sit_where_the_house_says():
    corners = LATTICE.corner_positions()
    np.testing.assert_array_equal(corners[2, 1, 4], [-1 + 2 * 0.5, 0.25 + 0.5, 3 + 4 * 0.5])
    np.testing.assert_array_equal(corners[-1, -1, -1], LATTICE.hi)
    np.testing.assert_array_equal(LATTICE.cell_centres()[0, 0, 0], [-0.75, 0.5, 3.25])
    assert LATTICE.num_corners == 60 and LATTICE.cell_shape == (3, 2, 4)
    slope = np.array([1.0, -2.0, 0.5])  # the mean of a linear field is its value at the centre
    np.testing.assert_allclose(LATTICE.corner_to_cell_mean(corners @ slope), LATTICE.cell_centres() @ slope)


@given(
    st.lists(st.floats(-10, 10), min_size=3, max_size=3),
    st.lists(st.floats(0.01, 20), min_size=3, max_size=3),
    st.integers(1, 200),
)
def test_covering_covers_and_wastes_less_than_a_voxel(lo, size, resolution):
    box_lo = np.array(lo)
    box_hi = box_lo + np.array(size)
    lattice = Lattice.covering(box_lo, box_hi, resolution)
    slack = 1e-5 * lattice.voxel_size
    assert np.all(np.array(lattice.lo) <= box_lo + slack) and np.all(np.array(lattice.hi) >= box_hi - slack)
    assert max(lattice.cell_shape) == resolution
    assert np.all(np.array(lattice.hi) - lattice.lo - (box_hi - box_lo) < lattice.voxel_size + slack)


@pytest.mark.parametrize(
    "lo, hi, resolution",
    [((0, 0, 0), (1, 0, 1), 8), ((0, 0, 0), (1, np.nan, 1), 8), ((0, 0, 0), (1, 1, 1), 0), ((1, 1, 1), (0, 0, 0), 8)],
)
def test_boxes_of_no_size_are_refused(lo, hi, resolution):
    with pytest.raises(ThermoxelsError, match="scene box: expected three finite sides"):
        Lattice.covering(lo, hi, resolution)


def full() -> GridSnapshot:
    """A snapshot of 2 x 3 x 4 corners with everything known."""
    ones = np.ones((2, 3, 4), np.float32)
    return GridSnapshot(
        Lattice((0.0, 0.0, 0.0), 1.0, (2, 3, 4)),
        ones,
        ones,
        ones,
        np.ones((1, 2, 3), np.float32),
        np.ones((2, 3, 4, 3), np.float32),
        RayEvidence(np.ones((1, 2, 3), np.float32), *(np.ones(shape, np.float32) for shape in (7, (7, 3), (7, 3)))),
        Views(np.zeros((5, 3, 4)), np.ones((5, 2)), np.zeros((5, 2)), np.ones((5, 2), np.int64)),
    )


@pytest.mark.parametrize("part", ["evidence", "views"])
def test_what_cannot_be_is_refused_by_name(part):
    """Another shape, numbers that are not finite, and numbers beyond what they may be."""
    whole = getattr(full(), part)
    beyond = {"voxel_weight": -1e-3, "half_depth_density": -1.0, "directions": 2.0, "focal": 0.0, "size": 0}
    for name, array in vars(whole).items():
        wrong = [array[..., None]]
        values = [np.nan, np.inf] if array.dtype.kind == "f" else []
        for value in (*values, *([beyond[name]] if name in beyond else [])):
            wrong.append(array.copy())
            wrong[-1].reshape(-1)[-1] = value
        for one in wrong:
            with pytest.raises(MeshError, match=f"^grid snapshot {name}: "):
                replace(full(), **{part: replace(whole, **{name: one})})
    for name in ("voxel_density", "colour"):
        with pytest.raises(MeshError, match=f"^grid snapshot {name}: expected shape"):
            replace(full(), **{name: np.ones((2, 3, 4), np.float32)})


def test_what_is_shown_well_ends_where_pixels_per_area_fall_off():
    """Eight cameras 2 away from a point at which all are pointed; visibility falls with the square of the distance."""
    angle = 0.25 * np.pi * np.arange(8)
    views = looking_at((0.0, 0.0, 0.0), 2.0 * np.column_stack((np.cos(angle), np.sin(angle), 0.0 * angle)), focal=200.0)
    reach = np.full(8, 2.0)
    places = np.array([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (2.5, 0.0, 0.0), (0.0, 0.0, 3.0)])
    # At (2.5, 0, 0), seen by three of eight, it is 0.6 / 8; nobody looks up to (0, 0, 3).
    assert views.shown_well(places, reach).tolist() == [True, True, False, False]
    one = np.where(np.arange(8) == 0, reach, np.nan)  # of the others it is not known what they are pointed at
    behind = np.array([(-2.9, 0.0, 0.0), (-3.5, 0.0, 0.0), (2.9, 0.0, 0.0)])
    assert views.shown_well(behind, one).tolist() == [True, False, False]  # (2 / 4.9)^2 = 0.17, (2 / 5.5)^2 = 0.13
    # Pointed at what is 3 away, it shows places up to 3 / sqrt(0.15) = 7.7 away well.
    farther = np.array([(-5.5, 0.0, 0.0), (-6.0, 0.0, 0.0)])
    assert views.shown_well(farther, 1.5 * one).tolist() == [True, False]
    assert views.shown_well(places, np.full(8, np.nan)).all()
