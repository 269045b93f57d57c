import numpy as np
import pytest

from tests.support.looking_cameras import looking_at
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import Views
from thermoxels_ns.evaluation.voxel_accuracy import SeenScore, surface_fscore
from thermoxels_ns.synthetic.solids import Sphere

LATTICE = Lattice.covering((-1, -1, -1), (1, 1, 1), 24)
H = LATTICE.voxel_size
TOLERANCE = 1.5 * H
SPHERE = Sphere((0.0, 0.0, 0.0), 0.6)
SEEN = SPHERE.surface_points(2000, 0)[0]


def voxels(shape: Sphere) -> np.ndarray:
    return shape.signed_distance(LATTICE.cell_centres()) < 0


def test_voxelised_sphere_scores_high():
    score = surface_fscore(voxels(SPHERE), LATTICE, SPHERE, SEEN, TOLERANCE)
    assert (score.precision, score.recall, score.fscore) == (1.0, 1.0, 1.0)
    assert score.mean_distance is not None
    assert 0.0 < score.mean_distance < 0.5 * H


def test_score_falls_as_the_body_is_shifted_away():
    scores = [
        surface_fscore(voxels(Sphere((shift * H, 0, 0), 0.6)), LATTICE, SPHERE, SEEN, TOLERANCE)
        for shift in (0, 2, 4, 6)
    ]
    fscores = [s.fscore for s in scores]
    distances = [s.mean_distance for s in scores]
    assert fscores == sorted(fscores, reverse=True)
    assert fscores[-1] < 0.5
    assert distances == sorted(distances)


def test_grown_sphere_has_neither_precision_nor_recall():
    score = surface_fscore(voxels(Sphere((0, 0, 0), 0.6 + 3.5 * H)), LATTICE, SPHERE, SEEN, TOLERANCE)
    assert (score.precision, score.recall, score.fscore) == (0.0, 0.0, 0.0)
    assert score.mean_distance == pytest.approx(3.5 * H, rel=0.1)


def test_half_a_sphere_has_half_the_recall():
    cells = voxels(SPHERE)
    cells[:12] = False
    score = surface_fscore(cells, LATTICE, SPHERE, SEEN, TOLERANCE)
    assert score.recall == pytest.approx(0.5 + 0.5 * 1.5 * H / 0.6, abs=0.05)  # a band of the tolerance beyond the cut
    assert score.precision < 0.9  # the cut face is no true surface
    assert score.fscore == pytest.approx(2 * score.precision * score.recall / (score.precision + score.recall))


def test_enclosed_cavities_do_not_count():
    hollow = voxels(SPHERE) & ~voxels(Sphere((0, 0, 0), 0.25))
    assert surface_fscore(hollow, LATTICE, SPHERE, SEEN, TOLERANCE).precision == 1.0
    opened = hollow.copy()
    opened[12, 12, :12] = False
    assert surface_fscore(opened, LATTICE, SPHERE, SEEN, TOLERANCE).precision < 1.0


def test_faces_where_the_box_cuts_do_not_count_for_precision():
    shape = Sphere((-1.0, 0.0, 0.0), 0.6)
    score = surface_fscore(voxels(shape), LATTICE, shape, shape.surface_points(500, 0)[0], TOLERANCE)
    assert score.precision == 1.0


def test_what_truly_stands_beside_the_body_counts_neither_way_but_lumps_between_do():
    wall = Sphere((0.0, 0.0, 5.72), 5.0)  # from z = 0.72 on, 0.12 above the ball
    both = voxels(SPHERE) | voxels(wall)
    assert surface_fscore(both, LATTICE, SPHERE, SEEN, TOLERANCE).precision < 0.9
    score = surface_fscore(both, LATTICE, SPHERE, SEEN, TOLERANCE, surroundings=wall)
    alone = surface_fscore(voxels(SPHERE), LATTICE, SPHERE, SEEN, TOLERANCE, surroundings=wall)
    assert score.precision == alone.precision == 1.0 and score.recall >= 0.95
    both[2:6, 2:6, 2:6] = True
    assert surface_fscore(both, LATTICE, SPHERE, SEEN, TOLERANCE, surroundings=wall).precision < 0.95
    nothing_else = surface_fscore(voxels(wall), LATTICE, SPHERE, SEEN, TOLERANCE, surroundings=wall)
    assert nothing_else.fscore == 0.0


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


def from_above() -> Views:
    eyes = [(1.2 * np.cos(turn), 1.2 * np.sin(turn), 6.0) for turn in np.arange(5) * 2 * np.pi / 5]
    return looking_at((0.0, 0.0, 0.0), eyes, focal=200.0)


def test_a_wrong_guess_behind_the_body_costs_only_the_score_of_all():
    cells = voxels(SPHERE)
    shadow = cells.copy()
    shadow[8:16, 8:16, 1:12] = True  # below the ball, where no camera above can look
    upper = SEEN[SEEN[:, 2] > 0.15]
    right = surface_fscore(cells, LATTICE, SPHERE, upper, TOLERANCE, views=from_above())
    guessed = surface_fscore(shadow, LATTICE, SPHERE, upper, TOLERANCE, views=from_above())
    assert right.precision == 1.0 and guessed.precision < 0.85
    assert right.seen is not None and guessed.seen is not None
    assert right.seen.precision == guessed.seen.precision == 1.0
    assert guessed.seen.fscore == right.seen.fscore == 1.0
    assert guessed.seen.share < right.seen.share < 0.75


def test_an_error_that_cameras_see_weighs_more_among_what_they_see():
    cells = voxels(SPHERE)
    cells[10:14, 10:14, 22] = True  # a plate before the cameras
    score = surface_fscore(cells, LATTICE, SPHERE, SEEN[SEEN[:, 2] > 0.15], TOLERANCE, views=from_above())
    assert score.seen is not None
    assert score.seen.precision < score.precision < 1.0
    plate, hidden = 16, 4 * 4  # its upper faces; its lower ones and a part of the ball are behind it
    assert 1.0 - score.seen.precision > plate / (np.count_nonzero(cells.any(axis=2)) * 2 + plate + hidden)


def test_only_faces_before_which_cameras_see_space_are_seen():
    plate = np.zeros(LATTICE.cell_shape, dtype=bool)
    plate[8:16, 8:16, 12] = True
    score = surface_fscore(plate, LATTICE, SPHERE, SEEN, TOLERANCE, views=from_above())
    assert score.seen is not None
    assert score.seen.share == (64 + 32) / (64 + 64 + 32)  # top and rim, not the underside


def test_a_true_surface_reached_only_by_hidden_boundary_is_not_recalled():
    # A roof over the whole ball: cameras see the roof, and none of the ball below it.
    cells = voxels(SPHERE)
    cells[:, :, 21:23] = True
    score = surface_fscore(cells, LATTICE, SPHERE, SEEN[SEEN[:, 2] > 0.15], TOLERANCE, views=from_above())
    assert score.recall == 1.0
    assert score.seen is not None
    assert (score.seen.precision, score.seen.recall, score.seen.fscore) == (0.0, 0.0, 0.0)
    assert score.seen.share > 0.0


def test_without_cameras_nothing_is_said_about_what_they_see():
    assert surface_fscore(voxels(SPHERE), LATTICE, SPHERE, SEEN, TOLERANCE).seen is None
    few = looking_at((0.0, 0.0, 0.0), [(0.0, 0.0, 6.0), (0.1, 0.0, 6.0)])  # fewer than three
    score = surface_fscore(voxels(SPHERE), LATTICE, SPHERE, SEEN, TOLERANCE, views=few)
    assert score.fscore == 1.0
    assert score.seen == SeenScore(precision=0.0, recall=0.0, fscore=0.0, share=0.0)
    for cells in (np.zeros(LATTICE.cell_shape, bool), np.ones(LATTICE.cell_shape, bool)):
        assert surface_fscore(cells, LATTICE, SPHERE, SEEN, TOLERANCE, views=few).seen == score.seen
