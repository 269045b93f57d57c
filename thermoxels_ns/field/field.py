"""The voxel grid as a nerfstudio `Field`, for code that samples fields through nerfstudio's interface."""

from __future__ import annotations

import torch
from nerfstudio.cameras.rays import RaySamples
from nerfstudio.field_components.field_heads import FieldHeadNames
from nerfstudio.fields.base_field import Field
from torch import Tensor

from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.field.voxel_grid import DensityActivation, VoxelGrid


class VoxelField(Field):
    """Density, view-dependent colour and temperature, trilinear on a corner lattice (the paper's V_i).

    Args:
        lattice: Start lattice.
        sh_degree: Degree of the colour harmonics, 0 to 2; None: no colour.
        temperature_degree: Degree of the temperature harmonics; 0: the same from all directions.
        start_density: Start density, [1 / world unit].
        activation: Density activation, applied after interpolation.
    """

    def __init__(
        self,
        lattice: Lattice,
        sh_degree: int | None,
        temperature_degree: int,
        start_density: float,
        activation: DensityActivation,
    ):
        super().__init__()
        self.grid = VoxelGrid(lattice, sh_degree, temperature_degree, start_density, activation)

    def get_density(self, ray_samples: RaySamples) -> tuple[Tensor, None]:
        """Density at the samples' positions, shape (..., 1); 0 outside the kept voxels."""
        positions = ray_samples.frustums.get_positions()
        flat = positions.reshape(-1, 3)
        density = self.grid.density_at(self.grid.locate(flat))
        density = torch.where(self.grid.in_kept_voxel(flat), density, torch.zeros_like(density))
        return density.view(*positions.shape[:-1], 1), None

    def get_outputs(
        self, ray_samples: RaySamples, density_embedding: Tensor | None = None
    ) -> dict[FieldHeadNames | str, Tensor]:  # type: ignore[override]
        """Colour (if the grid has it) and normalised temperature under the key "thermal", shape (..., 3 and 1)."""
        positions = ray_samples.frustums.get_positions()
        directions = ray_samples.frustums.directions.expand_as(positions).reshape(-1, 3)
        at = self.grid.locate(positions.reshape(-1, 3))
        outputs: dict[FieldHeadNames | str, Tensor] = {
            "thermal": self.grid.thermal_at(at, directions).view(*positions.shape[:-1], 1)
        }
        if self.grid.sh is not None:
            outputs[FieldHeadNames.RGB] = self.grid.rgb_at(at, directions).view(*positions.shape[:-1], 3)
        return outputs
