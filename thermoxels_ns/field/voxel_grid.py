"""Density, colour and temperature on lattice corners, and which voxels are kept."""

from __future__ import annotations

from typing import Literal, get_args

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.field.harmonics import MAX_DEGREE, degree_of, harmonics, harmonics_with_unit_mean, num_coefficients
from thermoxels_ns.field.interpolation import TrilinearPoints, interpolate
from thermoxels_ns.field.kept_voxels import KeptVoxels

DensityActivation = Literal["relu", "softplus", "exp"]
COLOUR_CHANNELS = tuple(3 * num_coefficients(degree) for degree in range(MAX_DEGREE + 1))
"""Columns of colour by the degree of its harmonics."""

_PALEST = 0.02  # Colours nearer to 0 or 1 are stored as this far from them: a sigmoid reaches neither


def activate_density(raw: Tensor, kind: DensityActivation) -> Tensor:
    """Map interpolated raw density to density >= 0, [1 / world unit], after interpolation.

    `relu` is the paper's (Plenoxels'): density itself is trilinear. `softplus` (DVGO, Sun et al. 2022) and `exp`
    (Instant-NGP) let one voxel hold a sharp surface; `exp` is limited to e^15, opaque at any resolution.
    """
    if kind == "relu":
        return F.relu(raw)
    if kind == "softplus":
        return F.softplus(raw)
    return torch.exp(raw.clamp(max=15.0))


def raw_density(density: float, kind: DensityActivation) -> float:
    """The raw value that `activate_density` maps to `density`, [1 / world unit], above 0.

    >>> round(raw_density(0.1, "softplus"), 4)
    -2.2522
    """
    value = torch.tensor(density, dtype=torch.float64)
    return float({"relu": value, "softplus": torch.log(torch.expm1(value)), "exp": torch.log(value)}[kind])


class VoxelGrid(nn.Module):
    """The parameters of the field, one row per corner of a kept voxel.

    Refinement and pruning make new parameters (autograd remembers the shape of a leaf), to which optimisers must be
    pointed. Loading a checkpoint exchanges only the data, so that optimisers that were built before stay valid.

    Args:
        lattice: Start lattice; all its voxels are kept at first.
        sh_degree: Degree of the colour harmonics that are stored; None: no colour. `refine.widen_colour` raises it.
        temperature_degree: Degree of the temperature harmonics; 0: the same from all directions (the paper).
        start_density: Start density everywhere, [1 / world unit]; near-transparent.
        activation: Density activation.
    """

    lo: Tensor
    voxel_size: Tensor
    corner_shape: Tensor
    cells: Tensor

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
        self.density = nn.Parameter(torch.full((n, 1), raw_density(start_density, activation)))
        channels = 0 if sh_degree is None else 3 * num_coefficients(sh_degree)
        self.sh = nn.Parameter(torch.zeros(n, channels)) if channels else None
        temperature = torch.zeros(n, num_coefficients(temperature_degree))
        temperature[:, 0] = 0.5
        self.temperature = nn.Parameter(temperature)
        self.register_buffer("activation_index", torch.tensor(get_args(DensityActivation).index(activation)))
        for name, values in _described(self.voxels).items():
            self.register_buffer(name, values)

    @property
    def sh_degree(self) -> int | None:
        """Degree of the colour harmonics that are stored; None: no colour."""
        return None if self.sh is None else degree_of(self.sh.shape[1] // 3)

    @property
    def lattice(self) -> Lattice:
        """The corner lattice."""
        return self.voxels.lattice

    @property
    def kept(self) -> Bool[Tensor, "x y z"]:
        """Kept voxels as a dense mask, on the CPU."""
        return torch.from_numpy(self.voxels.mask())

    def row_parameters(self) -> dict[str, nn.Parameter]:
        """The parameters that have one row per stored corner, by name."""
        rows = {"density": self.density, "sh": self.sh, "temperature": self.temperature}
        return {name: p for name, p in rows.items() if p is not None}

    @torch.no_grad()
    def paint(self, colours: Float[Tensor, "rows 3"]) -> None:
        """Give the stored corners a colour, the same from all directions."""
        assert self.sh is not None
        constant = harmonics(self.sh.new_tensor([[0.0, 0.0, 1.0]]), 0)  # the same in all directions
        by_channel = self.sh.view(len(self.sh), 3, -1)
        by_channel.zero_()
        by_channel[..., 0] = torch.logit(colours.to(self.sh), _PALEST) / constant

    def replace_voxels(self, voxels: KeptVoxels, rows: dict[str, Tensor], keep_identity: bool = False) -> None:
        """Exchange the kept voxels, of this lattice or another, and the rows of every parameter by its name.

        `keep_identity`: exchange the data of the parameters that exist; only while no graph uses them.
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
        """Take over the checkpoint's kept voxels and its degree of colour before its rows are copied."""
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
        """Find the voxels and trilinear weights of world positions."""
        return TrilinearPoints.of(self.voxels, points)

    def density_at(self, at: TrilinearPoints) -> Float[Tensor, " n"]:
        """Density, [1 / world unit], >= 0."""
        return activate_density(interpolate(self.density, at)[:, 0], self.activation)

    def rgb_at(self, at: TrilinearPoints, directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Colour in [0, 1] seen along unit directions: the sigmoid of the interpolated harmonics."""
        assert self.sh is not None and self.sh_degree is not None, "this grid has no colour"
        basis = harmonics(directions, self.sh_degree)[:, None]
        coefficients = interpolate(self.sh, at).view(len(directions), 3, basis.shape[-1])
        return torch.sigmoid((coefficients * basis).sum(-1))

    def thermal_at(self, at: TrilinearPoints, directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n 1"]:
        """Normalised temperature; the first coefficient is its mean over directions."""
        coefficients = interpolate(self.temperature, at)
        if self.temperature_degree == 0:
            return coefficients
        basis = harmonics_with_unit_mean(directions, self.temperature_degree)
        return (coefficients * basis).sum(-1, keepdim=True)

    @torch.no_grad()
    def corner_values(self, rows: Float[Tensor, " rows"], fill: float = 0.0) -> Float[Tensor, "x y z"]:
        """Spread one value per stored corner over the whole lattice; `fill` at the corners of no kept voxel."""
        values = torch.full((self.lattice.num_corners,), fill, dtype=rows.dtype, device=rows.device)
        values[torch.from_numpy(self.voxels.corners).to(rows.device)] = rows
        return values.view(self.lattice.shape)

    @torch.no_grad()
    def corner_density(self) -> Float[Tensor, "x y z"]:
        """Density at every corner, 0 at corners of no kept voxel."""
        return self.corner_values(activate_density(self.density[:, 0], self.activation))

    @torch.no_grad()
    def voxel_density(self) -> Float[Tensor, "x y z"]:
        """Density at every voxel centre, 0 in voxels that are not kept."""
        corners, _, _ = self.voxels.tables(self.density.device)
        centre = activate_density(self.density[:, 0][corners].mean(-1), self.activation)
        values = torch.zeros(self.lattice.cell_shape, dtype=centre.dtype, device=centre.device)
        values.view(-1)[self.cells] = centre
        return values


def _described(voxels: KeptVoxels) -> dict[str, Tensor]:
    """What a checkpoint keeps of a lattice and its kept voxels."""
    lattice = voxels.lattice
    return {
        "lo": torch.tensor(lattice.lo, dtype=torch.float64),
        "voxel_size": torch.tensor(lattice.voxel_size, dtype=torch.float64),
        "corner_shape": torch.tensor(lattice.shape),
        "cells": torch.from_numpy(voxels.cells),
    }
