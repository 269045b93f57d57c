"""Temperatures of mesh nodes: interpolated at measured nodes, extended harmonically to all others."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse.linalg import cg
from threadpoolctl import threadpool_limits

from thermoxels_ns.core.arrays import BoolArray, FloatArray, IntArray
from thermoxels_ns.core.checks import check_array
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.core.lattice import CORNER_OFFSETS
from thermoxels_ns.mesh.quality.tet_shapes import TET_EDGES, edge_stiffness

MIN_OBSERVED_WEIGHT = 0.5
"""Least weight of thermal rays at a node or corner that counts as measured, [fully absorbed rays]. Less weight comes
from light that leaked through a surface, or from the tail of an interpolation."""
_RELATIVE_RESIDUAL = 1e-9
_MOST_ROUNDS = 100_000
_LEAST_CONDUCTANCE = 1e-6
"""Least conductance of an edge as a share of the mean; it prevents overshoots and keeps components connected."""


def interpolate_corners(
    points_index: FloatArray, values: npt.NDArray, weights: npt.NDArray
) -> tuple[FloatArray, FloatArray]:
    """Return corner values interpolated at points by normalised convolution (Knutsson and Westin, CVPR 1993).

    value(x) = sum_c t_c w_c v_c / sum_c t_c w_c with the trilinear weights t_c of the eight corners around x, their
    values v_c and `weights` w_c.

    Args:
        points_index: Positions as fractional corner indices, shape (n, 3), within the lattice.
        values: Values on the corners, shape (nx, ny, nz) or (nx, ny, nz, k).
        weights: Weight of each corner's value, at least 0, 0 for an unknown value, shape (nx, ny, nz).

    Returns:
        values: Values at the points, shape (n,) or (n, k); 0 if all eight corners have weight 0.
        weight: sum_c t_c w_c, shape (n,).
    """
    # Not by ndimage.map_coordinates, which copies the lattice in double precision.
    low = np.clip(np.floor(points_index).astype(np.int64), 0, np.array(weights.shape) - 2)
    fraction = np.clip(points_index - low, 0.0, 1.0)
    trailing = (slice(None), *[None] * (values.ndim - 3))
    total, weight = np.zeros((len(low), *values.shape[3:])), np.zeros(len(low))
    for offset in CORNER_OFFSETS:
        at = tuple((low + offset).T)
        share = np.prod(np.where(offset == 1, fraction, 1.0 - fraction), axis=1) * weights[at]
        weight += share
        total += share[trailing] * np.where(share[trailing] > 0.0, values[at], 0.0)
    return total / np.where(weight > 0.0, weight, 1.0)[trailing], weight


def extend_harmonically(
    edges: IntArray, temperature_c: npt.NDArray[np.floating], observed: BoolArray, edge_weights: npt.NDArray
) -> FloatArray:
    """Return the temperatures of all nodes, shape (n,), [degrees Celsius], by harmonic extension to unobserved nodes.

    Observed nodes keep their value. Every other node i satisfies sum_j w_ij (T_i - T_j) = 0 over its edges, as in
    steady heat conduction in an insulated body; conjugate gradients solve these equations. All values are within the
    observed range, because weights below a very small positive number are raised to it.

    Args:
        edges: Node pairs, shape (e, 2); if a pair is listed several times, its weights add up.
        temperature_c: Nodal temperatures, shape (n,), [degrees Celsius]; read at observed nodes only.
        observed: True for nodes with a measured temperature, shape (n,); at least one in each connected part.
        edge_weights: Conductance w of each edge, shape (e,), as from `tet_conductances`.

    Raises:
        MeshError: No node is observed, a value is not finite, or the solver did not converge.

    >>> chain = np.array([[0, 1], [1, 2]])
    >>> extend_harmonically(chain, np.array([10.0, -99.0, 30.0]), np.array([True, False, True]), np.ones(2)).tolist()
    [10.0, 20.0, 30.0]
    """
    num_nodes = len(temperature_c)
    observed = np.asarray(observed, dtype=bool)
    temperature = np.where(observed, np.asarray(temperature_c, dtype=np.float64), 0.0)
    remedy = "The checkpoint is damaged; resume from an earlier one."
    check_array("observed temperatures", temperature, None, remedy, MeshError)
    if observed.all():
        return temperature
    if not observed.any():
        expected, remedy = "at least one node seen by a thermal ray", "Train with thermal images that show this part."
        raise MeshError("observed temperatures", expected=expected, got="none", remedy=remedy)

    start, end = edges[:, 0], edges[:, 1]
    links = sparse.coo_array((edge_weights, (start, end)), shape=(num_nodes, num_nodes)).tocsr()
    links = (links + links.T).tocsr()
    links.data = np.maximum(links.data, _LEAST_CONDUCTANCE * float(np.abs(links.data).mean()))
    free, fixed = np.flatnonzero(~observed), np.flatnonzero(observed)
    middle = 0.5 * (temperature[fixed].min() + temperature[fixed].max())
    rows = links[free]
    degree = np.asarray(rows.sum(axis=1)).ravel()
    matrix, load = sparse.diags_array(degree) - rows[:, free], rows[:, fixed] @ (temperature[fixed] - middle)
    with threadpool_limits(1, "blas"):  # the result is then the same, bit for bit, for any number of threads
        jacobi = sparse.diags_array(1.0 / degree)
        found, missed = cg(matrix.tocsr(), load, rtol=_RELATIVE_RESIDUAL, maxiter=_MOST_ROUNDS, M=jacobi)
    if missed:
        remedy = "Train at a lower resolution, or with thermal images that show more of the scene."
        expected, got = f"convergence in {_MOST_ROUNDS} iterations", f"none with {len(free)} unobserved nodes"
        raise MeshError("harmonic extension of the temperature", expected=expected, got=got, remedy=remedy)

    temperature[free] = np.clip(middle + found, temperature[fixed].min(), temperature[fixed].max())
    return temperature


def tet_conductances(points: FloatArray, tets: IntArray) -> tuple[IntArray, FloatArray]:
    """Return the edges of tetrahedra, (6 t, 2), and their conductances (6 t,): minus the entries of `edge_stiffness`.

    An edge is listed once for each tetrahedron around it. `extend_harmonically` is exact for temperatures linear in
    space, except near edges with a negative sum of conductances, as between obtuse angles.
    """
    return tets[:, TET_EDGES].reshape(-1, 2), -edge_stiffness(points, tets).ravel()
