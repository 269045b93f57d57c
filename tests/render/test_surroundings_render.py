import torch

from thermoxels_ns.field.surroundings import Surroundings
from thermoxels_ns.field.voxel_grid import raw_density
from thermoxels_ns.render.ray_render import RayRequest, RenderOptions
from thermoxels_ns.render.surroundings_render import render_surroundings

BOX = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])


def scene() -> Surroundings:
    made = Surroundings(BOX, 8, 4, 0.05, "exp", True)
    generator = torch.Generator().manual_seed(1)
    for values, scale in ((made.grid.density, 1.0), (made.grid.sh, 3.0), (made.grid.temperature, 1.0)):
        assert values is not None
        values.data += scale * torch.randn(values.shape, generator=generator)
    return made


def request(count: int = 60) -> RayRequest:
    generator = torch.Generator().manual_seed(2)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    return RayRequest(0.8 * torch.randn(count, 3, generator=generator), directions)


def test_the_renderers_agree_in_values_and_gradients():
    found = []
    for backend in ("fused", "reference"):
        made, rays = scene(), request()
        seen = render_surroundings(made, rays, RenderOptions(), backend, torch.ones(60, dtype=torch.bool))
        assert seen.rgb is not None
        (seen.rgb.square().sum() + seen.thermal.sum() + seen.transmittance.square().sum()).backward()
        grads = [p.grad.to_dense() for p in made.grid.row_parameters().values() if p.grad is not None]
        found.append([seen.rgb.detach(), seen.thermal.detach(), seen.transmittance.detach(), *grads])
    for fused, reference in zip(*found, strict=True):
        torch.testing.assert_close(fused, reference, rtol=2e-3, atol=2e-4)


def test_rays_that_are_not_asked_see_nothing():
    asked = torch.zeros(60, dtype=torch.bool)
    asked[7] = True
    seen = render_surroundings(scene(), request(), RenderOptions(), "fused", asked)
    assert seen.rgb is not None
    assert bool((seen.transmittance[~asked] == 1.0).all()) and not bool(seen.rgb[~asked].any())
    assert float(seen.transmittance[7]) < 1.0


def test_a_thing_outside_is_seen_where_it_is_from_two_places():
    """A sphere image could not: from the second place the thing lies in another direction."""
    made = Surroundings(BOX, 32, 32, 1e-6, "exp", True)
    thing = torch.tensor([4.0, 0.5, 0.3])
    voxel = torch.tensor([(1 - 1 / 4.0) * 32, 0.5 * (0.5 / 4 + 1) * 32, 0.5 * (0.3 / 4 + 1) * 32]).floor().long()
    index = torch.from_numpy(made.grid.voxels.corner_index())
    near = ((index - voxel >= 0) & (index - voxel <= 1)).all(1)
    made.grid.density.data[near] = raw_density(50.0, "exp")
    eyes = torch.tensor([[0.0, 0.0, 0.0], [0.5, -0.9, 0.8]])
    towards = torch.nn.functional.normalize(thing - eyes, dim=-1)
    both = RayRequest(eyes.repeat(2, 1), torch.cat((towards, towards.flip(0))))
    seen = render_surroundings(made, both, RenderOptions(), "fused", torch.ones(4, dtype=torch.bool))
    assert bool((seen.transmittance[:2] < 1e-3).all()), "both look at it"
    assert bool((seen.transmittance[2:] > 0.99).all()), "the other's direction leads past it"
