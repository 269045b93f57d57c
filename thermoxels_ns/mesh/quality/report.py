"""All figures of a mesh's quality: shapes, sizes, topology, and the criteria it meets."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, get_args

import numpy as np

from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.quality.checks import (
    count_overlaps,
    count_twin_nodes,
    count_wrong_facets,
    facet_areas,
)
from thermoxels_ns.mesh.quality.criteria import (
    SOLVABLE,
    AngleBins,
    BoundaryMode,
    Criterion,
    Figures,
    angle_bins,
    judge,
)
from thermoxels_ns.mesh.quality.face_count import edges_of_rows, group_edges, group_faces
from thermoxels_ns.mesh.quality.tet_shapes import angle_rounding, node_rounding, shapes_in_chunks
from thermoxels_ns.mesh.quality.topology import (
    SurfaceComponent,
    count_bodies,
    group_sides,
    surface_topology,
    tets_across_faces,
)
from thermoxels_ns.mesh.tetrahedra import FACET_BOX, TetMesh

RATIO_BIN = 0.05  # width of the bins of the radius ratio; 20 of them from 0 to 1, the last includes 1

_MOST_COMPONENTS = 20
_CANCELLED = 1e-9  # sums over an edge below this share of their terms' sizes are 0


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
    """Number of these angles, six per tetrahedron, in the bins of `criteria.angle_bins`."""
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
        angles = angle_bins(self.boundary_mode)
        bins = (
            ("dihedral_counts", angles.first_centre_deg, angles.width_deg),
            ("radius_ratio_counts", 0.5 * RATIO_BIN, RATIO_BIN),
        )
        for name, first, width in bins:
            mapping[name] = {"first_centre": first, "bin_width": width, "counts": list(mapping[name])}
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
    seen = np.asarray(mesh.observed, dtype=bool)
    observed_c = mesh.temperature_c[seen] if seen.any() else mesh.temperature_c
    low_c, high_c = observed_range_c or (float(observed_c.min()), float(observed_c.max()))
    shapes, volumes, stiffness = _measure_shapes(mesh, angle_bins(boundary_mode))
    edges = group_edges(mesh.tets)
    ends = edges_of_rows(mesh.tets, edges.order[edges.start])
    lengths = np.linalg.norm(mesh.points_m[ends[:, 0]] - mesh.points_m[ends[:, 1]], axis=1)
    entries, sizes = edges.sums(stiffness), edges.sums(np.abs(stiffness))
    share_positive = float(np.mean(entries > _CANCELLED * sizes))

    faces = group_faces(mesh.tets)
    sides = group_sides(mesh.facets)
    surface = surface_topology(mesh.points_m, mesh.facets, sides)
    genera = [component.genus for component in surface.components]
    areas = facet_areas(mesh.points_m, mesh.facets)
    overlaps = count_overlaps(mesh.points_m, mesh.facets, sides)
    temperature = mesh.temperature_c
    unused = len(mesh.points_m) - np.count_nonzero(np.bincount(mesh.tets.ravel()))
    figures = Figures(
        min_volume_m3=float(volumes.min()),
        num_non_positive=int(np.count_nonzero(~(volumes > 0.0))),
        num_mismatches=int(np.count_nonzero(faces.sizes > 2)) + overlaps + count_twin_nodes(mesh.points_m) + unused,
        num_open_edges=surface.num_open_edges,
        num_wrong_facets=count_wrong_facets(mesh, faces),
        dihedral_range_deg=shapes["dihedral_range_deg"],
        temperature_excess_k=float(max(low_c - temperature.min(), temperature.max() - high_c)),
        share_obtuse=shapes["share_obtuse"],
        share_positive_edges=share_positive,
        angle_rounding_deg=float(np.degrees(angle_rounding(node_rounding(mesh.points_m), float(lengths.min()) or 1.0))),
    )
    return QualityReport(
        boundary_mode=boundary_mode,
        length_unit=length_unit,
        num_nodes=len(mesh.points_m),
        num_tets=len(mesh.tets),
        num_edges=len(ends),
        num_facets=len(mesh.facets),
        num_box_facets=int(np.count_nonzero(mesh.facet_tags == FACET_BOX)),
        area_m2=float(areas.sum()),
        true_area_m2=None if mesh.boundary is None else float((areas * mesh.boundary.area_factor).sum()),
        edge_length_m=(float(lengths.min()), float(lengths.mean()), float(lengths.max())),
        **shapes,
        share_positive_edges=share_positive,
        bodies_by_node=count_bodies(len(mesh.points_m), ends) - unused,  # nodes without a tetrahedron are none
        bodies_by_face=count_bodies(len(mesh.tets), tets_across_faces(faces)),
        euler_characteristic=surface.euler_characteristic,
        genus=None if None in genera else sum(genus for genus in genera if genus is not None),
        components=surface.components,
        num_non_manifold_edges=surface.num_non_manifold_edges,
        num_non_manifold_vertices=surface.num_non_manifold_vertices,
        criteria=judge(figures, boundary_mode, length_unit),
    )


def _measure_shapes(mesh: TetMesh, bins: AngleBins) -> tuple[dict[str, Any], FloatArray, FloatArray]:
    """Figures by their names in `QualityReport`, volumes (t,), and stiffness in rows of `face_count.group_edges`."""
    num = len(mesh.tets)
    volumes, ratios, stiffness = np.empty(num), np.empty(num), np.empty((num, 6))
    angle_counts = np.zeros(bins.number, dtype=np.int64)
    before = bins.first_centre_deg / bins.width_deg - 0.5
    smallest, largest, obtuse = 180.0, 0.0, 0
    for which, shapes in shapes_in_chunks(mesh.points_m, mesh.tets):
        cosines = shapes.dihedral_cosines()
        angles = np.degrees(np.arccos(cosines))
        angle_counts += _histogram(angles.ravel() / bins.width_deg - before, bins.number)
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
        "radius_ratio_counts": tuple(_histogram(ratios / RATIO_BIN, round(1.0 / RATIO_BIN)).tolist()),
    }
    return figures, volumes, stiffness.ravel()


def _histogram(bin_of: FloatArray, bins: int) -> IntArray:
    """Counts of numbers of at least 0 by their whole part; what lies beyond the last bin counts in it."""
    return np.bincount(np.minimum(bin_of.astype(np.int64), bins - 1), minlength=bins)
