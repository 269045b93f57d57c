"""What crosses the wall from the trained model to the mesher: plain arrays on the lattice."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from thermoxels_ns.checks import check_finite, check_shape
from thermoxels_ns.errors import MeshError
from thermoxels_ns.lattice import Lattice


@dataclass(frozen=True)
class GridSnapshot:
    """The trained field, detached: arrays of the lattice's shape, all finite (checked)."""

    lattice: Lattice
    density: npt.NDArray[np.float32]
    """Density after activation at the corners, [1 / world unit], >= 0."""
    temperature_c: npt.NDArray[np.float32]
    """Temperature at the corners, [degrees Celsius]: the mean over thermal training rays, each sample weighted by its
    share of the pixel; where `observed_weight` is 0 it is not a measurement."""
    observed_weight: npt.NDArray[np.float32]
    """Sum of the weights that thermal training rays gave each corner; 0: no thermal ray ever saw it."""
    voxel_density: npt.NDArray[np.float32] | None = None
    """Density at the voxel centres as the field has it, shape `lattice.cell_shape`, [1 / world unit]. None: density is
    trilinear, so it is the mean of the corners."""

    def __post_init__(self) -> None:
        remedy = "The checkpoint is damaged; resume from an earlier one."
        for name in ("density", "temperature_c", "observed_weight"):
            array = getattr(self, name)
            check_shape(f"grid snapshot {name}", array, self.lattice.shape, remedy, MeshError)
            check_finite(f"grid snapshot {name}", array, remedy, MeshError)
        if self.voxel_density is not None:
            check_shape("grid snapshot voxel_density", self.voxel_density, self.lattice.cell_shape, remedy, MeshError)
            check_finite("grid snapshot voxel_density", self.voxel_density, remedy, MeshError)

    def centre_density(self) -> npt.NDArray[np.float64]:
        """Density at the voxel centres, shape `lattice.cell_shape`, [1 / world unit]."""
        if self.voxel_density is not None:
            return self.voxel_density.astype(np.float64)
        return self.lattice.corner_to_cell_mean(self.density.astype(np.float64))
