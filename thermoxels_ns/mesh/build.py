"""From a trained field to a voxel mesh in metres."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from thermoxels_ns.checks import check_finite, check_shape
from thermoxels_ns.errors import MeshError, explain
from thermoxels_ns.lattice import CORNER_OFFSETS
from thermoxels_ns.mesh.solid import SolidCells, SolidSelection, select_solid
from thermoxels_ns.mesh.temperature import MIN_OBSERVED_WEIGHT, extend_harmonically
from thermoxels_ns.mesh.tetrahedra import TetMesh
from thermoxels_ns.mesh.voxel_tets import boundary_facets, boundary_tags, kuhn_tets, lattice_edges
from thermoxels_ns.snapshot import GridSnapshot


@dataclass(frozen=True)
class MeshedCells(SolidCells):
    """The solid voxels that a mesh is made of."""

    num_unobserved_parts: int
    """Parts left out because no thermal ray saw any of their nodes."""
    num_unobserved_voxels: int
    """Voxels of these parts; they count in `component_sizes`, but are not in `cells`."""


def build_voxel_mesh(
    snapshot: GridSnapshot,
    selection: SolidSelection,
    world_to_metres: npt.NDArray[np.float64],
    min_observed_weight: float = MIN_OBSERVED_WEIGHT,
) -> tuple[TetMesh, MeshedCells]:
    """Cut the solid part of a trained field into tetrahedra with nodal temperatures.

    Parts of it that no thermal ray saw have no temperature at all and are left out.

    Args:
        snapshot: The trained field on its corner lattice.
        selection: Which voxels are solid.
        world_to_metres: Similarity (rotation or reflection, one scale, shift), shape (4, 4), that maps homogeneous
            column vectors of the trained scene to metres.
        min_observed_weight: Nodes with less thermal ray weight than this are not measurements, [rays], at least 0;
            0 keeps every node that any ray touched.

    Returns:
        The mesh, and the solid voxels it was made from. A reflection turns the tetrahedra over, so that their volumes
        stay positive.

    Raises:
        MeshError: Nothing is solid, the 4x4 is no similarity, or no node of the mesh was measured.
    """
    transform = check_similarity("world_to_metres", world_to_metres)
    if not (np.isfinite(min_observed_weight) and min_observed_weight >= 0.0):
        raise MeshError(
            explain(
                "min_observed_weight",
                expected="a finite number of at least 0",
                got=min_observed_weight,
                remedy=f"Leave it out to use {MIN_OBSERVED_WEIGHT}.",
            )
        )
    least = max(min_observed_weight, np.finfo(np.float32).tiny)
    observed_corners = snapshot.observed_weight >= least
    solid = _without_unobserved_parts(select_solid(snapshot, selection), observed_corners)
    corners, tets = kuhn_tets(solid.cells)
    facets = boundary_facets(tets)
    tags = boundary_tags(facets, corners, snapshot.lattice.shape)

    nodes = tuple(corners.T)
    observed = observed_corners[nodes]
    edges, num_voxels = lattice_edges(solid.cells)
    temperature_c = extend_harmonically(edges, snapshot.temperature_c[nodes], observed, edge_weights=num_voxels)

    if np.linalg.det(transform[:3, :3]) < 0.0:
        tets, facets = tets[:, [0, 2, 1, 3]], facets[:, ::-1]
    mesh = TetMesh(
        points_m=apply_transform(transform, snapshot.lattice.index_to_world(corners)),
        tets=np.ascontiguousarray(tets),
        temperature_c=temperature_c,
        observed=observed,
        facets=np.ascontiguousarray(facets),
        facet_tags=tags,
        region=np.zeros(len(tets), dtype=np.int64),
    )
    return mesh, solid


def _without_unobserved_parts(solid: SolidCells, observed_corners: npt.NDArray[np.bool_]) -> MeshedCells:
    """Leave out voxels whose connected part of the mesh has no observed node, unless that is all of them."""
    # Voxels share a node if they touch by a face, an edge or a corner.
    part = np.zeros(solid.cells.shape, dtype=np.int32)
    count = int(ndimage.label(solid.cells, structure=np.ones((3, 3, 3)), output=part))  # type: ignore[arg-type]
    nx, ny, nz = solid.cells.shape
    touched = np.zeros(solid.cells.shape, dtype=bool)
    for dx, dy, dz in CORNER_OFFSETS:
        touched |= observed_corners[dx : dx + nx, dy : dy + ny, dz : dz + nz]
    seen = np.bincount(part[solid.cells & touched], minlength=count + 1) > 0
    found = {field.name: getattr(solid, field.name) for field in fields(SolidCells)}
    if seen[1:].all() or not seen.any():
        return MeshedCells(**found, num_unobserved_parts=0, num_unobserved_voxels=0)
    found["cells"] = solid.cells & seen[part]
    return MeshedCells(
        **found,
        num_unobserved_parts=int(np.count_nonzero(~seen[1:])),
        num_unobserved_voxels=int(np.count_nonzero(solid.cells & ~seen[part])),
    )


def check_similarity(name: str, matrix: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return `matrix` as float64 if it is a 4x4 similarity (mirrors allowed), else raise `MeshError`."""
    remedy = "Pass a 4x4 matrix made of a rotation, one scale above 0 and a shift, with last row 0 0 0 1."
    transform = check_shape(name, np.asarray(matrix, dtype=np.float64), (4, 4), remedy, MeshError)
    check_finite(name, transform, remedy, MeshError)
    linear = transform[:3, :3]
    squared = linear.T @ linear
    scale = np.trace(squared) / 3.0
    similar = scale > 0.0 and np.allclose(squared, scale * np.eye(3), rtol=0.0, atol=1e-5 * scale)
    if not similar or not np.array_equal(transform[3], [0.0, 0.0, 0.0, 1.0]):
        raise MeshError(explain(name, expected="a similarity", got=transform.tolist(), remedy=remedy))
    return transform


def apply_transform(matrix: npt.NDArray[np.float64], points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Map points (n, 3) by a 4x4 that acts on homogeneous column vectors."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]
