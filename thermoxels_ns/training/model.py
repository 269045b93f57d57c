"""The nerfstudio model: a voxel grid with its background, losses and metrics."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.models.base_model import Model
from nerfstudio.utils import colormaps
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor, nn

from thermoxels_ns.core.arrays import IntArray
from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.core.feature_rays import RGB_STREAM, THERMAL_STREAM, FeatureRays
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import GridSnapshot, Views
from thermoxels_ns.core.units import TemperatureRange
from thermoxels_ns.field.harmonics import harmonics, num_coefficients
from thermoxels_ns.field.kept_voxels import check_memory
from thermoxels_ns.field.surroundings import SkyTemperature, SphereImage, Surroundings
from thermoxels_ns.field.voxel_grid import VoxelGrid, activate_density
from thermoxels_ns.render.ray_render import RayRequest, RenderOptions
from thermoxels_ns.render.reference import intersect_box
from thermoxels_ns.render.renderers import GridSamples, Scene, SceneRender, render_scene, sample_rays, split_render
from thermoxels_ns.training import losses
from thermoxels_ns.training.degrees_view import DegreesView
from thermoxels_ns.training.image_metrics import (
    SATURATED,
    fitted_gain,
    lpips,
    psnr,
    psnr_of_blocks,
    ssim,
    thermal_metrics,
)
from thermoxels_ns.training.model_config import ThermoxelsModelConfig
from thermoxels_ns.training.plain_areas import PlainAreas, bend_loss
from thermoxels_ns.training.ray_statistics import field_evidence

FEATURE_RAYS = 512  # Feature rays (to depths or to points of structure from motion) that each step draws
EARLY_STOP = 1e-5  # A ray ends where less than this share of its light is left, by which its pixel may be off
VARIATION_SHARE = 0.1  # Share of the kept voxels over which each step computes total variation
SURROUNDINGS = (48, 12)
"""Voxels of the surroundings at the start: across a face of the box, and from a face to infinity. They are split when
the voxels of the box are."""
SURROUNDINGS_DENSITY = 0.005  # Density of the surroundings at the start, [1 / voxel]; a ray straight out loses 6 %
SURROUNDINGS_VARIATION = 100.0
"""Weight of the surroundings' total variation, relative to the box's; from one real scene (1: 16.6, 100: 17.7 dB)."""


class ThermoxelsModel(Model):
    """A voxel grid with its surroundings and background, trained on RGB and thermal rays."""

    config: ThermoxelsModelConfig
    temperature_bounds_c: Tensor  # Temperatures that stand for 0 and 1, (2,), [degrees Celsius]
    backdrop_on: Tensor  # Whether colour at infinity, temperature at infinity and surroundings are rendered, (3,)
    corrected: Tensor  # Whether gains and temperature offsets of training images are applied, (2,)
    trained_steps: Tensor  # Last step of training; kept because colour depends on the direction from some step on

    def populate_modules(self) -> None:
        """Build grid, surroundings, background and corrections; raise `SceneError` without a temperature range."""
        # All buffers are kept in the checkpoint.
        super().populate_modules()
        self.config.check()
        box, metadata = self.scene_box.aabb.double().numpy(), self.kwargs.get("metadata") or {}
        voxel = self.config.voxel_pixels * metadata.get("pixel_size", math.inf)
        longest = float((box[1] - box[0]).max())
        self.config = config = self.config.suited_to(longest / voxel if 0.0 < voxel < math.inf else math.inf)
        torch.manual_seed(config.seed)
        self.loss_weights = config.loss_weights()
        temperatures = metadata.get("temperature_range", "none")
        self.has_temperatures = temperatures is not None
        if temperatures is None:  # photographs alone
            temperatures = TemperatureRange(0.0, 1.0)
        if not isinstance(temperatures, TemperatureRange):
            remedy = "Use the dataparser thermal-data."
            raise SceneError("scene", expected="thermal images with a temperature range", got="none", remedy=remedy)
        bounds_c = torch.tensor([temperatures.min_c, temperatures.max_c], dtype=torch.float64)
        self.register_buffer("temperature_bounds_c", bounds_c)
        self.degrees_view = DegreesView(temperatures, self._read_ray) if self.has_temperatures else None
        if 0.0 < voxel < math.inf and not config.suited:
            pixels = config.voxel_pixels * longest / config.resolutions[-1] / voxel
            CONSOLE.log(
                f"voxels: {config.resolutions[-1]} along the longest side of the box, each {pixels:.1f} pixels wide "
                "where most of what photographs show stands"
            )
        # Settings are for a box whose longest side is 2; `unit` converts them to world units.
        self.unit = longest / 2.0
        lattice = Lattice.covering(box[0], box[1], config.resolutions[0])
        channels, budget = config.row_channels(config.resolutions[0]), config.memory_budget_gb
        need = check_memory(lattice, int(np.prod(lattice.cell_shape)), channels, budget)
        CONSOLE.log(f"memory at the start: {need}")
        self.grid = VoxelGrid(
            lattice,
            config.first_sh_degree(),
            config.temperature_degree,
            config.start_density / self.unit,
            config.density_activation,
        )
        wants_rgb = config.sh_degree is not None and config.background != "off"
        self.background_rgb = SphereImage() if wants_rgb else None
        self.background_thermal = SkyTemperature() if config.thermal_background != "minimum" else None
        start = (*SURROUNDINGS, SURROUNDINGS_DENSITY, config.density_activation, wants_rgb)
        self.surroundings = Surroundings(torch.from_numpy(box), *start) if config.surroundings == "on" else None
        on = [wants_rgb, self.background_thermal is not None, self.surroundings is not None]
        self.register_buffer("backdrop_on", torch.tensor(on))
        images, colour = self.num_train_data, config.sh_degree is not None and config.exposure != "off"
        self.log_gain = nn.Parameter(torch.zeros(images, 3)) if colour else None
        self.thermal_offset = nn.Parameter(torch.zeros(images)) if config.per_image_offset != "off" else None
        self.register_buffer("corrected", torch.tensor([config.exposure == "on", config.per_image_offset == "on"]))
        self.register_buffer("trained_steps", torch.tensor(0))
        self.step = 0
        # Rays from training photographs to the points of structure from motion.
        rays: FeatureRays | None = metadata.get("feature_rays")
        self.feature_rays, self.feature_ray_sampler = rays, None
        if rays is not None and len(rays.point) and config.sh_degree is not None:
            self.feature_ray_sampler = losses.FeatureRaySampler(rays, box, self.surroundings is not None)
        # Rays through pixels that show a plain backdrop or ceiling; `callbacks.follow_depths` finds them.
        self.backdrop_ray_sampler: losses.FeatureRaySampler | None = None
        self.plain_areas: PlainAreas | None = None  # Found by `callbacks.follow_depths` too

    @property
    def seen_surroundings(self) -> Surroundings | None:
        """The surroundings that are rendered; None: everything outside the box lies at infinity."""
        return self.surroundings if bool(self.backdrop_on[2]) else None

    @property
    def temperature_range(self) -> TemperatureRange:
        """The temperatures that are normalised to 0 and 1, from the checkpoint if one was loaded."""
        low, high = self.temperature_bounds_c.tolist()
        return TemperatureRange(low, high)

    def get_param_groups(self) -> dict[str, list[nn.Parameter]]:
        """Return the parameters by the name of their optimiser, such as density or surroundings_density."""
        groups = {name: [parameter] for name, parameter in self.grid.row_parameters().items()}
        backdrop = [p for m in (self.background_rgb, self.background_thermal) if m is not None for p in m.parameters()]
        if backdrop:
            groups["background"] = backdrop
        corrections = [values for values in (self.log_gain, self.thermal_offset) if values is not None]
        if corrections:
            groups["corrections"] = corrections
        if self.surroundings is not None:
            rows = self.surroundings.grid.row_parameters()
            groups |= {f"surroundings_{name}": [parameter] for name, parameter in rows.items()}
        return groups

    def update_to_step(self, step: int) -> None:
        """Set the step of training, on which weights, random blocks and random rays depend."""
        self.step = step
        self.trained_steps.fill_(step)

    def _request(
        self, origins: Tensor, directions: Tensor, nears: Tensor | None = None, fars: Tensor | None = None
    ) -> RayRequest:
        """Return a request for rays from `nears` (at least the near plane; None: there) to `fars`, both (rays, 1)."""
        near: float | Tensor = self.config.near_plane * self.unit
        if nears is not None:
            near = nears[:, 0].clamp(min=near)
        return RayRequest(origins, directions, near, None if fars is None else fars[:, 0])

    def _options(self) -> RenderOptions:
        c = self.config
        return RenderOptions(
            smallest_weight=c.smallest_weight, early_stop=EARLY_STOP, thermal_moves_density=c.thermal_density_gradient
        )

    def _training_options(self) -> RenderOptions:
        """Return the options of a training step: the options for images, and the values that loss terms need."""
        return replace(
            self._options(),
            distortion_scale=2.0 * self.unit if self._distortion_weight() > 0 else None,
            colour_channels=None if self.config.sh_degree is None else 3 * num_coefficients(self.config.sh_degree),
            variation=self._blocks(self.grid, 1_000_003),
        )

    def _blocks(self, grid: VoxelGrid, stream: int) -> dict[str, tuple[int, int]]:
        """Return by parameter name the random block of a grid's voxels whose total variation this step computes."""
        generator = torch.Generator().manual_seed(self.config.seed * stream + self.step)
        return {
            name: losses.random_block(len(grid.voxels), VARIATION_SHARE, generator)
            for name in grid.row_parameters()
            if getattr(self.loss_weights, f"tv_{name}")
        }

    @torch.no_grad()
    def correct_photographs(self, index: IntArray, log_gain: npt.NDArray | None, offset: npt.NDArray | None) -> None:
        """Set the logarithmic gains (n, 3) and normalised offsets (n,) of the training images `index` (n,). Other
        images keep 0. If `log_gain` or `offset` is None, these corrections stay as they are."""
        for number, (parameter, values) in enumerate(((self.log_gain, log_gain), (self.thermal_offset, offset))):
            if parameter is not None and values is not None:
                parameter[torch.from_numpy(index)] = torch.from_numpy(values).to(parameter)
                self.corrected[number] = True

    def sample_rays(self, origins: Tensor, directions: Tensor) -> GridSamples:
        """Return the samples of rays in kept voxels of the box with their weights, for statistics."""
        return sample_rays(self.grid, self._request(origins, directions), self._options(), self.config.backend)

    def sample_surroundings(self, origins: Tensor, directions: Tensor) -> GridSamples:
        """Return the samples in the surroundings; each straight piece of a ray counts as a ray; the box hides none."""
        assert self.surroundings is not None
        cut = self.surroundings.segments(origins, directions)
        request = RayRequest(cut.origins, cut.directions, 0.0, cut.lengths)
        return sample_rays(self.surroundings.grid, request, RenderOptions(), self.config.backend)

    def render_rays(self, request: RayRequest, options: RenderOptions) -> SceneRender:
        """Return what rays see of the box, the surroundings and infinity."""
        rgb_on, thermal_on, _ = self.backdrop_on.tolist()
        around = self.seen_surroundings
        rgb, thermal = self.background_rgb if rgb_on else None, self.background_thermal if thermal_on else None
        blocks = self._blocks(around.grid, 3_000_017) if around is not None and options.variation else None
        return render_scene(Scene(self.grid, around, rgb, thermal), request, options, self.config.backend, blocks)

    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, Any]:
        """Return what rays see: rgb, thermal (normalised), temperature_c, depth, accumulation, in_box (1: meets box).

        For rays of a training batch, which carry their stream (see `core.feature_rays`), return the inputs of
        `get_loss_dict` instead. Rays are rendered from `nears` to `fars`, with which the viewer crops a scene.
        """
        request = self._request(ray_bundle.origins, ray_bundle.directions, ray_bundle.nears, ray_bundle.fars)
        stream = ray_bundle.metadata.get("stream")
        if stream is None:
            return self._image_outputs(request)
        rgb_rays, thermal_rays = (stream[:, 0] & RGB_STREAM) > 0, (stream[:, 0] & THERMAL_STREAM) > 0
        batch: dict[str, Any] = {"rgb_rays": rgb_rays, "thermal_rays": thermal_rays}
        if not self.training:
            # Exporters of nerfstudio render batches too; colour is left out only if no ray belongs to a photograph.
            if not bool(rgb_rays.any()):
                request = replace(request, rgb_rays=rgb_rays)
            return batch | self._image_outputs(request)
        request = replace(request, rgb_rays=rgb_rays, thermal_rays=thermal_rays)
        known = self._known_rays()
        # All in one call: on a GPU a step spends most of its time on starting operations.
        seen, *ends = split_render(
            [request, *(rays for rays, _ in known.values())],
            lambda joined: self.render_rays(joined, self._training_options()),
        )
        terms = {name: loss(end) for (name, (_, loss)), end in zip(known.items(), ends)}
        rgb, thermal = seen.rgb, seen.thermal
        # The gradient of `index_select` adds rays in their order; with an index instead, threads would race.
        gains_on, offsets_on = self.corrected.tolist()
        photograph = torch.zeros(0) if ray_bundle.camera_indices is None else ray_bundle.camera_indices[:, 0]
        if self.log_gain is not None and gains_on and rgb is not None:
            log_gain = self._correction(self.log_gain, self.config.exposure)
            rgb = rgb * torch.exp(log_gain - log_gain.mean(0)).index_select(0, photograph)
        if self.thermal_offset is not None and offsets_on:
            offset = self._correction(self.thermal_offset, self.config.per_image_offset)
            thermal = thermal + (offset - offset.mean()).index_select(0, photograph)[:, None]
        return batch | {"rgb": rgb, "thermal": thermal, "render": seen, "known_rays": terms}

    def _correction(self, correction: Tensor, wanted: str) -> Tensor:
        """Return `correction`, detached if its option `wanted` is auto and the distortion ramp has not ended yet."""
        return correction.detach() if wanted == "auto" and self.step < self.config.distortion_ramp[1] else correction

    def _image_outputs(self, request: RayRequest) -> dict[str, Tensor]:
        seen = self.render_rays(request, self._options())
        rgb, thermal, origins = seen.rgb, seen.thermal, request.origins
        if rgb is None or (request.rgb_rays is not None and not bool(request.rgb_rays.any())):
            rgb = thermal.expand(-1, 3)
        # A ray that hits nothing is drawn behind the box: image writers cannot show infinity.
        lo, hi = torch.tensor([self.grid.lattice.lo, self.grid.lattice.hi], dtype=origins.dtype, device=origins.device)
        far = torch.linalg.norm(origins - 0.5 * (lo + hi), dim=-1) + 0.5 * torch.linalg.norm(hi - lo)
        warm = {"thermal": thermal, "temperature_c": self.temperature_range.to_celsius(thermal)}
        return {
            "rgb": rgb.clamp(0, 1),
            **(warm if self.has_temperatures else {}),
            "depth": torch.minimum(seen.box.depth, far)[:, None],
            "accumulation": seen.box.accumulation[:, None],
            "in_box": intersect_box(origins, request.directions, lo, hi, request.near)[2][:, None].to(origins.dtype),
        }

    def get_rgba_image(self, outputs: dict[str, Tensor], output_name: str = "rgb") -> Tensor:
        """Return colour and opacity (..., 4), for the exporters of nerfstudio."""
        return torch.cat((outputs[output_name], outputs["accumulation"]), dim=-1)

    def get_loss_dict(
        self, outputs: dict[str, Any], batch: dict[str, Any], metrics_dict: dict[str, Any] | None = None
    ) -> dict[str, Tensor]:
        """Return the weighted loss terms by name; terms of weight 0 are not computed."""
        weights, terms = self.loss_weights, {}
        if weights.rgb and (pair := _seen_and_measured(outputs, batch, "rgb", "image")) is not None:
            seen, measured = pair
            if self.training and bool(self.corrected[0]):  # a saturated pixel may have been brighter than it says
                seen = torch.where(measured >= SATURATED, torch.minimum(seen, measured), seen)
            terms["rgb_loss"] = weights.rgb * torch.mean((seen - measured) ** 2)
        if weights.thermal and (pair := _seen_and_measured(outputs, batch, "thermal", "thermal")) is not None:
            terms["thermal_loss"] = weights.thermal * losses.thermal_loss(*pair)
        if not self.training:
            return terms
        render: SceneRender = outputs["render"]
        box, around = render.box, render.around
        for name, value in box.variation.items():
            if around is not None:
                value = value + SURROUNDINGS_VARIATION * around.variation.get(name, 0.0)
            terms[f"tv_{name}_loss"] = getattr(weights, f"tv_{name}") * value
        if weights.beta:
            terms["beta_loss"] = weights.beta * losses.beta_loss(box.accumulation)
        if box.distortion is not None:
            terms["distortion_loss"] = self._distortion_weight() * box.distortion.mean()
        if weights.surroundings and around is not None:
            terms["surroundings_loss"] = weights.surroundings * (1.0 - around.transmittance).mean()
        return terms | outputs["known_rays"]

    def _known_rays(self) -> dict[str, tuple[RayRequest, Callable[[SceneRender], Tensor]]]:
        """Return, by name of the loss term (tracks_loss, backdrop_loss, bend_loss), random rays whose ends are known
        from photographs, and the weighted loss as a function of their rendering."""
        weights, near, voxel = self.loss_weights, self.config.near_plane * self.unit, self.grid.lattice.voxel_size
        known: dict[str, tuple[RayRequest, Callable[[SceneRender], Tensor]]] = {}
        for name, weight, sampler in (
            ("tracks", weights.tracks, self.feature_ray_sampler),
            ("backdrop", weights.backdrop, self.backdrop_ray_sampler),
        ):
            if weight and sampler is not None:
                generator = torch.Generator().manual_seed((self.config.seed + 1) * 2_000_003 + self.step)
                step = 0.0 if self.seen_surroundings is None else self.seen_surroundings.step
                request = sampler.request(FEATURE_RAYS, near, voxel, generator, self.device, step)
                known[f"{name}_loss"] = request, partial(self._feature_ray_loss, weight, sampler)
        if weights.bend and self.plain_areas:  # None, or without any, in a scene without plain areas
            generator = torch.Generator().manual_seed((self.config.seed + 1) * 5_000_011 + self.step)
            request, length = self.plain_areas.request(FEATURE_RAYS // 4, near, generator, self.device)
            known["bend_loss"] = (
                request,
                lambda seen: weights.bend * bend_loss(seen.box.depth, seen.box.accumulation, length, voxel),
            )
        return known

    def _feature_ray_loss(self, weight: float, rays: losses.FeatureRaySampler, seen: SceneRender) -> Tensor:
        """Return `weight` times `losses.feature_ray_loss`; at coarse lattices `coarse_light` may pass the points."""
        lost, left = seen.box.accumulation, seen.box.transmittance
        if seen.around is not None:
            left = left * seen.around.transmittance
            lost = 1.0 - left
        last = max(self.grid.lattice.cell_shape) >= self.config.resolutions[-1]
        return weight * losses.feature_ray_loss(lost, left, 0.0 if last else rays.coarse_light)

    def _distortion_weight(self) -> float:
        """Return the weight of the distortion term at this step; over `distortion_ramp` the weight grows from 0."""
        first, last = self.config.distortion_ramp
        return self.loss_weights.distortion * min(1.0, max(0.0, (self.step - first) / max(1, last - first)))

    @torch.no_grad()
    def get_metrics_dict(self, outputs: dict[str, Any], batch: dict[str, Any]) -> dict[str, Tensor]:
        """Return psnr, [dB], and thermal_mae_c, the mean temperature error, [K], of a batch."""
        metrics = {}
        if (pair := _seen_and_measured(outputs, batch, "rgb", "image")) is not None:
            metrics["psnr"] = torch.tensor(psnr(*pair))
        if (pair := _seen_and_measured(outputs, batch, "thermal", "thermal")) is not None:
            metrics["thermal_mae_c"] = (pair[0] - pair[1]).abs().mean() * self.temperature_range.span_k
        return metrics

    @torch.no_grad()
    def get_image_metrics_and_images(
        self, outputs: dict[str, Tensor], batch: dict[str, Any]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """Return metrics of one held-out frame, and pictures by name; the measured image is left of the rendered one.

        The thermal image is rendered from the pose of its own camera if there is one. ``psnr_box`` and
        ``thermal_mae_box_c`` count the pixels whose rays meet the box ahead of the camera; some of these pixels show
        things in front of the box or behind it.
        """
        metrics: dict[str, float] = {}
        images: dict[str, Tensor] = {}
        if self.grid.sh is not None:
            target, predicted = batch["image"][..., :3].to(self.device), outputs["rgb"]
            mask = batch["mask"].to(self.device).bool() if "mask" in batch else None
            whole = None if mask is None else mask.expand_as(target)
            metrics |= {"psnr": psnr(predicted, target, whole), "ssim": ssim(predicted, target, mask)}
            metrics["psnr_8"] = psnr_of_blocks(predicted, target, mask)
            in_box = outputs["in_box"] > 0 if mask is None else (outputs["in_box"] > 0) & mask
            metrics["psnr_box"] = psnr(predicted, target, in_box.expand_as(target))
            if find_spec("lpips") is not None:  # an optional package: pip install thermoxels-ns[lpips]
                metrics["lpips"] = lpips(predicted, target)
            images["img"] = torch.cat((target, predicted), dim=1)
        seen = outputs
        if batch.get("thermal_camera") is not None:
            seen = self._rendered(batch["thermal_camera"], THERMAL_STREAM)
        images["accumulation"] = colormaps.apply_colormap(outputs["accumulation"])
        images["depth"] = colormaps.apply_depth_colormap(outputs["depth"], accumulation=outputs["accumulation"])
        thermal, valid = batch["thermal"].to(self.device), batch["thermal_valid"].to(self.device)
        if "mask" in batch and batch["mask"].shape == valid.shape and seen is outputs:
            valid = valid & batch["mask"].to(self.device).bool()
        if self.has_temperatures:
            metrics |= thermal_metrics(seen, thermal, valid, self.temperature_range.span_k)
            both = torch.cat((thermal, seen["thermal"]), dim=1).clamp(0, 1)
            images["thermal"] = colormaps.apply_float_colormap(both, "inferno")
        return metrics | self._fitted_metrics(outputs, seen, batch, valid), images

    def _fitted_metrics(
        self, outputs: dict[str, Tensor], seen: dict[str, Tensor], batch: dict[str, Any], valid: Tensor
    ) -> dict[str, float]:
        """Return ``psnr_fitted``: the PSNR of a held-out frame with fitted gains and, if there is one, fitted pose.

        Gains are fitted to all pixels in the mask. If the batch has a camera fitted to the frame's own features, the
        frame is rendered from there, and ``thermal_mae_debiased_c`` is returned too. `outputs` and `seen` are the
        photograph and the thermal image as rendered from the given poses; `valid` are the measured thermal pixels.
        """
        metrics: dict[str, float] = {}
        if batch.get("fitted_camera") is not None:
            outputs = self._rendered(batch["fitted_camera"], RGB_STREAM | THERMAL_STREAM)
            own = batch.get("fitted_thermal_camera")
            seen = outputs if own is None else self._rendered(own, THERMAL_STREAM)
            if self.has_temperatures:
                thermal, span_k = batch["thermal"].to(self.device), self.temperature_range.span_k
                warm = thermal_metrics(seen, thermal, valid, span_k)
                metrics["thermal_mae_debiased_c"] = warm["thermal_mae_debiased_c"]
        if self.grid.sh is not None:
            target, predicted = batch["image"][..., :3].to(self.device), outputs["rgb"]
            if "mask" in batch:
                mask = batch["mask"].to(self.device).bool()[..., 0]
                target, predicted = target[mask], predicted[mask]
            target, predicted = target.reshape(-1, 3), predicted.reshape(-1, 3)
            gain = fitted_gain(predicted, target)
            metrics["psnr_fitted"] = psnr((gain * predicted).clamp(max=1.0), target)
        return metrics

    def get_outputs_for_camera(self, camera: Cameras, obb_box: OrientedBox | None = None) -> dict[str, Tensor]:
        """Return the outputs of a camera's image; in a viewer, ``degrees`` too, from `DegreesView.picture`."""
        outputs = super().get_outputs_for_camera(camera, obb_box)
        if self.degrees_view is not None and self.degrees_view.shown:
            outputs["degrees"] = self.degrees_view.picture(outputs["temperature_c"])
        return outputs

    def _read_ray(self, origin: Tensor, direction: Tensor) -> tuple[float, float]:
        """Return the temperature that a ray sees, [degrees Celsius], and its opacity; both arguments are (1, 3)."""
        direction = torch.nn.functional.normalize(direction.to(self.device, torch.float32), dim=-1)
        seen = self._image_outputs(self._request(origin.to(self.device, torch.float32), direction))
        return float(seen["temperature_c"]), float(seen["accumulation"])

    def _rendered(self, camera: Cameras, stream: int) -> dict[str, Tensor]:
        """Return the outputs of `get_outputs` for the image of a camera of shape (1,); `stream` are the rays' bits."""
        rays = camera.to(self.device).generate_rays(camera_indices=0, keep_shape=True)
        rays.metadata["stream"] = torch.full((*rays.shape, 1), stream, dtype=torch.uint8, device=self.device)
        return self.get_outputs_for_camera_ray_bundle(rays)

    @torch.no_grad()
    def grid_snapshot(self, rays: Iterable[RayBundle], views: Views | None = None) -> GridSnapshot:
        """Return the trained field for the mesher, with the evidence of training rays of both streams.

        Without rays there is no evidence, and temperatures are the stored ones. Colour is the sigmoid of the harmonic
        of degree 0, about the mean over directions (exactly, if colour is the same from all sides). Corners without a
        row are grey.
        """
        grid, colour = self.grid, None
        thermal, thermal_weight, evidence = field_evidence(grid, self.sample_rays, rays)
        density = activate_density(grid.density[:, 0], grid.activation)
        # Corners without a row get the middle of the range; nothing reads these values.
        thermal = grid.corner_values(thermal.float(), fill=0.5)
        if grid.sh is not None and grid.sh_degree is not None:
            constant = harmonics(grid.sh.new_tensor([[0.0, 0.0, 1.0]]), 0)  # degree 0 is the same in all directions
            mean = grid.sh.view(len(grid.sh), 3, num_coefficients(grid.sh_degree))[..., 0] * constant
            channels = torch.sigmoid(mean).float().unbind(-1)
            colour = torch.stack([grid.corner_values(rows, 0.5) for rows in channels], -1).cpu().numpy()
        return GridSnapshot(
            grid.lattice,
            density=grid.corner_values(density.float()).cpu().numpy(),
            temperature_c=self.temperature_range.to_celsius(thermal).cpu().numpy(),
            observed_weight=grid.corner_values(thermal_weight.float()).cpu().numpy(),
            voxel_density=grid.voxel_density().float().cpu().numpy(),
            colour=colour,
            evidence=evidence,
            views=views,
        )


def _seen_and_measured(
    outputs: dict[str, Any], batch: dict[str, Any], name: str, target: str
) -> tuple[Tensor, Tensor] | None:
    """Return rendered and measured values of the rays of the stream `name`, rgb or thermal; None without such rays.
    `target` is the key of the measured values in `batch`, which has one row per ray."""
    (chosen,) = outputs[f"{name}_rays"].nonzero(as_tuple=True)
    if outputs.get(name) is None or not len(chosen):
        return None
    return outputs[name].index_select(0, chosen), batch[target].index_select(0, chosen)


ThermoxelsModelConfig.model_class = ThermoxelsModel
