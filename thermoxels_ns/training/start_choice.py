"""Which start a training takes: both are tried for some steps, and photographs held back from both decide.

Where depths on which photographs agree tell where surfaces are (see `photo_depth`), it is the plain one, untried.

A plain start (the same density everywhere) and one from photo-consistency end in different geometry, and neither is
better on all scenes: before walls of little texture a plain start closes fog, and where bodies hide each other
photographs agree in wrong places. Which it was shows in photographs that did not train.

Photographs held back give a trial nothing: no ray, no colour for the start from photographs, no line of sight. Only
where cameras and points stand is known from all photographs, to both trials alike.
"""

from __future__ import annotations

import math
import time
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.engine.callbacks import TrainingCallbackAttributes
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.utils.rich_utils import CONSOLE
from scipy.spatial import KDTree
from torch import Tensor

from thermoxels_ns.core.buffer_pool import SCRATCH
from thermoxels_ns.core.errors import MemoryBudgetError
from thermoxels_ns.core.feature_rays import FloatArray, Sightlines
from thermoxels_ns.core.ray_streams import RGB_STREAM
from thermoxels_ns.field.refine import refine
from thermoxels_ns.multiview.photo_consistency import DensityStart
from thermoxels_ns.training.model_config import FINEST_START
from thermoxels_ns.training.photo_start import find_start, hold_density, set_density
from thermoxels_ns.training.track_carving import carve_air
from thermoxels_ns.training.track_loss import TrackRays

if TYPE_CHECKING:
    from thermoxels_ns.training.model import ThermoxelsModel

Chosen = Literal["plain", "photographs"]
STARTS = ("auto", "plain", "photographs")
"""Their places are what checkpoints hold; auto: not decided yet."""
HELD_BACK = 8
"""Every such photograph is held back from the trials and decides between them."""
FEWEST_PHOTOGRAPHS = 16
"""Photographs that a choice needs: of fewer, too few are held back."""
SHORTEST_RUN = 3
"""Lengths of a trial that a run must have: a shorter one would spend most of its time on trials."""
RAYS_SHARE = 2
"""Every such colour ray of a batch trains in a trial, which halves its time."""
CLEAR_LEAD_DB = 2.5
"""Lead at half of the trials that ends them. The start from photographs catches up in the second half, when its colours
have found their values: by 0.7 to 2.2 dB on the scenes where that was measured."""
_JUDGED_BATCHES = 48
"""Batches from which the rays of the held-back photographs are taken."""
_FIRST_JUDGED = 1_000_000_007
"""Number of the first of these batches, which no training reaches."""
_SAME_PLACE = 1e-5
"""Distance between cameras that stand in one place, relative to half of the scene box's longest side."""

Batch = tuple[RayBundle, dict[str, Tensor]]
"""Rays and what they should show."""


@dataclass(frozen=True)
class Verdict:
    """The start that a training takes."""

    start: Chosen
    """What was chosen."""
    reason: str
    """Why, for the log."""
    found: DensityStart | None = None
    """What the photographs say, where they were asked."""


def decide_start(model: ThermoxelsModel, attributes: TrainingCallbackAttributes, depths: bool = False) -> Verdict:
    """Settle the start of a training, before its first step or after a checkpoint was loaded; the model remembers it.

    Args:
        model: The model.
        attributes: What nerfstudio gives callbacks.
        depths: Whether the training follows depths that the photographs agree about.
    """
    remembered, wanted = STARTS[int(model.start_index)], model.config.start
    if remembered != "auto":
        if wanted not in ("auto", remembered):
            CONSOLE.log(f"start: {remembered}, as the training began; {wanted} would need a new training")
        return Verdict(_named(remembered), "as decided when the training began")
    if attributes.trainer is not None and attributes.trainer._start_step > 0:
        return Verdict(_named(model.config.start), "as for all trainings that began without a choice")
    verdict = _decide(model, attributes, depths)
    if model.config.start != "plain":
        CONSOLE.log(f"start: {verdict.start}, {verdict.reason}")
    model.start_index.fill_(STARTS.index(verdict.start))
    return verdict


def _named(start: str) -> Chosen:
    return "photographs" if start == "photographs" else "plain"


def _decide(model: ThermoxelsModel, attributes: TrainingCallbackAttributes, depths: bool) -> Verdict:
    """Decide for a training that begins."""
    if model.config.start == "auto" and depths:
        return Verdict("plain", "as depths tell where surfaces are")
    if model.config.start == "auto":
        return _choose(model, attributes)
    if model.config.start == "plain":
        return Verdict("plain", "as asked for")
    assert attributes.pipeline is not None
    found = find_start(model, attributes.pipeline.datamanager)
    if found.log_gain is None:
        return Verdict("plain", f"the same density everywhere, because {found.report}")
    return Verdict("photographs", "as asked for", found)


def _choose(model: ThermoxelsModel, attributes: TrainingCallbackAttributes) -> Verdict:
    """Try both starts where that can tell them apart.

    Both train copies of the model for ``trial_steps`` steps on one lattice, with the optimisers of the run and the same
    rays, none of them from the photographs that are held back. The one whose pictures of these are nearer (mean
    squared error of colour) wins. The model, its optimisers and its batches are not touched: the training that follows
    is, bit for bit, the one that the option would have given by name.
    """
    config, optimizers, trainer = model.config, attributes.optimizers, attributes.trainer
    steps = config.trial_steps
    datamanager: Any = getattr(attributes.pipeline, "datamanager", None)
    if config.recipe != "default":
        return Verdict("plain", f"as published for the recipe {config.recipe}")
    if trainer is None or optimizers is None or trainer.config.max_num_iterations < SHORTEST_RUN * steps:
        return Verdict("plain", f"as the run is shorter than {SHORTEST_RUN} trials of {steps} steps")
    if model.grid.sh is None or datamanager.config.streams == "thermal" or not model.loss_weights.rgb:
        return Verdict("plain", "as no photographs train")
    if (photographs := len(datamanager.train_dataset)) < FEWEST_PHOTOGRAPHS:
        return Verdict("plain", f"as {photographs} photographs are too few to hold some back")
    if config.resolutions[0] > FINEST_START:
        return Verdict("plain", f"as trials need a lattice of at most {FINEST_START} voxels along its longest side")
    try:
        model.check_memory(config.skipped_factor())
    except MemoryBudgetError as problem:
        return Verdict("plain", f"as trials need more memory than they may have ({problem})")
    began = time.perf_counter()
    judges = _held_back_batches(datamanager)
    if not judges:
        return Verdict("plain", "as nothing of the photographs to hold back can be seen")
    found = find_start(model, datamanager, left_out=held_back(photographs))
    if found.log_gain is None:
        return Verdict("plain", f"as {found.report}")
    CONSOLE.log(f"start: trying both for {steps} steps; naming one (--pipeline.model.start) saves the time")
    trials = (_Trial(model, datamanager, optimizers.config, start) for start in (None, found))
    plain, photo, taken = _contest(next(trials), next(trials), judges, steps)
    SCRATCH.release()
    reason = (
        f"as photographs held back from {taken} steps of each are met with {_psnr(plain):.2f} dB from the plain start "
        f"and {_psnr(photo):.2f} dB from the photographs ({time.perf_counter() - began:.0f} s)"
    )
    if not (photo < plain or (math.isnan(plain) and not math.isnan(photo))):
        return Verdict("plain", reason)
    complete = find_start(model, datamanager)
    if complete.log_gain is None:
        return Verdict("plain", f"as {complete.report}")
    return Verdict("photographs", reason, complete)


def _contest(plain: _Trial, photo: _Trial, judges: list[Batch], steps: int) -> tuple[float, float, int]:
    """Train both and judge them, earlier where one leads clearly: both errors, and the steps that were taken."""
    half = steps // 2
    if half:
        errors = plain.error_after(half, judges), photo.error_after(half, judges)
        if abs(_psnr(errors[0]) - _psnr(errors[1])) > CLEAR_LEAD_DB:
            return *errors, half
    return plain.error_after(steps, judges), photo.error_after(steps, judges), steps


def held_back(photographs: int) -> range:
    """Numbers of the photographs that judge trials."""
    return range(HELD_BACK // 2, photographs, HELD_BACK)


def _held_back_batches(datamanager: Any) -> list[Batch]:
    """Rays of the photographs held back, the same for both trials; none where these are masked."""
    numbers = range(_FIRST_JUDGED, _FIRST_JUDGED + _JUDGED_BATCHES)
    batches = (colour_rays(datamanager.next_train(number), judging=True) for number in numbers)
    return [batch for batch in batches if len(batch[0])]


def colour_rays(batch: Batch, judging: bool) -> Batch:
    """Colour rays of a batch: those of the photographs held back, or a share of the others."""
    rays, targets = batch
    assert rays.camera_indices is not None
    chosen = (rays.metadata["stream"][:, 0] & RGB_STREAM) > 0
    chosen &= (rays.camera_indices[:, 0] % HELD_BACK == HELD_BACK // 2) == judging
    (places,) = chosen.nonzero(as_tuple=True)
    places = places if judging else places[::RAYS_SHARE]
    rays = rays[places]
    rays.metadata["stream"] = torch.full_like(rays.metadata["stream"], RGB_STREAM)
    return rays, {name: values[places] for name, values in targets.items()}


def lines_of_others(lines: Sightlines, centres: FloatArray, judging: range, tolerance: float) -> Sightlines | None:
    """Lines of sight without those of some photographs, and without points that no line is left to.

    Args:
        lines: Of all training photographs, world units.
        centres: Where the photographs were taken from, shape (photographs, 3), world units.
        judging: Numbers of the photographs that are left out; what stands where one of them does is left out too.
        tolerance: Distance between cameras that stand in one place, [world units].

    Returns:
        The others; None if there are none.
    """
    others = np.delete(centres, judging, axis=0)
    near, far = (KDTree(places).query(lines.origins)[0] for places in (centres[judging], others))
    stay = near > far + tolerance
    if not stay.any():
        return None
    known, point = np.unique(lines.point[stay], return_inverse=True)
    return Sightlines(lines.origins[stay], point, lines.points[known], lines.uncertainty[stay])


class _Trial:
    """A short training of a copy of a model, on colour alone.

    Args:
        model: The untrained model; a copy trains.
        datamanager: Gives the batches.
        settings: Optimisers by group, as nerfstudio's configuration has them.
        found: Where the density starts; None: plain.
    """

    def __init__(
        self,
        model: ThermoxelsModel,
        datamanager: Any,
        settings: dict[str, Any],
        found: DensityStart | None,
    ):
        self.model, self.datamanager, self.found, self.step = deepcopy(model), datamanager, found, 0
        # A trial knows the geometry by its colours alone, which temperature does not move unless it is asked to.
        self.model.loss_weights = replace(model.loss_weights, thermal=0.0, tv_temperature=0.0)
        self._forget_lines()
        if (factor := model.config.skipped_factor()) > 1:
            refine(self.model.grid, factor)
        carve_air(self.model)
        if found is not None:
            set_density(self.model, found)
        self.optimizers = Optimizers(deepcopy(settings), self.model.get_param_groups())

    def _forget_lines(self) -> None:
        """Leave the copy of the model no line of sight of a photograph held back."""
        lines, cameras = self.model.sightlines, self.datamanager.train_dataset.cameras
        if lines is None:
            return
        centres = cameras.camera_to_worlds[:, :3, 3].double().cpu().numpy()
        judging = held_back(len(centres))
        self.model.sightlines = lines = lines_of_others(lines, centres, judging, _SAME_PLACE * self.model.unit)
        if self.model.track_rays is not None:
            self.model.track_rays = None if lines is None else TrackRays(lines)

    def error_after(self, steps: int, judges: list[Batch]) -> float:
        """Train up to a step, and give the mean squared error of colour on the photographs held back."""
        self.model.train()
        for step in range(self.step, steps):
            self.model.update_to_step(step)
            if self.found is not None:
                hold_density(self.optimizers.optimizers["density"], step, self.model.config.hold_density)
            self.optimizers.zero_grad_all()
            rays, batch = colour_rays(self.datamanager.next_train(step), judging=False)
            losses = self.model.get_loss_dict(self.model.get_outputs(rays), batch)
            sum(losses.values()).backward()  # type: ignore[union-attr]
            self.optimizers.optimizer_step_all()
            for scheduler in self.optimizers.schedulers.values():
                scheduler.step()
        self.step = steps
        return self._error(judges)

    @torch.no_grad()
    def _error(self, judges: list[Batch]) -> float:
        self.model.eval()
        squares, count = 0.0, 0
        for rays, batch in judges:
            shown = self.model.get_outputs(rays)["rgb"]
            squares += float((shown - batch["image"]).double().square().sum())
            count += shown.numel()
        return squares / count


def _psnr(error: float) -> float:
    return math.inf if error == 0.0 else -10.0 * math.log10(error)
