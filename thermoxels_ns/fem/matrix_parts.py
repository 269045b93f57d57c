"""Parts of sparse matrices, changes of their diagonal and products of rows, in one pass."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import sparse

from thermoxels_ns.core.kernel_cache import kernel


def with_more_on_diagonal(matrix: sparse.csr_matrix, more: npt.NDArray[np.float64]) -> sparse.csr_matrix:
    """Add to the diagonal of a matrix.

    Args:
        matrix: Shape (n, n).
        more: What is added, shape (n,).

    >>> with_more_on_diagonal(sparse.csr_matrix([[2.0, -1.0], [-1.0, 2.0]]), np.array([1.0, 3.0])).toarray().tolist()
    [[3.0, -1.0], [-1.0, 5.0]]
    """
    data = matrix.data.copy()
    if _add_to_diagonal(matrix.indptr, matrix.indices, more, data):
        return sparse.csr_matrix((data, matrix.indices, matrix.indptr), shape=matrix.shape)
    return sparse.csr_matrix(matrix + sparse.diags(more, format="csr"))


def block_of(matrix: sparse.csr_matrix, kept: npt.NDArray[np.int64]) -> sparse.csr_matrix:
    """Take some rows and the same columns of a matrix.

    Args:
        matrix: Shape (n, n).
        kept: Their numbers, ascending, shape (k,).

    >>> block_of(sparse.csr_matrix([[2.0, -1.0, 5.0], [-1.0, 2.0, 0.0], [5.0, 0.0, 3.0]]), np.array([0, 2])).toarray()
    array([[2., 5.],
           [5., 3.]])
    """
    number = np.full(len(matrix.indptr) - 1, -1, matrix.indices.dtype)
    number[kept] = np.arange(len(kept), dtype=matrix.indices.dtype)
    first = np.zeros(len(kept) + 1, matrix.indptr.dtype)
    _count_kept(matrix.indptr, matrix.indices, kept, number, first)
    columns, data = np.empty(first[-1], matrix.indices.dtype), np.empty(first[-1], matrix.data.dtype)
    _take_kept(matrix.indptr, matrix.indices, matrix.data, kept, number, columns, data)
    return sparse.csr_matrix((data, columns, first), shape=(len(kept), len(kept)))


def product_of_rows(
    matrix: sparse.csr_matrix, rows: npt.NDArray[np.int64], vector: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Multiply some rows of a matrix by a vector, without making a matrix of them.

    Args:
        matrix: Shape (n, m).
        rows: Their numbers, shape (k,).
        vector: Shape (m,).

    Returns:
        Shape (k,).

    >>> product_of_rows(sparse.csr_matrix([[2.0, -1.0], [-1.0, 3.0]]), np.array([1]), np.array([1.0, 2.0]))
    array([5.])
    """
    product = np.empty(len(rows))
    _multiply_rows(matrix.indptr, matrix.indices, matrix.data, rows, vector, product)
    return product


@kernel
def _multiply_rows(indptr, indices, data, rows, vector, product):
    for place in range(len(rows)):
        total = 0.0
        for k in range(indptr[rows[place]], indptr[rows[place] + 1]):
            total += data[k] * vector[indices[k]]
        product[place] = total


@kernel
def _add_to_diagonal(indptr, indices, more, data):
    """Returns whether each row has an entry on the diagonal to add to."""
    for row in range(len(indptr) - 1):
        found = False
        for k in range(indptr[row], indptr[row + 1]):
            if indices[k] == row:
                data[k] += more[row]
                found = True
                break
        if not found:
            return False
    return True


@kernel
def _count_kept(indptr, indices, kept, number, first):
    for place in range(len(kept)):
        count = 0
        for k in range(indptr[kept[place]], indptr[kept[place] + 1]):
            count += number[indices[k]] >= 0
        first[place + 1] = first[place] + count


@kernel
def _take_kept(indptr, indices, data, kept, number, columns, values):
    place = 0
    for row in kept:
        for k in range(indptr[row], indptr[row + 1]):
            if number[indices[k]] >= 0:
                columns[place], values[place] = number[indices[k]], data[k]
                place += 1
