"""Compiled forward pass: follow rays through kept voxels, compute sample weights, sum colour and temperature."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.kernel_cache import kernel

Floats = npt.NDArray[np.floating]
Ints = Any  # arrays of integers; numba knows which

Y00 = 0.28209479177387814  # Value of the spherical harmonic of degree 0
BLOCK = 8  # Voxels along the side of a block of `KeptVoxels`
OPAQUE = 100.0  # Largest optical depth of a step; light behind such a step is 0
EXP_LIMIT = 15.0  # Raw density above which the activation `exp` stays constant
AHEAD = 8  # Samples of a ray that `march_rays` finds and reads before it weighs them
RELU, EXP = 0, 1
DENSITY, COLOUR, TEMPERATURE = 1, 2, 4
"""Bits of `SampleGradients.uses`: the parameters for which a sample has a gradient."""


class Volume(NamedTuple):
    """The kept voxels and their parameters as plain arrays; lengths are in world units."""

    lo: Floats  # Lower corner of the lattice, (3,) float64
    hi: Floats  # Upper corner of the lattice, (3,) float64
    size: float  # Edge of a voxel
    cells: Ints  # Number of voxels along x, y and z, (3,) int64
    block_slot: Ints  # This and the next two: the attributes of `KeptVoxels` of that name
    voxel_number: Ints
    voxel_rows: Ints
    density: Floats  # Raw density, before the activation, (rows, 1)
    sh: Floats  # k harmonics of red, of green and of blue, (rows, 3 k); (0, 0) without colour
    temperature: Floats  # k harmonics of normalised temperature, (rows, k)
    activation: int  # RELU or EXP


class Rays(NamedTuple):
    """A batch of rays; lengths are in world units."""

    origins: Floats  # (rays, 3)
    directions: Floats  # Unit vectors, (rays, 3)
    near: Floats  # Distance at which sampling begins, (rays,)
    far: Floats  # Distance at which sampling ends, (rays,)
    wants: Ints  # Values that each ray wants, (rays,) uint8: 1 for colour, 2 for temperature, 3 for both


class Settings(NamedTuple):
    """Options of the kernels: `RenderOptions` as plain numbers."""

    step: float  # Length of a step along a ray, world units
    smallest_weight: float
    early_stop: float
    distortion_scale: float  # Length that counts as 1 in the distortion, world units; 0: no distortion is computed
    thermal_moves_density: int  # 1: density gets a gradient from temperature; 0: it does not


class Records(NamedTuple):
    """One record per sample in a kept voxel, ray after ray, up to where `Settings.early_stop` ends the ray.
    Each range of rays has a part of the arrays for itself, so unused records may lie between ranges."""

    offset: Ints  # First record of each ray, (rays,) int64
    used: Ints  # Number of records of each ray, (rays,) int64
    number: Ints  # Index of the kept voxel in `KeptVoxels.cells`, (records,) int32
    step: Ints  # Number of the step along the ray, from 0, (records,) int32
    fraction: Floats  # Place in the voxel, each coordinate from 0 to 1, (records, 3)
    density: Floats  # Density, [1 / world unit], (records,)
    transmittance: Floats  # Share of the ray's light that is left behind the step, (records,)
    weight: Floats  # Share of the ray's light that ends in the step, (records,)
    rgb: Floats  # Colour from 0 to 1, (records, 3); (0, 3) without colour
    thermal: Floats  # Normalised temperature, (records,)


class SampleGradients(NamedTuple):
    """Gradients of the loss with respect to values of each sample; three arrays reuse the memory of `Records`."""

    offset: Ints  # This and the next three are the arrays of `Records` of that name
    used: Ints
    number: Ints
    fraction: Floats
    raw_density: Floats  # Gradient for the raw density, (records,); overwrites `Records.density`
    temperature: Floats  # Gradient for the temperature, (records,); overwrites `Records.transmittance`
    logits: Floats  # Gradient for the colour before the sigmoid, (records, 3); overwrites `Records.rgb`
    uses: Ints  # Gradients that a sample has, (records,) uint8: bits DENSITY, COLOUR, TEMPERATURE


class Sums(NamedTuple):
    """The results of the forward pass for each ray; `RayRender` says what each is."""

    rgb: Floats  # (rays, 3); (0, 3) without colour
    thermal: Floats  # (rays, 1)
    transmittance: Floats  # (rays,)
    accumulation: Floats  # (rays,)
    depth: Floats  # (rays,), world units
    distortion: Floats  # (rays,); (0,) where `Settings.distortion_scale` is 0


@kernel
def chord(rays: Rays, r: int, volume: Volume):
    """Return the distances at which ray `r` enters and leaves the box (see `reference.intersect_box`); a miss: 0, 0."""
    enter, leave = float(rays.near[r]), float(rays.far[r])
    for axis in range(3):
        origin, direction = float(rays.origins[r, axis]), float(rays.directions[r, axis])
        lo, hi = volume.lo[axis], volume.hi[axis]
        if abs(direction) < 1e-20:
            if not lo <= origin <= hi:
                return 0.0, 0.0
            continue
        inverse = 1.0 / direction
        a, b = (lo - origin) * inverse, (hi - origin) * inverse
        if not (a <= b or a >= b):  # a NaN of the ray, which the comparisons below would pass over
            return 0.0, 0.0
        enter = max(enter, min(a, b))
        leave = min(leave, max(a, b))
    if not (leave > enter and leave < math.inf):
        return 0.0, 0.0
    return enter, leave


@kernel
def path_of(rays: Rays, r: int, volume: Volume):
    """Return origin, direction and 1 / direction of ray `r`, three numbers each; 1e200 replaces 1 / 0."""
    never = 1e200
    dx, dy, dz = float(rays.directions[r, 0]), float(rays.directions[r, 1]), float(rays.directions[r, 2])
    ix, iy = 1.0 / dx if abs(dx) > 1e-100 else never, 1.0 / dy if abs(dy) > 1e-100 else never
    origin = (float(rays.origins[r, 0]), float(rays.origins[r, 1]), float(rays.origins[r, 2]))
    return origin, (dx, dy, dz), (ix, iy, 1.0 / dz if abs(dz) > 1e-100 else never)


@kernel
def next_sample(i: int, enter: float, length: float, step: float, path, volume: Volume):
    """Return the first sample of a ray, from step number `i` on, that lies in a kept voxel.

    The ray `path`, from `path_of`, enters the box at distance `enter` and has `length` in it; steps have length `step`.
    Returns number of the step (-1: no sample), number of the voxel, distance, length of the step, and place (x, y, z)
    in the voxel, each 0 to 1.
    """
    (ox, oy, oz), (dx, dy, dz), (ix, iy, iz) = path
    lx, ly, lz = volume.lo[0], volume.lo[1], volume.lo[2]
    h = volume.size
    nx, ny, nz = volume.cells[0], volume.cells[1], volume.cells[2]
    by, bz = (ny + BLOCK - 1) // BLOCK, (nz + BLOCK - 1) // BLOCK
    per_step = 1.0 / step
    while True:
        delta = min(step, length - i * step)
        if delta <= 0.0:
            return -1, -1, 0.0, 0.0, 0.0, 0.0, 0.0
        t = enter + i * step + 0.5 * delta
        # The same order of operations as in `TrilinearPoints.of`: rounding decides on a face between two voxels.
        ux = min(max((ox + dx * t - lx) / h, 0.0), float(nx))
        uy = min(max((oy + dy * t - ly) / h, 0.0), float(ny))
        uz = min(max((oz + dz * t - lz) / h, 0.0), float(nz))
        x, y, z = min(int(ux), nx - 1), min(int(uy), ny - 1), min(int(uz), nz - 1)
        slot = volume.block_slot[((x >> 3) * by + (y >> 3)) * bz + (z >> 3)]
        if slot >= 0:
            number = volume.voxel_number[(slot << 9) + (((x & 7) << 6) | ((y & 7) << 3) | (z & 7))]
            if number >= 0:
                return i, number, t, delta, ux - x, uy - y, uz - z
            i += 1
            continue
        # The block is empty: go on with the first sample behind its far side, rather a little early than late.
        face_x = lx + ((x >> 3) + (1 if ix > 0.0 else 0)) * BLOCK * h
        face_y = ly + ((y >> 3) + (1 if iy > 0.0 else 0)) * BLOCK * h
        face_z = lz + ((z >> 3) + (1 if iz > 0.0 else 0)) * BLOCK * h
        leave = min((face_x - ox) * ix, (face_y - oy) * iy, (face_z - oz) * iz, enter + length + step)
        ahead = (leave - enter) * per_step - 0.5 - 1e-6
        i = max(i + 1, int(ahead) + 1 if ahead >= 0.0 else 0)


@kernel
def basis_of(directions: Floats, r: int, count: int, scale: float, basis: Floats):
    """Write the first `count` (1, 4, 9) spherical harmonics in the direction of ray `r`, times `scale`, to `basis`."""
    basis[0] = Y00 * scale
    if count > 1:
        x, y, z = float(directions[r, 0]), float(directions[r, 1]), float(directions[r, 2])
        one = 0.4886025119029199 * scale
        basis[1], basis[2], basis[3] = -one * y, one * z, -one * x
        if count > 4:
            off = 1.0925484305920792 * scale
            basis[4], basis[5], basis[7] = off * x * y, -off * y * z, -off * x * z
            basis[6] = 0.31539156525252005 * scale * (3.0 * z * z - 1.0)
            basis[8] = 0.5462742152960396 * scale * (x * x - y * y)


@kernel(fastmath={"contract"})
def gather(values: Floats, rows: Ints, number: int, fx: float, fy: float, fz: float, into: Floats):
    """Write all channels of `values` at a place in a voxel to `into` (channels,); see `gather_one` for arguments."""
    gx, gy, gz = 1.0 - fx, 1.0 - fy, 1.0 - fz
    a, b, c, d = rows[number, 0], rows[number, 1], rows[number, 2], rows[number, 3]
    one = values.dtype.type
    wa0, wa1, wb0, wb1 = one(gx * gy * gz), one(gx * gy * fz), one(gx * fy * gz), one(gx * fy * fz)
    wc0, wc1, wd0, wd1 = one(fx * gy * gz), one(fx * gy * fz), one(fx * fy * gz), one(fx * fy * fz)
    ra0, ra1, rb0, rb1 = values[a], values[a + 1], values[b], values[b + 1]
    rc0, rc1, rd0, rd1 = values[c], values[c + 1], values[d], values[d + 1]
    for k in range(into.shape[0]):
        into[k] = (wa0 * ra0[k] + wa1 * ra1[k] + wb0 * rb0[k] + wb1 * rb1[k]) + (
            wc0 * rc0[k] + wc1 * rc1[k] + wd0 * rd0[k] + wd1 * rd1[k]
        )


@kernel(fastmath={"contract"})
def gather_one(values: Floats, rows: Ints, number: int, fx: float, fy: float, fz: float, k: int):
    """Return channel `k` of `values` (rows, channels), interpolated at (fx, fy, fz), each 0 to 1, in voxel `number`.
    `rows` is `Volume.voxel_rows`."""
    gx, gy, gz = 1.0 - fx, 1.0 - fy, 1.0 - fz
    a, b = np.uint64(rows[number, 0]), np.uint64(rows[number, 1])
    c, d = np.uint64(rows[number, 2]), np.uint64(rows[number, 3])
    next_one = np.uint64(1)
    return gx * (
        gy * (gz * values[a, k] + fz * values[a + next_one, k])
        + fy * (gz * values[b, k] + fz * values[b + next_one, k])
    ) + fx * (
        gy * (gz * values[c, k] + fz * values[c + next_one, k])
        + fy * (gz * values[d, k] + fz * values[d + next_one, k])
    )


@kernel
def place_of(records: Records, n: int):
    """Return the place of the sample of record `n` in its voxel: x, y and z, each from 0 to 1."""
    return float(records.fraction[n, 0]), float(records.fraction[n, 1]), float(records.fraction[n, 2])


@kernel
def activate(raw: float, kind: int):
    """Return the density of an interpolated raw density, for the activation `kind`; NaN for NaN."""
    if kind == RELU:
        return raw if not raw <= 0.0 else 0.0
    return math.exp(raw if not raw > EXP_LIMIT else EXP_LIMIT)


@kernel
def march_rays(
    first: int,
    last: int,
    rays: Rays,
    volume: Volume,
    settings: Settings,
    records: Records,
    sums: Sums,
    begin: int,
    end: int,
):
    """Compute the weights of the samples of rays `first` to before `last` (paper, eq. 1).

    Writes records `begin` to before `end` and, summed in double precision, all of `sums` but colour and temperature.
    Threads share a batch: each has a range of rays and a range of records. `AHEAD` samples are read together, so that
    their loads from memory overlap.

    Returns:
        Number of rays with a NaN density (-1: too few records), and index of the last record written plus 1.
    """
    distance, length_of, raw = np.empty(AHEAD), np.empty(AHEAD), np.empty(AHEAD)
    wrong = 0
    n = begin
    for r in range(first, last):
        enter, leave = chord(rays, r, volume)
        length = leave - enter
        path = path_of(rays, r, volume)
        expected, left, depth_sum = 0.0, 1.0, 0.0
        weight_sum, moment_sum, distortion = 0.0, 0.0, 0.0
        start, i = n, 0
        records.offset[r] = start
        while i >= 0 and left >= settings.early_stop:
            if n + AHEAD > end:
                return -1, n
            found = 0
            while found < AHEAD:
                i, number, t, delta, fx, fy, fz = next_sample(i, enter, length, settings.step, path, volume)
                if i < 0:
                    break
                at = n + found
                records.number[at], records.step[at] = number, i
                records.fraction[at, 0], records.fraction[at, 1], records.fraction[at, 2] = fx, fy, fz
                distance[found], length_of[found] = t, delta
                found += 1
                i += 1
            for k in range(found):
                number, (fx, fy, fz) = records.number[n + k], place_of(records, n + k)
                raw[k] = gather_one(volume.density, volume.voxel_rows, number, fx, fy, fz, 0)
            for k in range(found):
                density = activate(raw[k], volume.activation)
                if density != density:
                    wrong += 1
                    i = -1
                    break
                t, delta = distance[k], length_of[k]
                optical = min(density * delta, OPAQUE)
                alpha = -math.expm1(-optical)
                weight = left * alpha
                depth_sum += optical
                left *= math.exp(-optical) if alpha > 0.5 else 1.0 - alpha
                records.density[n], records.transmittance[n], records.weight[n] = density, left, weight
                expected += weight * t
                if settings.distortion_scale > 0.0:
                    distortion += 2.0 * weight * (t * weight_sum - moment_sum) + weight * weight * delta / 3.0
                    weight_sum += weight
                    moment_sum += weight * t
                n += 1
                if left < settings.early_stop:
                    break
        records.used[r] = n - start
        opacity = -math.expm1(-depth_sum)
        sums.transmittance[r], sums.accumulation[r] = left, opacity
        sums.depth[r] = expected / opacity if opacity > 0.0 else math.inf
        if settings.distortion_scale > 0.0:
            sums.distortion[r] = distortion / settings.distortion_scale
    return wrong, n


@kernel
def shade(first: int, last: int, rays: Rays, volume: Volume, settings: Settings, records: Records, sums: Sums):
    """Write colour and temperature of rays `first` to before `last` to `sums` (paper, eq. 1 and 2).

    The samples' own values are written to `records`, which `march_rays` must have filled. A ray that does not want a
    value gets 0. Samples of at most `Settings.smallest_weight` are left out.
    """
    channels, thermal_channels = volume.sh.shape[1], volume.temperature.shape[1]
    count = channels // 3
    one = volume.density.dtype.type
    coefficients = np.empty(channels, volume.sh.dtype)
    thermal_coefficients = np.empty(thermal_channels, volume.temperature.dtype)
    basis, thermal_basis = np.empty(9), np.empty(9)
    for r in range(first, last):
        wants_rgb, wants_thermal = (rays.wants[r] & 1) != 0 and channels > 0, (rays.wants[r] & 2) != 0
        if wants_rgb:
            basis_of(rays.directions, r, count, 1.0, basis)
        if wants_thermal and thermal_channels > 1:
            basis_of(rays.directions, r, thermal_channels, 1.0 / Y00, thermal_basis)
        red, green, blue, thermal = 0.0, 0.0, 0.0, 0.0
        wanted = records.used[r] if wants_rgb or wants_thermal else 0
        for n in range(records.offset[r], records.offset[r] + wanted):
            if not records.weight[n] > settings.smallest_weight:  # as recorded: the backward pass compares this too
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
