"""Figures of a mesh's quality, and the criteria that it meets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.quality.checks import (
    count_overlaps,
    count_twin_nodes,
    count_wrong_facets,
    group_faces,
    group_sides,
)
from thermoxels_ns.mesh.quality.tet_shapes import shapes_in_chunks
from thermoxels_ns.mesh.tetrahedra import TetMesh, facet_areas

BoundaryMode = Literal["conforming", "voxel"]
"""How the boundary of a mesh runs: "conforming" along the level set of the density, "voxel" along voxel faces."""
DIHEDRAL_BOUNDS_DEG: dict[BoundaryMode, tuple[float, float]] = {"voxel": (45.0, 90.0), "conforming": (10.7, 164.8)}
"""Bounds of the angles between two faces of a tetrahedron, [degrees]. The six tetrahedra of a voxel have angles of 45,
60 and 90 degrees; for the angles of isosurface stuffing see Labelle and Shewchuk (2007)."""
ANGLE_TOLERANCE_DEG = 1e-4  # error of an angle that rounding of the nodes may cause, [degrees]
TEMPERATURE_TOLERANCE_K = 1e-6  # error of a temperature that rounding may cause, [K]

_CRITERIA = {
    "volumes_positive": "Every tetrahedron has a volume above 0.",
    "conforming": "Neighbours share whole faces: no crack, no face with three owners, no twin or unused node.",
    "boundary_closed": "The boundary is closed: just the faces with one owner, normals outwards.",
    "dihedral_within_bounds": "Angles between two faces of a tetrahedron lie within {:g} to {:g} degrees.",
    "temperatures_in_range": "No node is colder than the coldest or hotter than the hottest observation.",
    "non_obtuse": "No obtuse angle between faces: heat with lumped mass keeps the maximum principle.",
}
"""Quality criteria, sentence by name. The last one is for voxel meshes only, because no conforming mesh meets it. A
boundary may touch itself, because bodies may."""


@dataclass(frozen=True)
class Criterion:
    """One quality criterion, and the result of a mesh for this criterion."""

    name: str  # short name, the same for every mesh
    sentence: str  # what the criterion asks for
    kept: bool  # True if the mesh meets the criterion
    figure: float  # number by which the criterion is met or not; its unit depends on the criterion
    found: str  # what was found, in words


@dataclass(frozen=True)
class QualityReport:
    """Figures of the quality of a mesh, and its result for each quality criterion; lengths are in the mesh's unit."""

    boundary_mode: BoundaryMode  # how the boundary was made
    num_nodes: int
    num_tets: int
    num_facets: int
    num_non_manifold_edges: int  # number of boundary edges with more than two boundary triangles
    volume_m3: float  # sum of the signed volumes, [m^3]
    area_m2: float  # sum of the boundary triangles' areas, [m^2]
    dihedral_range_deg: tuple[float, float]  # smallest and largest angle between two faces of a tetrahedron, [degrees]
    criteria: tuple[Criterion, ...]  # the criteria for this `boundary_mode`, each with the mesh's result

    @property
    def unmet(self) -> tuple[str, ...]:
        """Return the names of the criteria that this mesh does not meet."""
        return tuple(criterion.name for criterion in self.criteria if not criterion.kept)


def check_mesh(
    mesh: TetMesh,
    boundary_mode: BoundaryMode = "conforming",
    observed_range_c: tuple[float, float] | None = None,
    length_unit: str = "m",
) -> QualityReport:
    """Return the figures of a mesh and its results by the quality criteria; raise if no solver can use the mesh.

    Args:
        mesh: The mesh, damaged or not.
        boundary_mode: How the boundary of the mesh was made.
        observed_range_c: Lowest and highest observed temperature, [degrees Celsius]; if left out, the range of the
            observed nodes, or of all nodes if none was observed.
        length_unit: Unit of length of the nodes' positions.

    Raises:
        MeshError: A volume is not above 0, neighbours do not share whole faces, a node belongs to no tetrahedron, two
            nodes are at one place, or the boundary is not closed; or the arrays do not fit each other or are not
            finite, see `TetMesh.check`.
    """
    mesh.check()
    points, tets, temperature = mesh.points_m, mesh.tets, mesh.temperature_c
    if not mesh.has_temperatures:
        temperature = np.zeros(len(points))
    observed_c = temperature[mesh.observed] if mesh.observed.any() else temperature
    low_c, high_c = observed_range_c or (float(observed_c.min()), float(observed_c.max()))
    excess_k = float(max(low_c - temperature.min(), temperature.max() - high_c, 0.0))
    volumes, (low, high) = np.empty(len(tets)), DIHEDRAL_BOUNDS_DEG[boundary_mode]
    least_cosine, most_cosine, num_obtuse = 1.0, -1.0, 0
    for which, shapes in shapes_in_chunks(points, tets):
        volumes[which], cosines = shapes.volumes, shapes.dihedral_cosines()
        least_cosine, most_cosine = min(least_cosine, cosines.min()), max(most_cosine, cosines.max())
        num_obtuse += int(np.count_nonzero(cosines.min(axis=0) < 0.0))
    smallest, largest = np.degrees(np.arccos([most_cosine, least_cosine])).tolist()
    inside, obtuse = min(smallest - low, high - largest), num_obtuse / len(tets)
    faces, sides = group_faces(tets), group_sides(mesh.facets)
    mismatches = int(np.count_nonzero(faces.sizes > 2)) + count_overlaps(points, mesh.facets, sides)
    mismatches += count_twin_nodes(points) + len(points) - np.count_nonzero(np.bincount(tets.ravel()))
    wrong, turned = count_wrong_facets(mesh, faces), int(np.count_nonzero(~(volumes > 0.0)))
    volume = f"{turned:,} at or below 0" if turned else f"smallest {volumes.min():.3g} {length_unit}³"
    warm = excess_k > TEMPERATURE_TOLERANCE_K
    found = (
        (turned == 0, float(volumes.min()), volume),
        (mismatches == 0, float(mismatches), f"{mismatches:,} mismatches"),
        (wrong == 0, float(wrong), f"{wrong:,} triangles wrong or missing"),
        (inside >= -ANGLE_TOLERANCE_DEG, inside, f"{smallest:.2f}° to {largest:.2f}°"),
        (not warm, excess_k, f"{excess_k:.2g} K outside" if warm else "none outside"),
        (num_obtuse == 0, obtuse, f"{num_obtuse:,} tetrahedra obtuse"),
    )
    criteria = [Criterion(name, text.format(low, high), *one) for (name, text), one in zip(_CRITERIA.items(), found)]
    for criterion in criteria[:3]:
        if not criterion.kept:
            remedy = "The mesh is damaged: build it again, and report this if it persists."
            expected, got = criterion.sentence.rstrip("."), criterion.found
            raise MeshError(f"mesh {criterion.name}", expected=expected, got=got, remedy=remedy)
    return QualityReport(
        boundary_mode=boundary_mode,
        num_nodes=len(points),
        num_tets=len(tets),
        num_facets=len(mesh.facets),
        num_non_manifold_edges=int(np.count_nonzero(sides.sizes > 2)),
        volume_m3=float(volumes.sum()),
        area_m2=float(facet_areas(points, mesh.facets).sum()),
        dihedral_range_deg=(smallest, largest),
        criteria=tuple(criteria[: None if boundary_mode == "voxel" else 5]),
    )
