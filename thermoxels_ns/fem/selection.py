"""Choice of the patches and regions on which effects act, by name, and places on and in them."""

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
    """The k places at which a quantity is evaluated: centroids of boundary triangles, points in tetrahedra, nodes."""

    points_m: FloatArray  # Positions, shape (k, 3), [m]
    normals: FloatArray  # Outward unit normals of the surface, shape (k, 3); 0 in tetrahedra and at nodes
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)  # Unit vector that points up

    def __len__(self) -> int:
        return len(self.points_m)


class Selection:
    """The patches and regions of a mesh, by name, and the geometry of its f boundary triangles."""

    def __init__(self, mesh: TetMesh, up: tuple[float, float, float] = (0.0, 0.0, 1.0)) -> None:
        """Keep a mesh, for which `TetMesh.check` must have passed; `up` is the unit vector for `Places.up`."""
        self.mesh, self.up = mesh, up
        self.patch_names: tuple[str, ...] = mesh.boundary.patch_names  # Names of the patches
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
        """Return the numbers of the triangles of matching patches; raise `HeatError` if a pattern matches none."""
        chosen = np.isin(self.patch_names, [*chosen_names("patches", self.patch_names, patterns)])
        return np.flatnonzero(chosen[self.facet_patch])

    def tets(self, patterns: tuple[str, ...]) -> IntArray:
        """Return the numbers of the tetrahedra of matching regions; raise `HeatError` if a pattern matches none."""
        names = self.mesh.region_names
        chosen = np.isin(names, [*chosen_names("regions", names, patterns, "regions")])
        return np.flatnonzero(chosen[self.mesh.region])

    def facet_places(self, facets: IntArray) -> Places:
        """Return the centroids of the boundary triangles with the numbers `facets`, with outward normals."""
        centroids = self.mesh.points_m[self.mesh.facets[facets]].mean(axis=1)
        return Places(centroids, self.facet_normal[facets], self.up)


def matching_names(names: Collection[str], pattern: str) -> list[str]:
    """Return the names that match a pattern; a pattern without `*`, `?` and `[` matches only the equal name.

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
    """Return the `names` that match at least one pattern; raise `error` about the entry `name` if one matches none. The
    message calls the names `what`."""
    chosen = set[str]()
    for pattern in patterns:
        found = matching_names(names, pattern)
        if not found:
            remedy = f"Correct the name; {what} are those of the mesh, see --patches of ns-export thermoxels-mesh."
            raise error(name, expected=f"{what} out of {', '.join(names)}", got=repr(pattern), remedy=remedy)
        chosen |= set(found)
    return chosen
