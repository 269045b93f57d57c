"""Compiled backward pass: from gradients for rays to gradients for their samples, which are summed for each row."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from thermoxels_ns.core.kernel_cache import kernel
from thermoxels_ns.render.kernels import (
    COLOUR,
    DENSITY,
    EXP_LIMIT,
    OPAQUE,
    RELU,
    TEMPERATURE,
    Y00,
    Floats,
    Ints,
    Rays,
    Records,
    SampleGradients,
    Settings,
    Volume,
    basis_of,
    chord,
)

_FLAT_EXP = math.exp(EXP_LIMIT) * (1.0 - 1e-6)
"""Density from which the activation `exp` is constant, times 1 - 1e-6: densities are rounded to single precision."""


class RayGradients(NamedTuple):
    """Gradients of the loss with respect to the results of each ray; the shapes are those of `kernels.Sums`."""

    rgb: Floats
    thermal: Floats
    transmittance: Floats  # Gradient for the transmittance minus that for the accumulation, 1 - transmittance
    depth: Floats  # Gradient for the depth, divided by the accumulation; 0 where this is 0
    distortion: Floats


@kernel
def find_sample_gradients(
    first: int,
    last: int,
    rays: Rays,
    volume: Volume,
    settings: Settings,
    records: Records,
    grads: RayGradients,
    depth: Floats,
    samples: SampleGradients,
):
    """Write the gradients for the samples of rays `first` to before `last` to `samples`, which overwrites `records`.

    `grads` are the gradients for the results of the rays, and `depth` (rays,) is `Sums.depth`. Let x_i be the optical
    depth of step i, w_i = T_i (1 - exp(-x_i)) and T_{i+1} = T_i exp(-x_i), g_i = dL/dw_i and g_T = dL/dT_end. Then
    dL/dx_i = g_i T_{i+1} - sum_{j>i} g_j w_j - g_T T_end. The depth of a ray is d = sum_i w_i t_i / sum_i w_i and
    adds dL/dd (t_i - d) / sum_j w_j to g_i.
    """
    channels = volume.sh.shape[1]
    for r in range(first, last):
        start, used = records.offset[r], records.used[r]
        if used == 0:
            continue
        end = start + used
        wants_rgb, wants_thermal = (rays.wants[r] & 1) != 0 and channels > 0, (rays.wants[r] & 2) != 0
        thermal_weight = wants_thermal and settings.thermal_moves_density != 0
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
        pull = grads.depth[r]
        weight_after, moment_after = 0.0, 0.0
        end_term = grads.transmittance[r] * records.transmittance[end - 1]
        behind = 0.0
        for n in range(end - 1, start - 1, -1):
            i = records.step[n]
            delta = min(settings.step, length - i * settings.step)
            weight, density = float(records.weight[n]), float(records.density[n])
            left = float(records.transmittance[n])
            gain = 0.0
            seen = weight > settings.smallest_weight
            if seen and wants_rgb:
                cr, cg, cb = float(records.rgb[n, 0]), float(records.rgb[n, 1]), float(records.rgb[n, 2])
                gain += red * cr + green * cg + blue * cb
                samples.logits[n, 0] = red * weight * cr * (1.0 - cr)
                samples.logits[n, 1] = green * weight * cg * (1.0 - cg)
                samples.logits[n, 2] = blue * weight * cb * (1.0 - cb)
            if seen and thermal_weight:
                gain += heat * records.thermal[n]
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
            if pull != 0.0:
                gain += pull * (enter + i * settings.step + 0.5 * delta - depth[r])
            slope = gain * left - behind - end_term
            behind += gain * weight
            slope = slope * delta if density * delta < OPAQUE else 0.0
            if volume.activation == RELU:
                slope = slope if density > 0.0 else 0.0
            else:
                slope = slope * density if density < _FLAT_EXP else 0.0
            samples.raw_density[n] = slope
            samples.temperature[n] = heat * weight if seen else 0.0
            uses = DENSITY if samples.raw_density[n] != 0.0 else 0
            if seen:
                uses |= (COLOUR if wants_rgb else 0) | (TEMPERATURE if wants_thermal else 0)
            samples.uses[n] = uses


class Order(NamedTuple):
    """The samples with a gradient, sorted by groups of 2^`shift` successive voxels, and within a group by rays."""

    shift: int  # Logarithm to base 2 of the number of voxels in a group
    group: Ints  # Index in `record` and `ray` where each group begins, and their used length, (groups + 1,) int64
    record: Ints  # Index in `SampleGradients` of each sample, int32
    ray: Ints  # Index in `Rays` of the ray of each sample, int32


class Blocks(NamedTuple):
    """Blocks of voxels whose total variation has a gradient: one each for density, colour and temperature."""

    first: Ints  # Number of the first voxel of each block, (3,) int64
    last: Ints  # Number of the last voxel of each block plus 1, (3,) int64; equal to `first` if there is no block
    push: Floats  # Gradient of the loss with respect to the `total_variation` of each block, (3,) float64
    smallest: float  # Number added under the root of the total variation


class RowGradients(NamedTuple):
    """Sums of gradients by row (corner) of a `Volume`; the last three arrays have only the rows with a gradient."""

    uses: Ints  # Parameters that have a gradient at each row, (rows,) uint8: bits DENSITY, COLOUR, TEMPERATURE
    place: Ints  # Index of each row's sum in `density`, `sh`, `temperature`, (rows, 3) int32; undefined without a sum
    density: Floats  # (rows with a gradient of density, 1)
    sh: Floats  # (rows with a gradient of colour, columns)
    temperature: Floats  # (rows with a gradient of temperature, columns)


@kernel
def order_samples(samples: SampleGradients, order: Order):
    """Fill `order` by a counting sort of the samples with a gradient; `order.group` must hold zeros."""
    group = order.group
    for r in range(len(samples.used)):
        for n in range(samples.offset[r], samples.offset[r] + samples.used[r]):
            if samples.uses[n]:
                group[(samples.number[n] >> order.shift) + 1] += 1
    for g in range(1, len(group)):
        group[g] += group[g - 1]
    for r in range(len(samples.used)):
        for n in range(samples.offset[r], samples.offset[r] + samples.used[r]):
            if samples.uses[n]:
                g = samples.number[n] >> order.shift
                order.record[group[g]], order.ray[group[g]] = n, r
                group[g] += 1
    for g in range(len(group) - 1, 0, -1):
        group[g] = group[g - 1]
    group[0] = 0


@kernel
def first_voxel(voxel_rows: Ints, corner: int, row: int):
    """Return the first voxel n with ``voxel_rows[n, corner] >= row``, or the number of voxels if there is none. The
    column `corner` (0 to 3) of `voxel_rows` must ascend, as in `KeptVoxels`."""
    low, high = 0, len(voxel_rows)
    while low < high:
        middle = (low + high) >> 1
        if voxel_rows[middle, corner] < row:
            low = middle + 1
        else:
            high = middle
    return low


@kernel
def use_rows(
    first_row: int, last_row: int, volume: Volume, samples: SampleGradients, order: Order, blocks: Blocks, uses: Ints
):
    """Write `RowGradients.uses` of rows `first_row` to before `last_row` to `uses`: bits for the parameters that get a
    gradient from samples or from the total variation of `blocks`."""
    rows = volume.voxel_rows
    uses[first_row:last_row] = 0
    begin, end = first_voxel(rows, 3, first_row - 1), first_voxel(rows, 0, last_row)
    for at in range(order.group[begin >> order.shift], order.group[_groups_before(end, order)]):
        n = order.record[at]
        number, bits = samples.number[n], samples.uses[n]
        for corner in range(8):
            row = rows[number, corner >> 1] + (corner & 1)
            if first_row <= row < last_row:
                uses[row] |= bits
    for kind in range(3):
        bit = np.uint8(1 << kind)
        for number in range(max(begin, blocks.first[kind]), min(end, blocks.last[kind])):
            a, b, c = np.int64(rows[number, 0]), np.int64(rows[number, 1]), np.int64(rows[number, 2])
            for row in (a, a + 1, b, c):
                if first_row <= row < last_row:
                    uses[row] |= bit


@kernel
def _groups_before(number: int, order: Order):
    """Return the number of groups that hold the voxels 0 to `number` - 1."""
    return (number + (1 << order.shift) - 1) >> order.shift


@kernel
def list_rows(first_row: int, last_row: int, kind: int, at: int, rows: RowGradients, listed: Ints, sums: Floats):
    """Give each row from `first_row` to before `last_row` with a gradient for parameter `kind` a place in `sums`.

    `kind` is 0, 1 or 2 for density, colour or temperature. Places are successive, beginning with `at`. Written in place
    are ``rows.place[row, kind]``, the row's number in ``listed[place]``, and zeros in ``sums[place]``.
    """
    for row in range(first_row, last_row):
        if rows.uses[row] & (1 << kind):
            rows.place[row, kind], listed[at] = at, row
            sums[at, :] = 0.0
            at += 1


@kernel
def corner_shares(samples: SampleGradients, n: int, shares: Floats):
    """Write the trilinear weights of the corners at sample `n`, in order of `CORNER_OFFSETS`, to `shares` (8,)."""
    one = shares.dtype.type(1.0)
    fx, fy, fz = samples.fraction[n, 0], samples.fraction[n, 1], samples.fraction[n, 2]
    gx, gy, gz = one - fx, one - fy, one - fz
    a, b, c, d = gx * gy, gx * fy, fx * gy, fx * fy
    shares[0], shares[1], shares[2], shares[3] = a * gz, a * fz, b * gz, b * fz
    shares[4], shares[5], shares[6], shares[7] = c * gz, c * fz, d * gz, d * fz


@kernel(fastmath={"contract"})
def add_samples(
    first_row: int,
    last_row: int,
    rays: Rays,
    volume: Volume,
    samples: SampleGradients,
    order: Order,
    rows: RowGradients,
):
    """Add the gradients of samples, in the sequence of `order`, to the sums in `rows`.

    Only sums of the rows `first_row` to before `last_row` are changed. As no other thread adds to these rows, the sums
    have the same bits for any number of threads.
    """
    count, thermal_channels = volume.sh.shape[1] // 3, volume.temperature.shape[1]
    dtype = volume.density.dtype
    basis, thermal_basis = np.empty(9), np.empty(9)
    colour, shares = np.zeros(3 * count, dtype), np.empty(8, dtype)
    flat = count == 1
    begin, end = first_voxel(volume.voxel_rows, 3, first_row - 1), first_voxel(volume.voxel_rows, 0, last_row)
    stop = order.group[_groups_before(end, order)]
    for at in range(order.group[begin >> order.shift], stop):
        n, r = order.record[at], order.ray[at]
        number, bits = samples.number[n], samples.uses[n]
        if volume.voxel_rows[number, 3] + 1 < first_row or volume.voxel_rows[number, 0] >= last_row:
            continue
        inside = volume.voxel_rows[number, 0] >= first_row and volume.voxel_rows[number, 3] + 1 < last_row
        slope, heat = samples.raw_density[n], samples.temperature[n]
        if bits & COLOUR:
            basis_of(rays.directions, r, count, 1.0, basis)
            for c in range(3):
                for k in range(count):
                    colour[c * count + k] = samples.logits[n, c] * basis[k]
        if bits & TEMPERATURE and thermal_channels > 1:
            basis_of(rays.directions, r, thermal_channels, 1.0 / Y00, thermal_basis)
        corner_shares(samples, n, shares)
        for corner in range(8):
            row = volume.voxel_rows[number, corner >> 1] + (corner & 1)
            if not (inside or first_row <= row < last_row):
                continue
            share = shares[corner]
            if bits & DENSITY:
                rows.density[rows.place[row, 0], 0] += share * slope
            if bits & COLOUR:
                place = rows.place[row, 1]
                if flat:
                    rows.sh[place, 0] += share * colour[0]
                    rows.sh[place, 1] += share * colour[1]
                    rows.sh[place, 2] += share * colour[2]
                else:
                    for k in range(3 * count):
                        rows.sh[place, k] += share * colour[k]
            if bits & TEMPERATURE:
                place = rows.place[row, 2]
                if thermal_channels == 1:
                    rows.temperature[place, 0] += share * heat
                else:
                    for k in range(thermal_channels):
                        rows.temperature[place, k] += share * heat * thermal_basis[k]


@kernel(fastmath={"contract"})
def total_variation(values: Floats, voxel_rows: Ints, first: int, last: int, smallest: float):
    """Return the sum of sqrt(dx^2 + dy^2 + dz^2 + smallest) over voxels `first` to before `last` and all channels.

    dx, dy and dz are the differences of `values` (rows, channels) between a voxel's lowest corner and the corners one
    step along x, y and z. In `voxel_rows` (voxels, 4), column 0 is the row of the lowest corner, column 1 of its
    neighbour along y, column 2 of its neighbour along x. The neighbour along z has the row of column 0 plus 1.
    `smallest`, above 0, keeps the gradient finite where all differences are 0.
    """
    channels = values.shape[1]
    tiny = values.dtype.type(smallest)
    totals = np.zeros(channels)
    for number in range(first, last):
        a = voxel_rows[number, 0]
        here, along_z = values[a], values[a + 1]
        along_y, along_x = values[voxel_rows[number, 1]], values[voxel_rows[number, 2]]
        for k in range(channels):
            dx, dy, dz = along_x[k] - here[k], along_y[k] - here[k], along_z[k] - here[k]
            totals[k] += np.sqrt(dx * dx + dy * dy + dz * dz + tiny)
    total = 0.0
    for k in range(channels):
        total += totals[k]
    return total


@kernel(fastmath={"contract"})
def add_variation(
    first_row: int,
    last_row: int,
    values: Floats,
    voxel_rows: Ints,
    kind: int,
    blocks: Blocks,
    place: Ints,
    gradient: Floats,
):
    """Add the gradient of `blocks.push[kind]` times `total_variation`, with respect to its `values`, to `gradient`.

    Only rows `first_row` to before `last_row` are changed; the sum of a row lies in ``gradient[place[row, kind]]``.
    `kind` is 0, 1 or 2 for density, colour or temperature, of which `values` are the rows.
    """
    channels = values.shape[1]
    first, last = blocks.first[kind], blocks.last[kind]
    one = values.dtype.type
    tiny = one(blocks.smallest)
    scale = one(blocks.push[kind])
    shares = np.empty((4, channels), values.dtype)
    begin, end = first_voxel(voxel_rows, 2, first_row), first_voxel(voxel_rows, 0, last_row)
    for number in range(max(begin, first), min(end, last)):
        a, b, c = np.int64(voxel_rows[number, 0]), np.int64(voxel_rows[number, 1]), np.int64(voxel_rows[number, 2])
        here, along_z, along_y, along_x = values[a], values[a + 1], values[b], values[c]
        for k in range(channels):
            dx, dy, dz = along_x[k] - here[k], along_y[k] - here[k], along_z[k] - here[k]
            push = scale / np.sqrt(dx * dx + dy * dy + dz * dz + tiny)
            shares[1, k], shares[2, k], shares[3, k] = push * dz, push * dy, push * dx
            shares[0, k] = -(shares[3, k] + shares[2, k] + shares[1, k])
        for corner, row in enumerate((a, a + 1, b, c)):
            if first_row <= row < last_row:
                into = gradient[place[row, kind]]
                for k in range(channels):
                    into[k] += shares[corner, k]
