"""Temperatures at points inside a body, interpolated as the solver does."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from skfem import ElementTetP2

from thermoxels_ns.core.checks import check_finite, check_shape
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.p1_kernels import TET_EDGES, mesh_edges
from thermoxels_ns.mesh.tetrahedra import TetMesh

_OUTSIDE = 1e-9
"""How far outside a tetrahedron, as a share of its height, a point may be and still count as on its face."""


@dataclass(frozen=True)
class Probes:
    """Points in a body and how their temperature follows from that of the nodes."""

    points_m: npt.NDArray[np.float64]  # Positions, shape (p, 3), [m]
    nodes: npt.NDArray[np.int64]  # Nodes of the tetrahedron around each point, shape (p, 4)
    weights: npt.NDArray[np.float64]  # Barycentric coordinates in it, shape (p, 4); each row adds up to 1

    def at(self, nodal: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Interpolate nodal values, shape (..., n), to the points, shape (..., p)."""
        return np.einsum("...pa,pa->...p", nodal[..., self.nodes], self.weights)

    def at_quadratic(self, mesh: TetMesh, values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Interpolate values of a mesh's nodes and then of its `mesh_edges`, shape (..., n), to shape (..., p)."""
        middles = len(mesh.points_m) + mesh_edges(mesh.tets, len(mesh.points_m)).numbers(self.nodes, TET_EDGES)
        nodes, element = np.concatenate([self.nodes, middles], axis=1), ElementTetP2()
        shapes = np.stack([element.lbasis(self.weights[:, 1:].T, i)[0] for i in range(nodes.shape[1])], axis=1)
        return np.einsum("...pa,pa->...p", values[..., nodes], shapes)


def place_probes(mesh: TetMesh, points_m: npt.ArrayLike) -> Probes:
    """Find the tetrahedron around each point, shape (p, 3), [m]; raises `HeatError` if one lies outside the body.

    >>> corner, none = np.vstack([np.zeros(3), np.eye(3)]), np.zeros((0, 3), np.int64)
    >>> tets, seen = np.array([[0, 1, 2, 3]]), np.ones(4, bool)
    >>> mesh = TetMesh(corner, tets, np.array([0.0, 8.0, 0.0, 0.0]), seen, none, none[:, 0], np.array([0]))
    >>> place_probes(mesh, [[0.25, 0.25, 0.25]]).at(mesh.temperature_c).tolist()
    [2.0]
    """
    remedy = "Give three coordinates in metres for each probe."
    points = check_shape("probes", np.asarray(points_m, dtype=np.float64), (None, 3), remedy, HeatError)
    check_finite("probes", points, remedy, HeatError)
    corner = mesh.points_m[mesh.tets]
    low, high = corner.min(axis=1), corner.max(axis=1)
    slack = _OUTSIDE * float(np.max(high - low))
    nodes, weights = np.zeros((len(points), 4), np.int64), np.zeros((len(points), 4))
    for number, point in enumerate(points):
        near = np.flatnonzero(np.all((low <= point + slack) & (high >= point - slack), axis=1))
        shares = _barycentric(corner[near], point)
        # On a face or at a node several tetrahedra have it: the one it lies deepest in, the first of equals.
        best = int(np.argmax(shares.min(axis=1))) if len(near) else -1
        if best < 0 or shares[best].min() < -_OUTSIDE:
            raise _outside(mesh, number, point)
        inside = np.clip(shares[best], 0.0, 1.0)
        nodes[number], weights[number] = mesh.tets[near[best]], inside / inside.sum()
    return Probes(points, nodes, weights)


def _barycentric(corner: npt.NDArray[np.float64], point: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Barycentric coordinates of a point in tetrahedra, shape (k, 4)."""
    sides = corner[:, 1:] - corner[:, :1]
    others = np.linalg.solve(np.swapaxes(sides, 1, 2), (point - corner[:, 0])[..., None])[..., 0]
    return np.concatenate([1.0 - others.sum(axis=1, keepdims=True), others], axis=1)


def _outside(mesh: TetMesh, number: int, point: npt.NDArray[np.float64]) -> HeatError:
    distance = np.linalg.norm(mesh.points_m - point, axis=1)
    nearest = int(np.argmin(distance))
    x, y, z = mesh.points_m[nearest]
    low, high = (", ".join(f"{v:.4g}" for v in end) for end in (mesh.points_m.min(axis=0), mesh.points_m.max(axis=0)))
    return HeatError(
        f"probe {number + 1}",
        expected=f"a point inside the body, which lies between ({low}) and ({high}) m",
        got=f"({', '.join(f'{v:.6g}' for v in point)}), which is outside",
        remedy=f"Move it; the nearest node is ({x:.6g}, {y:.6g}, {z:.6g}), {distance[nearest]:.3g} m away.",
    )
