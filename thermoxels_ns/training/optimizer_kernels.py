"""The compiled row updates of Adam on a CPU; `optimizers` has the same updates in plain PyTorch."""

from __future__ import annotations

import numpy as np

from thermoxels_ns.core.kernel_cache import kernel


@kernel
def adam_rows(
    begin: int,
    end: int,
    rows,  # numbers of the rows with a gradient, (n,)
    gradient,  # gradients of these rows, (n, channels)
    values,  # the parameter, (all rows, channels), changed in place
    first,  # running mean of gradients, (all rows, channels), changed in place
    second,  # running mean of squared gradients, (all rows, channels), changed in place
    updates,  # number of updates of each row, (all rows,), changed in place
    lr,
    beta1,
    beta2,
    eps,
    correction1,  # 1 - beta1^t by the number t of updates
    correction2,  # 1 - beta2^t by the number t of updates
):
    """Take one step of Adam on the rows ``rows[begin:end]`` of a parameter and of its state; see `RowAdam`."""
    last1, last2 = len(correction1) - 1, len(correction2) - 1
    one = values.dtype.type  # constants in the parameter's precision, so that the inner loop has one width
    b1, c1, b2, c2, tiny = one(beta1), one(1.0 - beta1), one(beta2), one(1.0 - beta2), one(eps)
    for n in range(begin, end):
        row = rows[n]
        updates[row] += one(1.0)
        count = int(updates[row] + 0.5)  # after a split, interpolated numbers of updates are not whole
        rate, share = one(lr / correction1[min(count, last1)]), one(1.0 / correction2[min(count, last2)])
        at, m, v, g = values[row], first[row], second[row], gradient[n]
        for k in range(at.shape[0]):
            m[k] = b1 * m[k] + c1 * g[k]
            v[k] = b2 * v[k] + c2 * g[k] * g[k]
            at[k] -= rate * m[k] / (np.sqrt(v[k] * share) + tiny)
