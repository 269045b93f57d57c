"""Compiled backward pass: gradients of each ray's sums become those of its samples."""

from __future__ import annotations

import math
from typing import NamedTuple

from thermoxels_ns.core.kernel_cache import kernel
from thermoxels_ns.render.kernels import (
    COLOUR,
    DENSITY,
    EXP_LIMIT,
    OPAQUE,
    RELU,
    SOFTPLUS,
    TEMPERATURE,
    Floats,
    Rays,
    Records,
    SampleGradients,
    Settings,
    Volume,
    chord,
)

_FLAT_EXP = math.exp(EXP_LIMIT) * (1.0 - 1e-6)
"""Density from which `exp` is constant; a little less, so that rounding to single precision does not hide it."""


class RayGradients(NamedTuple):
    """Gradients of what came out per ray."""

    rgb: Floats
    thermal: Floats
    transmittance: Floats  # That of the accumulation is subtracted already, the sum of both being 1
    distortion: Floats
    sparsity: Floats


@kernel
def find_sample_gradients(
    first: int,
    last: int,
    rays: Rays,
    volume: Volume,
    settings: Settings,
    records: Records,
    grads: RayGradients,
    samples: SampleGradients,
):
    """Find the gradients of the samples of rays `first` to `last`; each replaces what is recorded of its sample.

    With w_i = T_i (1 - exp(-x_i)), T_{i+1} = T_i exp(-x_i) and x_i the optical depth of step i,
    dL/dx_i = g_i T_{i+1} - sum_{j>i} g_j w_j - g_T T_end, where g_i = dL/dw_i and g_T is the gradient of what is left.
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
            samples.raw_density[n] = slope
            samples.temperature[n] = heat * weight if seen else 0.0
            uses = DENSITY if samples.raw_density[n] != 0.0 else 0
            if seen:
                uses |= (COLOUR if wants_rgb else 0) | (TEMPERATURE if wants_thermal else 0)
            samples.uses[n] = uses
