import numpy as np
import pytest
from numba import njit

from thermoxels_ns.render.kernels import prefetch


@njit(error_model="numpy")
def sum_with_hints(values, rows):
    total = 0.0
    for place in range(len(rows)):
        prefetch(values, rows[place], 1)
        total += values.flat[0]
    return total


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int32, np.uint8])
@pytest.mark.parametrize("shape", [(7,), (7, 3)], ids=["list", "table"])
def test_hints_read_and_write_nothing(shape, dtype):
    values = np.arange(2, 2 + np.prod(shape)).reshape(shape).astype(dtype)
    before = values.copy()
    rows = np.array([0, 6, 7, -1, 10**6, -(10**6), 2**40, -(2**40)])
    assert sum_with_hints(values, rows) == 2.0 * len(rows)
    assert np.array_equal(values, before)


def test_hint_is_compiled_in():
    """A hint that does nothing at all would pass every other test."""
    sum_with_hints(np.zeros((4, 2), np.float32), np.zeros(3, np.int64))
    code = "".join(sum_with_hints.inspect_llvm().values())
    assert "call void @llvm.prefetch" in code
