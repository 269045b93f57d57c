"""The pool of threads that runs compiled kernels on ranges of their work."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache, partial

_CHUNKS_PER_THREAD = 8
_threads: int | None = None


def num_threads() -> int:
    """Return the number of threads that `run_ranges` and `run_tasks` use."""
    return _threads or os.cpu_count() or 1


def set_num_threads(threads: int | None) -> None:
    """Set the number of threads of `run_ranges` and `run_tasks`; None: one per processor."""
    global _threads
    _threads = threads


@lru_cache(maxsize=1)
def _executor(threads: int, _process: int) -> ThreadPoolExecutor:
    """Return the pool of a process: a forked process does not have the threads of its parent."""
    return ThreadPoolExecutor(threads, thread_name_prefix="thermoxels")


def run_ranges(work: Callable[[int, int], object], total: int, smallest: int = 64) -> list[object]:
    """Call ``work(first, last)`` in parallel on ranges (last excluded) that cover 0 to `total`; return all results.

    Results are in the order of the ranges. Each range has at least `smallest` items, except the last range. To run in
    parallel, `work` must release Python's global lock. To give the same result with any number of threads, it must
    write only to places of its own range.
    """
    threads = num_threads()
    size = max(smallest, total if threads == 1 else -(-total // (threads * _CHUNKS_PER_THREAD)))
    return run_tasks([partial(work, first, min(first + size, total)) for first in range(0, total, size)])


def run_tasks(tasks: list[Callable[[], object]]) -> list[object]:
    """Call independent functions in parallel and return their results in the order of `tasks`."""
    if num_threads() == 1 or len(tasks) < 2:
        return [task() for task in tasks]
    return list(_executor(num_threads(), os.getpid()).map(lambda task: task(), tasks))
