from dataclasses import replace

import numpy as np
import pytest

from thermoxels_ns.evaluation.truth_comparison import sample_facets, surface_distances
from thermoxels_ns.mesh.tetrahedra import FACET_BOX, TetMesh


class Plane:
    def __init__(self, height: float):
        self.height = height

    def signed_distance(self, points):
        return points[:, 2] - self.height

    def surface_points(self, n, seed):
        xy = np.random.default_rng(seed).random((n, 2))
        return np.column_stack([xy, np.full(n, self.height)]), np.tile([0.0, 0.0, 1.0], (n, 1))


def slab(mesh_of_cells, height_tag: bool = True) -> TetMesh:
    """A slab of 4 x 4 x 1 voxels of 0.25 m; only its top counts as surface; temperature 10 + 4 x."""
    mesh = mesh_of_cells(np.ones((4, 4, 1), dtype=bool), 0.25)
    top = np.all(mesh.points_m[mesh.facets][:, :, 2] == 0.25, axis=1)
    tags = np.where(top, mesh.facet_tags * 0, FACET_BOX) if height_tag else mesh.facet_tags
    return replace(mesh, temperature_c=10.0 + 4.0 * mesh.points_m[:, 0], facet_tags=tags)


def test_parallel_planes_are_their_distance_apart(mesh_of_cells):
    truth = Plane(0.20)
    found = surface_distances(slab(mesh_of_cells), truth, truth.surface_points(500, 0)[0])
    assert found is not None
    distances = (found.mesh_to_truth, found.truth_to_mesh, found.chamfer, found.hausdorff)
    assert distances == pytest.approx((0.05,) * 4, abs=1e-12)


def test_temperatures_are_those_of_the_closest_point(mesh_of_cells):
    truth = Plane(0.30)
    points = truth.surface_points(500, 1)[0]
    found = surface_distances(slab(mesh_of_cells), truth, points)
    assert found is not None
    assert found.closest_temperature_c == pytest.approx(10.0 + 4.0 * points[:, 0], abs=1e-6)


def test_a_mesh_that_is_all_cut_by_the_box_has_no_surface(mesh_of_cells):
    mesh = mesh_of_cells(np.ones((2, 2, 2), dtype=bool), 0.5)
    assert np.all(mesh.facet_tags == FACET_BOX)
    assert surface_distances(mesh, Plane(0.5), np.zeros((1, 3))) is None


def test_samples_are_spread_by_area_and_lie_on_the_triangles(mesh_of_cells):
    mesh = mesh_of_cells(np.ones((3, 1, 1), dtype=bool), 1.0)
    samples = sample_facets(mesh.points_m, mesh.facets, 14_000)
    at_end = np.abs(samples[:, 0]) < 1e-12
    assert np.mean(at_end) == pytest.approx(1 / 14, rel=0.01)
    on_some_face = np.isclose(samples, [0, 0, 0], atol=1e-12) | np.isclose(samples, [3, 1, 1], atol=1e-12)
    assert on_some_face.any(axis=1).all()
