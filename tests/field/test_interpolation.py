import numpy as np
import pytest
import torch

from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.field.interpolation import TrilinearPoints, interpolate
from thermoxels_ns.field.kept_voxels import KeptVoxels

LATTICE = Lattice((-1.0, 0.5, 2.0), 0.25, (5, 4, 6))
ALL = KeptVoxels(LATTICE)
SOME = KeptVoxels(LATTICE, np.flatnonzero(np.random.default_rng(1).random(60) < 0.4))


def random_points(n: int, voxels: KeptVoxels = ALL, seed: int = 0) -> torch.Tensor:
    """Points spread evenly over the kept voxels."""
    generator = torch.Generator().manual_seed(seed)
    number = torch.randint(len(voxels), (n,), generator=generator).numpy()
    index = np.stack(np.unravel_index(voxels.cells[number], LATTICE.cell_shape), -1)
    place = torch.rand(n, 3, generator=generator, dtype=torch.float64)
    return torch.tensor(LATTICE.lo, dtype=torch.float64) + (torch.from_numpy(index) + place) * LATTICE.voxel_size


def trilinear_function(p: torch.Tensor) -> torch.Tensor:
    x, y, z = p.unbind(-1)
    return torch.stack((1 + 2 * x - y + 3 * z, x * y - 2 * y * z + x * y * z), -1)


@pytest.mark.parametrize("voxels", [ALL, SOME], ids=["dense", "sparse"])
def test_trilinear_functions_are_exact(voxels):
    rows = trilinear_function(torch.as_tensor(LATTICE.index_to_world(voxels.corner_index())))
    points = random_points(500, voxels)
    at = TrilinearPoints.of(voxels, points)
    assert bool(at.kept().all())
    torch.testing.assert_close(interpolate(rows, at), trilinear_function(points), rtol=0, atol=1e-12)


@pytest.mark.parametrize("end", ["lo", "hi"])
def test_corners_of_the_box_give_the_corner_value_and_outside_the_nearest(end):
    rows = torch.arange(LATTICE.num_corners, dtype=torch.float64)[:, None]
    corner = torch.tensor([getattr(LATTICE, end)], dtype=torch.float64)
    outward = -1.0 if end == "lo" else 1.0
    expected = rows[0] if end == "lo" else rows[-1]
    for point in (corner, corner + outward * 7.0):
        torch.testing.assert_close(interpolate(rows, TrilinearPoints.of(ALL, point))[0], expected)


def test_points_in_voxels_that_are_not_kept_are_known():
    centres = torch.as_tensor(LATTICE.cell_centres()).reshape(-1, 3)
    at = TrilinearPoints.of(SOME, centres)
    np.testing.assert_array_equal(at.kept().numpy(), SOME.mask().reshape(-1))
    np.testing.assert_array_equal(at.number[at.kept()].numpy(), np.arange(len(SOME)))
    torch.testing.assert_close(at.fraction, torch.full_like(centres, 0.5), rtol=0, atol=1e-12)


@pytest.mark.parametrize("voxels", [ALL, SOME], ids=["dense", "sparse"])
def test_gradient_is_exact(voxels):
    at = TrilinearPoints.of(voxels, random_points(40, voxels))
    rows = torch.rand(voxels.num_rows, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda r: interpolate(r, at), (rows,))
