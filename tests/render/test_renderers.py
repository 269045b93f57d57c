"""Box, surroundings and infinity as one picture."""

import math
from dataclasses import replace

import pytest
import torch

from tests.reference.two_renderers import random_grid
from thermoxels_ns.field.surroundings import SkyTemperature, SphereImage, Surroundings
from thermoxels_ns.render.ray_render import RayRequest, RenderOptions
from thermoxels_ns.render.renderers import Scene, render_scene, split_render

BOX = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])


def scene() -> Scene:
    around = Surroundings(BOX, 8, 4, 0.05, "exp", True)
    made = Scene(random_grid(1, density=-2.0), around, SphereImage(4), SkyTemperature())
    generator = torch.Generator().manual_seed(1)
    for values, scale in ((around.grid.density, 1.0), (around.grid.sh, 3.0), (around.grid.temperature, 1.0)):
        values.data += scale * torch.randn(values.shape, generator=generator)
    for module in (made.rgb, made.thermal):
        for values in module.parameters():
            values.data = torch.randn(values.shape, generator=generator)
    return made


def request(count: int = 60) -> RayRequest:
    generator = torch.Generator().manual_seed(2)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    wants = [torch.rand(count, generator=generator) < 0.7 for _ in range(2)]
    return RayRequest(0.8 * torch.randn(count, 3, generator=generator), directions, 0.0, None, *wants)


def test_what_is_seen_is_what_each_part_lets_through_to_the_next():
    made, rays = scene(), request()
    whole = render_scene(made, rays, RenderOptions(), "fused")
    box, around = whole.box, whole.around
    left = box.transmittance[:, None]
    for seen, parts, infinity, wants in (
        (whole.rgb, (box.rgb, around.rgb), made.rgb, rays.rgb_rays),
        (whole.thermal, (box.thermal, around.thermal), made.thermal, rays.thermal_rays),
    ):
        far = infinity(rays.directions) * wants[:, None]
        torch.testing.assert_close(seen, parts[0] + left * (parts[1] + around.transmittance[:, None] * far))
        assert not bool(seen[~wants].any()) and float(seen.detach().std()) > 0.1
    alone = render_scene(Scene(made.grid), rays, RenderOptions(), "fused")
    assert alone.around is None and torch.equal(alone.thermal, box.thermal)


@pytest.mark.parametrize("moves", [False, True])
def test_the_renderers_agree_in_values_and_gradients(moves):
    found = []
    options = RenderOptions(thermal_moves_density=moves)
    for backend in ("fused", "reference"):
        made = scene()
        seen = render_scene(made, request(), options, backend, {"density": (0, 9)})
        loss = seen.rgb.square().sum() + seen.thermal.sum() + seen.around.transmittance.square().sum()
        (loss + seen.around.variation["density"]).backward()
        parts = [made.grid, made.surroundings.grid, made.rgb, made.thermal]
        grads = [p.grad.to_dense() for part in parts for p in part.parameters() if p.grad is not None]
        found.append([seen.rgb.detach(), seen.thermal.detach(), *grads])
    assert len(found[0]) == 10
    for fused, reference in zip(*found, strict=True):
        torch.testing.assert_close(fused, reference, rtol=2e-3, atol=3e-4)


def test_rays_of_several_requests_see_together_what_they_see_alone():
    made, rays = scene(), request()
    odd = torch.arange(60) % 2 == 1
    requests = [
        rays,
        replace(rays, near=0.3, rgb_rays=odd),
        RayRequest(rays.origins[:7], rays.directions[:7], 0.1, torch.full((7,), 1.5), None, odd[:7]),
    ]
    options = RenderOptions(distortion_scale=2.0)
    together = split_render(requests, lambda joined: render_scene(made, joined, options, "fused"))
    for part, one in zip(together, requests, strict=True):
        alone = render_scene(made, one, options, "fused")
        for here, there in ((part, alone), (part.box, alone.box), (part.around, alone.around)):
            for name, value in vars(there).items():
                if isinstance(value, torch.Tensor):
                    torch.testing.assert_close(getattr(here, name), value)


def test_rays_that_end_in_the_box_are_not_followed_out_of_it():
    made = scene()
    made.grid.density.data.fill_(math.log(1e3))
    rays = replace(request(), origins=torch.zeros(60, 3), rgb_rays=None, thermal_rays=None)
    seen = render_scene(made, rays, RenderOptions(), "fused").around
    assert bool((seen.transmittance == 1.0).all()) and not bool(seen.rgb.any())


def test_a_thing_outside_is_seen_where_it_is_from_two_places():
    """A sphere image could not: from the second place the thing lies in another direction."""
    made, grid = Surroundings(BOX, 32, 32, 1e-6, "exp", True), random_grid(0, density=-50.0)
    thing = torch.tensor([4.0, 0.5, 0.3])
    voxel = torch.tensor([(1 - 1 / 4.0) * 32, 0.5 * (0.5 / 4 + 1) * 32, 0.5 * (0.3 / 4 + 1) * 32]).floor().long()
    index = torch.from_numpy(made.grid.voxels.corner_index())
    near = ((index - voxel >= 0) & (index - voxel <= 1)).all(1)
    made.grid.density.data[near] = math.log(50.0)
    eyes = torch.tensor([[0.0, 0.0, 0.0], [0.5, -0.9, 0.8]])
    towards = torch.nn.functional.normalize(thing - eyes, dim=-1)
    both = RayRequest(eyes.repeat(2, 1), torch.cat((towards, towards.flip(0))))
    seen = render_scene(Scene(grid, made), both, RenderOptions(), "fused").around
    assert bool((seen.transmittance[:2] < 1e-3).all()), "both look at it"
    assert bool((seen.transmittance[2:] > 0.99).all()), "the other's direction leads past it"
