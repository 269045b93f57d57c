"""Compiled shading: read colour and temperature where samples have weight, and sum them along rays."""

from __future__ import annotations

import math

import numpy as np

from thermoxels_ns.core.kernel_cache import kernel
from thermoxels_ns.render.kernels import (
    Y00,
    Floats,
    Ints,
    Rays,
    Records,
    Settings,
    Sums,
    Volume,
    basis_of,
    gather,
    gather_one,
    place_of,
    prefetch,
    prefetch_corners,
)

NEAR, FAR = 8, 24
"""Samples ahead whose values, and whose row numbers, are asked for."""


@kernel
def prefetch_colours(values: Floats, rows: Ints, number: int):
    """Ask for the colours of a voxel's corners, whose rows are longer than a cache line unless there is one colour."""
    channels = values.shape[1]
    if channels == 3:
        prefetch_corners(values, rows, number)
        return
    for corner in range(4):
        row = np.int64(rows[number, corner])
        # The two rows of a corner and the next one stand one behind the other.
        prefetch(values, row, 0)
        prefetch(values, row, 16)
        prefetch(values, row + 1, 0)
        prefetch(values, row + 1, channels - 1)


@kernel
def shade(first: int, last: int, rays: Rays, volume: Volume, settings: Settings, records: Records, sums: Sums):
    """Read and sum colour and temperature of rays `first` to `last` (paper, eq. 1 and 2).

    Samples of at most the smallest weight are left out, and what their ray does not want. Values are asked for some
    samples ahead.
    """
    channels, thermal_channels = volume.sh.shape[1], volume.temperature.shape[1]
    count = channels // 3
    one = volume.density.dtype.type
    coefficients = np.empty(channels, volume.sh.dtype)
    thermal_coefficients = np.empty(thermal_channels, volume.temperature.dtype)
    basis, thermal_basis = np.empty(9), np.empty(9)
    end = records.offset[last - 1] + records.used[last - 1]
    for r in range(first, last):
        wants_rgb, wants_thermal = (rays.wants[r] & 1) != 0 and channels > 0, (rays.wants[r] & 2) != 0
        if wants_rgb:
            basis_of(rays.directions, r, count, 1.0, basis)
        if wants_thermal and thermal_channels > 1:
            basis_of(rays.directions, r, thermal_channels, 1.0 / Y00, thermal_basis)
        red, green, blue, thermal = 0.0, 0.0, 0.0, 0.0
        wanted = records.used[r] if wants_rgb or wants_thermal else 0
        for n in range(records.offset[r], records.offset[r] + wanted):
            if n + FAR < end:
                prefetch(volume.voxel_rows, records.number[n + FAR], 0)
            if n + NEAR < end and records.weight[n + NEAR] > settings.smallest_weight:
                # What this ray wants is a good guess of what the next one wants.
                if wants_rgb:
                    prefetch_colours(volume.sh, volume.voxel_rows, records.number[n + NEAR])
                if wants_thermal:
                    prefetch_corners(volume.temperature, volume.voxel_rows, records.number[n + NEAR])
            if not records.weight[n] > settings.smallest_weight:  # as rounded: the backward pass asks the same
                continue
            number, (fx, fy, fz), weight = records.number[n], place_of(records, n), float(records.weight[n])
            if wants_rgb:
                if count > 1:
                    gather(volume.sh, volume.voxel_rows, number, fx, fy, fz, coefficients)
                for c in range(3):
                    logit = 0.0
                    if count == 1:
                        logit = Y00 * gather_one(volume.sh, volume.voxel_rows, number, fx, fy, fz, c)
                    else:
                        for k in range(count):
                            logit += coefficients[c * count + k] * basis[k]
                    records.rgb[n, c] = one(1.0) / (one(1.0) + math.exp(one(-logit)))
                red += weight * records.rgb[n, 0]
                green += weight * records.rgb[n, 1]
                blue += weight * records.rgb[n, 2]
            if wants_thermal:
                value = 0.0
                if thermal_channels == 1:
                    value = gather_one(volume.temperature, volume.voxel_rows, number, fx, fy, fz, 0)
                else:
                    gather(volume.temperature, volume.voxel_rows, number, fx, fy, fz, thermal_coefficients)
                    for k in range(thermal_channels):
                        value += thermal_coefficients[k] * thermal_basis[k]
                records.thermal[n] = value
                thermal += weight * records.thermal[n]
        if channels > 0:
            sums.rgb[r, 0], sums.rgb[r, 1], sums.rgb[r, 2] = red, green, blue
        sums.thermal[r, 0] = thermal
