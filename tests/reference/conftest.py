"""Fixtures of the comparison of renderers."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

from thermoxels_ns.core import threads


@pytest.fixture
def restored_threads() -> Iterator[None]:
    """Give kernels and torch their threads back after a test."""
    kernels, ours = threads._state["threads"], torch.get_num_threads()
    yield
    threads.set_num_threads(kernels or None)
    torch.set_num_threads(ours)
