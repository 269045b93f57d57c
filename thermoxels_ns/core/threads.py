"""A pool of threads for ranges of work of the compiled kernels."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

_CHUNKS_PER_THREAD = 8
_state: dict[str, int] = {"threads": 0, "owner": 0}
_pool: list[ThreadPoolExecutor] = []


def num_threads() -> int:
    """Return the number of threads that kernels use."""
    return _state["threads"] or os.cpu_count() or 1


def set_num_threads(threads: int | None) -> None:
    """Set the number of threads; None: one per processor."""
    _state["threads"] = threads or 0


def _executor() -> ThreadPoolExecutor:
    wanted, process = num_threads(), os.getpid()
    if not _pool or _state["owner"] != process or _pool[0]._max_workers != wanted:
        # A forked process has none of its parent's threads.
        if _pool and _state["owner"] == process:
            _pool[0].shutdown(wait=True)
        _pool[:] = [ThreadPoolExecutor(wanted, thread_name_prefix="thermoxels")]
        _state["owner"] = process
    return _pool[0]


def run_ranges(work: Callable[[int, int], object], total: int, smallest: int = 64) -> list[object]:
    """Call ``work(first, last)`` on ranges that cover 0 to `total`, in parallel, and return the results in order.

    Kernels release Python's lock and write to disjoint places; how many threads there are never changes a result. A
    range of fewer than `smallest` items is not worth a thread.
    """
    threads = num_threads()
    if threads == 1 or total <= smallest:
        return [work(0, total)] if total else []
    size = max(smallest, -(-total // (threads * _CHUNKS_PER_THREAD)))
    starts = range(0, total, size)
    return list(_executor().map(lambda first: work(first, min(first + size, total)), starts))


def run_tasks(tasks: list[Callable[[], object]]) -> list[object]:
    """Call independent functions in parallel and return their results in order."""
    if num_threads() == 1 or len(tasks) < 2:
        return [task() for task in tasks]
    return list(_executor().map(lambda task: task(), tasks))
