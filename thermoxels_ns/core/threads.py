"""The pool of threads that runs compiled kernels on ranges of their work."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

_CHUNKS_PER_THREAD = 8
_state: dict[str, int] = {"threads": 0, "owner": 0}
_pool: list[ThreadPoolExecutor] = []


def num_threads() -> int:
    """Return the number of threads that `run_ranges` and `run_tasks` use."""
    return _state["threads"] or os.cpu_count() or 1


def set_num_threads(threads: int | None) -> None:
    """Set the number of threads of `run_ranges` and `run_tasks`; None: one per processor."""
    _state["threads"] = threads or 0


def _executor() -> ThreadPoolExecutor:
    wanted, process = num_threads(), os.getpid()
    if not _pool or _state["owner"] != process or _pool[0]._max_workers != wanted:
        # A forked process does not have the threads of its parent.
        if _pool and _state["owner"] == process:
            _pool[0].shutdown(wait=True)
        _pool[:] = [ThreadPoolExecutor(wanted, thread_name_prefix="thermoxels")]
        _state["owner"] = process
    return _pool[0]


def run_ranges(work: Callable[[int, int], object], total: int, smallest: int = 64) -> list[object]:
    """Call ``work(first, last)`` in parallel on ranges (last excluded) that cover 0 to `total`; return all results.

    Results are in the order of the ranges. Each range has at least `smallest` items, except the last range. To run in
    parallel, `work` must release Python's global lock. To give the same result with any number of threads, it must
    write only to places of its own range.
    """
    threads = num_threads()
    if threads == 1 or total <= smallest:
        return [work(0, total)] if total else []
    size = max(smallest, -(-total // (threads * _CHUNKS_PER_THREAD)))
    starts = range(0, total, size)
    return list(_executor().map(lambda first: work(first, min(first + size, total)), starts))


def run_tasks(tasks: list[Callable[[], object]]) -> list[object]:
    """Call independent functions in parallel and return their results in the order of `tasks`."""
    if num_threads() == 1 or len(tasks) < 2:
        return [task() for task in tasks]
    return list(_executor().map(lambda task: task(), tasks))
