"""nerfstudio datamanager whose batches have two streams of rays: colour and temperature."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.configs.dataparser_configs import AnnotatedDataParserUnion
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManager, VanillaDataManagerConfig
from nerfstudio.data.pixel_samplers import PixelSamplerConfig
from nerfstudio.data.utils.dataloaders import FixedIndicesEvalDataloader, RandIndicesEvalDataloader
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.core.snapshot import Views
from thermoxels_ns.data.dataparser import ThermalDataParserConfig
from thermoxels_ns.data.dataset import ThermalDataset
from thermoxels_ns.data.ray_sampler import RaySampler, draw_generator

_TRAIN, _EVAL, _EVAL_IMAGE = 0, 1, 2


@dataclass
class ThermalDataManagerConfig(VanillaDataManagerConfig):
    """Batches of rays from paired photographs, in two streams: colour and temperature."""

    _target: type = field(default_factory=lambda: ThermalDataManager)
    """Class to instantiate."""
    dataparser: AnnotatedDataParserUnion = field(default_factory=ThermalDataParserConfig)
    """Dataparser that reads the scene; only thermal-data gives thermal images."""
    train_num_rays_per_batch: int = 4096
    """Rays through photographs per training step. If a pair shares its camera, these rays carry temperature too."""
    thermal_num_rays_per_batch: int = 2048
    """Rays through thermal images per training step, beside the rays through photographs. Used only if thermal cameras
    differ from the photographs' in pose, intrinsics or resolution."""
    eval_num_rays_per_batch: int = 4096
    """Rays through photographs per evaluation batch. Thermal rays are added in the proportion of training."""
    streams: Literal["both", "rgb", "thermal"] = "both"
    """Images that train: both, rgb (photographs only) or thermal (thermal images only, the baseline without colour)."""
    seed: int = 42
    """Seed of the random numbers. A batch depends on the seed and the step alone, so that a resumed training draws the
    same batches as an uninterrupted training."""


class ThermalDataManager(VanillaDataManager[ThermalDataset]):
    """Source of batches of colour and thermal rays of one scene, made in this process.

    In training (test_mode "val"), a training batch depends on seed and step alone. In other modes, the number of the
    call replaces the step, because nerfstudio's exporters always pass step 0 and need new rays each time.
    """

    config: ThermalDataManagerConfig
    train_dataset: ThermalDataset
    eval_dataset: ThermalDataset

    def setup_train(self) -> None:
        """Make the rays and load the photographs of the training split; print how many thermal pixels are masked.

        Raises `SceneError` if thermal images alone are to train and there are none.
        """
        if self.train_dataset.temperature_range is None:
            if self.config.streams == "thermal":
                remedy = "Use the method thermoxels, which trains on photographs alone too."
                raise SceneError("thermal images", expected="some to train on", got="none", remedy=remedy)
            self.config.streams = "rgb"
        # Stock exporters and dynamic batches set the number of rays on this object.
        self.train_pixel_sampler = PixelSamplerConfig(num_rays_per_batch=self.config.train_num_rays_per_batch).setup()
        self.train_rays.load()
        dataset = self.train_dataset
        temperatures, shared = dataset.temperature_range, dataset.thermal_cameras is None
        if temperatures is None:
            CONSOLE.print(f"Training split: {len(dataset)} photographs alone: the mesh will have no temperatures.")
            return
        CONSOLE.print(
            f"Training split: {len(dataset)} pairs ("
            + ("one ray carries colour and temperature" if shared else "thermal cameras of their own")
            + f"), {temperatures.min_c:.2f} to {temperatures.max_c:.2f} C; thermal: {dataset.thermal_report()}."
        )

    def setup_eval(self) -> None:
        """Prepare whole evaluation images; the rays of the evaluation split are made at the first `next_eval`."""
        self.eval_pixel_sampler = PixelSamplerConfig(num_rays_per_batch=self.config.eval_num_rays_per_batch).setup()
        self.fixed_indices_eval_dataloader = FixedIndicesEvalDataloader(self.eval_dataset, device=self.device)
        self.eval_dataloader = RandIndicesEvalDataloader(self.eval_dataset, device=self.device)
        dataset = self.eval_dataset
        pairs = dataset.temperature_range is not None
        kind = f"pairs; thermal: {dataset.thermal_report()}" if pairs else "photographs"
        CONSOLE.print(f"Evaluation split: {len(dataset)} {kind}.")

    @cached_property
    def train_rays(self) -> RaySampler:
        """Pixels and rays of the training split."""
        storage = self.device if self.config.images_on_gpu else "cpu"
        return RaySampler(self.train_dataset, self.config.streams, storage, self.device)

    @cached_property
    def eval_rays(self) -> RaySampler:
        """Pixels and rays of the evaluation split."""
        storage = self.device if self.config.images_on_gpu else "cpu"
        return RaySampler(self.eval_dataset, self.config.streams, storage, self.device)

    def next_train(self, step: int) -> tuple[RayBundle, dict[str, Tensor]]:
        """Return the rays and targets of the training batch of a step, see `RaySampler.draw`.

        ``metadata["stream"]`` of the rays holds the bits (`core.feature_rays`) of the targets that each ray has.
        """
        number = step if self.test_mode == "val" else self.train_count
        self.train_count += 1
        generator = draw_generator(self.config.seed, self.local_rank, _TRAIN, number)
        return self.train_rays.draw(generator, self._rgb_rays(), self.config.thermal_num_rays_per_batch)

    def next_eval(self, step: int) -> tuple[RayBundle, dict[str, Tensor]]:
        """Return rays and targets of the evaluation split, in the form of `next_train`, chosen by seed and step."""
        self.eval_count += 1
        rgb_rays = self.config.eval_num_rays_per_batch
        share = self.config.thermal_num_rays_per_batch / max(self.config.train_num_rays_per_batch, 1)
        generator = draw_generator(self.config.seed, self.local_rank, _EVAL, step)
        return self.eval_rays.draw(generator, rgb_rays, max(round(rgb_rays * share), 1))

    def next_eval_image(self, step: int) -> tuple[Cameras, dict]:
        """Return camera (1,) and item (see `ThermalDataset`) of one evaluation image, chosen by seed and step alone."""
        generator = draw_generator(self.config.seed, self.local_rank, _EVAL_IMAGE, step)
        index = int(torch.randint(len(self.eval_dataset), (1,), generator=generator))
        return self.eval_dataloader.get_camera(index)

    def training_rays(self, stream: int, max_rays_per_image: int | None = None) -> Iterator[RayBundle]:
        """Yield bundles of training rays through the pixels of a regular grid, without decoding photographs.

        `stream` holds bits of `core.feature_rays`. The thermal bit alone gives rays through valid thermal pixels; both
        bits together give every ray once. Streams that do not train (option `streams`) give no rays. The grid is the
        same in each call and has at most `max_rays_per_image` pixels of an image (None: all).
        """
        return self.train_rays.grid(stream, max_rays_per_image)

    def training_views(self) -> Views:
        """Return the cameras of the streams that train: the photographs', and the thermal cameras if these differ."""
        dataset, streams = self.train_dataset, self.config.streams
        own = dataset.thermal_cameras is not None
        parts = [dataset.views()] if streams != "thermal" or not own else []
        if streams != "rgb" and own:
            parts.append(dataset.views(thermal=True))
        return Views(*(np.concatenate(arrays) for arrays in zip(*(vars(part).values() for part in parts))))

    def get_train_rays_per_batch(self) -> int:
        """Return the number of rays in a batch of `next_train`."""
        thermal = 0 if self.train_dataset.thermal_cameras is None else self.config.thermal_num_rays_per_batch
        rgb = self._rgb_rays()
        return {"both": rgb + thermal, "rgb": rgb, "thermal": thermal or rgb}[self.config.streams]

    def _rgb_rays(self) -> int:
        sampler = self.train_pixel_sampler
        return self.config.train_num_rays_per_batch if sampler is None else sampler.num_rays_per_batch
