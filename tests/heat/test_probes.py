import numpy as np
import pytest

from tests.support.heat_meshes import box_mesh, mesh_from, planes
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.heat.run import place_probes


def linear(points: np.ndarray) -> np.ndarray:
    return 3.0 + points @ np.array([2.0, -5.0, 0.5])


@pytest.fixture(scope="module")
def box():
    return box_mesh(planes(0.0, 1.0, step=0.25), planes(0.0, 0.5, step=0.25), [-1.0, 0.0], temperature_c=linear)


def test_a_linear_field_is_interpolated_exactly_everywhere(box) -> None:
    """Also at nodes, on edges, faces and the surface."""
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform([0, 0, -1], [1, 0.5, 0], (200, 3)), box.points_m, [[0.125, 0.0, -0.3]]])
    probes = place_probes(box, points)
    np.testing.assert_allclose(probes.at(box.temperature_c), linear(points), atol=1e-12)
    states = np.stack([box.temperature_c, 2.0 * box.temperature_c])
    np.testing.assert_allclose(probes.at(states), [linear(points), 2.0 * linear(points)], atol=1e-12)
    assert np.all(probes.weights >= 0.0) and np.allclose(probes.weights.sum(axis=1), 1.0, rtol=1e-14)


@pytest.mark.parametrize("point", [(1.001, 0.2, -0.5), (0.5, 0.5 + 1e-6, -0.5), (7.0, 8.0, 9.0)])
def test_a_point_outside_is_refused_with_the_nearest_node(box, point) -> None:
    with pytest.raises(HeatError, match="probe 2: "):
        place_probes(box, [(0.5, 0.25, -0.5), point])


@pytest.mark.parametrize("points", [(0.5, 0.25, -0.5), [[0.1, 0.2]], [[np.nan, 0.0, 0.0]]])
def test_probes_are_rows_of_three_finite_numbers(box, points) -> None:
    with pytest.raises(HeatError, match="probes: expected"):
        place_probes(box, points)


def test_a_point_just_beyond_a_slanted_face_is_outside() -> None:
    """It lies within the box around the tetrahedron."""
    corner = np.vstack([np.zeros(3), np.eye(3)])
    tet = mesh_from(corner, np.array([[0, 1, 2, 3]]), lambda p: np.arange(4.0))
    on_it = np.full(3, 1.0 / 3.0)
    assert place_probes(tet, [on_it]).at(tet.temperature_c)[0] == pytest.approx(2.0)
    with pytest.raises(HeatError, match="probe 1: expected a point inside"):
        place_probes(tet, [on_it + 1e-5])
