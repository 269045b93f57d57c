"""Fields and meshes as a perfect training of a synthetic scene would leave them."""

import numpy as np

from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import GridSnapshot, Views
from thermoxels_ns.mesh.build import BoundaryMode, build_mesh
from thermoxels_ns.mesh.solid.voxels import SolidSelection
from thermoxels_ns.mesh.tetrahedra import TetMesh
from thermoxels_ns.synthetic.scene_folder import make_scene


def exact_snapshot(signed_distance, lattice: Lattice, temperature_c=20.0, views: Views | None = None) -> GridSnapshot:
    """Density is 1 on the surface and grows e-fold per voxel inwards; corners within 1.5 voxels of it were measured."""

    def depth(points: np.ndarray) -> np.ndarray:
        distance = signed_distance(points.reshape(-1, 3)).reshape(points.shape[:-1])
        return np.clip(-distance / lattice.voxel_size, -8.0, 8.0)

    at_corners = depth(lattice.corner_positions())
    return GridSnapshot(
        lattice,
        np.exp(at_corners).astype(np.float32),
        np.broadcast_to(np.asarray(temperature_c, np.float32), lattice.shape),
        (np.abs(at_corners) < 1.5).astype(np.float32),
        np.exp(depth(lattice.cell_centres())).astype(np.float32),
        views=views,
    )


def demo_mesh(scene_name: str, voxels: int, boundary: BoundaryMode = "conforming") -> TetMesh:
    scene = make_scene(scene_name)
    lattice = Lattice.covering(*scene.scene_box, voxels)
    temperature_c = scene.surface_temperature_c(lattice.corner_positions().reshape(-1, 3)).reshape(lattice.shape)
    snapshot = exact_snapshot(scene.solid.signed_distance, lattice, temperature_c)
    selection = SolidSelection(density_threshold=1.0, close_gaps=0)
    return build_mesh(snapshot, selection, np.eye(4), boundary).mesh
