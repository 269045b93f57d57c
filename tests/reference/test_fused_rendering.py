"""The compiled renderer against its plain torch twin, over random grids and however rows are split."""

import itertools
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn.functional import normalize

from tests.reference.two_renderers import (
    EVERYTHING,
    as_double,
    assert_same,
    assert_twins_agree,
    in_double,
    random_grid,
    random_request,
    see,
)
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.threads import num_threads, set_num_threads
from thermoxels_ns.render import fused
from thermoxels_ns.render.fused import render as fused_render
from thermoxels_ns.render.kernels import AHEAD
from thermoxels_ns.render.ray_render import RayRequest, RenderOptions
from thermoxels_ns.render.renderers import sample_rays

ACTIVATIONS = ("relu", "exp")


@pytest.mark.parametrize("kept", [1.0, 0.4], ids=["dense", "sparse"])
@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize(
    ("sh_degree", "temperature_degree"), itertools.product((None, 0, 1, 2), (0, 1)), ids=lambda d: f"degree {d}"
)
def test_everything_at_once(sh_degree, temperature_degree, activation, kept):
    """With total variation of a block in the middle for all parameters."""
    grid = random_grid(sh_degree, temperature_degree, activation, kept)
    block = dict.fromkeys(grid.row_parameters(), (len(grid.voxels) // 4, len(grid.voxels) // 2))
    reference = assert_twins_agree(grid, random_request(grid), replace(EVERYTHING, variation=block))
    assert all(float(g.norm()) > 0 for g in reference.gradients.values())


@pytest.mark.parametrize("moves", [False, True])
@pytest.mark.parametrize(
    "options",
    [
        RenderOptions(),
        RenderOptions(distortion_scale=0.7),
        RenderOptions(variation={"temperature": (3, 4)}),
        RenderOptions(variation={"density": (0, 100), "sh": (50, 51)}),
        RenderOptions(steps_per_voxel=0.7, smallest_weight=1e-3, distortion_scale=2.0),
        RenderOptions(steps_per_voxel=5.3, smallest_weight=1e-2),
    ],
    ids=["plain", "distortion", "one variation", "two variations", "coarse steps", "fine steps"],
)
def test_each_term_alone(options, moves):
    grid = random_grid(1, 1, "exp", 0.4)
    options = replace(options, thermal_moves_density=moves)
    reference = assert_twins_agree(grid, random_request(grid), options)
    assert ("distortion" in reference.values) is (options.distortion_scale is not None)


@pytest.mark.parametrize("rgb", [None, True, False])
@pytest.mark.parametrize("thermal", [None, True, False])
@pytest.mark.parametrize("moves", [False, True])
def test_rays_that_want_only_one_stream_or_none(rgb, thermal, moves):
    grid = random_grid(1, 0)
    plain = random_request(grid, 60, mixed=False)
    wants = [None if w is None else torch.full((60,), w) for w in (rgb, thermal)]
    request = RayRequest(plain.origins, plain.directions, plain.near, None, *wants)
    reference = assert_twins_agree(grid, request, replace(EVERYTHING, thermal_moves_density=moves))
    if rgb is False:
        assert float(reference.values["rgb"].abs().max()) == 0.0
    if thermal is False:
        assert float(reference.gradients["temperature"].abs().max()) == 0.0


def test_gradients_hold_the_touched_rows_and_no_others():
    grid = random_grid(1)
    request = random_request(grid, 3)
    fused_render(grid, request, RenderOptions()).accumulation.sum().backward()
    gradient = grid.density.grad
    assert gradient.is_sparse
    rows = gradient._indices()[0]
    assert 0 < len(rows) < 0.3 * len(grid.density) and bool((rows.diff() > 0).all())
    samples = sample_rays(grid, request, RenderOptions(), "reference")
    assert set(rows.tolist()) == set(samples.at.rows().flatten().tolist())


@pytest.mark.parametrize("near", [0.0, 0.9, "per ray"])
@pytest.mark.parametrize("far", [None, "per ray"])
def test_near_and_far(near, far):
    grid = random_grid(0, 0)
    plain = random_request(grid, 80)
    span = torch.rand(2, 80, generator=torch.Generator().manual_seed(4))
    near = 0.5 + span[0] if near == "per ray" else near
    request = RayRequest(plain.origins, plain.directions, near, None if far is None else 1.0 + 2.0 * span[1])
    reference = assert_twins_agree(grid, request)
    assert 0 < int((reference.values["accumulation"] > 0).sum()) <= 80


def test_values_at_the_limit_of_exp_have_no_gradient():
    """Raw density above 15 stays at e^15; in a tiny box such a step is not yet opaque."""
    lattice = Lattice((0.0, 0.0, 0.0), 1e-6, (5, 5, 5))
    grid = random_grid(0, 0, "exp", 1.0, lattice, density=17.0)
    assert 0.1 < float((grid.density > 15).double().mean()) < 0.95
    reference = assert_twins_agree(grid, random_request(grid, 60), replace(EVERYTHING, distortion_scale=1e-6))
    assert float(reference.gradients["density"].norm()) > 0
    grid.density.data.fill_(20.0)
    assert float(see("fused", grid, random_request(grid, 60)).gradients["density"].abs().max()) == 0.0


def test_weights_next_to_the_smallest_weight_are_seen_by_both_passes_or_by_none():
    """A weight that single precision rounds across the limit: colour that was never read has no gradient."""
    lattice = Lattice((0.0, 0.0, 0.0), 1.0, (2, 2, 2))
    grid = random_grid(0, 0, "relu", 1.0, lattice)
    grid.density.data.fill_(1e-3)
    origins = torch.tensor([[-1.0, 0.3, 0.4]])
    request = RayRequest(origins, torch.tensor([[1.0, 0.0, 0.0]]))
    samples = sample_rays(as_double(grid), in_double(request), RenderOptions(steps_per_voxel=1.0), "fused")
    exact = float(samples.weight)
    rounded = float(torch.tensor(exact, dtype=torch.float32))
    limit = 0.5 * (exact + rounded)
    assert exact != rounded
    options = RenderOptions(steps_per_voxel=1.0, smallest_weight=limit)
    for _ in range(20):
        seen = see("fused", grid, request, options)
        shown = float(seen.values["rgb"].abs().max()) > 0
        assert (float(seen.gradients["sh"].abs().max()) > 0) is shown
        assert (float(seen.gradients["temperature"].abs().max()) > 0) is (float(seen.values["thermal"]) > 0)


def test_a_second_backward_through_one_render_is_refused():
    grid = random_grid(0)
    seen = fused_render(grid, random_request(grid, 20), RenderOptions())
    loss = seen.accumulation.sum()
    loss.backward(retain_graph=True)
    first = grid.density.grad.to_dense().clone()
    with pytest.raises(RuntimeError):
        loss.backward()
    assert torch.equal(grid.density.grad.to_dense(), first)


def test_parameters_that_are_not_asked_for_get_no_gradient():
    grid = random_grid(1)
    grid.density.requires_grad_(False)
    seen = fused_render(grid, random_request(grid, 30, mixed=False), RenderOptions())
    (seen.rgb.sum() + seen.thermal.sum()).backward()
    assert grid.density.grad is None and grid.sh.grad is not None and grid.temperature.grad is not None


def test_no_rays():
    grid = random_grid(1)
    nothing = torch.zeros(0, 3)
    for renderer in ("reference", "fused"):
        seen = see(renderer, grid, RayRequest(nothing, nothing))
        assert seen.values["rgb"].shape == (0, 3) and seen.values["depth"].shape == (0,)
        assert all(float(g.abs().sum()) == 0.0 for g in seen.gradients.values())


@st.composite
def cases(draw):
    """A lattice of any shape, a sparse pattern and rays, some of them along the axes and on faces between voxels."""
    shape = draw(st.tuples(*[st.integers(1, 20)] * 3))
    seed = draw(st.integers(0, 2**20))
    kept = draw(st.sampled_from([0.0, 0.01, 0.1, 0.5, 0.999]))
    # Voxel sizes and places that binary fractions cannot hold make sums round.
    size = draw(st.sampled_from([0.25, 0.1, 1 / 3, 7.0]))
    lattice = Lattice(
        tuple(draw(st.sampled_from([0.0, -0.7, 3.1])) for _ in range(3)), size, tuple(n + 1 for n in shape)
    )
    grid = random_grid(0, 0, "exp", kept, lattice, seed)
    rays = random_request(grid, 24, seed)
    origins, directions = rays.origins.clone(), rays.directions.clone()
    for ray in range(0, 24, 3):
        axis = draw(st.integers(0, 2))
        directions[ray] = torch.zeros(3)
        directions[ray, axis] = draw(st.sampled_from([1.0, -1.0]))
        directions[ray, (axis + 1) % 3] = draw(st.sampled_from([0.0, 0.0, 1e-7, -1e-6, 0.1]))
        face = draw(st.integers(0, shape[(axis + 2) % 3]))
        origins[ray, (axis + 2) % 3] = lattice.lo[(axis + 2) % 3] + face * size
    directions = normalize(directions, dim=-1)
    steps = draw(st.sampled_from([0.3, 1.0, 2.0, 3.7]))
    return (
        grid,
        RayRequest(origins, directions, draw(st.sampled_from([0.0, 1.0]))),
        RenderOptions(steps_per_voxel=steps),
    )


@given(cases())
@settings(max_examples=30, deadline=None, derandomize=True, database=None)
def test_both_backends_list_the_same_samples(case):
    grid, request, options = case
    grid, request = as_double(grid), in_double(request)
    found, expected = (sample_rays(grid, request, options, backend) for backend in ("fused", "reference"))
    torch.testing.assert_close(found.transmittance, expected.transmittance, rtol=1e-11, atol=0)
    # Steps so short that only rounding decides whether they exist have no weight.
    parts = []
    for samples in (found, expected):
        real = samples.weight > 1e-13
        parts.append((samples.ray[real], samples.at.number[real], samples.weight[real], samples.before[real]))
    (ray, number, weight, before), (ray2, number2, weight2, before2) = parts
    assert torch.equal(ray, ray2) and torch.equal(number, number2)
    torch.testing.assert_close(weight, weight2, rtol=1e-9, atol=1e-15)
    torch.testing.assert_close(before, before2, rtol=1e-9, atol=1e-12)


@given(cases())
@settings(max_examples=20, deadline=None, derandomize=True, database=None)
def test_any_pattern_has_the_reference_s_values_and_gradients(case):
    grid, request, options = case
    assert_twins_agree(grid, request, replace(EVERYTHING, steps_per_voxel=options.steps_per_voxel))


@pytest.fixture
def three_threads():
    before = num_threads()
    set_num_threads(3)
    yield
    set_num_threads(before)


@pytest.mark.usefixtures("three_threads")
@pytest.mark.parametrize("kept", [1.0, 0.4], ids=["dense", "sparse"])
@pytest.mark.parametrize("ranges", [1, 30, 400])
def test_any_number_of_row_ranges_gives_the_reference_s_sums(monkeypatch, ranges, kept):
    """Ranges of a few rows cut through voxels, blocks of total variation and groups of samples."""
    monkeypatch.setattr(fused, "RANGES_PER_THREAD", ranges)
    grid = as_double(random_grid(2, 1, "exp", kept, density=0.0))
    request, count = in_double(random_request(grid)), len(grid.voxels)
    blocks = {"density": (3, count), "sh": (count // 3, count // 2), "temperature": (0, 1)}
    options = replace(EVERYTHING, variation=blocks)
    reference = see("reference", grid, request, options)
    assert_same(see("fused", grid, request, options), reference, 1e-11, 1e-11)
    assert all(float(g.norm()) > 0 for g in reference.gradients.values())


@pytest.mark.usefixtures("three_threads")
def test_a_batch_that_needs_more_room_than_the_last_one_is_complete(monkeypatch):
    """Fewer places than samples at first: the render is repeated with room for all, and nothing is lost."""
    grid = random_grid(1, density=-3.0)
    request = random_request(grid, 500)
    expected = see("fused", grid, request)
    for room in (1, AHEAD):
        monkeypatch.setitem(fused._room, len(grid.density), room)
        found = see("fused", grid, request)
        assert fused._room[len(grid.density)] > room
        assert all(torch.equal(found.gradients[name], value) for name, value in expected.gradients.items())
        assert all(torch.equal(found.values[name], value) for name, value in expected.values.items())
