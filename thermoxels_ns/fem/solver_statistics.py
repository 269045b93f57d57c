"""The bill of a heat computation: what was assembled, how often and for how long."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field


@dataclass
class Assembled:
    """Forms that were assembled, by kind; what a problem does not call for has no entry.

    >>> bill = Assembled()
    >>> with bill.form("stiffness"):
    ...     pass
    >>> bill.counts
    {'stiffness': 1}
    """

    counts: dict[str, int] = field(default_factory=dict)
    """How often each kind was assembled: stiffness, mass, robin, flux, radiation, source, fixed."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Time each kind took, [s]."""

    @contextmanager
    def form(self, kind: str) -> Iterator[None]:
        """Count what is assembled inside."""
        start = time.perf_counter()
        yield
        self.seconds[kind] = self.seconds.get(kind, 0.0) + time.perf_counter() - start
        self.counts[kind] = self.counts.get(kind, 0) + 1
