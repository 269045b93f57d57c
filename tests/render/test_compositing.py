import math

import pytest
import torch

from thermoxels_ns.render.compositing import RaySteps, composite, ray_weights


def double_loop(density, deltas, rgb, thermal, t, background_rgb, background_thermal):
    """Paper, eq. 1 and 2, ray by ray and sample by sample in Python floats."""
    out = []
    for r in range(len(density)):
        transmittance, colour, temperature, distance, opacity = 1.0, [0.0] * 3, 0.0, 0.0, 0.0
        for i in range(len(density[r])):
            alpha = -math.expm1(-density[r][i] * deltas[r][i])
            weight = transmittance * alpha
            colour = [c + weight * v for c, v in zip(colour, rgb[r][i])]
            temperature += weight * thermal[r][i]
            distance += weight * t[r][i]
            opacity += weight
            transmittance *= math.exp(-density[r][i] * deltas[r][i])
        colour = [c + transmittance * b for c, b in zip(colour, background_rgb)]
        out.append((colour, temperature + transmittance * background_thermal, opacity, distance / opacity))
    return out


@pytest.mark.parametrize("dtype, tolerance", [(torch.float32, 2e-6), (torch.float64, 1e-13)])
def test_matches_the_double_loop(dtype, tolerance):
    generator = torch.Generator().manual_seed(1)
    rays, steps = 7, 64
    density = torch.rand(rays, steps, generator=generator, dtype=torch.float64) ** 4 * 40
    deltas = torch.full_like(density, 0.05)
    deltas[:, -1] = 0.013
    t = torch.cumsum(deltas, -1) - 0.5 * deltas + 1.0
    rgb = torch.rand(rays, steps, 3, generator=generator, dtype=torch.float64)
    thermal = torch.rand(rays, steps, generator=generator, dtype=torch.float64)
    background_rgb, background_thermal = [0.2, 0.4, 0.9], 0.3
    expected = double_loop(
        *(x.tolist() for x in (density, deltas, rgb, thermal, t)), background_rgb, background_thermal
    )

    along = ray_weights(density.to(dtype), deltas.to(dtype))
    seen = composite(
        RaySteps(t.to(dtype), deltas.to(dtype)),
        along,
        lambda flat: rgb.reshape(-1, 3)[flat].to(dtype),
        lambda flat: thermal.reshape(-1, 1)[flat].to(dtype),
    )
    assert seen.rgb is not None and seen.thermal is not None
    left = along.transmittance[:, None]
    shown = seen.rgb + left * torch.tensor(background_rgb, dtype=dtype)
    warm = seen.thermal + left * background_thermal
    for r, (colour, temperature, opacity, distance) in enumerate(expected):
        torch.testing.assert_close(shown[r].double(), torch.tensor(colour, dtype=torch.float64), atol=tolerance, rtol=0)
        assert abs(float(warm[r]) - temperature) < tolerance
        assert abs(float(seen.accumulation[r]) - opacity) < tolerance
        assert abs(float(seen.depth[r]) - distance) < 20 * tolerance


def test_weights_and_background_sum_to_one():
    density = torch.rand(50, 200, dtype=torch.float64) * 10
    along = ray_weights(density, torch.full_like(density, 0.02))
    torch.testing.assert_close(along.weights.sum(-1) + along.transmittance, torch.ones(50, dtype=torch.float64))
    torch.testing.assert_close(along.accumulation + along.transmittance, torch.ones(50, dtype=torch.float64))


def test_gradcheck_of_the_sum():
    density = (torch.rand(3, 6, dtype=torch.float64) * 5 + 0.1).requires_grad_()
    rgb = torch.rand(18, 3, dtype=torch.float64, requires_grad=True)
    thermal = torch.rand(18, 1, dtype=torch.float64, requires_grad=True)
    deltas = torch.full((3, 6), 0.1, dtype=torch.float64)
    steps = RaySteps(torch.arange(6, dtype=torch.float64).expand(3, 6) * 0.1 + 0.05, deltas)

    def outputs(density, rgb, thermal):
        seen = composite(
            steps,
            ray_weights(density, deltas),
            lambda flat: rgb[flat],
            lambda flat: thermal[flat],
            thermal_moves_density=True,
        )
        return seen.rgb, seen.thermal, seen.accumulation, seen.depth

    assert torch.autograd.gradcheck(outputs, (density, rgb, thermal))


def test_temperature_does_not_move_density_unless_asked():
    density = torch.rand(4, 8, dtype=torch.float64, requires_grad=True)
    deltas = torch.full((4, 8), 0.2, dtype=torch.float64)
    steps = RaySteps(torch.cumsum(deltas, -1), deltas)
    thermal = torch.rand(32, 1, dtype=torch.float64, requires_grad=True)
    for moves in (False, True):
        seen = composite(
            steps, ray_weights(density, deltas), None, lambda flat: thermal[flat], thermal_moves_density=moves
        )
        assert seen.thermal is not None and seen.rgb is None
        if moves:
            gradient = torch.autograd.grad(seen.thermal.sum(), density)[0]
            assert gradient.abs().max() > 1e-3
        else:
            gradient = torch.autograd.grad(seen.thermal.sum(), [density, thermal], allow_unused=True)
            assert gradient[0] is None and gradient[1].abs().max() > 1e-3
