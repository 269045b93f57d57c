"""Callbacks of a training: carve, refine, prune, widen colour, decide on backgrounds, print progress."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from datetime import timedelta
from typing import Any

import numpy as np
import torch
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.utils.rich_utils import CONSOLE
from threadpoolctl import threadpool_limits

from thermoxels_ns.core.errors import MemoryBudgetError, PruningError
from thermoxels_ns.core.feature_rays import RGB_STREAM, THERMAL_STREAM, FeatureRays
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.field.kept_voxels import check_memory
from thermoxels_ns.field.refine import GridChange, prune, refine, widen_colour
from thermoxels_ns.field.voxel_grid import VoxelGrid
from thermoxels_ns.multiview.backdrop import mean_colours
from thermoxels_ns.multiview.evidence import evidence_of_photographs
from thermoxels_ns.multiview.votes import air_voxels, hardly_shown
from thermoxels_ns.training.losses import COARSE_LIGHT, FeatureRaySampler
from thermoxels_ns.training.model import ThermoxelsModel
from thermoxels_ns.training.plain_areas import PlainAreas
from thermoxels_ns.training.ray_statistics import backdrop_evidence, share_of_rays_opened, voxel_weights

FEWEST_OPEN_RAYS = 0.002  # A background is kept if at least this share of rays leaves the box with half of its light
FEWEST_SKY_DIFFERENCE = 0.01
"""Share of the temperature range by which the learned sky must differ from the scene's minimum to be kept."""
FEWEST_RAYS = 6.0
"""Least number of rays, in the steps to come, per voxel of a surface for a refinement that the user did not ask for. In
standard quality it was 2.6 to 4.3 in five scenes that have no worse images without the last refinement (living-room,
l-room, wild-14, ARCO, saharov32; F of l-room falls by 0.012) and 7.8 to 33 in thirty others, which were not tried. It
depends on the box: with the box that six neighbours in stereo give, wild-14 has 7.8, is refined, and loses 0.01 F."""
MOST_OPENED_RAYS = 0.01  # Largest share, of the rays of opacity above one half, that pruning may open
OPAQUE_DEPTH = 0.7  # Least optical depth across an opaque voxel: half of the light is lost
PROGRESS_LINES, LONGEST_SILENCE_S = 20, 60.0  # Number of lines of progress; a line comes at least this often
PRUNING_ATTEMPTS = 4  # Number of thresholds tried before pruning fails
RAYS_PER_IMAGE = 4096  # Training rays per image from which statistics are made
SHORTEST_RUN_WITH_DEPTHS = 400
"""Fewest steps for which photo_depth auto finds depths: a shorter run would spend most of its time on them."""


def coarse_to_fine_callbacks(model: ThermoxelsModel, attributes: TrainingCallbackAttributes) -> list[TrainingCallback]:
    """Return the callbacks of one training run, in the order in which they act at a step."""
    before = [TrainingCallbackLocation.BEFORE_TRAIN_ITERATION]
    rays = follow_depths(model, attributes)
    factors = model.config.refinements()
    steps = {*factors, *model.config.prune_at, *model.config.thin_at}
    end, told = None, list[TrainingCallback]()
    if attributes.trainer is not None:
        first = attributes.trainer._start_step
        end = first + attributes.trainer.config.max_num_iterations
        told = [TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], progress(first, end))]
        late = sorted(step for step in steps if step >= end)
        if late:
            CONSOLE.log(f"the run ends before step {end}: no refinement or pruning at {', '.join(map(str, late))}")
    # A run that never changes the lattice decides on backgrounds after a third of its steps.
    decisions = {step for step in steps if end is None or step < end} or {(end or 0) // 3}

    def carve(step: int) -> None:
        """Drop voxels of the box that are air, or that fewer than two photographs show (`carve` in the settings)."""
        if model.config.carve == "off" or rays is None:
            return
        assert attributes.pipeline is not None
        dataset: Any = attributes.pipeline.datamanager.train_dataset
        voxels, lattice = model.grid.voxels, model.grid.voxels.lattice
        air = air_voxels(lattice, rays).reshape(-1)[voxels.cells]
        centres = np.stack(np.unravel_index(voxels.cells, lattice.cell_shape), axis=1) + 0.5
        hidden = hardly_shown(lattice.index_to_world(centres), dataset.views())
        air |= hidden & ~hidden.all()
        if 0 < air.sum() < len(air):
            CONSOLE.log(
                f"step {step}: {air.sum():,} of {len(air):,} voxels are air, or in view of fewer than two photographs"
            )
            follow(prune(model.grid, ~air))

    def follow(change: GridChange, grid: VoxelGrid = model.grid, prefix: str = "") -> None:
        """Give the optimisers `prefix` + name the new parameters of `grid`, and change their state by `change`."""
        assert attributes.optimizers is not None
        for name, new in grid.row_parameters().items():
            (old,) = attributes.optimizers.parameters[prefix + name]
            if new is not old:
                optimizer: Any = attributes.optimizers.optimizers[prefix + name]
                optimizer.follow(old, new, change)
                attributes.optimizers.parameters[prefix + name] = [new]

    def change_surroundings(step: int) -> None:
        """Drop voxels of the surroundings with no weight above `prune_threshold` (step 0: above 0); refine the rest."""
        if model.seen_surroundings is None:
            return
        assert attributes.pipeline is not None
        datamanager: Any = attributes.pipeline.datamanager
        grid, prefix = model.seen_surroundings.grid, "surroundings_"
        rays = datamanager.training_rays(RGB_STREAM | THERMAL_STREAM, RAYS_PER_IMAGE)
        largest = voxel_weights(grid, model.sample_surroundings, rays)[0].cpu().numpy()
        keep = grid.voxels.dilated(largest > (model.config.prune_threshold if step else 0.0), 1)
        if not keep.any():
            model.backdrop_on[2], keep[0] = False, True  # one voxel stays: parameters need a row
        follow(prune(grid, keep), grid, prefix)
        if model.seen_surroundings is None:
            CONSOLE.log(f"step {step}: surroundings dropped, all that is outside the box lies at infinity")
            return
        if step in factors:
            follow(refine(grid, factors[step]), grid, prefix)
        CONSOLE.log(f"step {step}: surroundings of {len(grid.voxels):,} voxels")

    def change_lattice(step: int) -> None:
        assert attributes.pipeline is not None
        datamanager: Any = attributes.pipeline.datamanager
        config = model.config
        if step in decisions:
            decide_backdrop(model, datamanager)
        thin = step in config.thin_at
        threshold = config.thin_threshold if thin else config.prune_threshold
        if step in steps and threshold > 0:
            said, change = prune_by_rays(model, datamanager, threshold, 0 if thin else config.prune_dilation)
            follow(change)
            CONSOLE.log(f"step {step}: {'thinning' if thin else 'pruning'} {said}")
        if step in steps:
            change_surroundings(step)
        if step in factors:
            lattice = model.grid.lattice.refined(factors[step])
            voxels, channels = len(model.grid.voxels) * factors[step] ** 3, config.row_channels(max(lattice.cell_shape))
            rays = math.inf if end is None else (end - step) * datamanager.config.train_num_rays_per_batch
            needed = FEWEST_RAYS * len(model.grid.voxels) * factors[step] ** 2
            try:
                CONSOLE.log(f"memory: {check_memory(lattice, voxels, channels, config.memory_budget_gb)}")
                why = "" if rays >= needed else f"{rays:,} rays to come are few for so many; --quality fine has more"
            except MemoryBudgetError as problem:
                why = str(problem)
                if not config.voxel_pixels:  # the user gave this resolution
                    raise
            if why and config.voxel_pixels:
                CONSOLE.log(f"step {step}: the lattice stays, where photographs ask for a finer one: {why}")
                finest = config.resolutions.index(max(model.grid.lattice.cell_shape))
                known = config.resolutions[: finest + 1], config.refine_at[:finest]
                model.config = replace(config, resolutions=known[0], refine_at=known[1])
                trainer: Any = attributes.trainer
                if trainer is not None:
                    trainer.save_found_settings()  # so that a run that resumes from here agrees
                return
            follow(refine(model.grid, factors[step]))
            CONSOLE.log(f"step {step}: lattice refined to {' x '.join(map(str, model.grid.lattice.cell_shape))} voxels")
            carve(step)

    def widen(step: int) -> None:
        """From step `view_dependence_from` on, let grid and optimiser store all harmonics of colour."""
        stored, degree = model.grid.sh_degree, model.config.sh_degree
        if stored is None or degree is None or stored >= degree:
            return
        if int(model.trained_steps) >= model.config.view_dependence_from:
            follow(widen_colour(model.grid, degree))

    early = min(steps | decisions) // 3
    return [
        TrainingCallback(before, model.update_to_step),
        TrainingCallback(before, carve, iters=(0,)),
        TrainingCallback(before, change_surroundings, iters=tuple({0, early})),
        TrainingCallback(before, change_lattice, iters=tuple(sorted(steps | decisions))),
        TrainingCallback(before, widen),
        *told,
    ]


def progress(first: int, end: int) -> Callable[[int], None]:
    """Return a function that prints progress; it must be called after each step from `first` to before `end`.

    A line comes at each twentieth of the steps and after a minute without a line, both on a terminal and in a file. It
    states the steps done and the time that the others take at the pace since the line before.
    """
    said_s, said = time.monotonic(), first + 1

    def tell(step: int) -> None:
        nonlocal said_s, said
        done, now = step + 1, time.monotonic()
        if done == first + 1:  # kernels may have been compiled in the first step
            said_s = now
        elif done * PROGRESS_LINES // end > said * PROGRESS_LINES // end or now - said_s > LONGEST_SILENCE_S:
            left = timedelta(seconds=round((end - done) * (now - said_s) / (done - said)))
            more = f"; at this pace {left} more" if done < end else ""
            CONSOLE.print(f"step {done:,} of {end:,} ({100 * done / end:.0f} %){more}", highlight=False)
            said_s, said = now, done

    return tell


def follow_depths(model: ThermoxelsModel, attributes: TrainingCallbackAttributes) -> FeatureRays | None:
    """Return the rays to all known points: points of structure from motion and depths of photographs; None: no rays.

    Depths are found only if `ThermoxelsModelConfig.photo_depth` allows it and photographs are trained on. The model
    then gets feature rays to the depths too, and rays through a plain backdrop or to a plain ceiling. Unless the
    training is resumed, it also gets gains, offsets and first colours.
    """
    config, pipeline, trainer = model.config, attributes.pipeline, attributes.trainer
    tracks = model.feature_rays
    if config.photo_depth == "off" or not model.loss_weights.tracks or pipeline is None:
        return tracks
    if config.photo_depth == "auto":
        steps = 0 if trainer is None else trainer._start_step + trainer.config.max_num_iterations
        if steps < SHORTEST_RUN_WITH_DEPTHS:
            return tracks
    datamanager: Any = pipeline.datamanager
    if model.grid.sh is None or datamanager.config.streams == "thermal":
        return tracks
    box = model.scene_box.aabb.double().numpy()
    lattice = Lattice.covering(box[0], box[1], config.resolutions[0])  # not the grid's, which may be finer if resumed
    near = config.near_plane * model.unit
    with threadpool_limits(1, "blas"):  # same bits for any number of threads
        wanted = config.exposure == "auto", config.per_image_offset == "auto" and datamanager.config.streams != "rgb"
        found = evidence_of_photographs(datamanager.train_dataset, near, lattice.lo, lattice.hi, CONSOLE.log, *wanted)
    if trainer is None or trainer._start_step == 0:
        assert found.photographs.index is not None
        model.correct_photographs(found.photographs.index, found.log_gain, found.offset)
    rays, depths, far = tracks, found.feature_rays, model.seen_surroundings is not None
    if depths is not None:
        rays = depths if tracks is None else tracks.joined_with(depths)
        model.feature_ray_sampler = FeatureRaySampler(rays, box, far, COARSE_LIGHT if tracks is None else 0.0)
    plain_rays = found.plain_rays(*box)
    model.backdrop_ray_sampler = None if plain_rays is None else FeatureRaySampler(plain_rays, box)
    model.plain_areas = PlainAreas(found.photographs, np.isfinite(found.depth), found.backdrop)
    if trainer is None or trainer._start_step == 0:
        points = model.grid.voxels.corner_index() * lattice.voxel_size + np.asarray(lattice.lo)
        model.grid.paint(torch.from_numpy(mean_colours(found.photographs, found.backdrop, points)))
    return rays


def prune_by_rays(model: ThermoxelsModel, datamanager, threshold: float, dilation: int) -> tuple[str, GridChange]:
    """Drop voxels that training rays hardly use; return a sentence for the log and the change of rows.

    A voxel is needed if some ray of either stream gives it more than `threshold` of its light, or if a ray of opacity
    above one half completes half of its weight in it (else soft surfaces would open). Needed voxels, voxels up to
    `dilation` voxels away from them, and opaque neighbours of them are kept: the rays of statistics miss some voxels of
    a fine surface, and each would be a hole. If this opens more than the share `MOST_OPENED_RAYS` of the rays, the
    threshold is divided by 4 and the pruning tried again. Raises `PruningError`, without a change of the grid, if even
    the last of `PRUNING_ATTEMPTS` thresholds would open more.
    """

    def rays():
        return datamanager.training_rays(RGB_STREAM | THERMAL_STREAM, RAYS_PER_IMAGE)

    field = model.grid, model.sample_rays
    (largest, ends), voxels, opened = voxel_weights(*field, rays()), model.grid.voxels, 1.0
    density = model.grid.voxel_density().view(-1)[model.grid.cells].cpu().numpy()
    opaque = density * voxels.lattice.voxel_size > OPAQUE_DEPTH
    for attempt in range(PRUNING_ATTEMPTS):
        threshold = threshold / 4 if attempt else threshold
        chosen = ((largest > threshold) | ends).cpu().numpy()
        if not chosen.any():
            continue
        keep = voxels.dilated(chosen, dilation) | (voxels.dilated(chosen, 1) & opaque)
        opened = share_of_rays_opened(*field, rays(), torch.from_numpy(keep).to(largest.device))
        if opened <= MOST_OPENED_RAYS:
            kept, total = int(keep.sum()), math.prod(voxels.lattice.cell_shape)
            said = (
                f"kept {kept:,} of {total:,} voxels ({kept / total:.1%}); threshold {threshold:.2g}, {opened:.2%} of "
            )
            return f"{said}the rays lost what they ended on", prune(model.grid, keep)
    expected = f"to open at most {MOST_OPENED_RAYS:.0%} of the rays that end on something"
    remedy = "Lower --pipeline.model.prune-threshold, or prune later when surfaces have formed."
    raise PruningError("pruning", expected=expected, got=f"{opened:.1%} at threshold {threshold:.2g}", remedy=remedy)


@torch.no_grad()
def decide_backdrop(model: ThermoxelsModel, datamanager) -> None:
    """Switch off a background that the scene does not need, and log which background was chosen and why. The decision
    is repeated at every change of the lattice, because surfaces may form late."""
    config, field = model.config, (model.grid, model.sample_rays)
    rgb_on, thermal_on, _ = model.backdrop_on.tolist()
    if config.background == "auto" and rgb_on:
        unsaturated, _ = backdrop_evidence(*field, datamanager.training_rays(RGB_STREAM, RAYS_PER_IMAGE))
        keep = unsaturated >= FEWEST_OPEN_RAYS
        model.backdrop_on[0] = keep
        CONSOLE.log(
            f"background: {'sphere image kept' if keep else 'none'}, "
            f"{unsaturated:.2%} of RGB rays leave the box unsaturated"
        )
    if config.thermal_background == "auto" and thermal_on and model.background_thermal is not None:
        unsaturated, directions = backdrop_evidence(*field, datamanager.training_rays(THERMAL_STREAM, RAYS_PER_IMAGE))
        sky = model.background_thermal(directions)
        difference = float(sky.abs().mean()) if len(sky) else 0.0
        learned = unsaturated >= FEWEST_OPEN_RAYS and difference > FEWEST_SKY_DIFFERENCE
        model.backdrop_on[1] = learned
        CONSOLE.log(
            f"thermal background: {'learned sky' if learned else 'the minimum of the scene'}, "
            f"{unsaturated:.2%} of thermal rays leave the box unsaturated, "
            f"where the sky differs from the minimum by {difference * model.temperature_range.span_k:.1f} K"
        )
