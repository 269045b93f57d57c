"""Numbers as the report of a heat computation writes them."""

from __future__ import annotations

import numpy as np


def figure(value: float) -> str:
    """Write four digits, without powers of ten where figures are of everyday size.

    >>> figure(1234.56), figure(0.0123456), figure(0.0)
    ('1,235', '0.01235', '0')
    """
    if value == 0.0:
        return "0"
    if 1e-3 <= abs(value) < 1e6:
        digits = max(0, 3 - int(np.floor(np.log10(abs(value)))))
        return f"{value:,.{digits}f}"
    return f"{value:.3e}"
