"""From a snapshot to a mesh in metres."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermoxels_ns.errors import MeshError
from thermoxels_ns.mesh.build import build_voxel_mesh, check_similarity
from thermoxels_ns.mesh.quality import check_mesh
from thermoxels_ns.mesh.solid import SolidSelection
from thermoxels_ns.mesh.tetrahedra import FACET_BOX

DENSE = SolidSelection(close_gaps=0, density_threshold=0.5)


def rotation(seed: int) -> np.ndarray:
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


def similarity(scale: float, linear: np.ndarray, shift=(0.0, 0.0, 0.0)) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = scale * linear
    matrix[:3, 3] = shift
    return matrix


def carved(snapshot_of):
    density = np.ones((6, 5, 4))
    density[:3, :3, 2:] = 0.0
    return snapshot_of(density, lo=(-1.0, 2.0, 0.5), voxel_size=0.25)


@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_rotated_scaled_and_mirrored_meshes_stay_valid(snapshot_of, seed, mirror):
    linear = rotation(seed) @ (np.diag([1.0, 1.0, -1.0]) if mirror else np.eye(3))
    mesh, solid = build_voxel_mesh(carved(snapshot_of), DENSE, similarity(3.0, linear, (5.0, -7.0, 1.0)))
    quality = check_mesh(mesh)  # positive volumes, facets outwards
    assert quality.volume_m3 == pytest.approx(solid.cells.sum() * (0.25 * 3.0) ** 3, rel=1e-12)
    assert quality.min_tet_volume_m3 == pytest.approx((0.25 * 3.0) ** 3 / 6, rel=1e-9)


def test_points_are_transformed_lattice_corners(snapshot_of):
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # a quarter turn about z
    snapshot = snapshot_of(np.ones((2, 2, 2)), lo=(1.0, 2.0, 3.0), voxel_size=0.5)
    mesh, _ = build_voxel_mesh(snapshot, DENSE, similarity(2.0, turn, (10.0, 20.0, 30.0)))
    # Corner (0, 0, 0) at (1, 2, 3): turned (-2, 1, 3), doubled (-4, 2, 6), shifted (6, 22, 36).
    assert mesh.points_m[0].tolist() == [6.0, 22.0, 36.0]
    # Corner (1, 0, 0) is node 4 and lies one metre further along y.
    assert mesh.points_m[4].tolist() == [6.0, 23.0, 36.0]
    assert mesh.points_m.dtype == np.float64


def test_temperature_and_observed_follow_the_corners(snapshot_of):
    shape = (4, 3, 3)
    values = np.arange(np.prod(shape), dtype=float).reshape(shape)
    weight = np.ones(shape)
    weight[1, 1, 1] = 0.0
    density = np.ones(shape)
    density[3] = 0.0
    mesh, solid = build_voxel_mesh(
        snapshot_of(density, values, weight), SolidSelection(close_gaps=0, density_threshold=0.9), np.eye(4)
    )
    assert solid.cells[:, 0, 0].tolist() == [True, True, False]
    index = np.rint(mesh.points_m / 0.5).astype(int)
    assert np.array_equal(mesh.observed, ~np.all(index == 1, axis=1))
    assert np.allclose(mesh.temperature_c, values[tuple(index.T)], atol=1e-9)  # linear: the unseen corner too


def test_corners_with_less_than_the_least_weight_are_extended(snapshot_of):
    weight = np.full((3, 3, 3), 5.0)
    weight[1, 1, 1] = 0.004
    values = np.full((3, 3, 3), 20.0)
    values[1, 1, 1] = 900.0
    snapshot = snapshot_of(np.ones((3, 3, 3)), values, weight)
    mesh, _ = build_voxel_mesh(snapshot, DENSE, np.eye(4))
    assert (mesh.observed.sum(), mesh.temperature_c.max()) == (26, 20.0)
    mesh, _ = build_voxel_mesh(snapshot, DENSE, np.eye(4), min_observed_weight=0.0)
    assert (mesh.observed.sum(), mesh.temperature_c.max()) == (27, 900.0)


def test_extension_conducts_like_the_voxels_do(snapshot_of):
    # A bar seen at both ends only, with a step in its width: heat flows through the voxels, four times as many in the
    # wide half, so the wide half takes a fifth of the temperature difference, plus what the constriction itself takes.
    density = np.zeros((42, 4, 4))
    density[:, :2, :2] = 1.0
    density[21:, :3, :3] = 1.0
    weight = np.zeros(density.shape)
    weight[[0, -1]] = 1.0
    values = np.zeros(density.shape)
    values[-1] = 100.0
    mesh, solid = build_voxel_mesh(
        snapshot_of(density, values, weight), SolidSelection(close_gaps=0, density_threshold=1.0), np.eye(4)
    )
    per_layer = solid.cells.sum(axis=(1, 2))
    assert (per_layer[0], per_layer[-1]) == (1, 4)
    x = mesh.points_m[:, 0] / 0.5
    thin = mesh.temperature_c[x == 10].mean() - mesh.temperature_c[x == 5].mean()
    wide = mesh.temperature_c[x == 37].mean() - mesh.temperature_c[x == 32].mean()
    assert thin == pytest.approx(4 * wide, rel=1e-6)


def test_weight_zero_is_never_a_measurement(snapshot_of):
    weight = np.ones((3, 3, 3))
    weight[1, 1, 1] = 0.0
    mesh, _ = build_voxel_mesh(snapshot_of(np.ones((3, 3, 3)), 20.0, weight), DENSE, np.eye(4), min_observed_weight=0.0)
    assert mesh.observed.sum() == 26


def test_body_no_thermal_ray_saw_is_refused(snapshot_of):
    with pytest.raises(MeshError, match="at least one node seen by a thermal ray"):
        build_voxel_mesh(snapshot_of(np.ones((3, 3, 3)), 20.0, 0.0), DENSE, np.eye(4))


def test_part_no_thermal_ray_saw_is_left_out(snapshot_of):
    # Three bodies: one seen, one that touches it by a corner only, and one apart that nobody saw.
    cells = np.zeros((7, 4, 4), bool)
    cells[:2, :2, :2] = cells[2, 2, 2] = cells[4:6, :1, :3] = True
    weight = np.zeros((8, 5, 5))
    weight[0] = 1.0
    field = replace(snapshot_of(np.ones(weight.shape), 20.0, weight), voxel_density=cells.astype(np.float32))
    every = SolidSelection(close_gaps=0, density_threshold=0.5, largest_component=False)
    mesh, solid = build_voxel_mesh(field, every, np.eye(4))
    assert (solid.num_unobserved_parts, solid.num_unobserved_voxels) == (1, 6)
    expected = cells.copy()
    expected[4:] = False
    assert np.array_equal(solid.cells, expected) and len(mesh.tets) == 6 * 9
    assert check_mesh(mesh).volume_m3 == pytest.approx(9 * 0.5**3)
    mesh, solid = build_voxel_mesh(replace(field, observed_weight=np.ones((8, 5, 5), np.float32)), every, np.eye(4))
    assert (solid.num_unobserved_parts, solid.num_unobserved_voxels, len(mesh.tets)) == (0, 0, 6 * 15)


def test_solid_that_touches_the_border_is_tagged(snapshot_of):
    mesh, _ = build_voxel_mesh(carved(snapshot_of), DENSE, similarity(1.0, rotation(4)))
    quality = check_mesh(mesh)
    assert 0 < quality.num_box_facets < quality.num_facets
    assert np.count_nonzero(mesh.facet_tags == FACET_BOX) == quality.num_box_facets


@pytest.mark.parametrize(
    "bad",
    [
        np.diag([1.0, 1.0, 2.0, 1.0]),
        np.zeros((4, 4)),
        np.diag([1.0, 1.0, 1.0, 2.0]),
        np.full((4, 4), np.nan),
        np.eye(3),
        np.array([[1.0, 0.2, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]),
    ],
)
def test_what_is_no_similarity_is_refused(bad):
    with pytest.raises(MeshError, match="world_to_metres"):
        check_similarity("world_to_metres", bad)


def test_negative_least_weight_is_refused(snapshot_of):
    with pytest.raises(MeshError, match="min_observed_weight"):
        build_voxel_mesh(snapshot_of(np.ones((2, 2, 2))), DENSE, np.eye(4), min_observed_weight=-1.0)
