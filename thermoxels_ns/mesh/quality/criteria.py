"""Quality criteria of a mesh, each with the figure that decides whether it is met."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

BoundaryMode = Literal["voxel", "conforming"]  # how the boundary was made: of voxel faces, or along the level set

DIHEDRAL_BOUNDS_DEG: dict[BoundaryMode, tuple[float, float]] = {"voxel": (45.0, 90.0), "conforming": (10.7, 164.8)}
"""Bounds of the angles between two faces of a tetrahedron, [degrees]: six equal tetrahedra per voxel have angles of 45,
60 and 90 degrees; for isosurface stuffing see Labelle and Shewchuk (2007)."""
ANGLE_TOLERANCE_DEG = 1e-6  # what rounding may add to an angle, [degrees]
_BINS_WITHIN_BOUNDS: dict[BoundaryMode, int] = {"voxel": 10, "conforming": 30}
TEMPERATURE_TOLERANCE_K = 1e-6  # what rounding may add to a temperature, [K]


SOLVABLE = ("volumes_positive", "conforming", "boundary_closed")  # criteria without which no solver takes a mesh


@dataclass(frozen=True)
class Criterion:
    """One quality criterion, and whether a mesh meets it."""

    name: str  # short name, the same for every mesh
    sentence: str  # what it asks for
    kept: bool  # whether the mesh meets it
    figure: float  # the number that decides
    found: str  # the number in words


@dataclass(frozen=True)
class Figures:
    """Figures that decide about the criteria."""

    min_volume_m3: float  # smallest signed volume of a tetrahedron, [m^3]
    num_non_positive: int  # tetrahedra whose volume is not above 0
    num_mismatches: int
    """Faces with more than two owners, pairs of boundary triangles upon each other, nodes at one place or in none."""
    num_open_edges: int  # edges that the boundary's triangles do not pass equally often in both directions
    num_wrong_facets: int  # boundary triangles that are missing, too many or turned over
    dihedral_range_deg: tuple[float, float]  # smallest and largest angle between two faces of a tetrahedron, [degrees]
    temperature_excess_k: float
    """How far the hottest or coldest node lies outside the observed range, [K]; 0 or less if inside."""
    share_obtuse: float  # share of tetrahedra with an obtuse angle between two faces, 0 to 1
    share_positive_edges: float  # share of edges whose entry of the stiffness matrix is positive, 0 to 1
    angle_rounding_deg: float = 0.0  # how far rounding of nodes far from the origin may have turned angles, [degrees]


@dataclass(frozen=True)
class AngleBins:
    """Bins of one width for a histogram of angles from 0 to 180 degrees; both bounds of the criterion are edges."""

    first_centre_deg: float  # centre of the first bin, [degrees]; the bin may begin below 0
    width_deg: float  # width of each, [degrees]
    number: int  # how many; the last may end above 180


def angle_bins(boundary_mode: BoundaryMode) -> AngleBins:
    """Choose bins about 5 degrees wide such that none lies on both sides of a bound, and rounding crosses none.

    >>> bins = angle_bins("voxel")
    >>> round(bins.width_deg, 3), bins.number
    (4.5, 40)
    """
    low, high = DIHEDRAL_BOUNDS_DEG[boundary_mode]
    low, high = low - ANGLE_TOLERANCE_DEG, high + ANGLE_TOLERANCE_DEG
    within = _BINS_WITHIN_BOUNDS[boundary_mode]
    width = (high - low) / within
    below, above = math.ceil(low / width), math.ceil((180.0 - high) / width)
    return AngleBins(low - (below - 0.5) * width, width, below + within + above)


def judge(figures: Figures, boundary_mode: BoundaryMode, length_unit: str = "m") -> tuple[Criterion, ...]:
    """Hold a mesh's figures against the criteria of its boundary mode; the unit of lengths is only named.

    Criteria on obtuse angles are for voxel meshes alone: no cut along a level set can meet them. None asks that a
    boundary nowhere touches itself, because bodies may.
    """
    smallest, largest = figures.dihedral_range_deg
    low, high = DIHEDRAL_BOUNDS_DEG[boundary_mode]
    inside = min(smallest - low, high - largest)
    open_or_wrong = figures.num_open_edges + figures.num_wrong_facets
    excess = max(figures.temperature_excess_k, 0.0)
    worst_volume = f"smallest {figures.min_volume_m3:.3g} {length_unit}³"
    criteria = (
        Criterion(
            "volumes_positive",
            "Every tetrahedron has a volume above 0.",
            figures.num_non_positive == 0,
            figures.min_volume_m3,
            f"{figures.num_non_positive:,} at or below 0" if figures.num_non_positive else worst_volume,
        ),
        Criterion(
            "conforming",
            "Neighbours share whole faces: no crack, no face with three owners, no twin or unused node.",
            figures.num_mismatches == 0,
            float(figures.num_mismatches),
            f"{figures.num_mismatches:,} mismatches",
        ),
        Criterion(
            "boundary_closed",
            "The boundary is closed: just the faces with one owner, normals outwards.",
            open_or_wrong == 0,
            float(open_or_wrong),
            f"{figures.num_open_edges:,} open edges, {figures.num_wrong_facets:,} triangles wrong",
        ),
        Criterion(
            "dihedral_within_bounds",
            f"Angles between two faces of a tetrahedron lie within {low:g} to {high:g} degrees.",
            inside >= -(ANGLE_TOLERANCE_DEG + figures.angle_rounding_deg),
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
            figures.share_obtuse == 0.0,
            figures.share_obtuse,
            f"{in_percent(figures.share_obtuse)} of tetrahedra obtuse",
        ),
        Criterion(
            "stiffness_monotone",
            "No stiffness entry of an edge is positive: all that the maximum principle needs.",
            figures.share_positive_edges == 0.0,
            figures.share_positive_edges,
            f"{in_percent(figures.share_positive_edges)} of edges positive",
        ),
    )
    return criteria if boundary_mode == "voxel" else criteria[:5]


def in_percent(share: float) -> str:
    """A share in percent that does not look like none, or all, unless it is."""
    if share in (0.0, 1.0):
        return f"{100 * share:.0f} %"
    return "< 0.01 %" if share < 1e-4 else f"{min(100.0 * share, 99.99):.2f} %"
