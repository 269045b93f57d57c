from __future__ import annotations

import pytest
import torch

from thermoxels_ns.field.interpolation import TrilinearPoints, interpolate, splat
from thermoxels_ns.lattice import Lattice

LATTICE = Lattice((-1.0, 0.5, 2.0), 0.25, (5, 4, 6))


def random_points(n: int, seed: int = 0) -> torch.Tensor:
    lo, hi = torch.tensor(LATTICE.lo, dtype=torch.float64), torch.tensor(LATTICE.hi, dtype=torch.float64)
    return lo + torch.rand(n, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * (hi - lo)


def trilinear_function(p: torch.Tensor) -> torch.Tensor:
    x, y, z = p.unbind(-1)
    return torch.stack((1 + 2 * x - y + 3 * z, x * y - 2 * y * z + x * y * z), -1)


def test_trilinear_functions_are_exact():
    rows = trilinear_function(torch.as_tensor(LATTICE.corner_positions()).reshape(-1, 3))
    points = random_points(500)
    torch.testing.assert_close(
        interpolate(rows, TrilinearPoints(LATTICE, points)), trilinear_function(points), rtol=0, atol=1e-12
    )


@pytest.mark.parametrize("end", ["lo", "hi"])
def test_corners_of_the_box_give_the_corner_value_and_outside_the_nearest(end):
    rows = torch.arange(LATTICE.num_corners, dtype=torch.float64)[:, None]
    corner = torch.tensor([getattr(LATTICE, end)], dtype=torch.float64)
    outward = -1.0 if end == "lo" else 1.0
    expected = rows[0] if end == "lo" else rows[-1]
    for point in (corner, corner + outward * 7.0):
        torch.testing.assert_close(interpolate(rows, TrilinearPoints(LATTICE, point))[0], expected)


def test_weights_sum_to_one_and_select_is_a_subset():
    at = TrilinearPoints(LATTICE, random_points(50))
    torch.testing.assert_close(at.weights().sum(-1), torch.ones(50, dtype=torch.float64))
    chosen = torch.tensor([3, 7, 7])
    assert torch.equal(at.select(chosen).corners(), at.corners()[chosen])


def test_gradient_is_exact():
    at = TrilinearPoints(LATTICE, random_points(40))
    rows = torch.rand(LATTICE.num_corners, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda r: interpolate(r, at), (rows,))


def test_splat_is_the_transpose_and_conserves_the_sum():
    at = TrilinearPoints(LATTICE, random_points(200))
    rows = torch.rand(LATTICE.num_corners, 2, dtype=torch.float64)
    values = torch.rand(200, 2, dtype=torch.float64)
    spread = splat(values, at, LATTICE.num_corners)
    torch.testing.assert_close((spread * rows).sum(), (values * interpolate(rows, at)).sum())
    torch.testing.assert_close(spread.sum(0), values.sum(0))


def test_gradient_has_the_same_bits_for_any_number_of_threads():
    at = TrilinearPoints(LATTICE, random_points(20_000).float())
    values = torch.rand(20_000, 27)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        one = splat(values, at, LATTICE.num_corners)
        torch.set_num_threads(2)
        two = splat(values, at, LATTICE.num_corners)
    finally:
        torch.set_num_threads(before)
    assert torch.equal(one, two)


def test_no_points_give_no_rows_and_no_gradient():
    rows = torch.rand(LATTICE.num_corners, 2, requires_grad=True)
    out = interpolate(rows, TrilinearPoints(LATTICE, torch.zeros(0, 3)))
    assert out.shape == (0, 2)
    out.sum().backward()
    assert rows.grad is not None and float(rows.grad.abs().sum()) == 0.0
