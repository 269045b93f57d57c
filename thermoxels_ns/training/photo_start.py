"""Start a training from where its photographs agree: ask them, set the density, say what was found."""

from __future__ import annotations

import time
from collections.abc import Collection
from typing import TYPE_CHECKING, Any

import torch
from nerfstudio.utils.rich_utils import CONSOLE

from thermoxels_ns.field.voxel_grid import DensityActivation
from thermoxels_ns.multiview.photo_consistency import DensityStart, density_from_photographs
from thermoxels_ns.multiview.photographs import read_photographs

if TYPE_CHECKING:
    from thermoxels_ns.training.model import ThermoxelsModel

SMALLEST_EPS = 1e-8
"""Least eps of the density's optimiser: what photographs say must not be undone by rows with next to no gradient,
which a smaller one moves as fast as all others."""


def set_density(model: ThermoxelsModel, found: DensityStart) -> None:
    """Set the density of an untrained grid from what photographs say.

    Args:
        model: The model, on the lattice on which a start from photographs begins.
        found: Made for that lattice, see `find_start`; they say something.
    """
    assert found.log_gain is not None
    grid, config = model.grid, model.config
    factors = torch.from_numpy(found.log_gain.reshape(-1)[grid.voxels.corners]).double().exp()
    start = _raw(config.start_density / model.unit * factors, grid.activation)
    with torch.no_grad():
        grid.density.copy_(start[:, None].to(grid.density))


def hold_density(optimizer: torch.optim.Optimizer, step: int, hold: int) -> None:
    """Set the density's optimiser for a step of a training that started from photographs.

    For `hold` steps the density stands, while colours are still those of nothing; its gradients are already followed.

    Args:
        optimizer: That of the density; its scheduler sets the learning rate anew after each step.
        step: The step that comes.
        hold: First step at which the density moves.
    """
    for group in optimizer.param_groups:
        group["eps"] = max(group["eps"], SMALLEST_EPS)
        if step < hold:
            group["lr"] = 0.0


def _raw(density: torch.Tensor, activation: DensityActivation) -> torch.Tensor:
    """What the activation maps to densities above 0."""
    if activation == "relu":
        return density
    return torch.log(density) if activation == "exp" else density + torch.log(-torch.expm1(-density))


def find_start(model: ThermoxelsModel, datamanager: Any, left_out: Collection[int] = ()) -> DensityStart:
    """Ask the photographs, for the lattice on which a start from them begins, and say what was found.

    Args:
        model: The untrained model.
        datamanager: Has the photographs.
        left_out: Numbers of training photographs that are not asked.
    """
    begin = time.perf_counter()
    found = _find(model, datamanager, left_out)
    if found.log_gain is not None:
        CONSOLE.log(f"photographs: {found.report}; {time.perf_counter() - begin:.1f} s")
    return found


def _find(model: ThermoxelsModel, datamanager: Any, left_out: Collection[int]) -> DensityStart:
    if model.grid.sh is None or datamanager.config.streams == "thermal":
        return DensityStart(None, "no photographs train")
    lattice = model.grid.lattice.refined(model.config.skipped_factor())
    photographs = read_photographs(datamanager.train_dataset, model.config.near_plane * model.unit, left_out)
    if photographs is None:
        return DensityStart(None, "no photograph is one of a perspective camera")
    return density_from_photographs(lattice, photographs)
