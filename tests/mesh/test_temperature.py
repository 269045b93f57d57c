import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh import temperature
from thermoxels_ns.mesh.stuffing.isosurface import stuff
from thermoxels_ns.mesh.temperature import extend_harmonically, interpolate_corners
from thermoxels_ns.mesh.voxel_tets import kuhn_tets, lattice_edges


@pytest.mark.parametrize("seed", range(12))
def test_maximum_principle_on_random_bodies(random_cells, seed):
    cells = random_cells(seed)
    edges, weights = lattice_edges(cells)
    num_nodes = len(kuhn_tets(cells)[0])
    random = np.random.default_rng(seed)
    measured = random.normal(20.0, 30.0, num_nodes)
    observed = random.random(num_nodes) < 0.5
    parts = temperature.connected_components(
        temperature.sparse.coo_array((weights, tuple(edges.T)), shape=(num_nodes, num_nodes)), directed=False
    )[1]
    for part in range(parts.max() + 1):  # every body needs a measurement
        observed[np.flatnonzero(parts == part)[0]] = True
    filled = extend_harmonically(edges, np.where(observed, measured, 1e6), observed, weights)
    assert np.array_equal(filled[observed], measured[observed])
    for part in range(parts.max() + 1):
        inside = parts == part
        assert filled[inside].min() >= measured[inside & observed].min()
        assert filled[inside].max() <= measured[inside & observed].max()


def test_a_solver_that_fails_is_reported(monkeypatch):
    monkeypatch.setattr(temperature, "_MOST_ROUNDS", 1)
    chain = np.stack([np.arange(6), np.arange(1, 7)], axis=1)
    with pytest.raises(MeshError, match="harmonic extension of the temperature"):
        extend_harmonically(chain, np.linspace(10.0, 40.0, 7), np.arange(7) % 6 == 0, np.arange(1.0, 7.0))


def test_the_number_of_threads_changes_no_bit():
    edges, weights = lattice_edges(np.ones((40, 40, 40), dtype=bool))
    random = np.random.default_rng(0)
    measured, observed = random.normal(20.0, 5.0, 41**3), random.random(41**3) < 0.02
    found = []
    for threads in (1, 2):
        with threadpool_limits(threads, "blas"):
            found.append(extend_harmonically(edges, measured, observed, weights))
    np.testing.assert_array_equal(found[0], found[1])


def test_linear_temperatures_are_extended_through_tetrahedra_of_any_size():
    """A graded mesh: a uniform edge weight would be off by percents where the size of the tetrahedra changes."""
    level = 9.3 - np.linalg.norm(np.indices((20, 20, 20)).transpose(1, 2, 3, 0) - 9.5, axis=-1)
    solid = stuff(np.clip(level / 1.5, -1.0, 1.0), 4)
    linear = 20.0 + solid.points @ [1.0, -2.0, 0.5]
    edges, conductance = temperature.tet_conductances(solid.points, solid.tets)
    filled = extend_harmonically(edges, np.where(solid.on_surface, linear, 0.0), solid.on_surface, conductance)
    lengths = np.linalg.norm(solid.points[solid.tets[:, 0]] - solid.points[solid.tets[:, 1]], axis=1)
    assert lengths.max() > 1.9  # there are coarse tetrahedra
    worst = np.abs(filled - linear).max() / np.ptp(linear)
    uniform = extend_harmonically(edges, np.where(solid.on_surface, linear, 0.0), solid.on_surface)
    assert worst < 0.01 < 0.03 < np.abs(uniform - linear).max() / np.ptp(linear)


def test_an_edge_with_negative_conductance_does_not_break_the_maximum_principle():
    edges = np.array([[0, 1], [1, 2], [0, 2], [1, 3]])
    known, conductance = np.array([True, False, True, False]), np.array([1.0, 1.0, 1.0, -5.0])
    filled = extend_harmonically(edges, np.array([10.0, 0.0, 30.0, 0.0]), known, conductance)
    assert filled.tolist() == pytest.approx([10.0, 20.0, 30.0, 20.0])


SHAPE = (4, 5, 3)


def test_trilinear_functions_are_exact_where_all_is_known():
    x, y, z = np.indices(SHAPE).astype(float)
    points = np.random.default_rng(0).random((200, 3)) * (np.array(SHAPE) - 1)
    values, weight = interpolate_corners(points, 2 + x - 3 * y + x * y * z, np.ones(SHAPE))
    px, py, pz = points.T
    assert values == pytest.approx(2 + px - 3 * py + px * py * pz, abs=1e-12)
    assert weight == pytest.approx(np.ones(len(points)))


def test_corners_that_know_nothing_have_no_influence():
    values = np.full(SHAPE, 1e6)
    weights = np.zeros(SHAPE)
    values[1, 1, 1], weights[1, 1, 1] = 20.0, 3.0
    values[1, 1, 2], weights[1, 1, 2] = 24.0, 1.0
    found, weight = interpolate_corners(np.array([[1.0, 1.0, 1.5], [0.5, 1.0, 1.0], [3.0, 4.0, 0.0]]), values, weights)
    assert found.tolist() == [21.0, 20.0, 0.0]
    assert weight.tolist() == [2.0, 1.5, 0.0]
