import math

import pytest
import torch

from thermoxels_ns.field.harmonics import harmonics, harmonics_with_unit_mean
from thermoxels_ns.field.surroundings import SkyTemperature, SphereImage, seen_behind


def sphere_quadrature(rows: int = 64) -> tuple[torch.Tensor, torch.Tensor]:
    """Midpoint rule on (cos theta, phi): uniform area weights that sum to 4 pi."""
    z = (torch.arange(rows, dtype=torch.float64) + 0.5) / rows * 2 - 1
    phi = (torch.arange(2 * rows, dtype=torch.float64) + 0.5) / (2 * rows) * 2 * math.pi
    z, phi = torch.meshgrid(z, phi, indexing="ij")
    r = torch.sqrt(1 - z**2)
    directions = torch.stack((r * torch.cos(phi), r * torch.sin(phi), z), -1).reshape(-1, 3)
    return directions, torch.full((len(directions),), 4 * math.pi / len(directions), dtype=torch.float64)


def test_basis_is_orthonormal():
    directions, weights = sphere_quadrature()
    basis = harmonics(directions, 2)
    gram = basis.T @ (basis * weights[:, None])
    torch.testing.assert_close(gram, torch.eye(9, dtype=torch.float64), atol=2e-3, rtol=0)


def test_first_coefficient_of_the_scaled_basis_is_the_mean():
    directions, weights = sphere_quadrature()
    coefficients = torch.rand(9, dtype=torch.float64)
    mean = (harmonics_with_unit_mean(directions, 2) @ coefficients * weights).sum() / (4 * math.pi)
    assert float(mean) == pytest.approx(float(coefficients[0]), abs=1e-3)


def test_sphere_image_is_continuous_across_its_seam_and_at_the_poles():
    image = SphereImage(8)
    image.image.data = torch.randn(8, 16, 3)
    eps = 1e-4
    seam = torch.nn.functional.normalize(torch.tensor([[-1.0, eps, 0.3], [-1.0, -eps, 0.3]]), dim=-1)
    a, b = image(seam)
    torch.testing.assert_close(a, b, atol=1e-3, rtol=0)
    assert torch.isfinite(image(torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [0.0, 0.0, 1.0000001]]))).all()


@pytest.mark.parametrize("make", [SphereImage, SkyTemperature])
@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_rays_that_want_nothing_see_nothing_and_the_others_the_same_bits(make, share):
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(997, 3, generator=generator), dim=-1)
    wanted = torch.rand(997, generator=generator) < share
    background = make()
    (parameter,) = background.parameters()
    parameter.data = torch.randn(parameter.shape, generator=generator)
    push = torch.randn(997, 1, generator=generator) * wanted[:, None]
    all_rays = seen_behind(background, directions, None)
    (expected,) = torch.autograd.grad((all_rays * push).sum(), parameter)
    values = seen_behind(background, directions, wanted)
    (gradient,) = torch.autograd.grad((values * push).sum(), parameter)
    assert torch.equal(values, all_rays * wanted[:, None]) and torch.equal(gradient, expected)
    assert (float(gradient.abs().max()) > 0) == (share > 0)
