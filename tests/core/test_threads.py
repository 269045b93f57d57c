import multiprocessing
import os
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from thermoxels_ns.core import threads
from thermoxels_ns.core.kernel_cache import forget_stale_kernels, kernel
from thermoxels_ns.core.threads import run_ranges, run_tasks, set_num_threads


@pytest.fixture(autouse=True)
def restored() -> Iterator[None]:
    before = threads._state["threads"]
    yield
    set_num_threads(before or None)


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
