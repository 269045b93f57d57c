"""Element matrices of linear tetrahedra (P1), added up along the edges and nodes of a mesh.

The geometry of each tetrahedron is computed where it is needed and never stored. On a lattice, tetrahedra are alike
and could share their matrices, but to recognise one takes longer than to compute it.

"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.checks import check_finite, check_shape
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.core.kernel_cache import kernel
from thermoxels_ns.fem.sparsity import MeshEdges, checked_tets

_REMEDY = "Build the mesh with thermoxels_ns.mesh."
_FLAT = 6e-12
"""Six volumes over the cube of the size, up to which a tetrahedron is flat: it cannot carry gradients."""
_ANGLE_ROUND_OFF = 16.0 * np.finfo(np.float64).eps
"""Round-off of the cosine of an angle per largest coordinate over the tetrahedron's size; an estimate from above."""


def edge_couplings(
    points_m: npt.NDArray[np.float64],
    tets: npt.NDArray[np.int64],
    conductivity_w_mk: float | npt.NDArray[np.float64],
    edges: MeshEdges,
) -> npt.NDArray[np.float64]:
    """Compute the entries of the stiffness matrix off its diagonal, k * integral(grad phi_i . grad phi_j).

    In a tetrahedron with faces opposite i and j of outward area vectors n_i and n_j, grad phi_i = -n_i / (3 V): the
    entry is k n_i . n_j / (9 V), and 0 where the two faces are at a right angle. An angle that is right up to the
    round-off of the coordinates counts as right, so that the many right angles of a lattice give no entries.

    Args:
        points_m: Nodes, shape (n, 3), [m].
        tets: Node numbers, shape (t, 4), positively oriented.
        conductivity_w_mk: Thermal conductivity, [W / (m K)], one for all or one per tetrahedron, shape (t,).
        edges: The mesh's edges.

    Returns:
        One entry per edge, shape (e,), [W / K].

    Raises:
        HeatError: If an array has the wrong shape, a conductivity is not above 0, or a tetrahedron is flat or inverted.
    """
    points_m, tets, reach = _checked(points_m, tets)
    conductivity = _per_tet("conductivity_w_mk", conductivity_w_mk, len(tets))
    coupling = np.zeros(len(edges.other))
    flat = _add_couplings(points_m, tets, conductivity, 1.0 / reach, edges.first, edges.other, coupling)
    _refuse_flat(flat, len(tets))
    coupling *= reach
    return coupling


def capacities(
    points_m: npt.NDArray[np.float64],
    tets: npt.NDArray[np.int64],
    heat_capacity_j_m3k: float | npt.NDArray[np.float64],
    edges: MeshEdges | None = None,
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Compute rho c * integral(phi_i) for every node and rho c * integral(phi_i phi_j) for every edge.

    A tetrahedron of volume V has V / 4 of the first and V / 20 of the second.

    Args:
        points_m: Nodes, shape (n, 3), [m].
        tets: Node numbers, shape (t, 4), positively oriented.
        heat_capacity_j_m3k: rho c, [J / (m3 K)], one for all or one per tetrahedron, shape (t,).
        edges: The mesh's edges; None: the second result is empty.

    Returns:
        nodal: Shape (n,), [J / K].
        edge: Shape (e,), [J / K].

    Raises:
        HeatError: If an array has the wrong shape, a heat capacity is not above 0, or a tetrahedron is flat or
            inverted.
    """
    points_m, tets, reach = _checked(points_m, tets)
    capacity = _per_tet("heat_capacity_j_m3k", heat_capacity_j_m3k, len(tets))
    if edges is None:
        edges = MeshEdges(np.zeros(0, np.int64), np.zeros(0, np.int32))
    nodal, edge = np.zeros(len(points_m)), np.zeros(len(edges.other))
    flat = _add_capacities(points_m, tets, capacity, 1.0 / reach, nodal, edges.first, edges.other, edge)
    _refuse_flat(flat, len(tets))
    return nodal * reach**3, edge * reach**3


def _checked(
    points_m: npt.NDArray[np.float64], tets: npt.NDArray[np.int64]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64], float]:
    """Check the arrays; find the power of 2 above all coordinates: in that unit nothing over- or underflows."""
    check_shape("mesh points", points_m, (None, 3), _REMEDY, HeatError)
    points_m = np.ascontiguousarray(points_m, dtype=np.float64)
    reach = float(max(np.max(points_m, initial=0.0), -np.min(points_m, initial=0.0)))
    if not np.isfinite(reach):
        check_finite("mesh points", points_m, _REMEDY, HeatError)
    return points_m, checked_tets(tets, len(points_m)), float(np.exp2(np.frexp(reach)[1])) if reach else 1.0


def _per_tet(name: str, value: float | npt.NDArray[np.float64], num_tets: int) -> npt.NDArray[np.float64]:
    """Give one value above 0 per tetrahedron, or one for all as an array of shape (1,)."""
    values = np.asarray(value, dtype=np.float64)
    bad = int(np.count_nonzero(~(np.isfinite(values) & (values > 0.0))))
    if bad or values.shape not in ((), (num_tets,)):
        raise HeatError(
            name,
            expected=f"finite numbers above 0, one for all or shape ({num_tets},)",
            got=f"shape {values.shape} with {bad} that are not",
            remedy="Give one number per tetrahedron of the mesh.",
        )
    return np.ascontiguousarray(values.reshape(-1))


def _refuse_flat(num_flat: int, num_tets: int) -> None:
    if num_flat:
        got = f"{num_flat} of {num_tets} flat or inverted"
        raise HeatError("mesh tets", expected="volumes above 0", got=got, remedy=_REMEDY)


@kernel
def _sides(points, tet, scale):
    # Unsigned, here and below: no test for negative numbers.
    o, a, b, c = (
        points[np.uint64(tet[0])],
        points[np.uint64(tet[1])],
        points[np.uint64(tet[2])],
        points[np.uint64(tet[3])],
    )
    return (
        ((a[0] - o[0]) * scale, (a[1] - o[1]) * scale, (a[2] - o[2]) * scale),
        ((b[0] - o[0]) * scale, (b[1] - o[1]) * scale, (b[2] - o[2]) * scale),
        ((c[0] - o[0]) * scale, (c[1] - o[1]) * scale, (c[2] - o[2]) * scale),
    )


@kernel
def _cross(u, v):
    return (u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0])


@kernel
def _dot(u, v):
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


@kernel
def _size(a, b, c):
    return max(abs(a[0]), abs(a[1]), abs(a[2]), abs(b[0]), abs(b[1]), abs(b[2]), abs(c[0]), abs(c[1]), abs(c[2]))


@kernel
def _place(first, other, node, neighbour):
    """Number of the edge between two nodes, by bisection."""
    low, high = np.uint64(min(node, neighbour)), max(node, neighbour)
    begin, end = np.uint64(first[low]), np.uint64(first[low + np.uint64(1)])
    while begin < end:
        middle = (begin + end) >> np.uint64(1)
        if other[middle] < high:
            begin = middle + np.uint64(1)
        else:
            end = middle
    return begin


@kernel
def _add_couplings(points, tets, conductivity, scale, first, other, coupling):
    """Returns the number of tetrahedra that are flat or inverted."""
    each = 0 if len(conductivity) == 1 else 1
    flat = 0
    for t in range(len(tets)):
        tet = tets[t]
        a, b, c = _sides(points, tet, scale)
        # Inward normals of the faces opposite each node, twice the face's area long.
        n1, n2, n3 = _cross(b, c), _cross(c, a), _cross(a, b)
        n0 = (-n1[0] - n2[0] - n3[0], -n1[1] - n2[1] - n3[1], -n1[2] - n2[2] - n3[2])
        normals = (n0, n1, n2, n3)
        six_volumes = _dot(a, n1)
        if not six_volumes > _FLAT * _size(a, b, c) ** 3:
            flat += 1
            continue
        right = _ANGLE_ROUND_OFF / _size(a, b, c)
        squares = (_dot(n0, n0), _dot(n1, n1), _dot(n2, n2), _dot(n3, n3))
        factor = conductivity[each * t] / (6.0 * six_volumes)
        for i in range(3):
            for j in range(i + 1, 4):
                product = _dot(normals[i], normals[j])
                if abs(product) > right * min(squares[i], squares[j]):
                    coupling[_place(first, other, tet[i], tet[j])] += factor * product
    return flat


@kernel
def _add_capacities(points, tets, capacity, scale, nodal, first, other, edge):
    """Returns the number of tetrahedra that are flat or inverted."""
    each = 0 if len(capacity) == 1 else 1
    flat = 0
    for t in range(len(tets)):
        tet = tets[t]
        a, b, c = _sides(points, tet, scale)
        six_volumes = _dot(a, _cross(b, c))
        if not six_volumes > _FLAT * _size(a, b, c) ** 3:
            flat += 1
            continue
        share = capacity[each * t] * six_volumes
        for i in range(4):
            nodal[tet[i]] += share / 24.0
        if len(edge) > 0:
            for i in range(3):
                for j in range(i + 1, 4):
                    edge[_place(first, other, tet[i], tet[j])] += share / 120.0
    return flat
