import math

import numpy as np
import pytest
import torch

from thermoxels_ns.field.harmonics import harmonics, harmonics_with_unit_mean
from thermoxels_ns.field.surroundings import SkyTemperature, SphereImage, Surroundings, seen_behind

BOX = torch.tensor([[-1.0, -0.8, 0.1], [1.0, 0.7, 0.6]])
ACROSS, DEEP = 16, 8


def surroundings() -> Surroundings:
    return Surroundings(BOX, ACROSS, DEEP, 0.01, "exp", True)


def rays(count: int = 400) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    origins = 1.5 * torch.randn(count, 3, generator=generator)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    origins[:3], directions[:3] = torch.tensor([0.0, 0.0, 0.3]), torch.eye(3)  # along the axes, from within
    origins[3], directions[3] = torch.tensor([5.0, 0.0, 0.3]), torch.tensor([1.0, 0.0, 0.0])  # away from the box
    return origins, directions


def in_lattice(point: np.ndarray) -> np.ndarray:
    """Where a point outside the box stands in the lattice: written again, point by point."""
    lo, hi = BOX.double().numpy()
    scaled = (point - 0.5 * (lo + hi)) / (0.5 * (hi - lo))
    axis = int(np.abs(scaled).argmax())
    q = abs(scaled[axis])
    face = 2 * axis + int(scaled[axis] < 0)
    sides = [0.5 * (scaled[(axis + step) % 3] / q + 1.0) * ACROSS for step in (1, 2)]
    return np.array([face * (DEEP + 1) + (1.0 - 1.0 / q) * DEEP, *sides])


def test_pieces_cover_each_ray_from_where_it_leaves_the_box_to_infinity():
    (origins, directions), (lo, hi) = rays(), BOX.double().numpy()
    cut = surroundings().segments(origins, directions)
    for number in range(len(origins)):
        own = cut.ray == number
        starts, ways, lengths = (v[own].double().numpy() for v in (cut.origins, cut.directions, cut.lengths))
        assert cut.rank[own].tolist() == list(range(len(starts)))
        covered = []
        for distance in np.geomspace(0.01, 1e4, 60):
            point = origins[number].double().numpy() + distance * directions[number].double().numpy()
            if ((point >= lo - 1e-6) & (point <= hi + 1e-6)).all():
                continue
            place = in_lattice(point)
            along = np.clip(((place - starts) * ways).sum(1), 0.0, lengths)
            covered.append(np.linalg.norm(starts + along[:, None] * ways - place, axis=1).min() < 1e-3)
        # Once a point lies on a piece, all farther ones do.
        first = covered.index(True)
        assert all(covered[first:])
        end = starts[-1] + lengths[-1] * ways[-1]
        assert abs(end[0] % (DEEP + 1) - DEEP) < 1e-4, "the last piece ends at infinity"


def test_a_ray_through_the_box_begins_at_its_far_side():
    origins, directions = torch.tensor([[0.0, 0.0, -5.0]]), torch.tensor([[0.0, 0.0, 1.0]])
    cut = surroundings().segments(origins, directions)
    assert len(cut.ray) == 1
    np.testing.assert_allclose(cut.origins[0], in_lattice(np.array([0.0, 0.0, 0.6 + 1e-12])), atol=1e-4)


def test_the_lattices_of_two_faces_share_no_corner():
    voxels = surroundings().grid.voxels
    layer = voxels.corner_index()[:, 0] // (DEEP + 1)
    of_voxel = voxels.cells // (ACROSS * ACROSS) // (DEEP + 1)
    for corner in range(4):
        np.testing.assert_array_equal(layer[voxels.voxel_rows[:, corner]], of_voxel)
    assert len(voxels) == 6 * DEEP * ACROSS * ACROSS


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
