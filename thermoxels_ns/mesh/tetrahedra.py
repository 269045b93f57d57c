"""The tetrahedral mesh and its boundary tags, as the heat solver and the file writers use them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from thermoxels_ns.core.checks import check_array
from thermoxels_ns.core.errors import MeshError

FACET_SURFACE = 0  # boundary between solid and empty space
FACET_BOX = 1  # boundary where the scene box, or the region of an export, cuts the solid
SUPPORT = {
    "supported": "three photographs or more",
    "weak": "one or two photographs",
    "smooth": "seen, but placed by smoothness alone",
    "filled": "seen by no photograph",
}
"""Classes of boundary triangles by their photographs, see `Boundary.photographs`, with a description of each."""


@dataclass(frozen=True)
class Boundary:
    """Tags of the boundary triangles, in the order of `TetMesh.facets`."""

    seen: BoolArray  # True where some training camera has a free line of sight to the triangle, shape (f,)
    patch: IntArray  # patch of each triangle, an index into `patch_names`, shape (f,)
    patch_names: tuple[str, ...]  # names of the patches, all different; some may have no triangle
    photographs: IntArray | None = None
    """Number of training photographs that see each triangle, and number of these that support it, shape (f, 2). A
    photograph supports a triangle if texture and parallax, or tracks, show the surface there. None: not compared."""


@dataclass(frozen=True)
class TetMesh:
    """A conforming tetrahedral mesh with nodal temperatures, regions and a tagged boundary; lengths in metres."""

    points_m: FloatArray  # nodes, shape (n, 3), [m]
    tets: IntArray  # node indices, shape (t, 4), positively oriented: det(p1 - p0, p2 - p0, p3 - p0) > 0
    temperature_c: FloatArray  # nodal temperature, shape (n,), [degrees Celsius]; NaN everywhere if not known
    observed: BoolArray
    """True for nodes whose temperature thermal rays measured, shape (n,); others have a harmonic extension."""
    facets: IntArray  # boundary triangles, shape (f, 3), oriented so that the right-hand normal points out of the body
    facet_tags: IntArray  # `FACET_SURFACE` or `FACET_BOX` for each boundary triangle, shape (f,)
    region: IntArray  # region of each tetrahedron, an index into `region_names`, shape (t,)
    region_names: tuple[str, ...] = ("solid",)  # names of the regions, all different
    boundary: Boundary = None  # type: ignore[assignment]
    """Tags of the boundary triangles. By default all triangles are seen and belong to one patch, "boundary"."""
    colour: Float32Array | None = None
    """Colour of each node, red, green, blue in [0, 1], shape (n, 3); None if colours are not known."""

    def __post_init__(self) -> None:
        if self.boundary is None:
            count = len(self.facets)
            whole = Boundary(np.ones(count, dtype=bool), np.zeros(count, dtype=np.int64), ("boundary",))
            object.__setattr__(self, "boundary", whole)

    @property
    def has_temperatures(self) -> bool:
        """False if no temperature is known, as after a training on photographs alone."""
        return not bool(np.isnan(self.temperature_c).all())

    def check(self, name: str = "mesh", remedy: str = "Build the mesh with thermoxels_ns.mesh.build.") -> None:
        """Check that the arrays fit each other; `quality.checks.check_mesh` checks the geometry.

        Messages begin with `name` and end with `remedy`.

        Raises:
            MeshError: An array has a shape that does not fit the others, is not finite or has an index out of range;
                there is no tetrahedron; or names of patches or regions are missing, equal or not printable.
        """
        nodes, tets, facets, tags = len(self.points_m), len(self.tets), len(self.facets), self.boundary
        arrays: list[tuple[str, npt.NDArray, tuple[int | None, ...], int | None]] = [
            ("points_m", self.points_m, (None, 3), None),
            ("tets", self.tets, (None, 4), nodes),
            ("temperature_c", self.temperature_c if self.has_temperatures else np.zeros(nodes), (nodes,), None),
            ("observed", self.observed, (nodes,), None),
            ("facets", self.facets, (None, 3), nodes),
            ("facet_tags", self.facet_tags, (facets,), None),
            ("region", self.region, (tets,), len(self.region_names)),
            ("boundary.seen", tags.seen, (facets,), None),
            ("boundary.patch", tags.patch, (facets,), len(tags.patch_names)),
        ]
        names = {"region_names": self.region_names, "boundary.patch_names": tags.patch_names}
        if self.colour is not None:
            arrays.append(("colour", self.colour, (nodes, 3), None))
        if tags.photographs is not None:
            arrays.append(("boundary.photographs", tags.photographs, (facets, 2), None))
        if tets == 0:
            raise MeshError(f"{name} tets", expected="at least one tetrahedron", got="none", remedy=remedy)
        for what, entries in names.items():
            good = all(isinstance(one, str) and one.strip() and one.isprintable() and '"' not in one for one in entries)
            if not good or not entries or len(set(entries)) != len(entries):
                expected = "at least one name, all different, of printable characters without a double quote"
                raise MeshError(f"{name} {what}", expected=expected, got=list(entries), remedy="Rename them.")
        for what, array, shape, below in arrays:
            values = check_array(f"{name} {what}", np.asarray(array), shape, remedy, MeshError)
            low, high = (values.min(), values.max()) if values.size else (0, -1)
            if below is not None and not (np.issubdtype(values.dtype, np.integer) and low >= 0 and high < below):
                expected, got = f"whole numbers from 0 to {below - 1}", f"{low} to {high} ({values.dtype})"
                raise MeshError(f"{name} {what}", expected=expected, got=got, remedy=remedy)


def support_of_facets(mesh: TetMesh) -> IntArray | None:
    """Return each boundary triangle's class, an index into `SUPPORT` or -1 for `FACET_BOX` triangles, shape (f,).

    The result is None if photographs were not compared.
    """
    if mesh.boundary.photographs is None:
        return None
    seen, supporting = mesh.boundary.photographs.T
    on_box = mesh.facet_tags == FACET_BOX
    return np.select([on_box, supporting >= 3, supporting > 0, seen > 0], [-1, 0, 1, 2], default=3)


def facet_area_vectors(points: FloatArray, facets: IntArray) -> FloatArray:
    """Return for each triangle its unit normal (right-hand rule) times its area, shape (f, 3), [m^2]."""
    origin = points[facets[:, 0]]
    return 0.5 * np.cross(points[facets[:, 1]] - origin, points[facets[:, 2]] - origin)


def facet_areas(points: FloatArray, facets: IntArray) -> FloatArray:
    """Return the area of each triangle, shape (f,), [m^2]."""
    return np.linalg.norm(facet_area_vectors(points, facets), axis=1)


def facet_normals(points: FloatArray, facets: IntArray) -> FloatArray:
    """Return the unit normal of each triangle (right-hand rule), shape (f, 3); 0 for a triangle without area."""
    vectors = facet_area_vectors(points, facets)
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0.0, length, 1.0)


def nodes_and_triangles(facets: IntArray) -> tuple[IntArray, IntArray]:
    """Return the nodes that triangles (f, 3) use, (m,), ascending, and the triangles as indices into these, (f, 3).

    >>> nodes_and_triangles(np.array([[3, 0, 2]]))[1].tolist()
    [[2, 0, 1]]
    """
    nodes, triangles = np.unique(facets, return_inverse=True)
    return nodes, triangles.reshape(-1, 3)
