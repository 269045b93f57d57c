"""Lines of sight to where photographs agree that something is: for scenes without tracks of structure from motion.

Before walls of little texture a training can close fog that no picture gives away: light that fog has stopped says
nothing of what lies behind. Depths that photographs find by being compared with each other do (see `plane_sweep`): each
sure one is a line of sight that has to end at its point (see `track_loss`).
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import numpy as np
from nerfstudio.engine.callbacks import TrainingCallbackAttributes
from nerfstudio.utils.rich_utils import CONSOLE

from thermoxels_ns.core.feature_rays import Sightlines
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.multiview.photographs import read_photographs
from thermoxels_ns.multiview.stereo import Depths, depths_of

if TYPE_CHECKING:
    from thermoxels_ns.training.model import ThermoxelsModel

SHORTEST_RUN = 400
"""Steps that a run must have under auto: a shorter one would spend most of its time on depths."""
LEAST_SHARE = 0.01
"""Share of the pixels whose depth must be sure; less is chance."""
ERROR_PLANES = 0.25
"""Standard error of a depth, in planes of the sweep."""


def lines_to_depths(depths: Depths) -> Sightlines:
    """One line of sight per sure pixel, to a point of its own.

    Args:
        depths: Of photographs.

    Returns:
        The lines, photograph after photograph, [world units]. A line's uncertainty is `ERROR_PLANES` times the distance
        between the planes of its sweep, along the line.
    """
    photographs = depths.photographs
    (sure,) = np.nonzero(np.isfinite(depths.depth))
    number = np.searchsorted(photographs.firsts, sure, side="right") - 1
    place, width = sure - photographs.firsts[number], photographs.sizes[number, 0]
    pixel = np.column_stack((place % width + 0.5, place // width + 0.5, np.ones(len(sure))))
    inverses = np.linalg.inv(photographs.matrices[:, :, :3])
    along = np.einsum("nij,nj->ni", inverses[number], pixel)  # of depth 1
    origins = photographs.centres[number]
    points = origins + depths.depth[sure, None].astype(np.float64) * along
    error = ERROR_PLANES * depths.error[sure].astype(np.float64) * np.linalg.norm(along, axis=1)
    return Sightlines(origins, np.arange(len(sure)), points, error)


def lines_for_training(model: ThermoxelsModel, attributes: TrainingCallbackAttributes) -> Sightlines | None:
    """Lines of sight that a training is to follow beside those of structure from motion.

    Args:
        model: The model.
        attributes: What nerfstudio gives callbacks.

    Returns:
        Lines of sight; None where the training does without, see `ThermoxelsModelConfig.photo_depth`.
    """
    config, pipeline, trainer = model.config, attributes.pipeline, attributes.trainer
    if config.photo_depth == "off" or not model.loss_weights.tracks or pipeline is None:
        return None
    if config.photo_depth == "auto":
        steps = 0 if trainer is None else trainer._start_step + trainer.config.max_num_iterations
        if model.track_rays is not None or steps < SHORTEST_RUN:
            return None
    return find_lines(model, pipeline.datamanager)


def find_lines(model: ThermoxelsModel, datamanager: Any) -> Sightlines | None:
    """Ask the training photographs how far away is what they show, and say what was found.

    Args:
        model: The model; its box says where to look.
        datamanager: Has the photographs.

    Returns:
        Lines of sight; None where the photographs say too little, or no photographs train.
    """
    began = time.perf_counter()
    if model.grid.sh is None or datamanager.config.streams == "thermal":
        return None
    near = model.config.near_plane * model.unit
    photographs = read_photographs(datamanager.train_dataset, near)
    if photographs is None:
        return None
    box = model.scene_box.aabb.double().numpy()
    lattice = Lattice.covering(box[0], box[1], model.config.resolutions[0])  # the same in a resumed training
    depths = depths_of(photographs, lattice.lo, lattice.hi)
    few = "" if depths.share >= LEAST_SHARE else ", too few to tell anything"
    CONSOLE.log(
        f"depths: {len(photographs)} photographs agree about {depths.share:.1%} of their pixels{few}; "
        f"{time.perf_counter() - began:.1f} s"
    )
    return None if few else lines_to_depths(depths)
