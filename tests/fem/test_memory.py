from __future__ import annotations

import pytest

from thermoxels_ns.errors import HeatError
from thermoxels_ns.fem.memory import check_memory, describe_bytes, needed_bytes


def test_need_grows_with_order_refinement_and_times() -> None:
    one = needed_bytes(1000, 200)
    assert needed_bytes(1000, 200, refinements=2) == 64.0 * one
    assert needed_bytes(1000, 200, order=2) > 10.0 * one
    assert needed_bytes(1000, 200, times=11) == one + 8.0 * 10 * 200


@pytest.mark.parametrize(
    ("amount", "words"), [(1024.0, "0.00098 MiB"), (2e6, "1.9 MiB"), (5e8, "477 MiB"), (6.9e9, "6.4 GiB")]
)
def test_amounts_in_words(amount, words) -> None:
    assert describe_bytes(amount) == words


def test_what_does_not_fit_is_refused() -> None:
    check_memory(10.0, 10.0, "")
    with pytest.raises(
        HeatError, match=r"memory of the heat problem: expected at most 1 GiB, got about 2 GiB\. Wait\."
    ):
        check_memory(2.0**31, 2.0**30, "Wait.")
