"""Compiled backward pass of `kernels.march_forward`, without racing adds.

First each ray turns the gradients of its sums into gradients of its samples (rays share nothing). Then each thread
owns a range of rows and adds to them, in the order of rays and samples, whatever falls there: the sums are the same
bits for any number of threads.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from thermoxels_ns.render.kernels import (
    EXP_LIMIT,
    OPAQUE,
    RELU,
    SOFTPLUS,
    Floats,
    Ints,
    Rays,
    Records,
    Settings,
    Volume,
    basis_of,
    chord,
    gather,
    gather_one,
)

_FLAT_EXP = math.exp(EXP_LIMIT) * (1.0 - 1e-6)
"""Density from which `exp` is constant; a little less, so that rounding to single precision does not hide it."""


class RayGradients(NamedTuple):
    """Gradients of what came out per ray."""

    rgb: Floats
    thermal: Floats
    transmittance: Floats
    """That of the accumulation is subtracted already, the sum of both being 1."""
    distortion: Floats
    sparsity: Floats


class RowGradients(NamedTuple):
    """Gradients of the rows that were touched, per parameter: the row's place in the values, -1 for none."""

    density_place: Ints
    density: Floats
    sh_place: Ints
    sh: Floats
    temperature_place: Ints
    temperature: Floats


@njit(nogil=True, cache=True, error_model="numpy")
def march_backward(
    first: int, last: int, rays: Rays, volume: Volume, settings: Settings, records: Records, grads: RayGradients
):
    """Replace in the records density, left and rgb by the gradients of raw density, temperature and colour logits.

    With w_i = T_i (1 - exp(-x_i)), T_{i+1} = T_i exp(-x_i) and x_i the optical depth of step i,
    dL/dx_i = g_i T_{i+1} - sum_{j>i} g_j w_j - g_T T_end, where g_i = dL/dw_i and g_T is the gradient of what is left.
    """
    channels, thermal_channels = volume.sh.shape[1], volume.temperature.shape[1]
    thermal_coefficients = np.empty(thermal_channels, volume.temperature.dtype)
    thermal_basis = np.empty(9)
    for r in range(first, last):
        start, used = records.offset[r], records.used[r]
        if used == 0:
            continue
        end = start + used
        wants_rgb, wants_thermal = (rays.wants[r] & 1) != 0 and channels > 0, (rays.wants[r] & 2) != 0
        thermal_weight = wants_thermal and settings.thermal_moves_density != 0
        if thermal_weight:
            basis_of(rays.directions, r, thermal_channels, 1.0 / 0.28209479177387814, thermal_basis)
        red = green = blue = 0.0
        if wants_rgb:
            red, green, blue = grads.rgb[r, 0], grads.rgb[r, 1], grads.rgb[r, 2]
        heat = grads.thermal[r, 0] if wants_thermal else 0.0
        enter, leave = chord(rays, r, volume)
        length = leave - enter
        spread = grads.distortion[r] / settings.distortion_scale if settings.distortion_scale > 0.0 else 0.0
        weight_sum, moment_sum = 0.0, 0.0
        if spread != 0.0:
            for n in range(start, end):
                i = records.step[n]
                t = enter + i * settings.step + 0.5 * min(settings.step, length - i * settings.step)
                weight_sum += records.weight[n]
                moment_sum += records.weight[n] * t
        weight_after, moment_after = 0.0, 0.0
        end_term = grads.transmittance[r] * records.left[end - 1]
        behind = 0.0
        for n in range(end - 1, start - 1, -1):
            i = records.step[n]
            delta = min(settings.step, length - i * settings.step)
            weight, density, left = float(records.weight[n]), float(records.density[n]), float(records.left[n])
            gain = 0.0
            seen = weight > settings.smallest_weight
            if seen and wants_rgb:
                cr, cg, cb = float(records.rgb[n, 0]), float(records.rgb[n, 1]), float(records.rgb[n, 2])
                gain += red * cr + green * cg + blue * cb
                records.rgb[n, 0] = red * weight * cr * (1.0 - cr)
                records.rgb[n, 1] = green * weight * cg * (1.0 - cg)
                records.rgb[n, 2] = blue * weight * cb * (1.0 - cb)
            if seen and thermal_weight:
                value = 0.0
                fx, fy, fz = records.fraction[n, 0], records.fraction[n, 1], records.fraction[n, 2]
                if thermal_channels == 1:
                    value = gather_one(volume.temperature, volume.voxel_rows, records.number[n], fx, fy, fz)
                else:
                    gather(volume.temperature, volume.voxel_rows, records.number[n], fx, fy, fz, thermal_coefficients)
                    for k in range(thermal_channels):
                        value += thermal_coefficients[k] * thermal_basis[k]
                gain += heat * value
            if spread != 0.0:
                t = enter + i * settings.step + 0.5 * delta
                weight_before = weight_sum - weight_after - weight
                moment_before = moment_sum - moment_after - weight * t
                gain += spread * (
                    2.0 * (t * (weight_before - weight_after) - (moment_before - moment_after))
                    + 2.0 / 3.0 * weight * delta
                )
                weight_after += weight
                moment_after += weight * t
            slope = gain * left - behind - end_term
            behind += gain * weight
            slope = slope * delta if density * delta < OPAQUE else 0.0
            if settings.sparsity:
                limited = min(density, 1e9)
                if density < 1e9:
                    slope += grads.sparsity[r] * 4.0 * limited / (1.0 + 2.0 * limited * limited)
            if volume.activation == RELU:
                slope = slope if density > 0.0 else 0.0
            elif volume.activation == SOFTPLUS:
                slope *= -math.expm1(-density)
            else:
                slope = slope * density if density < _FLAT_EXP else 0.0
            records.density[n] = slope
            records.left[n] = heat * weight if seen else 0.0


@njit(nogil=True, cache=True, error_model="numpy")
def mark_rows(
    first: int,
    last: int,
    rays: Rays,
    volume: Volume,
    settings: Settings,
    records: Records,
    density_used: Ints,
    sh_used: Ints,
    temperature_used: Ints,
):
    """Mark the voxels whose corners get a gradient; threads may mark the same one, the result does not depend on it."""
    channels = volume.sh.shape[1]
    for r in range(first, last):
        wants_rgb, wants_thermal = (rays.wants[r] & 1) != 0 and channels > 0, (rays.wants[r] & 2) != 0
        for n in range(records.offset[r], records.offset[r] + records.used[r]):
            number = records.number[n]
            if records.density[n] != 0.0:
                density_used[number] = 1
            if records.weight[n] > settings.smallest_weight:
                if wants_rgb:
                    sh_used[number] = 1
                if wants_thermal:
                    temperature_used[number] = 1


@njit(nogil=True, cache=True, error_model="numpy")
def place_rows(used: Ints, voxel_rows: Ints, block_first: int, block_last: int, place: Ints):
    """Number the rows that get a gradient, ascending.

    Args:
        used: Marked voxels.
        voxel_rows: Their rows.
        block_first: First voxel of the block that total variation looks at.
        block_last: One behind its last.
        place: All -1; the place of each row in the values, where it has one.

    Returns:
        Number of such rows.
    """
    for number in range(len(used)):
        if used[number] != 0 or block_first <= number < block_last:
            for k in range(4):
                row = voxel_rows[number, k]
                place[row] = 0
                place[row + 1] = 0
    total = 0
    for row in range(len(place)):
        if place[row] == 0:
            place[row] = total
            total += 1
    return total


@njit(nogil=True, cache=True, error_model="numpy")
def list_rows(place: Ints, total: int):
    """The `total` rows that `place_rows` numbered, ascending, int64."""
    rows = np.empty(total, np.int64)
    for row in range(len(place)):
        if place[row] >= 0:
            rows[place[row]] = row
    return rows


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"contract"})
def add_rows(
    first_row: int, last_row: int, rays: Rays, volume: Volume, settings: Settings, records: Records, rows: RowGradients
):
    """Add the gradients of all samples to rows `first_row` to `last_row` and to no other."""
    channels, thermal_channels = volume.sh.shape[1], volume.temperature.shape[1]
    count = channels // 3
    active = min(count, settings.sh_active)
    dtype = volume.density.dtype
    one = dtype.type
    basis, thermal_basis = np.empty(9), np.empty(9)
    colour = np.zeros(channels, dtype)
    for r in range(len(records.used)):
        start, end = records.offset[r], records.offset[r] + records.used[r]
        if start == end:
            continue
        wants_rgb, wants_thermal = (rays.wants[r] & 1) != 0 and channels > 0, (rays.wants[r] & 2) != 0
        ready = False
        for n in range(start, end):
            number = records.number[n]
            lowest, highest = volume.voxel_rows[number, 0], volume.voxel_rows[number, 3] + 1
            if highest < first_row or lowest >= last_row:
                continue
            slope = records.density[n]
            seen = records.weight[n] > settings.smallest_weight
            if slope == 0.0 and not seen:
                continue
            if seen and not ready:
                ready = True
                if wants_rgb:
                    basis_of(rays.directions, r, active, 1.0, basis)
                if wants_thermal:
                    basis_of(rays.directions, r, thermal_channels, 1.0 / 0.28209479177387814, thermal_basis)
            if seen and wants_rgb:
                for c in range(3):
                    for k in range(active):
                        colour[c * count + k] = records.rgb[n, c] * basis[k]
            heat = records.left[n]
            fx, fy, fz = float(records.fraction[n, 0]), float(records.fraction[n, 1]), float(records.fraction[n, 2])
            for corner in range(8):
                row = volume.voxel_rows[number, corner >> 1] + (corner & 1)
                if row < first_row or row >= last_row:
                    continue
                share = fx if corner & 4 else 1.0 - fx
                share *= fy if corner & 2 else 1.0 - fy
                share *= fz if corner & 1 else 1.0 - fz
                if slope != 0.0:
                    rows.density[rows.density_place[row], 0] += share * slope
                if seen:
                    if wants_rgb:
                        into = rows.sh[rows.sh_place[row]]
                        part = one(share)
                        if active == count:
                            for k in range(channels):
                                into[k] += part * colour[k]
                        else:
                            for c in range(0, channels, count):
                                for k in range(c, c + active):
                                    into[k] += part * colour[k]
                    if wants_thermal:
                        at = rows.temperature_place[row]
                        if thermal_channels == 1:
                            rows.temperature[at, 0] += share * heat
                        else:
                            for k in range(thermal_channels):
                                rows.temperature[at, k] += share * heat * thermal_basis[k]


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"contract"})
def block_variation(
    values: Floats, voxel_rows: Ints, first: int, last: int, smallest: float, first_row: int, gradient: Floats
):
    """Total variation of a block of voxels (Plenoxels, eq. 4) and its gradient.

    Args:
        values: Parameter, (rows, channels).
        voxel_rows: Rows of the voxels.
        first: First voxel of the block.
        last: One behind its last.
        smallest: Added under the root.
        first_row: Row that the first row of `gradient` stands for.
        gradient: Zeros; the gradient of the mean over voxels and channels.

    Returns:
        The mean over voxels and channels of sqrt(dx^2 + dy^2 + dz^2).
    """
    channels = values.shape[1]
    scale = 1.0 / (channels * (last - first))
    total = 0.0
    one = values.dtype.type
    part, tiny = one(scale), one(smallest)
    lengths = np.empty(channels, values.dtype)
    for number in range(first, last):
        a, b, c = voxel_rows[number, 0], voxel_rows[number, 1], voxel_rows[number, 2]
        here, along_z, along_y, along_x = values[a], values[a + 1], values[b], values[c]
        g_here, g_z = gradient[a - first_row], gradient[a + 1 - first_row]
        g_y, g_x = gradient[b - first_row], gradient[c - first_row]
        for k in range(channels):
            dx, dy, dz = along_x[k] - here[k], along_y[k] - here[k], along_z[k] - here[k]
            length = np.sqrt(dx * dx + dy * dy + dz * dz + tiny)
            lengths[k] = length
            push = part / length
            g_x[k] += push * dx
            g_y[k] += push * dy
            g_z[k] += push * dz
            g_here[k] -= push * (dx + dy + dz)
        for k in range(channels):
            total += lengths[k]
    return total * scale
