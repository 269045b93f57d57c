"""Training callbacks: refine, prune, and decide what stands behind the box."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.utils.rich_utils import CONSOLE

from thermoxels_ns.errors import PruningError
from thermoxels_ns.field.refine import PruningReport, prune, refine
from thermoxels_ns.ray_statistics import backdrop_evidence, voxel_weights
from thermoxels_ns.streams import RGB_STREAM, THERMAL_STREAM

if TYPE_CHECKING:
    from thermoxels_ns.model import ThermoxelsModel

FEWEST_OPEN_RAYS = 0.002
"""Share of rays that must leave the box unsaturated for a background to be worth its cost."""
FEWEST_SKY_DIFFERENCE = 0.01
"""Share of the temperature range by which the learned sky must differ from the scene's minimum to be kept."""
PRUNING_ATTEMPTS = 4
"""Thresholds tried before pruning fails."""
RAYS_PER_IMAGE = 4096
"""Training rays per image that statistics look at."""


def coarse_to_fine_callbacks(model: ThermoxelsModel, attributes: TrainingCallbackAttributes) -> list[TrainingCallback]:
    """The callbacks of one training run, in the order in which they act at a step."""
    before = [TrainingCallbackLocation.BEFORE_TRAIN_ITERATION]
    factors = model.config.refinements()
    steps = {*factors, *model.config.prune_at}
    end = None
    if attributes.trainer is not None:
        end = attributes.trainer._start_step + attributes.trainer.config.max_num_iterations
        late = sorted(step for step in steps if step >= end)
        if late:
            CONSOLE.log(f"the run ends before step {end}: no refinement or pruning at {', '.join(map(str, late))}")
    # Where the lattice never changes within the run, a third of it is time enough to know what stands behind.
    decisions = {step for step in steps if end is None or step < end} or {(end or 0) // 3}

    def count(step: int) -> None:
        model.update_to_step(step)

    def change_lattice(step: int) -> None:
        assert attributes.pipeline is not None and attributes.optimizers is not None
        datamanager = attributes.pipeline.datamanager
        if step in decisions:
            decide_backdrop(model, datamanager)
        if step in steps and model.config.prune_threshold > 0:
            report = prune_by_rays(model, datamanager)
            CONSOLE.log(f"step {step}: pruning {report}")
        if step in factors:
            refine(model.grid, factors[step])
            for name, parameter in model.grid.row_parameters().items():
                optimizer = attributes.optimizers.optimizers[name]
                optimizer.state.clear()  # moments of another lattice mean nothing here
                optimizer.param_groups[0]["params"] = [parameter]
                attributes.optimizers.parameters[name] = [parameter]
            CONSOLE.log(f"step {step}: lattice refined to {' x '.join(map(str, model.grid.lattice.cell_shape))} voxels")

    return [
        TrainingCallback(before, count),
        TrainingCallback(before, change_lattice, iters=tuple(sorted(steps | decisions))),
    ]


def prune_by_rays(model: ThermoxelsModel, datamanager) -> PruningReport:
    """Drop the voxels to which no training ray of either stream gives weight.

    While surfaces are still fog, many voxels hold little weight each. Then the threshold is lowered, fourfold at a
    time, until at most 1 % of the weight goes.

    Raises:
        PruningError: Even the lowest threshold would remove more.
    """
    weights = voxel_weights(model, datamanager.training_rays(RGB_STREAM | THERMAL_STREAM, RAYS_PER_IMAGE))
    for attempt in range(PRUNING_ATTEMPTS):
        threshold = model.config.prune_threshold / 4**attempt
        try:
            return prune(model.grid, weights.largest, weights.total, threshold, model.config.prune_dilation)
        except PruningError:
            if attempt == PRUNING_ATTEMPTS - 1:
                raise
    raise AssertionError("unreachable")


@torch.no_grad()
def decide_backdrop(model: ThermoxelsModel, datamanager) -> None:
    """Drop a background that the scene does not call for, and say which was chosen and why.

    Asked again at every change of the lattice: what was kept before surfaces had formed can still go.
    """
    config = model.config
    rgb_on, thermal_on = model.backdrop_on.tolist()
    if config.background == "auto" and rgb_on:
        evidence = backdrop_evidence(model, datamanager.training_rays(RGB_STREAM, RAYS_PER_IMAGE))
        keep = evidence.unsaturated >= FEWEST_OPEN_RAYS
        model.backdrop_on[0] = keep
        CONSOLE.log(
            f"background: {'sphere image kept' if keep else 'none'}, "
            f"{evidence.unsaturated:.2%} of RGB rays leave the box unsaturated"
        )
    if config.thermal_background == "auto" and thermal_on and model.background_thermal is not None:
        evidence = backdrop_evidence(model, datamanager.training_rays(THERMAL_STREAM, RAYS_PER_IMAGE))
        sky = model.background_thermal(evidence.directions)
        difference = float(sky.abs().mean()) if len(sky) else 0.0
        learned = evidence.unsaturated >= FEWEST_OPEN_RAYS and difference > FEWEST_SKY_DIFFERENCE
        model.backdrop_on[1] = learned
        CONSOLE.log(
            f"thermal background: {'learned sky' if learned else 'the minimum of the scene'}, "
            f"{evidence.unsaturated:.2%} of thermal rays leave the box unsaturated, "
            f"where the sky differs from the minimum by {difference * model.temperature_range.span_k:.1f} K"
        )
