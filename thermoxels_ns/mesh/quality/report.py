"""All figures of a mesh's quality: shapes, sizes, topology, and the criteria it meets."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, Literal, get_args

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.quality.checks import (
    TET_EDGES,
    SurfaceComponent,
    component_of,
    count_open_edges,
    count_overlaps,
    count_twin_nodes,
    count_wrong_facets,
    facet_areas,
    group_faces,
    group_sides,
    surface_topology,
)
from thermoxels_ns.mesh.quality.tet_shapes import angle_rounding, node_rounding, shapes_in_chunks
from thermoxels_ns.mesh.tetrahedra import FACET_BOX, TetMesh

BoundaryMode = Literal["conforming", "voxel"]
"""How the boundary of a mesh runs: along the level set of the density, or along voxel faces."""
DIHEDRAL_BOUNDS_DEG: dict[BoundaryMode, tuple[float, float]] = {"voxel": (45.0, 90.0), "conforming": (10.7, 164.8)}
"""Bounds of the angles between two faces of a tetrahedron, [degrees]: six equal tetrahedra per voxel have angles of 45,
60 and 90 degrees; for isosurface stuffing see Labelle and Shewchuk (2007)."""
ANGLE_TOLERANCE_DEG = 1e-6  # what rounding may add to an angle, [degrees]
TEMPERATURE_TOLERANCE_K = 1e-6  # what rounding may add to a temperature, [K]
SOLVABLE = ("volumes_positive", "conforming", "boundary_closed")  # criteria without which no solver takes a mesh
RATIO_EDGES = np.linspace(0.0, 1.0, 21)  # edges of the bins of the radius ratio

_BINS_WITHIN_BOUNDS: dict[BoundaryMode, int] = {"voxel": 10, "conforming": 30}
_MOST_COMPONENTS = 20
_CANCELLED = 1e-9  # sums over an edge below this share of their terms' sizes are 0


@dataclass(frozen=True)
class Criterion:
    """One quality criterion, and whether a mesh meets it."""

    name: str  # short name, the same for every mesh
    sentence: str  # what it asks for
    kept: bool  # whether the mesh meets it
    figure: float  # the number that decides
    found: str  # the number in words


def angle_edges(boundary_mode: BoundaryMode) -> FloatArray:
    """Edges of bins about 5 degrees wide from 0 to 180 degrees such that none lies on both sides of a bound.

    The first may begin below 0 and the last end above 180; rounding carries no angle across a bound.

    >>> angle_edges("voxel")[[0, 1, -1]].round(3)
    array([ -0. ,   4.5, 180. ])
    """
    low, high = DIHEDRAL_BOUNDS_DEG[boundary_mode]
    low, high = low - ANGLE_TOLERANCE_DEG, high + ANGLE_TOLERANCE_DEG
    within = _BINS_WITHIN_BOUNDS[boundary_mode]
    width = (high - low) / within
    below, above = math.ceil(low / width), math.ceil((180.0 - high) / width)
    return low + width * np.arange(-below, within + above + 1)


def in_percent(share: float) -> str:
    """A share in percent that does not look like none, or all, unless it is."""
    if share in (0.0, 1.0):
        return f"{100 * share:.0f} %"
    return "< 0.01 %" if share < 1e-4 else f"{min(100.0 * share, 99.99):.2f} %"


@dataclass(frozen=True)
class QualityReport:
    """Figures of a mesh and the criteria it meets."""

    boundary_mode: BoundaryMode  # how the boundary was made, by which the criteria differ
    length_unit: str  # unit of the nodes' positions; if it is not "m", [m] below stands for it
    num_nodes: int
    num_tets: int
    num_edges: int
    num_facets: int
    num_box_facets: int  # boundary triangles where the scene box cuts the solid
    volume_m3: float  # sum of the signed volumes, [m^3]
    area_m2: float  # sum of the boundary triangles' areas, [m^2]
    true_area_m2: float | None
    """Area of the surface that the boundary triangles stand for: each times its area factor, [m^2]; None for a mesh
    whose boundary was not tagged."""
    edge_length_m: tuple[float, float, float]  # shortest, mean and longest edge, [m]
    dihedral_range_deg: tuple[float, float]  # smallest and largest angle between two faces of a tetrahedron, [degrees]
    dihedral_counts: tuple[int, ...]
    """Number of these angles, six per tetrahedron, in the bins of `angle_edges`."""
    radius_ratio_range: tuple[float, float]
    """Smallest and largest of 3 r / R with the radii of the inscribed and the circumscribed sphere, 1 at best; 0 where
    the volume is not above 0."""
    radius_ratio_mean: float
    radius_ratio_counts: tuple[int, ...]
    """Number of tetrahedra by radius ratio in bins of 0.05 from 0 to 1; the last includes 1."""
    share_obtuse: float  # share of tetrahedra with an obtuse angle between two faces, 0 to 1
    share_positive_edges: float
    """Share of edges whose off-diagonal entry of the linear stiffness matrix, summed over the tetrahedra around the
    edge at conductivity 1, is positive: there the discrete maximum principle can fail, 0 to 1."""
    bodies_by_node: int  # parts of the mesh that share no node
    bodies_by_face: int
    """Parts of the mesh between which no heat is conducted through a face: they share nodes or edges at most."""
    euler_characteristic: int  # vertices - edges + triangles of the boundary
    genus: int | None  # handles of all boundary components together; None if one of them is not a closed manifold
    components: tuple[SurfaceComponent, ...]
    """Connected components of the boundary (triangles that share edges), largest first."""
    num_non_manifold_edges: int  # boundary edges with more than two boundary triangles
    num_non_manifold_vertices: int  # boundary vertices whose triangles are not one fan
    criteria: tuple[Criterion, ...]  # quality criteria of such a boundary, and whether this mesh meets them

    @property
    def num_cavities(self) -> int:
        """Boundary components around a hole inside a body."""
        return sum(component.is_cavity for component in self.components)

    @property
    def unmet(self) -> tuple[str, ...]:
        """Names of the criteria that this mesh does not meet."""
        return tuple(criterion.name for criterion in self.criteria if not criterion.kept)

    def as_mapping(self) -> dict[str, Any]:
        """The report as json can hold it; of the boundary's components the 20 largest are listed."""
        mapping = asdict(self)
        listed, criteria = mapping.pop("components"), mapping.pop("criteria")
        for name, edges in (
            ("dihedral_counts", angle_edges(self.boundary_mode)),
            ("radius_ratio_counts", RATIO_EDGES),
        ):
            width = float(edges[1] - edges[0])
            counts = list(mapping[name])
            mapping[name] = {"first_centre": float(edges[0]) + 0.5 * width, "bin_width": width, "counts": counts}
        for name in ("dihedral_range_deg", "radius_ratio_range"):
            mapping[name] = dict(zip(("min", "max"), mapping[name]))
        mapping["edge_length_m"] = dict(zip(("min", "mean", "max"), mapping["edge_length_m"]))
        mapping["num_components"] = len(self.components)
        mapping["num_cavities"] = self.num_cavities
        mapping["largest_components"] = list(listed[:_MOST_COMPONENTS])
        mapping["promises"] = list(criteria)
        return mapping


def check_mesh(
    mesh: TetMesh,
    boundary_mode: BoundaryMode = "conforming",
    observed_range_c: tuple[float, float] | None = None,
    length_unit: str = "m",
) -> QualityReport:
    """Measure a mesh as `quality_report` does, and refuse what no finite-element solver can take.

    Raises:
        MeshError: A volume is not above 0, neighbours do not share whole faces, a node belongs to no tetrahedron or
            lies where another is, or the boundary is not closed; or what `quality_report` raises.
    """
    report = quality_report(mesh, boundary_mode, observed_range_c, length_unit)
    for criterion in report.criteria:
        if criterion.name in SOLVABLE and not criterion.kept:
            remedy = "The mesh is damaged: build it again, and report this if it persists."
            expected, got = criterion.sentence.rstrip("."), criterion.found
            raise MeshError(f"mesh {criterion.name}", expected=expected, got=got, remedy=remedy)
    return report


def quality_report(
    mesh: TetMesh,
    boundary_mode: BoundaryMode,
    observed_range_c: tuple[float, float] | None = None,
    length_unit: str = "m",
) -> QualityReport:
    """Measure a mesh and hold it against its quality criteria. One that is not met is reported, it does not raise.

    Args:
        mesh: The mesh, damaged or not.
        boundary_mode: How its boundary was made.
        observed_range_c: Lowest and highest observed temperature, [degrees Celsius]; the observed nodes' if left out,
            all nodes' if none was observed.
        length_unit: Name of the unit of the nodes' positions.

    Raises:
        MeshError: The arrays do not fit each other or are not finite.
    """
    if boundary_mode not in get_args(BoundaryMode):
        modes = " or ".join(get_args(BoundaryMode))
        raise MeshError("boundary_mode", expected=modes, got=repr(boundary_mode), remedy="Pass one of these.")
    mesh.check()
    points, tets, temperature = mesh.points_m, mesh.tets, mesh.temperature_c
    seen = np.asarray(mesh.observed, dtype=bool)
    observed_c = temperature[seen] if seen.any() else temperature
    low_c, high_c = observed_range_c or (float(observed_c.min()), float(observed_c.max()))
    shapes, volumes, stiffness = _measure_shapes(mesh, angle_edges(boundary_mode))
    links, share_positive = _edges(mesh, stiffness)
    lengths = np.linalg.norm(points[links.row] - points[links.col], axis=1)
    faces, sides = group_faces(tets), group_sides(mesh.facets)
    first, second = faces.pairs()
    surface = surface_topology(points, mesh.facets, sides)
    areas = facet_areas(points, mesh.facets)
    unused = len(points) - np.count_nonzero(np.bincount(tets.ravel()))
    mismatches = int(np.count_nonzero(faces.sizes > 2)) + count_overlaps(points, mesh.facets, sides)
    criteria = _criteria(
        boundary_mode,
        shapes,
        share_positive,
        volumes,
        length_unit,
        mismatches=mismatches + count_twin_nodes(points) + unused,
        open_edges=count_open_edges(mesh.facets, sides),
        wrong_facets=count_wrong_facets(mesh, faces),
        excess=float(max(low_c - temperature.min(), temperature.max() - high_c, 0.0)),
        rounding_deg=float(np.degrees(angle_rounding(node_rounding(points), float(lengths.min()) or 1.0))),
    )
    return QualityReport(
        boundary_mode=boundary_mode,
        length_unit=length_unit,
        num_nodes=len(points),
        num_tets=len(tets),
        num_edges=len(lengths),
        num_facets=len(mesh.facets),
        num_box_facets=int(np.count_nonzero(mesh.facet_tags == FACET_BOX)),
        area_m2=float(areas.sum()),
        true_area_m2=None if mesh.boundary is None else float((areas * mesh.boundary.area_factor).sum()),
        edge_length_m=(float(lengths.min()), float(lengths.mean()), float(lengths.max())),
        **shapes,
        share_positive_edges=share_positive,
        # Nodes without a tetrahedron are no bodies.
        bodies_by_node=int(connected_components(links, directed=False)[0]) - unused,
        bodies_by_face=int(component_of(len(tets), first >> 2, second >> 2).max()) + 1,
        **surface,
        criteria=criteria if boundary_mode == "voxel" else criteria[:5],
    )


def _criteria(
    boundary_mode: BoundaryMode,
    shapes: dict[str, Any],
    share_positive: float,
    volumes: FloatArray,
    length_unit: str,
    *,
    mismatches: int,
    open_edges: int,
    wrong_facets: int,
    excess: float,
    rounding_deg: float,
) -> tuple[Criterion, ...]:
    """All criteria. The last two, on obtuse angles, are for voxel meshes alone: no cut along a level set meets them.

    None asks that a boundary nowhere touches itself, because bodies may.
    """
    (smallest, largest), (low, high) = shapes["dihedral_range_deg"], DIHEDRAL_BOUNDS_DEG[boundary_mode]
    inside, obtuse = min(smallest - low, high - largest), shapes["share_obtuse"]
    turned, smallest_volume = int(np.count_nonzero(~(volumes > 0.0))), float(volumes.min())
    return (
        Criterion(
            "volumes_positive",
            "Every tetrahedron has a volume above 0.",
            turned == 0,
            smallest_volume,
            f"{turned:,} at or below 0" if turned else f"smallest {smallest_volume:.3g} {length_unit}³",
        ),
        Criterion(
            "conforming",
            "Neighbours share whole faces: no crack, no face with three owners, no twin or unused node.",
            mismatches == 0,
            float(mismatches),
            f"{mismatches:,} mismatches",
        ),
        Criterion(
            "boundary_closed",
            "The boundary is closed: just the faces with one owner, normals outwards.",
            open_edges + wrong_facets == 0,
            float(open_edges + wrong_facets),
            f"{open_edges:,} open edges, {wrong_facets:,} triangles wrong",
        ),
        Criterion(
            "dihedral_within_bounds",
            f"Angles between two faces of a tetrahedron lie within {low:g} to {high:g} degrees.",
            inside >= -(ANGLE_TOLERANCE_DEG + rounding_deg),
            inside,
            f"{smallest:.2f}° to {largest:.2f}°",
        ),
        Criterion(
            "temperatures_in_range",
            "No node is colder than the coldest or hotter than the hottest observation.",
            excess <= TEMPERATURE_TOLERANCE_K,
            excess,
            f"{excess:.2g} K outside" if excess > TEMPERATURE_TOLERANCE_K else "none outside",
        ),
        Criterion(
            "non_obtuse",
            "No obtuse angle between faces: heat with lumped mass keeps the maximum principle.",
            obtuse == 0.0,
            obtuse,
            f"{in_percent(obtuse)} of tetrahedra obtuse",
        ),
        Criterion(
            "stiffness_monotone",
            "No stiffness entry of an edge is positive: all that the maximum principle needs.",
            share_positive == 0.0,
            share_positive,
            f"{in_percent(share_positive)} of edges positive",
        ),
    )


def _edges(mesh: TetMesh, stiffness: FloatArray) -> tuple[Any, float]:
    """Edges as entries of a sparse matrix, and the share of them whose stiffness, summed over the tets, is above 0."""
    ends = mesh.tets[:, TET_EDGES].reshape(-1, 2).T
    place, shape = (np.minimum(*ends), np.maximum(*ends)), (len(mesh.points_m),) * 2
    sums, sizes = (sparse.coo_array((values, place), shape).tocsr() for values in (stiffness, np.abs(stiffness)))
    return sums.tocoo(), float(np.mean(sums.data > _CANCELLED * sizes.data))


def _measure_shapes(mesh: TetMesh, edges_deg: FloatArray) -> tuple[dict[str, Any], FloatArray, FloatArray]:
    """Figures by their names in `QualityReport`, volumes (t,), and stiffness of the six edges of each in a row."""
    num = len(mesh.tets)
    volumes, ratios, stiffness = np.empty(num), np.empty(num), np.empty((num, 6))
    angle_counts = np.zeros(len(edges_deg) - 1, dtype=np.int64)
    smallest, largest, obtuse = 180.0, 0.0, 0
    for which, shapes in shapes_in_chunks(mesh.points_m, mesh.tets):
        cosines = shapes.dihedral_cosines()
        angles = np.degrees(np.arccos(cosines))
        angle_counts += np.histogram(angles, len(angle_counts), (edges_deg[0], edges_deg[-1]))[0]
        smallest, largest = min(smallest, float(angles.min())), max(largest, float(angles.max()))
        obtuse += int(np.count_nonzero(cosines.min(axis=0) < 0.0))
        volumes[which], ratios[which] = shapes.volumes, shapes.radius_ratios()
        stiffness[which] = shapes.stiffness(cosines).T
    figures = {
        "volume_m3": float(volumes.sum()),
        "share_obtuse": obtuse / num,
        "dihedral_range_deg": (smallest, largest),
        "dihedral_counts": tuple(angle_counts.tolist()),
        "radius_ratio_range": (float(ratios.min()), float(ratios.max())),
        "radius_ratio_mean": float(ratios.mean()),
        "radius_ratio_counts": tuple(np.histogram(ratios, RATIO_EDGES)[0].tolist()),
    }
    return figures, volumes, stiffness.ravel()
