"""The mesh that an export would cut from a perfectly trained synthetic scene."""

from __future__ import annotations

import numpy as np

from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import GridSnapshot
from thermoxels_ns.mesh.build import BoundaryMode, MeshOptions, build_mesh
from thermoxels_ns.mesh.solid.voxels import SolidSelection
from thermoxels_ns.mesh.tetrahedra import TetMesh
from thermoxels_ns.synthetic.scene_folder import make_scene


def demo_mesh(scene_name: str, voxels: int, boundary: BoundaryMode = "conforming") -> TetMesh:
    """Density grows e-fold per voxel into the scene's solid; corners within 1.5 voxels of its surface were measured."""
    scene = make_scene(scene_name)
    lattice = Lattice.covering(*scene.scene_box, voxels)

    def depth(points: np.ndarray) -> np.ndarray:
        distance = scene.signed_distance(points.reshape(-1, 3)).reshape(points.shape[:-1])
        return np.clip(-distance / lattice.voxel_size, -8.0, 8.0)

    corners = lattice.corner_positions()
    at_corners = depth(corners)
    temperature_c = scene.surface_temperature_c(corners.reshape(-1, 3)).reshape(lattice.shape)
    snapshot = GridSnapshot(
        lattice,
        np.exp(at_corners).astype(np.float32),
        temperature_c.astype(np.float32),
        (np.abs(at_corners) < 1.5).astype(np.float32),
        np.exp(depth(lattice.cell_centres())).astype(np.float32),
    )
    selection = SolidSelection(density_threshold=1.0, close_gaps=0)
    return build_mesh(snapshot, selection, np.eye(4), MeshOptions(boundary)).mesh
