"""The tetrahedral mesh that the heat solver and the file writers get."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from thermoxels_ns.core.checks import check_finite, check_shape
from thermoxels_ns.core.errors import MeshError

FACET_SURFACE = 0  # boundary between solid and empty space
FACET_BOX = 1  # boundary where the scene box or the region of an export cuts the solid
SUPPORT = {
    "supported": "three photographs or more",
    "weak": "one or two photographs",
    "smooth": "seen, but placed by smoothness alone",
    "filled": "seen by no photograph",
}
"""Classes of boundary triangles by the photographs that support them, see `Boundary.photographs`."""

_REMEDY = "Build the mesh with thermoxels_ns.mesh.build."


@dataclass(frozen=True)
class Boundary:
    """What physics needs to know of every boundary triangle, in the order of `TetMesh.facets`."""

    normal: FloatArray
    """Outward unit normal of the true surface, shape (f, 3). On a staircase of voxel faces it is not that of the
    triangle."""
    area_factor: FloatArray
    """Area of true surface that a triangle stands for, over its own area, shape (f,), above 0; 1 where the mesh follows
    the surface."""
    seen: BoolArray  # True where some training camera has a free line of sight to the triangle, shape (f,)
    patch: IntArray  # index into `patch_names`, shape (f,)
    patch_names: tuple[str, ...]  # names of the patches, all different; some may have no triangle
    photographs: IntArray | None = None
    """Training photographs that see each triangle, and those of them that support it: by texture and parallax, or by
    tracks, they say that the surface lies there. Shape (f, 2); None: not known."""


@dataclass(frozen=True)
class TetMesh:
    """A conforming tetrahedral mesh with nodal temperatures, in metres."""

    points_m: FloatArray  # nodes, shape (n, 3), [m]
    tets: IntArray  # node indices, shape (t, 4), positively oriented: det(p1 - p0, p2 - p0, p3 - p0) > 0
    temperature_c: FloatArray  # nodal temperature, shape (n,), [degrees Celsius]
    observed: BoolArray
    """True where a thermal ray saw the node; elsewhere the temperature is a harmonic extension. Shape (n,)."""
    facets: IntArray  # boundary triangles, shape (f, 3), oriented so that the right-hand normal points out of the body
    facet_tags: IntArray  # one of the `FACET_*` constants per boundary triangle, shape (f,)
    region: IntArray  # region number per tetrahedron, shape (t,); an index into `region_names`
    region_names: tuple[str, ...] = ("solid",)  # names of the regions, all different
    boundary: Boundary | None = None  # tags of the boundary triangles; None for a mesh that was not tagged
    colour: Float32Array | None = None
    """Colour of each node, red, green, blue in [0, 1], shape (n, 3); None if it is not known."""

    def check(self) -> None:
        """Check that the arrays fit each other; whether the tetrahedra do, `quality.report.check_mesh` says.

        Raises:
            MeshError: An array has another shape than the others ask for, is not finite or points at what is not there,
                there is no tetrahedron, or two patches or regions have one name.
        """
        nodes, tets, facets, tags = len(self.points_m), len(self.tets), len(self.facets), self.boundary
        _check_array("points_m", self.points_m, (None, 3))
        _check_array("tets", self.tets, (None, 4), below=nodes)
        _check_array("temperature_c", self.temperature_c, (nodes,))
        _check_array("observed", self.observed, (nodes,))
        _check_array("facets", self.facets, (None, 3), below=nodes)
        _check_array("facet_tags", self.facet_tags, (facets,))
        if tets == 0:
            raise MeshError("mesh tets", expected="at least one tetrahedron", got="none", remedy=_REMEDY)
        _check_names("region_names", self.region_names)
        _check_array("region", self.region, (tets,), below=len(self.region_names))
        if self.colour is not None:
            _check_array("colour", self.colour, (nodes, 3))
        if tags is None:
            return
        _check_array("boundary.normal", tags.normal, (facets, 3))
        _check_array("boundary.area_factor", tags.area_factor, (facets,))
        _check_array("boundary.seen", tags.seen, (facets,))
        _check_names("boundary.patch_names", tags.patch_names)
        _check_array("boundary.patch", tags.patch, (facets,), below=len(tags.patch_names))
        if tags.photographs is not None:
            _check_array("boundary.photographs", tags.photographs, (facets, 2))


def _check_array(name: str, values: npt.NDArray, shape: Sequence[int | None], below: int | None = None) -> None:
    """Check a shape, and finite numbers; with `below` whole numbers from 0 up to it."""
    values = check_shape(f"mesh {name}", np.asarray(values), shape, _REMEDY, MeshError)
    check_finite(f"mesh {name}", values, _REMEDY, MeshError)
    whole = np.issubdtype(values.dtype, np.integer)
    if below is not None and not (whole and (not len(values) or (values.min() >= 0 and values.max() < below))):
        got = f"{values.min()} to {values.max()} ({values.dtype})" if len(values) else f"nothing ({values.dtype})"
        expected = f"whole numbers from 0 to {below - 1}"
        raise MeshError(f"mesh {name}", expected=expected, got=got, remedy=_REMEDY)


def _check_names(name: str, names: Sequence[str]) -> None:
    for entry in names:
        if not (isinstance(entry, str) and entry.strip() and entry.isprintable() and '"' not in entry):
            expected = "names of printable characters without a double quote"
            raise MeshError(f"mesh {name}", expected=expected, got=repr(entry), remedy="Rename it.")
    if len(set(names)) != len(names) or not names:
        expected = "at least one name, all different"
        raise MeshError(f"mesh {name}", expected=expected, got=list(names), remedy="Rename them.")


def support_of_facets(mesh: TetMesh) -> IntArray | None:
    """Place in `SUPPORT` of each boundary triangle, -1 where the scene box cuts the solid, shape (f,).

    None if photographs were not compared.
    """
    if mesh.boundary is None or mesh.boundary.photographs is None:
        return None
    seen, supporting = mesh.boundary.photographs.T
    on_box = mesh.facet_tags == FACET_BOX
    return np.select([on_box, supporting >= 3, supporting > 0, seen > 0], [-1, 0, 1, 2], default=3)
