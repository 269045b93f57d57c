"""Compiled kernel that cuts rays into straight pieces of the surroundings."""

from __future__ import annotations

import numpy as np

from thermoxels_ns.core.kernel_cache import kernel

MOST_SEGMENTS = 6  # Most frusta through which a ray can pass


@kernel
def cut_rays(at, along, reaches, across: int, deep: int, ends, ray, rank):
    """Cut rays into straight pieces, one per frustum of `Surroundings`, and return the number of pieces.

    Args:
        at: Origins of the rays in coordinates in which the box is -1 to 1, (rays, 3).
        along: Directions per world unit in these coordinates, (rays, 3).
        reaches: Distance at which each ray ends, (rays,), [world units]; may be infinite.
        across: `Surroundings.across`.
        deep: `Surroundings.deep`.
        ends: Receives the two ends of each piece in lattice coordinates, (n, 2, 3), n >= `MOST_SEGMENTS` times rays.
        ray: Receives the ray of each piece, (n,).
        rank: Receives the number of each piece along its ray, from 0, (n,).
    """
    count = 0
    for r in range(len(at)):
        now = _begin(at[r], along[r])
        if now >= reaches[r]:
            continue
        axis, sign, reach = 0, 1.0, -1.0
        for i in range(3):  # the face of the largest coordinate; of equal coordinates, of the one that grows fastest
            value = at[r, i] + now * along[r, i]
            side = 1.0 if value + 1e-12 * along[r, i] >= 0.0 else -1.0
            if side * value > reach + 1e-9 or (
                side * value > reach - 1e-9 and side * along[r, i] > sign * along[r, axis]
            ):
                axis, sign, reach = i, side, side * value
        for number in range(MOST_SEGMENTS):
            until, next_axis, next_sign = reaches[r], -1, 1.0
            for j in range(3):
                for side in (-1.0, 1.0):
                    gain = side * along[r, j] - sign * along[r, axis]
                    if j == axis or gain <= 1e-12:
                        continue
                    t = (sign * at[r, axis] - side * at[r, j]) / gain
                    if now < t < until:
                        until, next_axis, next_sign = t, j, side
            if next_axis < 0 or until > now * (1.0 + 1e-9) + 1e-9:
                face = 2 * axis + (1 if sign < 0.0 else 0)
                for last in range(2):
                    t = until if last else now
                    endless = not t < 1e9
                    q = along[r, axis] * sign if endless else sign * (at[r, axis] + t * along[r, axis])
                    q = max(q, 1e-12) if endless else max(q, 1.0)
                    ends[count, last, 0] = face * (deep + 1) + (deep if endless else (1.0 - 1.0 / q) * deep)
                    for step in range(1, 3):
                        i = (axis + step) % 3
                        p = (along[r, i] if endless else at[r, i] + t * along[r, i]) / q
                        ends[count, last, step] = 0.5 * (min(max(p, -1.0), 1.0) + 1.0) * across
                ray[count], rank[count] = r, number
                count += 1
            if next_axis < 0:
                break
            now, axis, sign = until, next_axis, next_sign
    return count


@kernel
def _begin(at, along):
    """Return the distance, at least 0, at which a ray leaves the box -1 to 1. For a ray that misses the box, return the
    distance of its point nearest to the middle."""
    enter, leave, across, square = -np.inf, np.inf, 0.0, 0.0
    for i in range(3):
        step = along[i] if abs(along[i]) > 1e-12 else 1e-12
        a, b = (-1.0 - at[i]) / step, (1.0 - at[i]) / step
        enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
        across -= at[i] * along[i]
        square += along[i] * along[i]
    return max(0.0, leave if leave > enter and leave > 0.0 else across / square)
