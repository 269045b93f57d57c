"""Settings of the model: every field is an option of ``ns-train thermoxels --pipeline.model.*``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal

import tyro
from nerfstudio.models.base_model import ModelConfig

from thermoxels_ns.core.checks import check_ranges
from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.field.harmonics import MAX_DEGREE, num_coefficients
from thermoxels_ns.field.voxel_grid import DensityActivation
from thermoxels_ns.render.renderers import Backend
from thermoxels_ns.training.schedule import COARSEST, QUALITIES, schedule_for

_STANDARD = schedule_for(*QUALITIES["standard"])
MOST_VOXELS = 3.0
"""Most voxels along the longest side that a scene may ask for, divided by the last of the resolutions. Where textured
ground runs on around a body, a scene asks for many: with 192, 256 and 384 F of the seen surface is 0.59 and 0.95 on
wild-11 (it asks for 256), 0.58 and 0.74 on wild-14 (256 and 384), 0.63 and 0.79 on wild-17. A statue photographed at 12
megapixels asks for 512; after 1500 steps 17 % of its depths are off by 2 % with 384 voxels, 15 % with 192."""
FINEST = 512  # Most voxels along the longest side that a scene may ask for, whatever the quality
MOST_STRETCH = 1.5  # Voxels asked for, divided by the last of the resolutions, up to which no split is added
STEP_OF_COARSEST = 8  # The coarsest resolution is a multiple of this number of voxels


def _in_steps(voxels: float) -> int:
    """Return `voxels` as a multiple of `STEP_OF_COARSEST`, rounded up by less than 3/4 of it, else down; not 0."""
    return STEP_OF_COARSEST * max(1, math.ceil(voxels / STEP_OF_COARSEST - 0.25))


@dataclass(frozen=True)
class LossWeights:
    """Weight of each loss term; a term of weight 0 is not computed."""

    rgb: float = 1.0  # Mean squared error of colour (paper, eq. 3)
    thermal: float = 1.0  # lambda L2 + (1 - lambda) L1 of temperature (paper, eq. 4)
    tv_density: float = 1e-5  # Total variation of the stored density
    tv_sh: float = 1e-5  # Total variation of the colour harmonics
    tv_temperature: float = 1e-3  # Total variation of temperature
    beta: float = 0.0  # Push rays to be opaque or empty
    distortion: float = 0.1  # Gather each ray's weight in one short interval
    tracks: float = 0.05
    """Make feature rays end at their points: tracks of structure from motion, depths on which photographs agree."""
    backdrop: float = 0.02
    """Let rays through a plain backdrop (sky, a wall far behind) meet nothing in the box, and rays to a plain ceiling
    end on it."""
    bend: float = 0.001  # Keep surfaces flat in plain areas of photographs, where no depth is known
    surroundings: float = 1e-3  # Keep the surroundings transparent where colour at infinity explains the photographs


LOSS_RECIPES: Mapping[str, LossWeights] = {
    # Tuned on the synthetic scenes for meshes, which need opaque solids and empty air.
    "default": LossWeights(),
    # The published training configuration of the original code, TV and beta as there. Its sparsity of density is left
    # out: with a weight of 1e-11 the term is 5e-11 beside 2 of all others.
    "paper": LossWeights(
        tv_density=5e-3, tv_sh=5e-2, tv_temperature=1e-6, beta=1e-5, distortion=0.0, tracks=0.0, backdrop=0.0, bend=0.0
    ),
}


@dataclass
class ThermoxelsModelConfig(ModelConfig):
    """Settings of `ThermoxelsModel`."""

    model_class: ClassVar[type] = ModelConfig
    """Class of the model that these settings make; the module `training.model` sets it to `ThermoxelsModel`."""
    _target: type = field(default_factory=lambda: ThermoxelsModelConfig.model_class)
    enable_collider: bool = False
    """Rays are cut by the lattice itself; nerfstudio's collider is not used."""
    eval_num_rays_per_chunk: int = 8192
    """Rays rendered at once for a whole image."""

    resolutions: tuple[int, ...] = _STANDARD.resolutions
    """Voxels along the longest side of the scene box, coarse to fine; each number is a multiple of the one before.
    Unless resolutions is typed, voxel-pixels replaces these numbers, by at most twice as many voxels."""
    voxel_pixels: float = 0.0
    """Width of the finest voxels in pixels of the photographs, at the distance of most of what photographs show. Finer
    voxels follow noise, coarser voxels cannot hold the shape. 0: as resolutions says."""
    suited: tyro.conf.Suppress[bool] = False
    """Whether resolutions and steps are those found for the scene by `suited_to`, as in config.yml of a run."""
    refine_at: tuple[int, ...] = _STANDARD.refine_at
    """Steps at which the next resolution begins; one fewer than resolutions."""
    steps: int = _STANDARD.steps
    """Steps of a whole training, over which refine-at and prune-at are spread where voxel-pixels asks for another
    number of resolutions. A quality sets this number; --max-num-iterations alone does not."""
    prune_at: tuple[int, ...] = _STANDARD.prune_at
    """Steps, beside refine-at, at which voxels that hold little of each ray are dropped, see prune-threshold."""
    prune_threshold: float = 0.03
    """A voxel is kept if some training ray gave it more than this share of a pixel. 0 switches pruning off."""
    prune_dilation: int = 1
    """Width, in voxels, of the margin kept around voxels that prune-threshold keeps, so that surfaces can move."""
    thin_at: tuple[int, ...] = _STANDARD.thin_at
    """Steps at which surfaces are thinned: half-transparent voxels before and behind a surface are dropped."""
    thin_threshold: float = 0.05
    """At a step of thin-at a voxel is kept if some training ray gave it more than this share of a pixel or spent half
    of its light there; opaque neighbours of such voxels are kept too. 0 switches thinning off."""

    sh_degree: int | None = 2
    """Degree of the view-dependent colour, 0 to 2. None: no colour (thermal images alone)."""
    view_dependence_from: int = _STANDARD.view_dependence_from
    """Step from which colour depends on the direction. Before it there is one colour per voxel corner, which cannot
    explain away a surface in the wrong place."""
    temperature_degree: int = 0
    """Degree of view-dependent temperature; 0 (the paper): surfaces look equally warm from all sides."""
    density_activation: DensityActivation = "exp"
    """Maps interpolated values to density: relu is the paper's; exp holds a sharp surface in one voxel."""
    start_density: float = 0.1
    """Density everywhere at the start, per world unit in a scene of size 2: near-transparent, or floaters form."""
    carve: Literal["auto", "off"] = "auto"
    """auto: at the start and after every refinement, drop voxels that rays cross on the way to what photographs see:
    points of structure from motion (tracks of thermoxels capture or of a COLMAP model, see the dataparser's tracks),
    and depths on which photographs agree. Voxels in view of fewer than two photographs are dropped too."""
    photo_depth: Literal["auto", "off", "on"] = "auto"
    """Depth supervision: find depths by comparing each photograph with its neighbours (multi-view stereo, plane sweep),
    and make rays end at these depths, as at points of structure from motion. This keeps opaque floaters from forming
    before walls of little texture. auto: where the run has at least 400 steps; on: always. Both need a loss weight
    tracks above 0."""
    thermal_density_gradient: bool = False
    """Let thermal images move the geometry (off: temperature is painted on the surfaces that RGB images show)."""
    near_plane: float = 0.0
    """Distance before each camera that is not rendered, in units of half the longest side of the scene box."""
    backend: Backend = "auto"
    """fused: compiled kernels, on a CPU only; reference: plain PyTorch; auto: fused on a CPU, reference on a GPU."""
    memory_budget_gb: float = 4.0
    """Memory that the voxel grid with its optimiser may need, [GB]; a lattice that needs more is not built."""
    smallest_weight: float = 1e-5
    """Samples that fill at most this share of a pixel add no colour or temperature. 0 is exact and slower."""

    background: Literal["auto", "on", "off"] = "auto"
    """Colour behind the box as a sphere image. auto: dropped at the first refinement if no ray leaves unsaturated."""
    thermal_background: Literal["auto", "minimum", "learned"] = "auto"
    """Temperature behind the box: the scene's minimum (the paper), or a learned low-order sky."""

    surroundings: Literal["on", "off"] = "on"
    """on: what lies outside the box is rendered with parallax, by coarse lattices from the box to infinity, which are
    not exported. off: everything outside the box lies at infinity."""

    recipe: Literal["default", "paper"] = "default"
    """Set of loss weights; paper: the published weights."""
    loss_overrides: dict[str, float] = field(default_factory=dict)
    """Loss weights by name that replace weights of the recipe: rgb, thermal, tv_density, tv_sh, tv_temperature,
    beta, distortion, tracks, backdrop, bend, surroundings."""
    distortion_ramp: tuple[int, int] = _STANDARD.distortion_ramp
    """Steps over which the distortion term grows from nothing to its weight."""
    per_image_offset: Literal["auto", "on", "off"] = "auto"
    """One temperature offset per thermal image (mean zero), for cameras whose reading drifts. auto: only where thermal
    images of the same points differ, beginning with these differences (needs photo_depth); on: beginning with 0."""
    exposure: Literal["auto", "on", "off"] = "auto"
    """One gain per photograph and channel (mean one), for cameras that choose exposure and white balance anew. auto:
    only where photographs of the same points differ, beginning with their ratios (needs photo_depth); on: with 1."""
    seed: int = 0
    """Seed of everything random in the model."""

    def loss_weights(self) -> LossWeights:
        """Return the recipe's weights with the overrides; raise `ThermoxelsError` for an unknown name."""
        known = vars(LOSS_RECIPES[self.recipe])
        for name in self.loss_overrides.keys() - known.keys():
            expected = "one of " + ", ".join(known)
            raise ThermoxelsError(f"loss_overrides.{name}", expected=expected, got=name, remedy="Correct the name.")
        return LossWeights(**{**known, **self.loss_overrides})

    def check(self) -> None:
        """Raise `ThermoxelsError` if a setting is out of range or settings contradict each other."""
        self.refinements()
        ranges: dict[str, tuple[float, float, str]] = {
            **dict.fromkeys(("prune_threshold", "thin_threshold"), (0.0, 1.0, "from 0 to 1")),
            "smallest_weight": (0.0, 0.1, "from 0 to 0.1"),
            "eval_num_rays_per_chunk": (1, 1e9, "at least 1"),
            "prune_dilation": (0, 100, "from 0 to 100"),
            "temperature_degree": (0, 2, "0, 1 or 2"),
            "seed": (0, 2**32 - 1, "from 0 to 2^32 - 1"),
            "start_density": (1e-30, 1e30, "a finite number above 0"),
            "near_plane": (0.0, 1e30, "0 or more"),
            "memory_budget_gb": (1e-6, 1e6, "a number above 0"),
            "voxel_pixels": (0.0, 1000.0, "0 or more, at most 1000"),
        }
        values = {name: (getattr(self, name), *limits) for name, limits in ranges.items()}
        if self.sh_degree is not None:
            values["sh_degree"] = (self.sh_degree, 0, MAX_DEGREE, "None, 0, 1 or 2")
        values |= {
            f"loss_overrides {name}": (weight, 0.0, 1e30, "a finite number, 0 or more")
            for name, weight in vars(self.loss_weights()).items()
        }
        check_ranges("--pipeline.model.", values)
        for name, at in (("prune_at", self.prune_at), ("thin_at", self.thin_at)):
            if at and min(at) < 1:
                raise ThermoxelsError(name, expected="steps of at least 1", got=at, remedy="Correct the steps.")

    def refinements(self) -> dict[int, int]:
        """Return for each step of `refine_at` the factor by which the edges of voxels are divided. Raises
        `ThermoxelsError` if a resolution is no multiple of the one before or `refine_at` does not fit."""
        pairs = list(zip(self.resolutions, self.resolutions[1:]))
        increasing = all(b % a == 0 and b > a for a, b in pairs) and sorted(set(self.refine_at)) == list(self.refine_at)
        increasing = increasing and min((1, *self.refine_at)) == 1
        if not self.resolutions or len(self.refine_at) != len(pairs) or not increasing:
            expected = "resolutions that are multiples of each other and one ascending step fewer"
            got = f"{self.resolutions} at steps {self.refine_at}"
            remedy = "For example --pipeline.model.resolutions 32 64 128 --pipeline.model.refine-at 400 800."
            raise ThermoxelsError("resolutions and refine_at", expected=expected, got=got, remedy=remedy)
        return {step: b // a for step, (a, b) in zip(self.refine_at, pairs)}

    def suited_to(self, voxels: float) -> ThermoxelsModelConfig:
        """Return the settings for a scene along whose longest side `voxels` voxels of width `voxel_pixels` fit.

        If `voxels` is at most `MOST_STRETCH` times the last resolution, or if `resolutions`, `refine_at` or `prune_at`
        differs from `schedule_for`, all resolutions are scaled by one factor of at most `MOST_STRETCH`. Otherwise
        `schedule_for` gives all three for `voxels`, at most `MOST_VOXELS` times the last resolution and at most
        `FINEST` (or the last resolution, if that is more). Numbers are rounded, rather up: too few voxels lose shape
        (courtyard: F of the seen surface is 0.81, 0.86 and 0.89 with 96, 112 and 128). Infinite `voxels`, a
        `voxel_pixels` of 0, and settings that are `suited` already change nothing.
        """
        if self.suited or not self.voxel_pixels or not math.isfinite(voxels):
            return self
        first, last = self.resolutions[0], self.resolutions[-1]
        usual, splits = schedule_for(last, self.steps), 0
        own = self.resolutions, self.refine_at, self.prune_at
        if voxels <= MOST_STRETCH * last or own != (usual.resolutions, usual.refine_at, usual.prune_at):
            coarsest = _in_steps(min(voxels, MOST_STRETCH * last) * first / last)
            return replace(self, resolutions=tuple(coarsest * each // first for each in self.resolutions))
        wanted = min(voxels, MOST_VOXELS * last, max(FINEST, last))
        while wanted / 2 ** (splits + 1) >= COARSEST - STEP_OF_COARSEST / 2:
            splits += 1
        found = schedule_for(_in_steps(wanted / 2**splits) * 2**splits, self.steps)
        return replace(self, resolutions=found.resolutions, refine_at=found.refine_at, prune_at=found.prune_at)

    def first_sh_degree(self) -> int | None:
        """Return the degree of colour at the start: 0 (`sh_degree` if `view_dependence_from` is 0); None: no colour."""
        return 0 if self.sh_degree is not None and self.view_dependence_from > 0 else self.sh_degree

    def row_channels(self, resolution: int) -> int:
        """Return the largest count of numbers that a corner stores while the lattice has this `resolution`."""
        gives_way = dict(zip(self.resolutions, self.refine_at)).get(resolution, math.inf)
        degree = self.sh_degree if gives_way > self.view_dependence_from else self.first_sh_degree()
        return 1 + num_coefficients(self.temperature_degree) + (0 if degree is None else 3 * num_coefficients(degree))

    def checkpoint_columns(self) -> dict[str, tuple[int, ...]]:
        """Return, by name of a parameter of the grid, the numbers of columns that a checkpoint may have."""
        columns: dict[str, tuple[int, ...]] = {"density": (1,)}
        columns["temperature"] = (num_coefficients(self.temperature_degree),)
        if self.sh_degree is not None:  # one per channel until colour depends on the direction
            columns["sh"] = tuple(dict.fromkeys((3, 3 * num_coefficients(self.sh_degree))))
        return columns
