import numpy as np
import torch

from tests.reference.two_renderers import random_grid, random_request
from thermoxels_ns.core.arrays import BUFFERS, PATIENCE, SMALLEST, BufferPool, rounded_size
from thermoxels_ns.field.refine import refine
from thermoxels_ns.render.ray_render import RenderOptions
from thermoxels_ns.render.renderers import fused_render

LARGE = 4 * SMALLEST


def address(array: np.ndarray) -> int:
    return array.ctypes.data


def held_bytes(pool: BufferPool) -> int:
    return sum(length * len(blocks) for length, blocks in pool._free.items())


def test_memory_comes_back_when_the_last_view_of_it_is_gone():
    pool = BufferPool()
    array = pool.empty((LARGE // 8, 2), np.float32)
    assert array.shape == (LARGE // 8, 2) and array.dtype == np.float32
    where, view, tensor = address(array), array[3:], torch.from_numpy(array)[1:]
    del array
    assert held_bytes(pool) == 0
    del view
    assert held_bytes(pool) == 0
    del tensor
    assert held_bytes(pool) == rounded_size(LARGE)
    assert address(pool.empty(LARGE // 8, np.float64)) == where


def test_what_nobody_asks_for_is_given_back():
    pool = BufferPool()
    del [pool.empty(LARGE, np.uint8)][0]
    assert held_bytes(pool) == LARGE
    for _ in range(2 * PATIENCE):
        pool.empty(2 * LARGE, np.uint8)
    assert held_bytes(pool) == 2 * LARGE


def rendered(grid, request):
    seen = fused_render(grid, request, RenderOptions(distortion_scale=2.0))
    assert seen.rgb is not None and seen.distortion is not None
    return seen.rgb.sum() + seen.thermal.sum() + seen.distortion.sum()


def gradients(grid) -> list[torch.Tensor]:
    return [parameter.grad.to_dense().clone() for parameter in grid.parameters()]


def test_renders_that_wait_for_their_gradient_keep_their_records():
    """Two renders, then their gradients in either order, are each what they are alone."""
    grid = random_grid(2, density=0.0)
    requests = [random_request(grid, 600, seed) for seed in (0, 1)]
    alone = []
    for request in requests:
        grid.zero_grad()
        rendered(grid, request).backward()
        alone.append(gradients(grid))
    losses = [rendered(grid, request) for request in requests]
    for which in (1, 0):
        grid.zero_grad()
        losses[which].backward()
        assert all(torch.equal(a, b) for a, b in zip(gradients(grid), alone[which]))


def test_gradients_are_not_overwritten_by_the_next_step():
    grid = random_grid(2, density=0.0)
    rendered(grid, random_request(grid, 600, 0)).backward()
    held = [parameter.grad for parameter in grid.parameters()]
    before = gradients(grid)
    grid.zero_grad(set_to_none=True)
    for seed in (1, 2):
        rendered(grid, random_request(grid, 600, seed)).backward()
    assert all(torch.equal(kept.to_dense(), value) for kept, value in zip(held, before))


def test_a_new_lattice_gives_back_what_the_old_one_needed():
    grid = random_grid(2, density=0.0)
    rendered(grid, random_request(grid, 2000)).backward()
    grid.zero_grad(set_to_none=True)
    assert held_bytes(BUFFERS) > 0
    refine(grid, 2)
    assert held_bytes(BUFFERS) == 0
