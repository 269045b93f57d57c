"""Parts of matrices are those that scipy takes."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from thermoxels_ns.fem.matrix_parts import block_of, with_more_on_diagonal


def some_matrix(size: int = 30) -> sparse.csr_matrix:
    random = np.random.default_rng(1)
    half = np.where(random.random((size, size)) < 0.15, random.normal(size=(size, size)), 0.0)
    return sparse.csr_matrix(half + half.T + np.eye(size))


def test_blocks_are_those_of_dense_matrices() -> None:
    matrix = some_matrix()
    for kept in (np.arange(30), np.array([0, 3, 4, 17, 29]), np.array([7]), np.zeros(0, np.int64)):
        block = block_of(matrix, kept)
        np.testing.assert_array_equal(block.toarray(), matrix.toarray()[np.ix_(kept, kept)])
        assert block.has_canonical_format and block.indices.dtype == matrix.indices.dtype


def test_more_on_the_diagonal_leaves_the_matrix_as_it_was() -> None:
    matrix, more = some_matrix(), np.linspace(1.0, 2.0, 30)
    before = matrix.toarray()
    np.testing.assert_array_equal(with_more_on_diagonal(matrix, more).toarray(), before + np.diag(more))
    np.testing.assert_array_equal(matrix.toarray(), before)


def test_a_diagonal_may_lack_entries() -> None:
    matrix = sparse.csr_matrix([[1.0, 2.0, 0.0], [2.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    expected = [[2.0, 2.0, 0.0], [2.0, 3.0, 0.0], [0.0, 0.0, 5.0]]
    assert with_more_on_diagonal(matrix, np.array([1.0, 3.0, 5.0])).toarray().tolist() == expected
