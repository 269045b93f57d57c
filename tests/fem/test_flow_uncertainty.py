"""Parts of the bounds of round-off; what they are worth is in tests/stability/test_no_answer_lies.py."""

import numpy as np
import pytest
from scipy import sparse

from tests.support.heat_meshes import box_mesh
from thermoxels_ns.fem.flow_uncertainty import _matrix_energy, _relax, _tets_energy
from thermoxels_ns.fem.problem import HeatProblem, TimeSteps
from thermoxels_ns.fem.system import HeatSystem
from thermoxels_ns.fem.time_loop import solve_heat
from thermoxels_ns.heat.effects import Convection
from thermoxels_ns.heat.materials import Material

EPS = float(np.finfo(np.float64).eps)


def chain(conductances) -> sparse.csr_matrix:
    """Nodes in a row with thermal conductances between them, [W / K]."""
    count = len(conductances) + 1
    matrix = np.zeros((count, count))
    for n, each in enumerate(conductances):
        matrix[n : n + 2, n : n + 2] += each * np.array([[1.0, -1.0], [-1.0, 1.0]])
    return sparse.csr_matrix(matrix)


def test_energy_of_a_matrix_and_the_round_off_of_its_entries():
    rng = np.random.default_rng(0)
    half = rng.uniform(0.1, 1.0, (6, 6))
    dense = -(half + half.T)
    np.fill_diagonal(dense, 0.0)
    np.fill_diagonal(dense, -dense.sum(1))
    matrix, values = sparse.csr_matrix(dense), rng.normal(0.0, 10.0, 6)
    root = np.sqrt(dense.diagonal())
    wrong, energy = _matrix_energy(matrix.indptr, matrix.indices, matrix.data, root, values)
    assert energy == pytest.approx(values @ dense @ values)
    apart = (values[:, None] - values) ** 2
    assert wrong == pytest.approx(0.5 * EPS * (root[:, None] * root * apart).sum())


def test_resistances_along_a_chain_add_up():
    conductances = [2.0, 0.5, 4.0, 1.0]
    resistance = np.full(5, np.inf)
    resistance[0] = 0.1  # to the surroundings
    matrix = chain(conductances)
    _relax(matrix.indptr, matrix.indices, matrix.data, resistance)
    np.testing.assert_allclose(resistance, 0.1 + np.concatenate(([0.0], np.cumsum(1.0 / np.array(conductances)))))


def test_energy_of_tetrahedra_is_that_of_their_matrix():
    side = np.linspace(0.0, 1.0, 4)
    mesh = box_mesh(side, 2.0 * side, 0.3 * side)
    system = HeatSystem(HeatProblem(mesh, Material("concrete", 1.7, 2200.0, 880.0)))
    values = np.random.default_rng(0).normal(0.0, 10.0, len(mesh.points_m))
    conductivity = np.full(len(mesh.tets), 1.7)
    wrong, energy, thin = _tets_energy(np.ascontiguousarray(mesh.points_m), mesh.tets, conductivity, values)
    assert energy == pytest.approx(values @ system.stiffness @ values)
    assert EPS < wrong / energy < 1e3 * EPS
    assert EPS <= thin < 100.0 * EPS


@pytest.mark.parametrize("coefficient", [1e-3, 10.0, 1e9])
def test_heat_leaves_through_the_surface_and_the_cells_there_one_behind_the_other(coefficient):
    side = np.linspace(0.0, 1.0, 4)
    effects = (Convection(("x0",), coefficient, 20.0),)
    system = HeatSystem(HeatProblem(box_mesh(side, side, side), Material("m", 2.0, 1e3, 1e3), effects=effects))
    nodes = np.zeros(system.num_nodes)
    both, alone = (system.surface_w_k(nodes, 0.0, inside=inside) for inside in (True, False))
    assert alone == pytest.approx(coefficient)  # 1 m2
    (held,) = np.nonzero(system.held_w_k(0.0, np.inf))
    through, behind = system.held_w_k(0.0, np.inf)[held], system.stiffness.diagonal()[held]
    assert both == pytest.approx(float(np.sum(1.0 / (1.0 / through + 1.0 / behind))))


def test_what_is_uncertain_grows_from_output_to_output():
    side = np.linspace(0.0, 1.0, 4)
    air = (Convection(("x0",), 8.0, 20.0), Convection(("x1",), 25.0, -10.0))
    body = HeatProblem(box_mesh(side, side, side), Material("concrete", 1.7, 2200.0, 880.0), effects=air)
    solution = solve_heat(body, TimeSteps(4, 21600.0))
    for effect in solution.effects:
        uncertain_j = effect.uncertainty_w * np.diff(solution.times_s)
        assert np.all(np.diff(uncertain_j) > 0.0)
