"""Levels of known bodies for the tests of isosurface stuffing, and what their meshes must be."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import skfem
from scipy import sparse
from skfem.models.poisson import laplace

from tests.support.heat_meshes import mesh_from
from thermoxels_ns.mesh.quality.checks import component_of
from thermoxels_ns.mesh.stuffing.isosurface import StuffedSolid
from thermoxels_ns.mesh.tetrahedra import FACET_BOX, FACET_SURFACE, TetMesh

ANGLE_BOUNDS_DEG = (10.7, 164.8)
"""What Labelle and Shewchuk (2007) promise."""


def tet_mesh(solid: StuffedSolid, voxel_size: float = 1.0) -> TetMesh:
    tags = np.where(solid.on_box, FACET_BOX, FACET_SURFACE)
    return mesh_from(solid.points * voxel_size, solid.tets, 0.0, facets=solid.facets, facet_tags=tags)


def on_surface(solid: StuffedSolid) -> np.ndarray:
    """True for nodes of boundary triangles, shape (n,)."""
    return np.isin(np.arange(len(solid.points)), solid.facets)


def num_bodies(solid: StuffedSolid) -> int:
    """Parts of the mesh that share no node."""
    return len(np.unique(component_of(len(solid.points), solid.tets[:, :3].ravel(), solid.tets[:, 1:].ravel())))


def euler_characteristic(solid: StuffedSolid) -> int:
    """Vertices - edges + triangles of the boundary: 2 for a ball, 2 less for every hole through it."""
    sides = np.sort(solid.facets[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    return len(np.unique(solid.facets)) - len(np.unique(sides, axis=0)) + len(solid.facets)


def stiffness(points: np.ndarray, tets: np.ndarray) -> sparse.csr_array:
    """Stiffness matrix of linear elements for a conductivity of 1."""
    return sparse.csr_array(laplace.assemble(skfem.Basis(skfem.MeshTet(points.T, tets.T), skfem.ElementTetP1())))


def turn(degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def box_distance(points: np.ndarray, half: np.ndarray) -> np.ndarray:
    beyond = np.abs(points) - half
    return np.linalg.norm(np.maximum(beyond, 0.0), axis=-1) + np.minimum(beyond.max(axis=-1), 0.0)


def centres(*shape: int) -> np.ndarray:
    """Voxel centres, in voxels from the middle of the lattice."""
    axes = [np.arange(n) + 0.5 - 0.5 * n for n in shape]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


@dataclass(frozen=True)
class Shape:
    """A body in a box of side 2 with its exact measures."""

    distance: Callable[[np.ndarray], np.ndarray]
    """Signed distance, negative inside."""
    volume: float
    area: float
    sharp_edges: float = 0.0
    """Total length of its edges of 90 degrees."""

    def level(self, cells: int, voxels_to_one: float = 1.5) -> np.ndarray:
        """Levels on `cells`^3 voxels that reach 1 so many voxels from the surface."""
        size = 2.0 / cells
        # No symmetry between the body and the lattice.
        points = centres(cells, cells, cells) * size - [0.0137, -0.0071, 0.0043]
        return np.clip(-self.distance(points) / (voxels_to_one * size), -1.0, 1.0)


def _torus(p: np.ndarray) -> np.ndarray:
    return np.hypot(np.hypot(p[..., 0], p[..., 1]) - 0.6, p[..., 2]) - 0.25


def _cylinder(p: np.ndarray) -> np.ndarray:
    return box_distance(np.stack([np.hypot(p[..., 0], p[..., 1]), p[..., 2]], axis=-1), np.array([0.5, 0.7]))


def _slab(degrees: float) -> Shape:
    a, b, c = half = np.array([0.7, 0.25, 0.5])
    return Shape(
        lambda p: box_distance(p @ turn(degrees), half), 8 * a * b * c, 8 * (a * b + b * c + a * c), 8 * (a + b + c)
    )


SHAPES: dict[str, Shape] = {
    "sphere": Shape(lambda p: np.linalg.norm(p, axis=-1) - 0.8, 4 / 3 * np.pi * 0.8**3, 4 * np.pi * 0.8**2),
    "torus": Shape(_torus, 2 * np.pi**2 * 0.6 * 0.25**2, 4 * np.pi**2 * 0.6 * 0.25),
    "cylinder": Shape(_cylinder, np.pi * 0.25 * 1.4, 2 * np.pi * 0.5 * (1.4 + 0.5), 4 * np.pi * 0.5),
    "slab at 0 degrees": _slab(0.0),
    "slab at 30 degrees": _slab(30.0),
    "slab at 45 degrees": _slab(45.0),
}
