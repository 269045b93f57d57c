"""What crosses the wall from the trained model to the mesher: plain arrays on the corner lattice."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from thermoxels_ns.checks import check_finite, check_shape
from thermoxels_ns.errors import MeshError
from thermoxels_ns.lattice import Lattice


@dataclass(frozen=True)
class GridSnapshot:
    """The trained field, detached: three arrays of the lattice's shape, all finite (checked)."""

    lattice: Lattice
    density: npt.NDArray[np.float32]
    """Density after activation at the corners, [1 / world unit], >= 0."""
    temperature_c: npt.NDArray[np.float32]
    """Temperature at the corners, [degrees Celsius]; where `observed_weight` is 0 it is not a measurement."""
    observed_weight: npt.NDArray[np.float32]
    """Sum of the weights that thermal training rays gave each corner; 0: no thermal ray ever saw it."""

    def __post_init__(self) -> None:
        remedy = "The checkpoint is damaged; resume from an earlier one."
        for name in ("density", "temperature_c", "observed_weight"):
            array = getattr(self, name)
            check_shape(f"grid snapshot {name}", array, self.lattice.shape, remedy, MeshError)
            check_finite(f"grid snapshot {name}", array, remedy, MeshError)
