"""Where effects act: named patches of the boundary, regions of the body, and places on and in them."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cached_property

import numpy as np

from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.core.errors import HeatError, ThermoxelsError
from thermoxels_ns.mesh.tetrahedra import TetMesh, facet_areas, facet_normals


@dataclass(frozen=True)
class Places:
    """The k places where a quantity is evaluated: centroids of boundary triangles, points in tetrahedra, or nodes."""

    points_m: FloatArray  # Positions, shape (k, 3), [m]
    normals: FloatArray  # Outward unit normals of the surface, shape (k, 3); 0 in tetrahedra and at nodes
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)  # Unit vector that points up

    def __len__(self) -> int:
        return len(self.points_m)


class Selection:
    """A mesh's patches and regions, which effects name, and the geometry of its f boundary triangles."""

    def __init__(self, mesh: TetMesh, up: tuple[float, float, float] = (0.0, 0.0, 1.0)) -> None:
        """Take a mesh that `TetMesh.check` accepts; `up` is the unit vector for `Places.up`."""
        self.mesh, self.up = mesh, up
        self.patch_names: tuple[str, ...] = mesh.boundary.patch_names
        """Names of the patches."""
        self.facet_patch: IntArray = mesh.boundary.patch
        """Patch of each boundary triangle, as an index into `patch_names`, shape (f,)."""

    @cached_property
    def facet_area_m2(self) -> FloatArray:
        """Area of each boundary triangle, shape (f,), [m2]; computed when first asked for."""
        return facet_areas(self.mesh.points_m, self.mesh.facets)

    @cached_property
    def patch_area_m2(self) -> dict[str, float]:
        """Area of each patch by its name, [m2]; computed when first asked for."""
        area_m2 = np.bincount(self.facet_patch, self.facet_area_m2, len(self.patch_names))
        return dict(zip(self.patch_names, area_m2.tolist()))

    @cached_property
    def facet_normal(self) -> FloatArray:
        """Outward unit normal of each boundary triangle, shape (f, 3); computed when first asked for."""
        return facet_normals(self.mesh.points_m, self.mesh.facets)

    def facets(self, patterns: tuple[str, ...]) -> IntArray:
        """Return the numbers of the triangles of patches that match a pattern; `HeatError` if a pattern fits none."""
        chosen = np.isin(self.patch_names, [*chosen_names("patches", self.patch_names, patterns)])
        return np.flatnonzero(chosen[self.facet_patch])

    def tets(self, patterns: tuple[str, ...]) -> IntArray:
        """Return the numbers of the tetrahedra of regions that match a pattern; `HeatError` if a pattern fits none."""
        names = self.mesh.region_names
        chosen = np.isin(names, [*chosen_names("regions", names, patterns, "regions")])
        return np.flatnonzero(chosen[self.mesh.region])

    def facet_places(self, facets: IntArray) -> Places:
        """Return the centroids of boundary triangles as places with outward normals."""
        centroids = self.mesh.points_m[self.mesh.facets[facets]].mean(axis=1)
        return Places(centroids, self.facet_normal[facets], self.up)


def matching_names(names: Collection[str], pattern: str) -> list[str]:
    """Return the names that match a pattern; without `*`, `?` and `[` the pattern matches only the name equal to it.

    >>> [matching_names(["wall-7", "wall"], pattern) for pattern in ("wall-7", "wall*", "Wall")]
    [['wall-7'], ['wall-7', 'wall'], []]
    """
    if any(sign in pattern for sign in "*?["):
        return [name for name in names if fnmatchcase(name, pattern)]
    return [pattern] if pattern in names else []


def chosen_names(
    name: str,
    names: Collection[str],
    patterns: Iterable[str],
    what: str = "patches",
    error: type[ThermoxelsError] = HeatError,
) -> set[str]:
    """Return those of `names` that match a pattern; raises an `error` about entry `name` if a pattern has no match."""
    chosen = set[str]()
    for pattern in patterns:
        found = matching_names(names, pattern)
        if not found:
            remedy = f"Correct the name; {what} are those of the mesh, see --patches of ns-export thermoxels-mesh."
            raise error(name, expected=f"{what} out of {', '.join(names)}", got=repr(pattern), remedy=remedy)
        chosen |= set(found)
    return chosen
