"""Density, colour and temperature on lattice corners, and which voxels are kept."""

from __future__ import annotations

import math
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.field.harmonics import MAX_DEGREE, harmonics, harmonics_with_unit_mean, num_coefficients
from thermoxels_ns.field.interpolation import TrilinearPoints, interpolate
from thermoxels_ns.field.kept_voxels import KeptVoxels

DensityActivation = Literal["relu", "exp"]
COLOUR_CHANNELS = tuple(3 * num_coefficients(degree) for degree in range(MAX_DEGREE + 1))
"""Numbers of columns that the colour of a corner has, for each degree of its harmonics."""

_PALEST = 0.02  # `VoxelGrid.paint` clips colours to 0.02 .. 0.98, because a sigmoid reaches neither 0 nor 1


def activate_density(raw: Tensor, kind: DensityActivation) -> Tensor:
    """Return the density, >= 0, [1 / world unit], of interpolated raw density.

    `relu` is the choice of Plenoxels and of the paper. `exp` (Instant-NGP) lets one voxel hold a sharp surface; it is
    limited to e^15, which is opaque at any resolution.
    """
    return F.relu(raw) if kind == "relu" else torch.exp(raw.clamp(max=15.0))


class VoxelGrid(nn.Module):
    """The parameters of the field: density, colour and temperature, one row per corner of a kept voxel.

    Refinement and pruning make new parameter objects, because autograd remembers the shape of a leaf. The caller must
    then pass these objects to the optimisers. Loading a checkpoint exchanges only the data of the parameters, so that
    existing optimisers remain valid.

    Args:
        lattice: Lattice at the start; all its voxels are kept.
        sh_degree: Degree of the colour harmonics at the start; None: no colour. `refine.widen_colour` raises it.
        temperature_degree: Degree of the temperature harmonics; 0 (the paper): the same from all directions.
        start_density: Density everywhere at the start, [1 / world unit].
        activation: Function from interpolated raw density to density, see `activate_density`.
    """

    lo: Tensor  # This and the next two: `lo`, `voxel_size` and `shape` of the lattice
    voxel_size: Tensor
    corner_shape: Tensor
    cells: Tensor  # `KeptVoxels.cells`

    def __init__(
        self,
        lattice: Lattice,
        sh_degree: int | None = 2,
        temperature_degree: int = 0,
        start_density: float = 0.1,
        activation: DensityActivation = "relu",
    ):
        super().__init__()
        self.temperature_degree = temperature_degree
        self.activation: DensityActivation = activation
        self.voxels = KeptVoxels(lattice)
        n = lattice.num_corners
        raw = start_density if activation == "relu" else math.log(start_density)
        self.density = nn.Parameter(torch.full((n, 1), raw))
        channels = 0 if sh_degree is None else 3 * num_coefficients(sh_degree)
        self.sh = nn.Parameter(torch.zeros(n, channels)) if channels else None
        temperature = torch.zeros(n, num_coefficients(temperature_degree))
        temperature[:, 0] = 0.5
        self.temperature = nn.Parameter(temperature)
        self.register_buffer("activation_index", torch.tensor({"relu": 0, "exp": 2}[activation]))  # as in old runs
        for name, values in _described(self.voxels).items():
            self.register_buffer(name, values)

    @property
    def sh_degree(self) -> int | None:
        """Degree of the colour harmonics that are stored; None without colour."""
        return None if self.sh is None else COLOUR_CHANNELS.index(self.sh.shape[1])

    @property
    def lattice(self) -> Lattice:
        """The whole lattice, including corners that no kept voxel uses."""
        return self.voxels.lattice

    def row_parameters(self) -> dict[str, nn.Parameter]:
        """Return the parameters by name: density, sh (with colour only) and temperature, each (rows, columns)."""
        rows = {"density": self.density, "sh": self.sh, "temperature": self.temperature}
        return {name: p for name, p in rows.items() if p is not None}

    @torch.no_grad()
    def paint(self, colours: Float[Tensor, "rows 3"]) -> None:
        """Set the colour of each row, in [0, 1], the same from all directions; the grid must store colour."""
        assert self.sh is not None
        constant = harmonics(self.sh.new_tensor([[0.0, 0.0, 1.0]]), 0)  # the same in all directions
        by_channel = self.sh.view(len(self.sh), 3, -1)
        by_channel.zero_()
        by_channel[..., 0] = torch.logit(colours.to(self.sh), _PALEST) / constant

    def replace_voxels(self, voxels: KeptVoxels, rows: dict[str, Tensor], keep_identity: bool = False) -> None:
        """Replace the kept voxels by `voxels`, of this lattice or another, and the values of the parameters by `rows`.

        `rows` must have a tensor (voxels.num_rows, columns) for each name of `row_parameters`. By default the
        parameters become new objects. If `keep_identity` is True, the objects remain and only their data are
        exchanged; the caller must then make sure that no autograd graph uses them.
        """
        for name, parameter in self.row_parameters().items():
            data = rows[name].to(parameter.device, parameter.dtype).contiguous()
            if keep_identity:
                parameter.data, parameter.grad = data, None
            else:
                setattr(self, name, nn.Parameter(data))
        self.voxels = voxels
        for name, values in _described(voxels).items():
            setattr(self, name, values.to(self.lo.device))

    def _load_from_state_dict(self, state_dict, prefix, *args, **kwargs):
        """Take kept voxels and degree of colour from the checkpoint, if it has valid ones, then load its parameters."""
        names = ("lo", "voxel_size", "corner_shape", "cells")
        if all(prefix + name in state_dict for name in (*names, *self.row_parameters())):
            lo, size, shape, cells = (state_dict[prefix + name] for name in names)
            (x, y, z), (nx, ny, nz) = lo.tolist(), shape.tolist()
            voxels = KeptVoxels(Lattice((x, y, z), float(size), (nx, ny, nz)), cells.cpu().numpy().copy())
            rows = {name: state_dict[prefix + name].clone() for name in self.row_parameters()}
            if all(
                values.ndim == 2
                and len(values) == voxels.num_rows
                and values.shape[1] in (COLOUR_CHANNELS if name == "sh" else getattr(self, name).shape[1:])
                for name, values in rows.items()
            ):
                self.replace_voxels(voxels, rows, keep_identity=True)
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)

    def locate(self, points: Float[Tensor, "n 3"]) -> TrilinearPoints:
        """Return the voxel of each world position, and the place in the voxel."""
        return TrilinearPoints.of(self.voxels, points)

    def density_at(self, at: TrilinearPoints) -> Float[Tensor, " n"]:
        """Return the density at points in kept voxels, >= 0, [1 / world unit]."""
        return activate_density(interpolate(self.density, at)[:, 0], self.activation)

    def rgb_at(self, at: TrilinearPoints, directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Return the colour, in [0, 1], of points in kept voxels seen along unit directions. The grid must store
        colour."""
        assert self.sh is not None and self.sh_degree is not None, "this grid has no colour"
        basis = harmonics(directions, self.sh_degree)[:, None]
        coefficients = interpolate(self.sh, at).view(len(directions), 3, basis.shape[-1])
        return torch.sigmoid((coefficients * basis).sum(-1))

    def thermal_at(self, at: TrilinearPoints, directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n 1"]:
        """Return the normalised temperature of points in kept voxels seen along unit directions."""
        coefficients = interpolate(self.temperature, at)
        if self.temperature_degree == 0:
            return coefficients
        basis = harmonics_with_unit_mean(directions, self.temperature_degree)
        return (coefficients * basis).sum(-1, keepdim=True)

    @torch.no_grad()
    def corner_values(self, rows: Float[Tensor, " rows"], fill: float = 0.0) -> Float[Tensor, "x y z"]:
        """Return values on all corners of the lattice from one value per row; corners without a row get `fill`."""
        values = torch.full((self.lattice.num_corners,), fill, dtype=rows.dtype, device=rows.device)
        values[torch.from_numpy(self.voxels.corners).to(rows.device)] = rows
        return values.view(self.lattice.shape)

    @torch.no_grad()
    def voxel_density(self) -> Float[Tensor, "x y z"]:
        """Return the density at the centre of each voxel, [1 / world unit]; 0 in voxels that are not kept."""
        corners, _, _ = self.voxels.tables(self.density.device)
        centre = activate_density(self.density[:, 0][corners].mean(-1), self.activation)
        values = torch.zeros(self.lattice.cell_shape, dtype=centre.dtype, device=centre.device)
        values.view(-1)[self.cells] = centre
        return values


def _described(voxels: KeptVoxels) -> dict[str, Tensor]:
    """Return the buffers, by name, with which a checkpoint describes the lattice and its kept voxels."""
    lattice = voxels.lattice
    return {
        "lo": torch.tensor(lattice.lo, dtype=torch.float64),
        "voxel_size": torch.tensor(lattice.voxel_size, dtype=torch.float64),
        "corner_shape": torch.tensor(lattice.shape),
        "cells": torch.from_numpy(voxels.cells),
    }
