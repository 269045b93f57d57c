"""Geometry figures of ns-eval: opacity of rays, and agreement with a known truth."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.errors import MeshError, ThermoxelsError
from thermoxels_ns.core.snapshot import GridSnapshot
from thermoxels_ns.evaluation.truth_comparison import TOLERANCE_VOXELS, KnownTruth, load_known_truth, points_seen
from thermoxels_ns.evaluation.voxel_accuracy import surface_fscore
from thermoxels_ns.mesh.build import check_similarity
from thermoxels_ns.mesh.solid.voxels import SolidSelection, select_solid

COMMON_RESOLUTION = 128
"""Voxels along the longest side of the lattice whose voxel size `fscore_128` is measured with."""


def has_truth(scene_folder: Path | str, say: Callable[[str], None] = print) -> bool:
    """Whether a scene's exact shape is known; what stands in the way of a synthetic scene's is said."""
    try:
        return load_known_truth(scene_folder) is not None
    except ThermoxelsError as problem:
        say(f"Geometry is not compared with the truth: {problem}")
        return False


def geometry_metrics(
    snapshot: GridSnapshot,
    world_to_input: FloatArray,
    truth: Path | str | KnownTruth,
    say: Callable[[str], None] = print,
) -> dict[str, float]:
    """Compare the surface that an export with default options has with the exact scene, if it is known.

    The surface is the boundary of the voxels that `SolidSelection` chooses by default; precision, recall and F-score
    are defined by `thermoxels_ns.evaluation.truth_comparison.compare_with_truth`.

    Args:
        snapshot: The trained field, with the evidence and the cameras that an export has.
        world_to_input: Similarity, shape (4, 4), from the lattice's world to the coordinates of the input poses, in
            which a synthetic scene is written in metres.
        truth: The scene folder (or its ``transforms.json``), or its truth if it is at hand.
        say: Called with the reason where a figure cannot be given.

    Returns:
        Nothing for real photographs. Else ``fscore``, ``precision``, ``recall``, 0 to 1, at 1.5 voxels of the
        snapshot's lattice; ``fscore_128``, at 1.5 voxels of a lattice of 128 voxels over the same box, to compare
        resolutions; ``surface_distance_voxels`` and ``surface_distance_m``, the mean distance to the true surface.
        Without any solid voxel the scores are 0 and there is no distance.
    """
    try:
        known = truth if isinstance(truth, KnownTruth) else load_known_truth(truth)
        if known is None:
            return {}
        seen = points_seen(known)
    except ThermoxelsError as problem:
        say(f"Geometry is not compared with the truth: {problem}")
        return {}
    try:
        cells = select_solid(snapshot, SolidSelection(), makes_up_volume=False).cells
    except MeshError as problem:
        say(f"The geometry scores 0: {problem}")
        return dict.fromkeys(("fscore", "precision", "recall", "fscore_128"), 0.0)

    lattice = snapshot.lattice
    transform = check_similarity("world_to_input", world_to_input)
    voxel_m = lattice.voxel_size * float(np.cbrt(abs(np.linalg.det(transform[:3, :3]))))
    common_voxel_m = voxel_m * max(lattice.cell_shape) / COMMON_RESOLUTION
    own, common = (
        surface_fscore(
            *(cells, lattice, known.scene, seen, TOLERANCE_VOXELS * size_m, transform), surroundings=known.surroundings
        )
        for size_m in (voxel_m, common_voxel_m)
    )
    result = {
        "fscore": own.fscore,
        "precision": own.precision,
        "recall": own.recall,
        f"fscore_{COMMON_RESOLUTION}": common.fscore,
    }
    if own.mean_distance is not None:
        result["surface_distance_voxels"] = own.mean_distance / voxel_m
        result["surface_distance_m"] = own.mean_distance
    return result
