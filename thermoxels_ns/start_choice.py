"""Which start a training takes: both are tried for some steps, and photographs held back from both decide.

A plain start (the same density everywhere) and one from photo-consistency end in different geometry, and neither is
better on all scenes: before walls of little texture a plain start closes fog, and where bodies hide each other
photographs agree in wrong places. Which it was shows in photographs that did not train.
"""

from __future__ import annotations

import math
import time
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.engine.callbacks import TrainingCallbackAttributes
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from thermoxels_ns.model_config import FINEST_START
from thermoxels_ns.photo_consistency import DensityStart
from thermoxels_ns.photo_start import find_start, hold_density, set_density
from thermoxels_ns.scratch import SCRATCH
from thermoxels_ns.streams import RGB_STREAM
from thermoxels_ns.track_carving import carve_air

if TYPE_CHECKING:
    from thermoxels_ns.model import ThermoxelsModel

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
_JUDGED_BATCHES = 48
"""Batches from which the rays of the held-back photographs are taken."""
_FIRST_JUDGED = 1_000_000_007
"""Number of the first of these batches, which no training reaches."""


@dataclass(frozen=True)
class Verdict:
    """The start that a training takes."""

    start: Chosen
    """What was chosen."""
    reason: str
    """Why, for the log."""
    found: DensityStart | None = None
    """What the photographs say, where they were asked."""


def decide_start(model: ThermoxelsModel, attributes: TrainingCallbackAttributes) -> Verdict:
    """Settle the start of a training, before its first step or after a checkpoint was loaded; the model remembers it.

    Args:
        model: The model.
        attributes: What nerfstudio gives callbacks.
    """
    remembered = STARTS[int(model.start_index)]
    if remembered != "auto":
        return Verdict(_named(remembered), "as decided when the training began")
    if attributes.trainer is not None and attributes.trainer._start_step > 0:
        return Verdict(_named(model.config.start), "as for all trainings that began without a choice")
    verdict = _decide(model, attributes)
    if model.config.start != "plain":
        CONSOLE.log(f"start: {verdict.start}, {verdict.reason}")
    model.start_index.fill_(STARTS.index(verdict.start))
    return verdict


def _named(start: str) -> Chosen:
    return "photographs" if start == "photographs" else "plain"


def _decide(model: ThermoxelsModel, attributes: TrainingCallbackAttributes) -> Verdict:
    """Decide for a training that begins."""
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
    if model.grid.sh is None or datamanager.config.streams == "thermal":
        return Verdict("plain", "as no photographs train")
    if (photographs := len(datamanager.train_dataset)) < FEWEST_PHOTOGRAPHS:
        return Verdict("plain", f"as {photographs} photographs are too few to hold some back")
    if config.resolutions[0] > FINEST_START:
        return Verdict("plain", f"as trials need a lattice of at most {FINEST_START} voxels along its longest side")
    began = time.perf_counter()
    found = find_start(model, datamanager)
    if found.log_gain is None:
        return Verdict("plain", f"as {found.report}")
    CONSOLE.log(f"start: trying both for {steps} steps; naming one (--pipeline.model.start) saves the time")
    trials = (_Trial(model, datamanager, optimizers.config, start) for start in (None, found))
    plain, photo = (trial.error_after(steps) for trial in trials)
    SCRATCH.release()
    seconds = time.perf_counter() - began
    return Verdict(
        "photographs" if photo < plain else "plain",
        f"as photographs held back from {steps} steps of each are met with {_psnr(plain):.2f} dB from the plain start "
        f"and {_psnr(photo):.2f} dB from the photographs ({seconds:.0f} s)",
        found,
    )


class _Trial:
    """A short training of a copy of a model, on colour alone.

    Args:
        model: The untrained model; a copy trains.
        datamanager: Gives the batches.
        settings: Optimisers by group, as nerfstudio's configuration has them.
        found: Where the density starts; None: plain.
    """

    def __init__(self, model: ThermoxelsModel, datamanager: Any, settings: dict[str, Any], found: DensityStart | None):
        self.model, self.datamanager, self.found = deepcopy(model), datamanager, found
        # Temperature does not move the density, and a trial knows the geometry by its colours alone.
        self.model.loss_weights = replace(model.loss_weights, thermal=0.0, tv_temperature=0.0)
        self.model.split(model.config.skipped_factor())
        carve_air(self.model)
        if found is not None:
            set_density(self.model, found)
        self.optimizers = Optimizers(deepcopy(settings), self.model.get_param_groups())

    def error_after(self, steps: int) -> float:
        """Train, and give the mean squared error of colour on the photographs held back."""
        self.model.train()
        for step in range(steps):
            self.model.update_to_step(step)
            if self.found is not None:
                hold_density(self.optimizers.optimizers["density"], step, self.model.config.hold_density)
            self.optimizers.zero_grad_all()
            rays, batch = self._rays(step, held_back=False)
            losses = self.model.get_loss_dict(self.model.get_outputs(rays), batch)
            sum(losses.values()).backward()  # type: ignore[union-attr]
            self.optimizers.optimizer_step_all()
            for scheduler in self.optimizers.schedulers.values():
                scheduler.step()
        return self._error()

    @torch.no_grad()
    def _error(self) -> float:
        self.model.eval()
        squares, count = 0.0, 0
        for number in range(_FIRST_JUDGED, _FIRST_JUDGED + _JUDGED_BATCHES):
            rays, batch = self._rays(number, held_back=True)
            shown = self.model.get_outputs(rays)["rgb"]
            squares += float((shown - batch["image"]).double().square().sum())
            count += shown.numel()
        return squares / max(1, count)

    def _rays(self, number: int, held_back: bool) -> tuple[RayBundle, dict[str, Tensor]]:
        """Colour rays of a batch: those of the photographs held back, or a share of the others."""
        rays, batch = self.datamanager.next_train(number)
        assert rays.camera_indices is not None
        chosen = (rays.metadata["stream"][:, 0] & RGB_STREAM) > 0
        chosen &= (rays.camera_indices[:, 0] % HELD_BACK == HELD_BACK // 2) == held_back
        (places,) = chosen.nonzero(as_tuple=True)
        places = places if held_back else places[::RAYS_SHARE]
        rays = rays[places]
        rays.metadata["stream"] = torch.full_like(rays.metadata["stream"], RGB_STREAM)
        return rays, {name: values[places] for name, values in batch.items()}


def _psnr(error: float) -> float:
    return -10.0 * math.log10(error) if error > 0 else math.inf
