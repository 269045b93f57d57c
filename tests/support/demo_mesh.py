"""Fields and meshes as a perfect training would leave them: of synthetic scenes, and of houses with flat walls."""

from dataclasses import replace
from functools import cache

import numpy as np

from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import GridSnapshot, Views
from thermoxels_ns.mesh.build import build_mesh
from thermoxels_ns.mesh.solid.voxels import SolidSelection
from thermoxels_ns.mesh.tetrahedra import TetMesh, facet_area_vectors
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


def demo_mesh(scene_name: str, voxels: int, boundary="conforming") -> TetMesh:
    scene = make_scene(scene_name)
    lattice = Lattice.covering(*scene.scene_box, voxels)
    temperature_c = scene.surface_temperature_c(lattice.corner_positions().reshape(-1, 3)).reshape(lattice.shape)
    return _mesh(exact_snapshot(scene.solid.signed_distance, lattice, temperature_c), boundary)


def _mesh(snapshot: GridSnapshot, boundary="conforming") -> TetMesh:
    return build_mesh(snapshot, SolidSelection(density_threshold=1.0, close_gaps=0), np.eye(4), boundary).mesh


TURN = np.radians(30.0)
TURNED = np.array([[np.cos(TURN), -np.sin(TURN), 0.0], [np.sin(TURN), np.cos(TURN), 0.0], [0.0, 0.0, 1.0]])


def _between(*planes):
    """Signed distance to the body between planes, each a normal and its distance from the origin."""
    normals = np.array([np.array(normal) / np.linalg.norm(normal) for normal, _ in planes])
    return lambda points: (points @ normals.T - [offset for _, offset in planes]).max(axis=1)


def _box(low, high):
    ends = zip(np.concatenate([np.eye(3), -np.eye(3)]), (*high, *(-value for value in low)))
    return _between(*((normal, end) for normal, end in ends))


@cache
def gable_house() -> TetMesh:
    """8 m x 6 m, eaves 3 m, roof of 40 degrees, turned by 30 degrees, on ground of 12 m x 12 m."""
    slope = np.tan(np.radians(40.0))
    ridge = (3.0 + 3.0 * slope) * np.cos(np.radians(40.0))
    roof = _between(((0.0, slope, 1.0), ridge), ((0.0, -slope, 1.0), ridge))
    walls, ground = _box((-4, -3, -0.1), (4, 3, 9)), _box((-6, -6, -0.6), (6, 6, 0))

    def distance(points):
        return np.minimum(np.maximum(walls(points @ TURNED), roof(points @ TURNED)), ground(points))

    return _mesh(exact_snapshot(distance, Lattice.covering((-6.5, -6.5, -1.0), (6.5, 6.5, 6.5), 56)))


def angled_house() -> TetMesh:
    """An L of two boxes: 10 m x 5 m, 6 m high, and 4 m x 4.5 m, 3.5 m high; no ground."""
    parts = _box((-5, -2.5, 0), (5, 2.5, 6)), _box((1, -2.5, 0), (5, 7, 3.5))
    lattice = Lattice.covering((-6, -4, -1), (6, 8, 7), 56)
    return _mesh(exact_snapshot(lambda points: np.minimum(*(part(points) for part in parts)), lattice))


@cache
def house_corner(voxels: int = 64) -> TetMesh:
    """The demo's house; its outer nodes have the true temperatures and colours."""
    mesh, scene = demo_mesh("house-corner", voxels), make_scene("house-corner")
    normals = np.zeros_like(mesh.points_m)
    for corner in mesh.facets.T:
        np.add.at(normals, corner, facet_area_vectors(mesh.points_m, mesh.facets))
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    inside = mesh.points_m - (scene.solid.signed_distance(mesh.points_m) + 1e-4)[:, None] * normals
    return replace(
        mesh,
        temperature_c=np.asarray(scene.surface_temperature_c(inside)),
        observed=np.ones(len(mesh.points_m), dtype=bool),
        colour=np.asarray(scene.colour(mesh.points_m, normals), dtype=np.float32),
    )
