from dataclasses import replace

import numpy as np
import pytest

from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.build import MeshOptions, build_mesh, check_similarity
from thermoxels_ns.mesh.quality.checks import facet_areas
from thermoxels_ns.mesh.quality.report import check_mesh
from thermoxels_ns.mesh.solid.voxels import SolidSelection

DENSE = SolidSelection(close_gaps=0, density_threshold=0.5)
VOXEL = MeshOptions("voxel")
MODES = ["conforming", "voxel"]


def rotation(seed: int) -> np.ndarray:
    turn = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    return turn * np.linalg.det(turn)


def linear_map(linear: np.ndarray, shift=(0.0, 0.0, 0.0)) -> np.ndarray:
    return np.block([[linear, np.array(shift)[:, None]], [np.zeros(3), 1.0]])


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("mirror", [False, True])
def test_rotated_scaled_and_mirrored_meshes_stay_valid(snapshot_of, mirror, mode):
    linear = rotation(5) @ (np.diag([1.0, 1.0, -1.0]) if mirror else np.eye(3))
    density = np.ones((6, 5, 4))
    density[:3, :3, 2:] = 0.0
    field = snapshot_of(density, lo=(-1.0, 2.0, 0.5), voxel_size=0.25)
    built = build_mesh(field, DENSE, linear_map(3.0 * linear, (5.0, -7.0, 1.0)), MeshOptions(mode))
    quality = check_mesh(built.mesh, mode)  # positive volumes, facets outwards
    exact = built.solid.cells.sum() * (0.25 * 3.0) ** 3
    assert quality.volume_m3 == pytest.approx(exact, rel=1e-12 if mode == "voxel" else 0.2)


def test_extension_conducts_like_the_voxels_do(snapshot_of):
    # A bar seen at both ends only, with a step in its width: four times as many voxels in the wide half.
    density = np.zeros((42, 4, 4))
    density[:, :2, :2] = 1.0
    density[21:, :3, :3] = 1.0
    weight = np.zeros(density.shape)
    weight[[0, -1]] = 1.0
    values = np.zeros(density.shape)
    values[-1] = 100.0
    whole = SolidSelection(close_gaps=0, density_threshold=1.0)
    mesh = build_mesh(snapshot_of(density, values, weight), whole, np.eye(4), VOXEL).mesh
    x = mesh.points_m[:, 0] / 0.5
    thin = mesh.temperature_c[x == 10].mean() - mesh.temperature_c[x == 5].mean()
    wide = mesh.temperature_c[x == 37].mean() - mesh.temperature_c[x == 32].mean()
    assert thin == pytest.approx(4 * wide, rel=1e-6)


def test_body_no_thermal_ray_saw_is_refused(snapshot_of):
    with pytest.raises(MeshError, match="thermal ray"):
        build_mesh(snapshot_of(np.ones((3, 3, 3)), 20.0, 0.0), DENSE, np.eye(4))


def test_part_no_thermal_ray_saw_is_left_out(snapshot_of):
    # Three bodies: one seen, one that touches it by a corner only, and one apart that nobody saw.
    cells = np.zeros((7, 4, 4), bool)
    cells[:2, :2, :2] = cells[2, 2, 2] = cells[4:6, :1, :3] = True
    weight = np.zeros((8, 5, 5))
    weight[0] = 1.0
    field = replace(snapshot_of(np.ones(weight.shape), 20.0, weight), voxel_density=cells.astype(np.float32))
    every = SolidSelection(close_gaps=0, density_threshold=0.5, region="all")
    built = build_mesh(field, every, np.eye(4), VOXEL)
    mesh, solid = built.mesh, built.solid
    assert (built.unobserved_parts, built.unobserved_voxels) == (1, 6)
    expected = cells.copy()
    expected[4:] = False
    assert np.array_equal(solid.cells, expected) and len(mesh.tets) == 6 * 9
    assert check_mesh(mesh).volume_m3 == pytest.approx(9 * 0.5**3)
    seen = replace(field, observed_weight=np.ones((8, 5, 5), np.float32))
    built = build_mesh(seen, every, np.eye(4), VOXEL)
    assert (built.unobserved_parts, built.unobserved_voxels, len(built.mesh.tets)) == (0, 0, 6 * 15)


def test_part_of_a_conforming_mesh_no_thermal_ray_saw_is_counted(snapshot_of):
    """Two cubes that touch by a corner: one part as voxels, two as a smooth surface. Rays saw only the first."""
    cells = np.zeros((10, 10, 10), bool)
    cells[1:4, 1:4, 1:4] = cells[4:7, 4:7, 4:7] = True
    weight = np.zeros((11, 11, 11))
    weight[:3, :3, :3] = 1.0
    field = replace(snapshot_of(np.ones(weight.shape), 20.0, weight), voxel_density=cells.astype(np.float32))
    every = SolidSelection(close_gaps=0, density_threshold=0.5, interior="hollow")
    built = build_mesh(field, every, np.eye(4))
    assert (built.unobserved_parts, built.unobserved_voxels) == (1, 27)
    assert built.solid.cells.sum() == 27 and built.solid.cells[1:4, 1:4, 1:4].all()
    assert np.array_equal(built.solid.level > 0, built.solid.cells)
    assert built.mesh.points_m.max() < 4.3 * 0.5
    assert check_mesh(built.mesh).volume_m3 == pytest.approx(27 * 0.5**3, rel=0.2)


@pytest.mark.parametrize(
    "bad", [np.diag([1.0, 1.0, 2.0, 1.0]), np.zeros((4, 4)), np.diag([1.0, 1.0, 1.0, 2.0]), np.full((4, 4), np.nan)]
)
def test_what_is_no_similarity_is_refused(bad):
    with pytest.raises(MeshError, match="world_to_metres"):
        check_similarity("world_to_metres", bad)


def ball(snapshot_of, seen_side: bool = False):
    """A ball of radius 5.3 voxels of 0.5 in a lattice of 14, its density exponential in the distance to its surface."""
    corner = np.stack(np.meshgrid(*[np.arange(15.0)] * 3, indexing="ij"), axis=-1)
    inside = 5.3 - np.linalg.norm(corner - 7.0, axis=-1)
    weight = (np.abs(inside) < 1.5) * (corner[..., 0] > 7.0 if seen_side else 1.0)
    centre = np.stack(np.meshgrid(*[np.arange(14) + 0.5] * 3, indexing="ij"), axis=-1)
    depth = 5.3 - np.linalg.norm(centre - 7.0, axis=-1)
    field = snapshot_of(np.exp(3.0 * inside), 20.0 + corner[..., 0], weight)
    return replace(field, voxel_density=np.exp(3.0 * depth).astype(np.float32))


@pytest.mark.parametrize("mode", MODES)
def test_temperatures_come_from_what_was_seen_and_stay_in_its_range(snapshot_of, mode):
    mesh = build_mesh(ball(snapshot_of, seen_side=True), DENSE, np.eye(4), MeshOptions(mode)).mesh
    x = mesh.points_m[:, 0] / 0.5
    assert mesh.observed[x > 11].any() and not mesh.observed[x < 6].any()
    assert mesh.temperature_c[mesh.observed] == pytest.approx(20.0 + x[mesh.observed], abs=0.51)
    assert np.ptp(mesh.temperature_c[x < 4]) < 0.5  # far from what was seen it is level


@pytest.mark.parametrize("mode", MODES)
def test_boundary_is_tagged_with_normal_and_true_area(snapshot_of, mode):
    turn = rotation(6)
    mesh = build_mesh(ball(snapshot_of), DENSE, linear_map(2.0 * turn), MeshOptions(mode)).mesh
    boundary = mesh.boundary
    assert boundary is not None and boundary.seen.all()  # without cameras nothing is known to be hidden
    outwards = mesh.points_m[mesh.facets].mean(axis=1) - 2.0 * turn @ np.full(3, 3.5)
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    assert np.einsum("ij,ij->i", outwards, boundary.normal).min() > 0.9
    true_area = (facet_areas(mesh.points_m, mesh.facets) * boundary.area_factor).sum()
    radius = 5.3 + np.log(2.0) / 3.0  # where density is one half, [voxels]; a voxel is 0.5 * 2 wide
    assert true_area == pytest.approx(4 * np.pi * radius**2, rel=0.03 if mode == "conforming" else 0.05)


def test_colour_is_that_of_corners_with_density(snapshot_of):
    field = ball(snapshot_of)
    density = np.where(field.density > 0.05, field.density, 0.0).astype(np.float32)
    colour = np.where(density[..., None] > 0.0, [0.75, 0.5, 0.25], 0.0).astype(np.float32)
    mesh = build_mesh(replace(field, density=density, colour=colour), DENSE, np.eye(4)).mesh
    assert mesh.colour is not None
    assert np.all(mesh.colour == np.array([0.75, 0.5, 0.25], np.float32))
