"""Cases that break naive volume rendering, for both renderers: what must hold exactly, and the paper's sums."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from tests.reference.two_renderers import (
    EVERYTHING,
    RENDERERS,
    as_double,
    assert_twins_agree,
    in_double,
    keep_only,
    random_grid,
    random_request,
    see,
)
from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.field.voxel_grid import VoxelGrid
from thermoxels_ns.render import reference
from thermoxels_ns.render.fused import render as fused_render
from thermoxels_ns.render.ray_render import RayRequest, RenderOptions
from thermoxels_ns.render.renderers import sample_rays

CUBE = Lattice.covering((-1, -1, -1), (1, 1, 1), 16)
TUBE = Lattice((0.0, 0.0, 0.0), 1.0, (257, 2, 2))
"""256 voxels in a row: 512 samples on a ray along it."""
ALONG = RayRequest(torch.tensor([[-3.0, 0.3, 0.6]]), torch.tensor([[1.0, 0.0, 0.0]]))


def request(origins, directions) -> RayRequest:
    origins = torch.as_tensor(origins, dtype=torch.float32)
    directions = normalize(torch.as_tensor(directions, dtype=torch.float32).expand_as(origins), dim=-1)
    return RayRequest(origins, directions)


def filled(density: float, lattice: Lattice = CUBE, temperature: float = 0.4) -> VoxelGrid:
    grid = random_grid(1, 0, "relu", 1.0, lattice)
    grid.density.data.fill_(density)
    grid.temperature.data.fill_(temperature)
    return grid


@pytest.mark.parametrize("renderer", RENDERERS)
@pytest.mark.parametrize("sigma", [1e4, 1e30, float("inf")])
def test_huge_density_is_opaque_with_finite_gradients(renderer, sigma):
    rays = random_request(filled(1.0), 80, mixed=False)
    for grid, asked in ((filled(sigma), rays), (as_double(filled(sigma)), in_double(rays))):
        seen = see(renderer, grid, asked, replace(EVERYTHING, thermal_moves_density=True))
        hit = torch.isfinite(seen.values["depth"])
        assert 60 < int(hit.sum()) <= 80
        assert bool((seen.values["accumulation"][hit] == 1.0).all())
        assert float(seen.values["transmittance"][hit].max()) < 1e-30
        torch.testing.assert_close(seen.values["thermal"][hit, 0], torch.full((int(hit.sum()),), 0.4).double())
        for value in (seen.values[name][hit] for name in ("rgb", "depth", "distortion")):
            assert bool(torch.isfinite(value).all())
        assert all(bool(torch.isfinite(g).all()) for g in seen.gradients.values())
        assert float(seen.gradients["temperature"].norm()) > 0


@pytest.mark.parametrize("renderer", RENDERERS)
@pytest.mark.parametrize("activation", ["relu", "exp"])
def test_nan_density_is_refused_not_made_transparent(renderer, activation):
    grid = random_grid(0, 0, activation, 1.0, CUBE)
    grid.density.data[len(grid.density) // 2] = float("nan")
    with pytest.raises(ThermoxelsError, match=r"^density: "):
        RENDERERS[renderer](grid, random_request(grid), RenderOptions())


def test_transmittance_keeps_its_digits_over_512_samples():
    """Behind an optical depth of 30 each weight is far below what 1 - accumulation can hold in single precision."""
    grid = filled(0.04, TUBE)
    grid.density.data[:4] = 60.0
    single = sample_rays(grid, ALONG, RenderOptions(), "fused")
    exact = sample_rays(as_double(grid), in_double(ALONG), RenderOptions(), "reference")
    assert len(single.weight) == len(exact.weight) == 512
    error = (single.weight.double() - exact.weight).abs() / exact.weight
    assert float(error.max()) < 1e-5 and 0 < float(exact.weight[-1]) < 1e-17
    assert float(single.transmittance) == pytest.approx(float(exact.transmittance), rel=1e-5)
    # The rays alone move no density of a wall so opaque; its total variation gives the gradients a size to compare.
    options = replace(EVERYTHING, thermal_moves_density=True, variation={"density": (0, 256)})
    reference = assert_twins_agree(grid, ALONG, options)
    assert float(reference.values["transmittance"]) < 1e-16


def test_vanishing_density_keeps_value_and_gradient():
    """1 - exp(-1e-8) is 0 in single precision; a renderer that computes it so has a plateau without gradient."""
    grid = filled(1e-9, TUBE)
    reference = assert_twins_agree(grid, ALONG, RenderOptions())
    assert float(reference.values["accumulation"]) == pytest.approx(256e-9, rel=1e-6)
    for renderer in RENDERERS:
        grid.density.grad = None
        RENDERERS[renderer](grid, ALONG, RenderOptions()).accumulation.sum().backward()
        assert float(grid.density.grad.to_dense().sum()) == pytest.approx(256.0, rel=1e-5)


@pytest.mark.parametrize("eps", [0.1, 1e-2, 1e-3, 1e-5])
@pytest.mark.parametrize("density", [0.5, 2.5])
def test_early_stop_is_off_by_less_than_its_bound(eps, density):
    grid = random_grid(2, 0, "exp", 0.7, CUBE, density=density)
    rays = random_request(grid, 300, mixed=False)
    whole = fused_render(grid, rays, RenderOptions())
    stopped = fused_render(grid, rays, RenderOptions(early_stop=eps))
    for exact, early in ((getattr(whole, n), getattr(stopped, n)) for n in ("rgb", "thermal", "accumulation")):
        assert float((exact - early).abs().max()) <= eps + 1e-6
    full, short = (sample_rays(grid, rays, RenderOptions(early_stop=e), "fused") for e in (0.0, eps))
    assert 0 < len(short.weight) < len(full.weight)
    # It stops only rays of which less than eps is left.
    ended = short.transmittance != full.transmittance
    assert bool(ended.any()) and bool((short.transmittance[ended] < eps).all())


def test_skipped_colours_are_off_by_less_than_their_bound():
    grid = random_grid(2, 0, "exp", 1.0, CUBE, density=-1.0)
    rays = random_request(grid, 200, mixed=False)
    steps = torch.bincount(sample_rays(grid, rays, RenderOptions(), "fused").ray, minlength=200)
    exact, skipped = (fused_render(grid, rays, RenderOptions(smallest_weight=w)) for w in (0.0, 1e-2))
    error = (exact.rgb - skipped.rgb).abs().amax(-1)
    assert float(error.max()) > 0 and bool((error <= 1e-2 * steps + 1e-6).all())
    torch.testing.assert_close(exact.accumulation, skipped.accumulation, rtol=0, atol=0)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("slope", [0.0, 1e-7, -1e-7, 1e-6, -1e-6, 1e-30, -1e-30, 1e-42])
def test_axis_parallel_rays(axis, sign, slope):
    """d in {0, +-1e-6, +-1e-7}: no sign flips, no infinities; the chord is 2, also along faces between voxels."""
    directions = torch.zeros(5, 3)
    directions[:, axis], directions[:, (axis + 1) % 3] = sign, slope
    origins = torch.zeros(5, 3)
    origins[:, axis] = -4.0 * sign
    origins[:, (axis + 2) % 3] = torch.tensor([0.5, 0.0, 0.03, -0.125, 0.999])
    rays = request(origins, directions)
    full = filled(0.25)
    for renderer in RENDERERS:
        seen = RENDERERS[renderer](full, rays, RenderOptions())
        assert seen.accumulation.tolist() == pytest.approx([1 - np.exp(-0.5)] * 5, rel=1e-5)
    assert_twins_agree(random_grid(1, 0, "relu", 0.05, CUBE), rays)


@pytest.mark.parametrize("renderer", RENDERERS)
@pytest.mark.parametrize("offset, hits", [(1.0, True), (1.0 + 1e-6, False), (-1.0, True), (1.5, False)])
def test_parallel_ray_on_a_face_hits_just_outside_it_misses(renderer, offset, hits):
    rays = request([[-4.0, offset, 0.03]], [1.0, 0.0, 0.0])
    seen = RENDERERS[renderer](filled(5.0), rays, RenderOptions())
    assert (float(seen.accumulation) > 0.99) is hits and bool(torch.isinf(seen.depth)) is not hits


@pytest.mark.parametrize("renderer", RENDERERS)
@pytest.mark.parametrize("slope", [-1e-6, -1e-7])
def test_a_ray_that_is_nearly_parallel_enters_through_the_side_it_crosses(renderer, slope):
    """It starts just above the box and comes down to its top in the middle of it."""
    origins = torch.tensor([[-41.0, 1.0, 0.03]], dtype=torch.float64)
    origins[0, 1] -= 41.0 * slope
    rays = RayRequest(origins, torch.tensor([[1.0, slope, 0.0]], dtype=torch.float64))
    seen = RENDERERS[renderer](as_double(filled(0.25)), rays, RenderOptions())
    assert float(seen.accumulation) == pytest.approx(1.0 - np.exp(-0.25), rel=1e-6)


@pytest.mark.parametrize("renderer", RENDERERS)
@pytest.mark.parametrize(
    ("origin", "towards", "chord"),
    [
        *(  # on a face, an edge and a corner: inwards and outwards
            (corner, [way * side for side in corner], length)
            for corner in ([1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [1.0, 1.0, 1.0], [-1.0, 1.0, -1.0])
            for way, length in ((-1.0, 2.0 * float(np.linalg.norm(corner))), (1.0, 0.0))
        ),
        ([0.2, 0.01, 0.02], [1.0, 0.0, 0.0], 0.8),  # inside, where the ray starts at the camera
        ([3.0, 0.01, 0.02], [1.0, 0.0, 0.0], 0.0),  # the box lies behind
        ([0.0, 0.0, 5.0], [0.0, 0.0, 1.0], 0.0),
        ([3.0, 3.0, 0.0], [1.0, -1.0, 0.0], 0.0),
        ([-3.0, 0.0, 0.0], [0.0, 1.0, 0.0], 0.0),
    ],
)
def test_the_chord_of_a_camera_on_in_or_beside_the_box(renderer, origin, towards, chord):
    seen = RENDERERS[renderer](filled(0.5), request([origin], towards), RenderOptions())
    assert float(seen.accumulation) == pytest.approx(1.0 - np.exp(-0.5 * chord), rel=1e-5, abs=1e-6)
    if origin[0] in (0.0, 3.0, -3.0):  # a miss sees nothing at all
        assert not bool(seen.rgb.any()) and not bool(seen.thermal.any())
        assert float(seen.accumulation) == 0.0 and float(seen.transmittance) == 1.0 and bool(torch.isinf(seen.depth))
    assert_twins_agree(random_grid(1, 0, "relu", 0.3, CUBE), request([origin], towards))


@pytest.mark.parametrize("renderer", RENDERERS)
@pytest.mark.parametrize("parallel", [False, True])
@pytest.mark.parametrize("part", ["origins", "directions"])
@pytest.mark.parametrize("axes", [[0], [1], [2], [1, 2], [0, 1, 2]])
def test_a_ray_with_a_nan_misses_and_the_others_see_what_they_saw(renderer, part, axes, parallel):
    towards = [1.0, 0.0, 0.0] if parallel else [3.0, -0.3, -0.2]
    rays = request([[-3.0, 0.3, 0.2], [-3.0, 0.25, 0.1]], towards)
    before = RENDERERS[renderer](filled(50.0), rays, RenderOptions())
    getattr(rays, part)[0, axes] = float("nan")
    seen = RENDERERS[renderer](filled(50.0), rays, RenderOptions())
    assert before.accumulation.tolist() == [1.0, 1.0]
    assert seen.accumulation.tolist() == [0.0, 1.0] and float(seen.depth[0]) == float("inf")
    assert torch.equal(seen.thermal[1], before.thermal[1]) and torch.equal(seen.rgb[1], before.rgb[1])


@pytest.mark.parametrize("renderer", RENDERERS)
@pytest.mark.parametrize("activation, raw", [("relu", 0.0), ("relu", -3.0), ("exp", -1e30)])
def test_rays_through_nothing_see_nothing_and_pull_at_no_temperature(renderer, activation, raw):
    grid = random_grid(1, 0, activation, 1.0, CUBE)
    grid.density.data.fill_(raw)
    rays = random_request(grid, 50, mixed=False)
    seen = RENDERERS[renderer](grid, rays, EVERYTHING)
    assert bool((seen.transmittance == 1).all()) and bool((seen.accumulation == 0).all())
    assert bool(torch.isinf(seen.depth).all())
    assert float(seen.distortion.abs().max()) == 0.0
    (seen.rgb.sum() + seen.thermal.sum()).backward()
    for parameter in grid.row_parameters().values():
        assert parameter.grad is None or float(parameter.grad.to_dense().abs().max()) == 0.0


@pytest.mark.parametrize("renderer", RENDERERS)
@pytest.mark.parametrize("temperature_degree", [0, 1])
def test_constant_temperature_renders_constant_wherever_it_is_opaque(renderer, temperature_degree):
    """Voxels that are not kept have no temperature that could mix with the others'."""
    index = np.stack(np.unravel_index(np.arange(16**3), (16, 16, 16)), -1)
    ball = np.flatnonzero(np.linalg.norm(index - 7.5, axis=1) < 6)
    grid = random_grid(None, temperature_degree, "exp", ball, CUBE)
    grid.density.data.fill_(8.0)
    grid.temperature.data.zero_()
    grid.temperature.data[:, 0] = 0.4
    rays = random_request(grid, 200, mixed=False)
    seen = RENDERERS[renderer](grid, rays, RenderOptions())
    opaque = seen.accumulation > 0.5
    assert 100 < int(opaque.sum()) < 200
    torch.testing.assert_close(
        seen.thermal[opaque, 0] / seen.accumulation[opaque], torch.full((int(opaque.sum()),), 0.4), rtol=2e-6, atol=0
    )
    assert float(seen.accumulation[opaque].min()) > 0.99999


@pytest.mark.parametrize("renderer", RENDERERS)
@pytest.mark.parametrize("storage", ["dense", "sparse"])
@pytest.mark.parametrize("angle", [0.0, 30.0, 45.0])
def test_wall_one_voxel_thick_is_opaque_from_both_sides(renderer, storage, angle):
    lattice = Lattice.covering((-1, -1, -1), (1, 1, 1), 32)
    normal = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0.0])
    grid = random_grid(None, 0, "relu", 1.0, lattice)
    if storage == "sparse":
        near = np.abs(lattice.cell_centres() @ normal) / lattice.voxel_size
        keep_only(grid, np.flatnonzero(near.reshape(-1) < 2.0))
    positions = lattice.index_to_world(grid.voxels.corner_index())
    inside = np.abs(positions @ normal) / lattice.voxel_size <= 0.75
    grid.density.data = torch.tensor(np.where(inside, 600.0, 0.0)[:, None], dtype=torch.float32)
    side = torch.tensor([-normal[1], normal[0], 0.0])
    facing = torch.tensor(normal)
    for sign in (1.0, -1.0):
        origins = sign * 3.0 * facing + torch.linspace(-0.5, 0.5, 101)[:, None] * side + torch.tensor([0.0, 0.0, 0.137])
        seen = RENDERERS[renderer](grid, request(origins, -sign * facing), RenderOptions())
        assert float(seen.accumulation.min()) > 0.99
        # It is hit where it stands: half its thickness, and the voxels that interpolation smears it over.
        assert float((seen.depth - 3.0).abs().max()) < (0.75 + np.abs(normal).sum()) * lattice.voxel_size


def test_renders_are_the_sums_of_the_paper():
    """Eq. 1 and 2 with all voxels kept: colour, temperature, opacity, expected distance."""
    grid = as_double(random_grid(1, 1, "exp", density=0.0))
    rays = in_double(random_request(grid, 12, mixed=False))
    seen = reference.render(grid, rays, RenderOptions())
    marched = reference.march(grid, rays, RenderOptions())
    distances, deltas = marched.t, marched.deltas
    assert seen.rgb is not None and int((seen.accumulation > 0.1).sum()) > 6
    for r in range(12):
        real = deltas[r] > 0
        points = rays.origins[r] + distances[r][real][:, None] * rays.directions[r]
        at, along = grid.locate(points), rays.directions[r].expand_as(points)
        rows = torch.cat((grid.rgb_at(at, along), grid.thermal_at(at, along)), 1).tolist()
        left, total, distance = 1.0, [0.0] * 4, 0.0
        columns = grid.density_at(at), deltas[r][real], distances[r][real]
        for density, delta, t, row in zip(*(column.tolist() for column in columns), rows):
            weight = left * -math.expm1(-density * delta)
            total = [c + weight * v for c, v in zip(total, row)]
            distance += weight * t
            left *= math.exp(-density * delta)
        assert [*seen.rgb[r].tolist(), float(seen.thermal[r])] == pytest.approx(total, abs=1e-12)
        assert float(seen.transmittance[r]) == pytest.approx(left, rel=1e-10)
        assert float(seen.accumulation[r]) == pytest.approx(1.0 - left, abs=1e-12)
        if left < 1.0:
            assert float(seen.depth[r]) == pytest.approx(distance / (1.0 - left), rel=1e-9)


@pytest.mark.parametrize("activation", ["relu", "exp"])
def test_activations_stay_finite_for_any_stored_value(activation):
    grid = VoxelGrid(Lattice((0.0, 0.0, 0.0), 1.0, (2, 2, 2)), sh_degree=None, activation=activation)
    for value in (-1e30, -100.0, 0.0, 100.0, 1e30):
        grid.density.data.fill_(value)
        density = grid.density_at(grid.locate(torch.full((3, 3), 0.5)))
        assert (density >= 0).all() and torch.isfinite(density).all()
        density.sum().backward()
        assert grid.density.grad is not None and torch.isfinite(grid.density.grad).all()
