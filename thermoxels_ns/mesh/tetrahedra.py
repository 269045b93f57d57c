"""The tetrahedral mesh that crosses the wall from the mesher to the heat solver and the file writers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True)
class TetMesh:
    """A conforming tetrahedral mesh with nodal temperatures, in metres."""

    points_m: npt.NDArray[np.float64]
    """Nodes, shape (n, 3), [m]."""
    tets: npt.NDArray[np.int64]
    """Node indices, shape (t, 4), positively oriented: det(p1 - p0, p2 - p0, p3 - p0) > 0."""
    temperature_c: npt.NDArray[np.float64]
    """Nodal temperature, shape (n,), [degrees Celsius]."""
    observed: npt.NDArray[np.bool_]
    """True where a thermal ray saw the node; elsewhere the temperature is a harmonic extension. Shape (n,)."""
    facets: npt.NDArray[np.int64]
    """Boundary triangles, shape (f, 3), oriented so that the right-hand normal points out of the body."""
    facet_tags: npt.NDArray[np.int64]
    """One of the `FACET_*` constants per boundary triangle, shape (f,)."""
    region: npt.NDArray[np.int64]
    """Region number per tetrahedron, shape (t,); 0 is the only region so far."""


FACET_SURFACE = 0
"""Boundary between solid and empty space."""
FACET_BOX = 1
"""Boundary where the scene box cuts the solid."""
