"""Parts of the bounds of round-off; what they are worth is in tests/stability/test_no_answer_lies.py."""

import numpy as np
import pytest
from scipy import sparse

from thermoxels_ns.fem.flow_uncertainty import _matrix_energy, _relax

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
