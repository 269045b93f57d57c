"""The steps at which a training refines, prunes and thins, for every resolution and number of steps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from thermoxels_ns.core.errors import ThermoxelsError

COARSEST = 32  # Least first resolution, [voxels along the longest side], of a training that refines
# The shares of the run below were set by hand while the losses were tuned; only all of them together were measured.
_REFINE: Mapping[int, tuple[float, ...]] = {0: (), 1: (0.25,), 2: (0.2, 0.5)}
"""By number of refinements, the share of the run at which each happens. With three refinements 320 voxels begin as 40,
too few for a body that fills a third of the box: of what cameras see of wild-14, F is 0.82, and 0.86 with two."""
_PRUNE_AFTER = 0.13  # Share of the run between a refinement and the pruning that drops what it left empty
_THIN = 0.8
_VIEW_DEPENDENCE = 0.8
_RAMP = (0.1, 0.4)

Quality = Literal["draft", "standard", "fine"]
QUALITIES: Mapping[Quality, tuple[int, int, float]] = {
    "draft": (64, 800, 3.2),
    "standard": (128, 1500, 1.6),
    "fine": (256, 4000, 1.6),
}
"""Last resolution, steps, and width of a voxel in pixels of each named quality; `thermoxels cost` measures them.
Voxels of one pixel follow noise (wild-5: F falls from 0.89 to 0.87), voxels of two pixels lose shape (courtyard: F of
the seen surface is 0.81, 0.86, 0.89 with 2.1, 1.9, 1.6 pixels). House-corner keeps the resolution given here."""


@dataclass(frozen=True)
class Schedule:
    """The resolutions of a training, and the steps at which it changes."""

    resolutions: tuple[int, ...]  # Voxels along the longest side, coarse to fine
    refine_at: tuple[int, ...]  # Steps at which the next resolution begins
    prune_at: tuple[int, ...]  # Steps, beside `refine_at`, at which voxels that hold little of each ray are dropped
    thin_at: tuple[int, ...]  # Steps at which surfaces are thinned
    distortion_ramp: tuple[int, int]  # Steps over which the distortion term grows
    view_dependence_from: int  # Step from which colour depends on the direction
    steps: int  # Number of steps of the training
    voxel_pixels: float  # Width of the last voxels, [pixels of the photographs]; 0: `resolutions` counts


def schedule_for(resolution: int, steps: int, voxel_pixels: float = 0.0) -> Schedule:
    """Return the schedule of a training of `steps` steps that ends with `resolution` voxels along the longest side.

    If `voxel_pixels` is above 0, a scene later adapts the resolutions to last voxels about that wide, [pixels].
    Raises `ThermoxelsError` if `resolution` is below 1 or `steps` below 10.

    >>> schedule_for(128, 1000).refine_at
    (200, 500)
    """
    if resolution < 1 or steps < 10:
        remedy = "Raise them."
        got = f"{resolution} voxels, {steps} steps"
        raise ThermoxelsError("schedule", expected="at least 1 voxel and 10 steps", got=got, remedy=remedy)
    resolutions = [resolution]
    while resolutions[0] % 2 == 0 and resolutions[0] // 2 >= COARSEST and len(resolutions) <= max(_REFINE):
        resolutions.insert(0, resolutions[0] // 2)
    refine = _REFINE[len(resolutions) - 1]
    prune = [share + _PRUNE_AFTER for share in refine] or [0.5]

    def at(share: float) -> int:
        return max(1, round(share * steps))

    return Schedule(
        tuple(resolutions),
        tuple(at(share) for share in refine),
        tuple(at(share) for share in prune),
        (at(_THIN),),
        (at(_RAMP[0]), at(_RAMP[1])),
        at(_VIEW_DEPENDENCE),
        steps,
        voxel_pixels,
    )
