"""F-score of the surface against a body that is known exactly."""

from __future__ import annotations

import numpy as np
import pytest

from thermoxels_ns.errors import MeshError
from thermoxels_ns.lattice import Lattice
from thermoxels_ns.mesh.accuracy import boundary_samples, surface_fscore


class Sphere:
    """A sphere with exact signed distance."""

    def __init__(self, centre=(0.0, 0.0, 0.0), radius: float = 0.6) -> None:
        self.centre, self.radius = np.asarray(centre, dtype=float), radius

    def signed_distance(self, points):
        return np.linalg.norm(points - self.centre, axis=-1) - self.radius

    def surface_points(self, n, seed):
        normals = np.random.default_rng(seed).normal(size=(n, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return self.centre + self.radius * normals, normals


LATTICE = Lattice.covering((-1, -1, -1), (1, 1, 1), 24)
H = LATTICE.voxel_size
TOLERANCE = 1.5 * H
SPHERE = Sphere()
SEEN = SPHERE.surface_points(2000, 0)[0]


def voxels(shape: Sphere) -> np.ndarray:
    return shape.signed_distance(LATTICE.cell_centres()) < 0


def test_voxelised_sphere_scores_high():
    score = surface_fscore(voxels(SPHERE), LATTICE, SPHERE, SEEN, TOLERANCE)
    assert score.precision == 1.0
    assert score.recall == 1.0
    assert score.fscore == 1.0
    assert score.mean_distance is not None
    assert 0.0 < score.mean_distance < 0.5 * H


def test_score_falls_as_the_body_is_shifted_away():
    scores = [
        surface_fscore(voxels(Sphere((shift * H, 0, 0))), LATTICE, SPHERE, SEEN, TOLERANCE) for shift in (0, 2, 4, 6)
    ]
    fscores = [s.fscore for s in scores]
    distances = [s.mean_distance for s in scores]
    assert fscores == sorted(fscores, reverse=True)
    assert fscores[-1] < 0.5
    assert distances == sorted(distances)


def test_grown_sphere_has_neither_precision_nor_recall():
    score = surface_fscore(voxels(Sphere(radius=0.6 + 3.5 * H)), LATTICE, SPHERE, SEEN, TOLERANCE)
    assert (score.precision, score.recall, score.fscore) == (0.0, 0.0, 0.0)
    assert score.mean_distance == pytest.approx(3.5 * H, rel=0.1)


def test_nothing_scores_zero():
    score = surface_fscore(np.zeros(LATTICE.cell_shape, dtype=bool), LATTICE, SPHERE, SEEN, TOLERANCE)
    assert (score.precision, score.recall, score.fscore, score.mean_distance) == (0.0, 0.0, 0.0, None)


def test_a_full_box_has_no_precision():
    score = surface_fscore(np.ones(LATTICE.cell_shape, dtype=bool), LATTICE, SPHERE, SEEN, TOLERANCE)
    assert (score.precision, score.fscore, score.mean_distance) == (0.0, 0.0, None)


def test_half_a_sphere_has_half_the_recall():
    cells = voxels(SPHERE)
    cells[:12] = False
    score = surface_fscore(cells, LATTICE, SPHERE, SEEN, TOLERANCE)
    assert score.recall == pytest.approx(0.5 + 0.5 * 1.5 * H / 0.6, abs=0.05)  # a band of the tolerance beyond the cut
    assert score.precision < 0.9  # the cut face is no true surface
    assert score.fscore == pytest.approx(2 * score.precision * score.recall / (score.precision + score.recall))


def test_recall_asks_only_for_what_cameras_see():
    cells = voxels(SPHERE)
    cells[:12] = False
    assert surface_fscore(cells, LATTICE, SPHERE, SEEN[SEEN[:, 0] > 0], TOLERANCE).recall == 1.0


def test_enclosed_cavities_do_not_count():
    hollow = voxels(SPHERE) & ~voxels(Sphere(radius=0.25))
    assert surface_fscore(hollow, LATTICE, SPHERE, SEEN, TOLERANCE).precision == 1.0
    opened = hollow.copy()
    opened[12, 12, :12] = False
    assert surface_fscore(opened, LATTICE, SPHERE, SEEN, TOLERANCE).precision < 1.0


def test_faces_where_the_box_cuts_do_not_count_for_precision():
    shape = Sphere((-1.0, 0.0, 0.0))
    score = surface_fscore(voxels(shape), LATTICE, shape, shape.surface_points(500, 0)[0], TOLERANCE)
    assert score.precision == 1.0


def test_lattice_is_mapped_into_truth_coordinates():
    # Truth in millimetres, turned and shifted; tolerance in truth units.
    matrix = np.array([[0.0, -1000, 0, 5000], [1000, 0, 0, -70], [0, 0, 1000, 9], [0, 0, 0, 1]])
    shape = Sphere((5000.0, -70.0, 9.0), 600.0)
    off_centre = Sphere((0.3, 0.0, 0.0), 0.5)
    seen = shape.surface_points(2000, 0)[0]
    score = surface_fscore(voxels(SPHERE), LATTICE, shape, seen, 1000 * TOLERANCE, matrix)
    assert score.fscore == 1.0
    turned = Sphere((5000.0, 230.0, 9.0), 500.0)  # where +x of the lattice goes
    seen = turned.surface_points(2000, 0)[0]
    assert surface_fscore(voxels(off_centre), LATTICE, turned, seen, 1000 * TOLERANCE, matrix).fscore == 1.0
    with pytest.raises(MeshError, match="world_to_truth"):
        surface_fscore(voxels(SPHERE), LATTICE, shape, seen, TOLERANCE, np.zeros((4, 4)))


def test_samples_of_one_voxel():
    cells = np.zeros((3, 3, 2), dtype=bool)
    cells[1, 1, 1] = True
    points, on_border = boundary_samples(cells)
    assert len(points) == 24
    assert np.all(points[on_border][:, 2] == 2.0)
    assert on_border.sum() == 4
    bottom = points[points[:, 2] == 1.0]
    assert sorted(map(tuple, bottom[:, :2])) == [(1.25, 1.25), (1.25, 1.75), (1.75, 1.25), (1.75, 1.75)]
    assert len(boundary_samples(cells, per_side=3)[0]) == 54


def test_bad_input_is_refused():
    with pytest.raises(MeshError, match="cells: expected shape"):
        surface_fscore(np.ones((2, 2, 2), dtype=bool), LATTICE, SPHERE, SEEN, TOLERANCE)
    with pytest.raises(MeshError, match="true_points_seen: expected at least one point"):
        surface_fscore(voxels(SPHERE), LATTICE, SPHERE, SEEN[:0], TOLERANCE)
    with pytest.raises(MeshError, match="tolerance"):
        surface_fscore(voxels(SPHERE), LATTICE, SPHERE, SEEN, 0.0)
