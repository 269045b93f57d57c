"""Units, measured values, the lattice, snapshots on it, and the rename-when-done rule."""

import multiprocessing
import os
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import thermoxels_ns.core.feature_rays as module
from tests.support.looking_cameras import looking_at
from thermoxels_ns.core import threads
from thermoxels_ns.core.checks import remove_file, replace_when_done
from thermoxels_ns.core.errors import MeshError, OutputError, ThermoxelsError
from thermoxels_ns.core.feature_rays import FeatureRays, agrees_with_neighbours
from thermoxels_ns.core.kernel_cache import forget_stale_kernels, kernel
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.measured import read_measured
from thermoxels_ns.core.snapshot import GridSnapshot, RayEvidence, Views
from thermoxels_ns.core.threads import run_ranges, run_tasks, set_num_threads
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
    snapshot = GridSnapshot(LATTICE, *[corners @ slope] * 3)
    np.testing.assert_allclose(snapshot.centre_density(), LATTICE.cell_centres() @ slope)


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
        RayEvidence(*(np.ones(shape, np.float32) for shape in (7, (7, 3), (7, 3)))),
        Views(np.zeros((5, 3, 4)), np.ones((5, 2)), np.zeros((5, 2)), np.ones((5, 2), np.int64)),
    )


@pytest.mark.parametrize("part", ["evidence", "views"])
def test_what_cannot_be_is_refused_by_name(part):
    """Another shape, numbers that are not finite, and numbers beyond what they may be."""
    whole = getattr(full(), part)
    beyond = {"half_depth_density": -1.0, "directions": 2.0, "focal": 0.0, "size": 0}
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


CAMERAS = np.random.default_rng(9).uniform(-0.6, 0.6, (6, 3)) + np.array([0.0, 0.0, 2.0])


def seen_by_all(points: np.ndarray, uncertainty: float = 0.0) -> FeatureRays:
    number = np.repeat(np.arange(len(points)), len(CAMERAS))
    return FeatureRays(np.tile(CAMERAS, (len(points), 1)), number, points, np.full(len(number), uncertainty))


def floor(count: int = 600, seed: int = 0, slope: float = 0.0) -> np.ndarray:
    x, y = np.random.default_rng(seed).uniform(-1.0, 1.0, (2, count))
    return np.column_stack((x, y, slope * x))


def moved_in_sight(points: np.ndarray, wrong: np.ndarray, factors: np.ndarray) -> np.ndarray:
    """Points at another distance from the middle of the cameras."""
    middle = CAMERAS.mean(axis=0)
    return np.where(wrong[:, None], middle + factors[:, None] * (points - middle), points)


@pytest.mark.parametrize("slope, most_missed", [(0.0, 0.1), (1.0, 0.25)])
@pytest.mark.parametrize("share", [0.05, 0.2])
@pytest.mark.parametrize("side", ["before", "behind"])
def test_wrong_points_before_and_behind_a_surface_are_found_and_right_ones_stay(
    slope, most_missed, share, side
) -> None:
    random = np.random.default_rng(1)
    points = floor(slope=slope)
    wrong = random.random(len(points)) < share
    factors = random.uniform(0.5, 0.75, len(points)) if side == "before" else random.uniform(1.3, 1.6, len(points))
    agrees = agrees_with_neighbours(seen_by_all(moved_in_sight(points, wrong, factors)))
    assert agrees[~wrong].mean() > 0.97
    assert agrees[wrong].mean() < most_missed


def test_of_two_surfaces_one_before_the_other_both_stay() -> None:
    points = floor(2000)
    near = points[:, 0] > 0.1
    points[near, 2] = 0.7
    points = points[near | (points[:, 0] < 0.0)]
    assert agrees_with_neighbours(seen_by_all(points)).mean() > 0.99


def test_the_same_distance_off_is_doubted_where_points_are_dense_and_not_where_they_are_sparse() -> None:
    off = np.array([[0.0, 0.0, 0.3]])
    dense, sparse = (np.concatenate((floor(count), off)) for count in (4000, 12))
    assert not agrees_with_neighbours(seen_by_all(dense))[-1]
    assert agrees_with_neighbours(seen_by_all(sparse))[-1]
    assert agrees_with_neighbours(seen_by_all(dense, uncertainty=0.2))[-1], "what is not known better"


def test_the_verdict_is_the_same_in_any_world_and_in_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    random = np.random.default_rng(4)
    points = floor(300)
    wrong = random.random(300) < 0.2
    lines = seen_by_all(moved_in_sight(points, wrong, random.uniform(0.5, 1.6, 300)))
    whole = agrees_with_neighbours(lines)
    turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
    assert 0.05 < (~whole).mean() < 0.3
    assert np.array_equal(agrees_with_neighbours(lines.moved(turn, np.array([5.0, -3.0, 1.0]), 250.0)), whole)
    monkeypatch.setattr(module, "_RAYS_AT_ONCE", 37)
    assert np.array_equal(agrees_with_neighbours(lines), whole)


def test_points_without_lines_are_not_doubted_and_nothing_is_made_of_nothing() -> None:
    nothing = FeatureRays(np.zeros((0, 3)), np.zeros(0, dtype=np.int64), floor(4), np.zeros(0))
    assert agrees_with_neighbours(nothing).tolist() == [True] * 4
    none = FeatureRays(nothing.origins, nothing.point, np.zeros((0, 3)), nothing.uncertainty)
    assert agrees_with_neighbours(none).shape == (0,)


@pytest.fixture(autouse=True)
def restored() -> Iterator[None]:
    before = threads._threads
    yield
    set_num_threads(before)


@given(st.integers(1, 6), st.integers(0, 5000), st.integers(1, 300))
@settings(max_examples=80, deadline=None, derandomize=True, database=None)
def test_ranges_cover_everything_once_in_order(count, total, smallest):
    set_num_threads(count)
    ranges = run_ranges(lambda first, last: (first, last), total, smallest)
    assert [i for first, last in ranges for i in range(first, last)] == list(range(total))
    assert all(last > first for first, last in ranges)
    assert all(last - first >= smallest for first, last in ranges[:-1])


def test_work_runs_in_as_many_threads_as_were_asked_for():
    """Each waits until all are there: fewer threads than asked for would wait in vain."""
    set_num_threads(3)
    together = threading.Barrier(3)
    assert len(set(run_tasks([lambda: together.wait(20) for _ in range(3)]))) == 3
    set_num_threads(1)
    assert run_ranges(lambda *_: threading.current_thread(), 10_000, 1) == [threading.main_thread()]


@pytest.mark.parametrize("count", [1, 4])
def test_an_error_in_a_range_reaches_the_caller_and_the_next_call_works(count):
    set_num_threads(count)

    def work(first: int, last: int) -> int:
        if first <= 700 < last:
            raise ValueError("range with 700")
        return last - first

    with pytest.raises(ValueError, match="range with 700"):
        run_ranges(work, 1000)
    with pytest.raises(ValueError, match="range with 700"):
        run_tasks([lambda: 1, lambda: work(700, 701)])
    assert sum(run_ranges(work, 500)) == 500  # type: ignore[arg-type]


def counted() -> int:
    return sum(run_ranges(lambda first, last: last - first, 5000))  # type: ignore[arg-type]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_a_forked_process_has_threads_of_its_own():
    """Data loaders fork: the pool that they inherit has no living thread, and work given to it would never end."""
    set_num_threads(3)
    assert counted() == 5000
    with multiprocessing.get_context("fork").Pool(1) as pool:
        assert pool.apply_async(counted).get(30.0) == 5000
    assert counted() == 5000


def test_what_was_compiled_from_other_sources_goes_and_nothing_else(tmp_path: Path):
    one, two, cached = tmp_path / "one.py", tmp_path / "two.py", tmp_path / "cache"
    one.write_text("a = 1")
    two.write_text("b = 1")
    assert forget_stale_kernels(cached, (one, two))
    kept = [cached / "one.f-3.py311.nbi", cached / "two.g-7.py311.1.nbc"]
    for path in (*kept, cached / "one.pyc"):
        path.write_text("x")
    assert not forget_stale_kernels(cached, (two, one)) and all(path.exists() for path in kept)
    one.write_text("a = 2")  # as long as before: a time stamp may be equal too
    assert forget_stale_kernels(cached, (one, two))
    assert not any(path.exists() for path in kept) and (cached / "one.pyc").exists()
    assert not forget_stale_kernels(cached, (one, two))


def test_the_kernels_in_use_are_watched():
    from thermoxels_ns.mesh.solid.free_space import _enter_solid as in_mesh
    from thermoxels_ns.render.kernels import march_rays as in_render

    for dispatcher in (in_mesh, in_render):
        assert (Path(dispatcher.stats.cache_path) / "thermoxels-kernels.sha256").is_file()


def test_a_kernel_divides_like_numpy():
    @kernel(cache=False)
    def share(a, b):
        return a / b

    assert share(1.0, 0.0) == np.inf
