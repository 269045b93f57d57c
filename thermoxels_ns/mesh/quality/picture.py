"""One picture of a mesh's quality: angles, radius ratios, figures and criteria."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.checks import replace_when_done, writable_folder
from thermoxels_ns.core.errors import OutputError
from thermoxels_ns.mesh.quality.report import (
    DIHEDRAL_BOUNDS_DEG,
    RATIO_EDGES,
    QualityReport,
    angle_edges,
    in_percent,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_BARS, _BOUND, _INK, _PALE = "#4a78b0", "#b8571b", "#202020", "#606060"
_MET, _UNMET = "#2a7f3f", "#b3261e"


def picture_of_quality(path: Path | str, report: QualityReport) -> None:
    """Draw the report as a PNG: two histograms above, figures and criteria below."""
    from matplotlib.figure import Figure

    path = Path(path)
    if path.suffix != ".png":
        raise OutputError("picture", expected="a name that ends in .png", got=path.name, remedy="Rename the file.")
    # Counts are on a logarithmic axis, because a solver stumbles over the few worst tetrahedra.
    figure = Figure(figsize=(12.5, 9.0), dpi=110, facecolor="white", layout="constrained")
    title = f"Mesh quality, {report.boundary_mode} boundary: {report.num_tets:,} tetrahedra"
    figure.suptitle(title, fontsize=14, color=_INK)
    grid = figure.add_gridspec(2, 2, height_ratios=(1.0, 1.05))
    _draw_angles(figure.add_subplot(grid[0, 0]), report)
    _draw_ratios(figure.add_subplot(grid[0, 1]), report)
    sizes, criteria = figure.add_subplot(grid[1, 0]), figure.add_subplot(grid[1, 1])
    _write(sizes, 0.0, 0.98, "Figures", _INK, size=12.0, bold=True)
    for number, (name, value) in enumerate(_size_lines(report)):
        y = 0.89 - 0.07 * number
        _write(sizes, 0.0, y, name, _PALE)
        _write(sizes, 0.55, y, value, _INK)
    _write_criteria(criteria, report)
    for axis in (sizes, criteria):
        axis.set_axis_off()
    folder = writable_folder(path.parent)
    with replace_when_done(folder / path.name) as temporary:
        figure.savefig(temporary)


def _draw_angles(axis: Axes, report: QualityReport) -> None:
    low, high = DIHEDRAL_BOUNDS_DEG[report.boundary_mode]
    _draw_bars(axis, report.dihedral_counts, angle_edges(report.boundary_mode))
    across = axis.get_xaxis_transform()
    for bound, side, shift in ((low, "left", 4), (high, "right", -4)):
        axis.axvline(bound, color=_BOUND, linestyle="--", linewidth=1.3)
        text = axis.annotate(f"{bound:g}°", (bound, 0.97), (shift, 0), xycoords=across, textcoords="offset points")
        text.set(ha=side, va="top", color=_BOUND, fontsize=10)
    smallest, largest = report.dihedral_range_deg
    axis.set_xlim(0.0, 180.0)
    axis.set_xticks(range(0, 181, 30))
    axis.set_xlabel(f"angle between two faces of a tetrahedron [degrees]; found {smallest:.1f} to {largest:.1f}")
    axis.set_ylabel("angles")
    axis.set_title("Dihedral angles, and their bounds", fontsize=11)


def _draw_ratios(axis: Axes, report: QualityReport) -> None:
    _draw_bars(axis, report.radius_ratio_counts, RATIO_EDGES)
    axis.axvline(report.radius_ratio_mean, color=_PALE, linestyle=":", linewidth=1.3)
    worst, _ = report.radius_ratio_range
    axis.set_xlim(0.0, 1.0)
    axis.set_xlabel(f"3 r / R (1: regular, 0: flat); worst {worst:.3f}, mean {report.radius_ratio_mean:.3f} (dotted)")
    axis.set_ylabel("tetrahedra")
    axis.set_title("Inscribed over circumscribed radius", fontsize=11)


def _draw_bars(axis: Axes, counts: tuple[int, ...], edges: FloatArray) -> None:
    axis.bar(edges[:-1], counts, np.diff(edges), align="edge", color=_BARS, edgecolor="white", linewidth=0.6)
    axis.set_yscale("log")
    axis.set_ylim(0.7, 4.0 * max(counts))
    axis.grid(axis="y", alpha=0.3)
    axis.set_axisbelow(True)
    for side in ("top", "right"):
        axis.spines[side].set_visible(False)


def _size_lines(report: QualityReport) -> list[tuple[str, str]]:
    """Names and values of the figures that a person asks for first."""
    unit = report.length_unit
    shortest, mean, longest = report.edge_length_m
    pinched = report.num_non_manifold_edges, report.num_non_manifold_vertices
    true_area = "not known" if report.true_area_m2 is None else f"{report.true_area_m2:.6g} {unit}²"
    return [
        ("nodes, tetrahedra", f"{report.num_nodes:,}, {report.num_tets:,}"),
        ("boundary triangles", f"{report.num_facets:,} ({report.num_box_facets:,} cut by the box or the region)"),
        ("volume", f"{report.volume_m3:.6g} {unit}³"),
        ("area of triangles", f"{report.area_m2:.6g} {unit}²"),
        ("area of the surface they stand for", true_area),
        ("edge length: shortest, mean, longest", f"{shortest:.4g}, {mean:.4g}, {longest:.4g} {unit}"),
        ("bodies: sharing faces; sharing nodes", f"{report.bodies_by_face:,}; {report.bodies_by_node:,}"),
        ("boundary components; cavities", f"{len(report.components):,}; {report.num_cavities:,}"),
        ("genus (handles)", "none: not a manifold" if report.genus is None else f"{report.genus:,}"),
        ("Euler characteristic of the boundary", f"{report.euler_characteristic:,}"),
        ("edges, points where it touches itself", f"{pinched[0]:,}, {pinched[1]:,}"),
        ("tetrahedra with an obtuse angle", in_percent(report.share_obtuse)),
        ("edges with a positive stiffness entry", in_percent(report.share_positive_edges)),
    ]


def _write_criteria(axis: Axes, report: QualityReport) -> None:
    met = len(report.criteria) - len(report.unmet)
    heading = f"Criteria of a {report.boundary_mode} boundary: {met} of {len(report.criteria)} met"
    _write(axis, 0.0, 0.98, heading, _INK, size=12.0, bold=True)
    for number, criterion in enumerate(report.criteria):
        y = 0.89 - 0.113 * number
        _write(axis, 0.0, y, *(("yes", _MET) if criterion.kept else ("no", _UNMET)), bold=True)
        _write(axis, 0.07, y, criterion.name.replace("_", " "), _INK)
        _write(axis, 0.48, y, criterion.found, _INK)
        _write(axis, 0.07, y - 0.048, criterion.sentence, _PALE, size=8.0)


def _write(axis: Axes, x: float, y: float, words: str, colour: str, size: float = 10.0, bold: bool = False) -> None:
    """Write a line; it takes no room away from the histograms, however long it is."""
    weight = "bold" if bold else "normal"
    line = axis.text(x, y, words, fontsize=size, weight=weight, color=colour, va="top", transform=axis.transAxes)
    line.set_in_layout(False)
