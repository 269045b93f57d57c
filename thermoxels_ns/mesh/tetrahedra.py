"""The tetrahedral mesh that the heat solver and the file writers get."""

from __future__ import annotations

from dataclasses import dataclass

from thermoxels_ns.core.arrays import BoolArray, Float32Array, FloatArray, IntArray


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


FACET_SURFACE = 0  # boundary between solid and empty space
FACET_BOX = 1  # boundary where the scene box or the region of an export cuts the solid
