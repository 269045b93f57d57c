"""All figures of a mesh's quality (shapes, sizes, topology), the criteria it meets, and a picture of both."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.checks import replace_when_done, writable_folder
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.quality.checks import (
    component_of,
    count_overlaps,
    count_twin_nodes,
    count_wrong_facets,
    group_faces,
    group_sides,
    surface_components,
)
from thermoxels_ns.mesh.quality.tet_shapes import TET_EDGES, shapes_in_chunks
from thermoxels_ns.mesh.tetrahedra import FACET_BOX, TetMesh, facet_areas

if TYPE_CHECKING:
    from matplotlib.axes import Axes

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
ANGLE_EDGES_DEG = np.linspace(0.0, 180.0, 37)  # edges of the bins of `dihedral_counts`


@dataclass(frozen=True)
class Criterion:
    """One quality criterion, and the result of a mesh for this criterion."""

    name: str  # short name, the same for every mesh
    sentence: str  # what the criterion asks for
    kept: bool  # True if the mesh meets the criterion
    figure: float  # number by which the criterion is met or not; its unit depends on the criterion
    found: str  # what was found, in words


def in_percent(share: float) -> str:
    """Return a share as text in percent; only exactly 0 and exactly 1 are written as "0 %" and "100 %"."""
    if share in (0.0, 1.0):
        return f"{100 * share:.0f} %"
    return "< 0.01 %" if share < 1e-4 else f"{min(100.0 * share, 99.99):.2f} %"


@dataclass(frozen=True)
class QualityReport:
    """Figures of the quality of a mesh, and its result for each quality criterion."""

    boundary_mode: BoundaryMode  # how the boundary was made
    length_unit: str  # unit of length of the nodes' positions; where it is not "m", read [m] below as this unit
    num_nodes: int
    num_tets: int
    num_edges: int
    num_facets: int
    num_box_facets: int  # number of boundary triangles with the tag `FACET_BOX`
    volume_m3: float  # sum of the signed volumes, [m^3]
    area_m2: float  # sum of the boundary triangles' areas, [m^2]
    edge_length_m: tuple[float, float, float]  # shortest, mean and longest edge, [m]
    dihedral_range_deg: tuple[float, float]  # smallest and largest angle between two faces of a tetrahedron, [degrees]
    dihedral_counts: tuple[int, ...]  # numbers of angles, six per tetrahedron, between the `ANGLE_EDGES_DEG`
    share_obtuse: float  # share of tetrahedra with an obtuse angle between two faces, 0 to 1
    bodies_by_node: int  # number of parts of the mesh that share no node
    bodies_by_face: int  # number of parts that share no face, so that no heat is conducted between them
    num_components: int  # number of parts of the boundary that are joined by edges
    num_cavities: int  # number of these parts that bound a hole inside a body
    num_non_manifold_edges: int  # number of boundary edges with more than two boundary triangles
    criteria: tuple[Criterion, ...]  # the criteria for this `boundary_mode`, each with the mesh's result

    @property
    def unmet(self) -> tuple[str, ...]:
        """Return the names of the criteria that this mesh does not meet."""
        return tuple(criterion.name for criterion in self.criteria if not criterion.kept)

    def as_mapping(self) -> dict[str, Any]:
        """Return the report as a dictionary for json."""
        mapping = asdict(self)
        width, counts = float(ANGLE_EDGES_DEG[1]), list(self.dihedral_counts)
        mapping["dihedral_counts"] = {"first_centre": 0.5 * width, "bin_width": width, "counts": counts}
        mapping["dihedral_range_deg"] = dict(zip(("min", "max"), self.dihedral_range_deg))
        mapping["edge_length_m"] = dict(zip(("min", "mean", "max"), self.edge_length_m))
        mapping["promises"] = list(mapping.pop("criteria"))
        return mapping


def check_mesh(
    mesh: TetMesh,
    boundary_mode: BoundaryMode = "conforming",
    observed_range_c: tuple[float, float] | None = None,
    length_unit: str = "m",
) -> QualityReport:
    """Return `quality_report` of a mesh; raise if no finite-element solver can use the mesh.

    Raises:
        MeshError: A volume is not above 0, neighbours do not share whole faces, a node belongs to no tetrahedron, two
            nodes are at one place, or the boundary is not closed; or what `quality_report` raises.
    """
    report = quality_report(mesh, boundary_mode, observed_range_c, length_unit)
    for criterion in report.criteria[:3]:
        if not criterion.kept:
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
    """Return the figures of a mesh and its results by the quality criteria; no error is raised for an unmet criterion.

    Args:
        mesh: The mesh, damaged or not.
        boundary_mode: How the boundary of the mesh was made.
        observed_range_c: Lowest and highest observed temperature, [degrees Celsius]; if left out, the range of the
            observed nodes, or of all nodes if none was observed.
        length_unit: Unit of length of the nodes' positions.

    Raises:
        MeshError: The arrays do not fit each other or are not finite, see `TetMesh.check`.
    """
    mesh.check()
    points, tets, temperature = mesh.points_m, mesh.tets, mesh.temperature_c
    if not mesh.has_temperatures:
        temperature = np.zeros(len(points))
    observed_c = temperature[mesh.observed] if mesh.observed.any() else temperature
    low_c, high_c = observed_range_c or (float(observed_c.min()), float(observed_c.max()))
    figures, volumes = _measure_shapes(mesh)
    ends = tets[:, TET_EDGES].reshape(-1, 2).T
    place = np.minimum(*ends), np.maximum(*ends)
    links = sparse.coo_array((np.ones(len(place[0])), place), (len(points),) * 2).tocsr()
    edges = links.tocoo()
    lengths = np.linalg.norm(points[edges.row] - points[edges.col], axis=1)
    faces, sides = group_faces(tets), group_sides(mesh.facets)
    areas, cavity = facet_areas(points, mesh.facets), surface_components(points, mesh.facets, sides)
    unused = len(points) - np.count_nonzero(np.bincount(tets.ravel()))
    mismatches = int(np.count_nonzero(faces.sizes > 2)) + count_overlaps(points, mesh.facets, sides)
    criteria = _criteria(
        boundary_mode,
        figures,
        float(volumes.min()),
        int(np.count_nonzero(~(volumes > 0.0))),
        length_unit,
        mismatches=mismatches + count_twin_nodes(points) + unused,
        wrong_facets=count_wrong_facets(mesh, faces),
        excess_k=float(max(low_c - temperature.min(), temperature.max() - high_c, 0.0)),
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
        edge_length_m=(float(lengths.min()), float(lengths.mean()), float(lengths.max())),
        **figures,
        # Nodes without a tetrahedron do not count as bodies.
        bodies_by_node=int(connected_components(links, directed=False)[0]) - unused,
        bodies_by_face=int(component_of(len(tets), *(rows // 4 for rows in faces.pairs())).max()) + 1,
        num_components=len(cavity),
        num_cavities=int(np.count_nonzero(cavity)),
        num_non_manifold_edges=int(np.count_nonzero(sides.sizes > 2)),
        criteria=criteria,
    )


def _criteria(
    mode: BoundaryMode,
    figures: dict[str, Any],
    smallest_m3: float,
    turned: int,
    unit: str,
    *,
    mismatches: int,
    wrong_facets: int,
    excess_k: float,
) -> tuple[Criterion, ...]:
    """Return all criteria of a boundary mode; `turned` counts tetrahedra whose volume is not above 0."""
    (smallest, largest), (low, high) = figures["dihedral_range_deg"], DIHEDRAL_BOUNDS_DEG[mode]
    inside = min(smallest - low, high - largest)
    obtuse, warm = figures["share_obtuse"], excess_k > TEMPERATURE_TOLERANCE_K
    smallest_volume = f"{turned:,} at or below 0" if turned else f"smallest {smallest_m3:.3g} {unit}³"
    found = (
        (turned == 0, smallest_m3, smallest_volume),
        (mismatches == 0, float(mismatches), f"{mismatches:,} mismatches"),
        (wrong_facets == 0, float(wrong_facets), f"{wrong_facets:,} triangles wrong or missing"),
        (inside >= -ANGLE_TOLERANCE_DEG, inside, f"{smallest:.2f}° to {largest:.2f}°"),
        (not warm, excess_k, f"{excess_k:.2g} K outside" if warm else "none outside"),
        (obtuse == 0.0, obtuse, f"{in_percent(obtuse)} of tetrahedra obtuse"),
    )
    criteria = (Criterion(name, text.format(low, high), *one) for (name, text), one in zip(_CRITERIA.items(), found))
    return tuple(criteria)[: None if mode == "voxel" else 5]


def _measure_shapes(mesh: TetMesh) -> tuple[dict[str, Any], FloatArray]:
    """Return the shape figures by their names in `QualityReport`, and the volumes, shape (t,)."""
    num = len(mesh.tets)
    volumes = np.empty(num)
    angle_counts = np.zeros(len(ANGLE_EDGES_DEG) - 1, dtype=np.int64)
    smallest, largest, obtuse = 180.0, 0.0, 0
    for which, shapes in shapes_in_chunks(mesh.points_m, mesh.tets):
        cosines = shapes.dihedral_cosines()
        angles = np.degrees(np.arccos(cosines))
        angle_counts += np.histogram(angles, len(angle_counts), (0.0, 180.0))[0]
        smallest, largest = min(smallest, float(angles.min())), max(largest, float(angles.max()))
        obtuse += int(np.count_nonzero(cosines.min(axis=0) < 0.0))
        volumes[which] = shapes.volumes
    figures = {
        "volume_m3": float(volumes.sum()),
        "share_obtuse": obtuse / num,
        "dihedral_range_deg": (smallest, largest),
        "dihedral_counts": tuple(angle_counts.tolist()),
    }
    return figures, volumes


def picture_of_quality(path: Path | str, report: QualityReport) -> None:
    """Draw a report as a PNG file: a histogram of the angles above, figures and criteria below."""
    from matplotlib.figure import Figure

    path = Path(path)
    figure = Figure(figsize=(12.5, 9.0), dpi=110, facecolor="white", layout="constrained")
    title = f"Mesh quality, {report.boundary_mode} boundary: {report.num_tets:,} tetrahedra"
    figure.suptitle(title, fontsize=14, color=_INK)
    grid = figure.add_gridspec(2, 2, height_ratios=(1.0, 1.05))
    angles, figures, criteria = (figure.add_subplot(grid[place]) for place in ((0, slice(None)), (1, 0), (1, 1)))

    edges, counts = ANGLE_EDGES_DEG, report.dihedral_counts
    angles.bar(edges[:-1], counts, np.diff(edges), align="edge", color=_BARS, edgecolor="white", linewidth=0.6)
    # The axis is logarithmic, because a solver stumbles over the few worst tetrahedra.
    angles.set(yscale="log", ylim=(0.7, 4.0 * max(counts)), axisbelow=True)
    angles.grid(axis="y", alpha=0.3)
    angles.spines[["top", "right"]].set_visible(False)
    for bound, side, shift in zip(DIHEDRAL_BOUNDS_DEG[report.boundary_mode], ("left", "right"), (4, -4)):
        angles.axvline(bound, color=_BOUND, linestyle="--", linewidth=1.3)
        place = {"xycoords": angles.get_xaxis_transform(), "textcoords": "offset points"}
        text = angles.annotate(f"{bound:g}°", (bound, 0.97), (shift, 0), **place)
        text.set(ha=side, va="top", color=_BOUND, fontsize=10)
    smallest, largest = report.dihedral_range_deg
    angles.set(xlim=(0.0, 180.0), xticks=range(0, 181, 30), ylabel="angles")
    angles.set_xlabel(f"angle between two faces of a tetrahedron [degrees]; found {smallest:.1f} to {largest:.1f}")
    angles.set_title("Dihedral angles, and their bounds", fontsize=11)

    _write(figures, 0.0, 0.98, "Figures", _INK, size=12.0, weight="bold")
    for number, (name, value) in enumerate(_figures(report).items()):
        _write(figures, 0.0, 0.89 - 0.07 * number, name, _PALE)
        _write(figures, 0.55, 0.89 - 0.07 * number, value, _INK)
    met = len(report.criteria) - len(report.unmet)
    heading = f"Criteria of a {report.boundary_mode} boundary: {met} of {len(report.criteria)} met"
    _write(criteria, 0.0, 0.98, heading, _INK, size=12.0, weight="bold")
    for number, criterion in enumerate(report.criteria):
        y = 0.89 - 0.113 * number
        _write(criteria, 0.0, y, *(("yes", "#2a7f3f") if criterion.kept else ("no", "#b3261e")), weight="bold")
        _write(criteria, 0.07, y, criterion.name.replace("_", " "), _INK)
        _write(criteria, 0.48, y, criterion.found, _INK)
        _write(criteria, 0.07, y - 0.048, criterion.sentence, _PALE, size=8.0)
    with replace_when_done(writable_folder(path.parent) / path.name) as temporary:
        figure.savefig(temporary)


_BARS, _BOUND, _INK, _PALE = "#4a78b0", "#b8571b", "#202020", "#606060"


def _write(axis: Axes, x: float, y: float, words: str, colour: str, size: float = 10.0, weight: str = "normal") -> None:
    """Write a line of text that takes no room from the histograms, however long the line is."""
    axis.set_axis_off()
    line = axis.text(x, y, words, fontsize=size, weight=weight, color=colour, va="top", transform=axis.transAxes)
    line.set_in_layout(False)


def _figures(report: QualityReport) -> dict[str, str]:
    """Return the figures shown in the picture as text, by their captions."""
    unit = report.length_unit
    shortest, mean, longest = report.edge_length_m
    return {
        "nodes, tetrahedra": f"{report.num_nodes:,}, {report.num_tets:,}",
        "boundary triangles": f"{report.num_facets:,} ({report.num_box_facets:,} cut by the box or the region)",
        "volume": f"{report.volume_m3:.6g} {unit}³",
        "area": f"{report.area_m2:.6g} {unit}²",
        "edge length: shortest, mean, longest": f"{shortest:.4g}, {mean:.4g}, {longest:.4g} {unit}",
        "bodies: sharing faces; sharing nodes": f"{report.bodies_by_face:,}; {report.bodies_by_node:,}",
        "boundary components; cavities": f"{report.num_components:,}; {report.num_cavities:,}",
        "edges where the boundary touches itself": f"{report.num_non_manifold_edges:,}",
        "tetrahedra with an obtuse angle": in_percent(report.share_obtuse),
    }
