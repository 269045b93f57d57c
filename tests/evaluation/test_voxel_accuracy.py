from dataclasses import replace

import numpy as np
import pytest

from tests.support.looking_cameras import looking_at
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import Views
from thermoxels_ns.evaluation.truth_comparison import KnownTruth, SurfaceScore, mesh_errors
from thermoxels_ns.mesh.tetrahedra import FACET_BOX, TetMesh
from thermoxels_ns.synthetic.drawn_scenes import make_scene
from thermoxels_ns.synthetic.scene_truth import Body
from thermoxels_ns.synthetic.solids import BoxSolid, Solid, Sphere

LATTICE = Lattice.covering((-1, -1, -1), (1, 1, 1), 24)
H = LATTICE.voxel_size
SPHERE = Sphere((0.0, 0.0, 0.0), 0.6)
SEEN = SPHERE.surface_points(2000, 0)[0]


def known(solid: Solid, seen: np.ndarray, views: Views, surroundings: Solid | None = None) -> KnownTruth:
    """A body of which cameras of one lens see the points `seen`, 10 C warm at x = 0 and 4 K/m warmer along x."""
    ball = make_scene("sphere")
    around = None if surroundings is None else Body(surroundings, ball.colour, ball.surface_temperature_c)
    scene = replace(ball, solid=solid, around=around, surface_temperature_c=lambda points: 10.0 + 4.0 * points[:, 0])
    poses = np.concatenate((views.camera_to_world, np.tile([0.0, 0.0, 0.0, 1.0], (len(views.size), 1, 1))), axis=1)
    truth = KnownTruth(scene, poses, Camera(*views.size[0].tolist(), *views.focal[0], *views.centre[0]))
    vars(truth)["points_seen"] = seen
    return truth


def score_of(cells, truth=SPHERE, seen=SEEN, views=None, surroundings=None):
    views = from_above() if views is None else views
    return known(truth, seen, views, surroundings).score(cells, LATTICE, np.eye(4), 1.5 * H)


def voxels(shape: Sphere) -> np.ndarray:
    return shape.signed_distance(LATTICE.cell_centres()) < 0


def test_grown_sphere_has_neither_precision_nor_recall():
    score = score_of(voxels(Sphere((0, 0, 0), 0.6 + 3.5 * H)))[0]
    assert (score.precision, score.recall, score.fscore) == (0.0, 0.0, 0.0)
    assert score.mean_distance == pytest.approx(3.5 * H, rel=0.1)


def test_half_a_sphere_has_half_the_recall():
    cells = voxels(SPHERE)
    cells[:12] = False
    score = score_of(cells)[0]
    assert score.recall == pytest.approx(0.5 + 0.5 * 1.5 * H / 0.6, abs=0.05)  # a band of the tolerance beyond the cut
    assert score.precision < 0.9  # the cut face is no true surface
    assert score.fscore == pytest.approx(2 * score.precision * score.recall / (score.precision + score.recall))


def test_enclosed_cavities_and_faces_where_the_box_cuts_do_not_count_for_precision():
    hollow = voxels(SPHERE) & ~voxels(Sphere((0, 0, 0), 0.25))
    assert score_of(hollow)[0].precision == 1.0
    hollow[12, 12, :12] = False
    assert score_of(hollow)[0].precision < 1.0
    cut = Sphere((-1.0, 0.0, 0.0), 0.6)
    assert score_of(voxels(cut), cut, cut.surface_points(500, 0)[0])[0].precision == 1.0


def test_what_truly_stands_beside_the_body_counts_neither_way_but_lumps_between_do():
    wall = Sphere((0.0, 0.0, 5.72), 5.0)  # from z = 0.72 on, 0.12 above the ball
    both = voxels(SPHERE) | voxels(wall)
    assert score_of(both)[0].precision < 0.9
    score = score_of(both, surroundings=wall)[0]
    alone = score_of(voxels(SPHERE), surroundings=wall)[0]
    assert score.precision == alone.precision == 1.0 and score.recall >= 0.95
    both[2:6, 2:6, 2:6] = True
    assert score_of(both, surroundings=wall)[0].precision < 0.95
    nothing_else = score_of(voxels(wall), surroundings=wall)[0]
    assert nothing_else.fscore == 0.0


def from_above() -> Views:
    eyes = [(1.2 * np.cos(turn), 1.2 * np.sin(turn), 6.0) for turn in np.arange(5) * 2 * np.pi / 5]
    return looking_at((0.0, 0.0, 0.0), eyes, focal=200.0)


def test_a_wrong_guess_behind_the_body_costs_only_the_score_of_all():
    cells = voxels(SPHERE)
    shadow = cells.copy()
    shadow[8:16, 8:16, 1:12] = True  # below the ball, where no camera above can look
    upper = SEEN[SEEN[:, 2] > 0.15]
    (right, right_seen), (guessed, guessed_seen) = (score_of(one, seen=upper) for one in (cells, shadow))
    assert right.precision == 1.0 and guessed.precision < 0.85
    assert right_seen.precision == guessed_seen.precision == 1.0
    assert guessed_seen.fscore == right_seen.fscore == 1.0
    assert guessed_seen.share < right_seen.share < 0.75


def test_a_true_surface_reached_only_by_hidden_boundary_is_not_recalled():
    # A roof over the whole ball: cameras see the roof, and none of the ball below it.
    cells = voxels(SPHERE)
    cells[:, :, 21:23] = True
    score, of_seen = score_of(cells, seen=SEEN[SEEN[:, 2] > 0.15])
    assert score.recall == 1.0
    assert (of_seen.precision, of_seen.recall, of_seen.fscore) == (0.0, 0.0, 0.0)
    assert of_seen.share > 0.0


def test_fewer_than_three_cameras_see_nothing_of_any_boundary():
    few = looking_at((0.0, 0.0, 0.0), [(0.0, 0.0, 6.0), (0.1, 0.0, 6.0)])
    for cells in (voxels(SPHERE), np.zeros(LATTICE.cell_shape, bool), np.ones(LATTICE.cell_shape, bool)):
        assert score_of(cells, views=few)[1] == SurfaceScore()


GROUND = BoxSolid([((-9.0, -9.0, -9.0), (9.0, 9.0, 0.2))])


def slab(mesh_of_cells) -> TetMesh:
    """A slab of 4 x 4 x 1 voxels of 0.25 m; only its top counts as surface; temperature 10 + 4 x."""
    mesh = mesh_of_cells(np.ones((4, 4, 1), dtype=bool), 0.25)
    top = np.all(mesh.points_m[mesh.facets][:, :, 2] == 0.25, axis=1)
    return replace(
        mesh, temperature_c=10.0 + 4.0 * mesh.points_m[:, 0], facet_tags=np.where(top, mesh.facet_tags * 0, FACET_BOX)
    )


def test_parallel_planes_are_their_distance_apart_and_temperatures_those_of_the_closest_point(mesh_of_cells):
    points = np.column_stack((np.random.default_rng(0).random((500, 2)), np.full(500, 0.2)))
    found = [mesh_errors(known(GROUND, points, from_above()), slab(mesh_of_cells), t) for t in (0.0501, 0.0499)]
    assert found[0]["chamfer_m"] == pytest.approx(0.05, abs=1e-12)
    assert found[0]["temperature_seen_mae_c"] == pytest.approx(0.0, abs=1e-6)
    assert [one["share_of_seen_reached"] for one in found] == [1.0, 0.0]


def test_a_mesh_that_is_all_cut_by_the_box_has_no_surface(mesh_of_cells):
    mesh = mesh_of_cells(np.ones((2, 2, 2), dtype=bool), 0.5)
    assert np.all(mesh.facet_tags == FACET_BOX)
    found = mesh_errors(known(GROUND, np.zeros((1, 3)), from_above()), mesh, 0.1)
    assert set(found) == {"mesh_volume_m3", "mesh_area_m2"}
