"""The training methods of this package, which nerfstudio finds through entry points."""

from __future__ import annotations

import torch
from nerfstudio.configs.base_config import LocalWriterConfig, LoggingConfig, MachineConfig, ViewerConfig
from nerfstudio.engine.optimizers import OptimizerConfig
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig
from nerfstudio.plugins.types import MethodSpecification

from thermoxels_ns import nerfstudio_bridge
from thermoxels_ns.core.yaml_records import configs_folder, read_yaml, with_overrides
from thermoxels_ns.data.datamanager import ThermalDataManagerConfig
from thermoxels_ns.training.model_config import ThermoxelsModelConfig
from thermoxels_ns.training.optimizers import FusedAdamConfig, LateDecaySchedulerConfig, RowAdamConfig, RowRMSpropConfig
from thermoxels_ns.training.pipeline import ThermoxelsPipeline, ThermoxelsPipelineConfig
from thermoxels_ns.training.schedule import QUALITIES
from thermoxels_ns.training.trainer import LOCAL_HOST, ThermoxelsTrainerConfig

nerfstudio_bridge.install()
ThermoxelsPipeline.compare_with_truth = nerfstudio_bridge.compare_with_truth

_, ITERATIONS, VOXEL_PIXELS = QUALITIES["standard"]


Scheduler = type[ExponentialDecaySchedulerConfig]


def _group(
    lr: float, lr_final: float, optimizer: type[OptimizerConfig], scheduler: Scheduler = ExponentialDecaySchedulerConfig
) -> dict:
    return {"optimizer": optimizer(lr=lr), "scheduler": scheduler(lr_final=lr_final, max_steps=ITERATIONS)}


def _trainer(
    optimizer: type[OptimizerConfig] = RowAdamConfig,
    dense: type[OptimizerConfig] = FusedAdamConfig,
    values: Scheduler = LateDecaySchedulerConfig,
) -> ThermoxelsTrainerConfig:
    """Return the default training; `optimizer` is for rows of the voxel grid, `dense` for arrays updated as a whole,
    `values` for the learning rates of colours and temperatures.

    Colours and temperatures end at a fiftieth of the first rate: few rays meet each of many small voxels, and a rate
    that is still high leaves the noise of the last of them (docs/accuracy.md).
    """
    return ThermoxelsTrainerConfig(
        method_name="thermoxels",
        max_num_iterations=ITERATIONS,
        steps_per_save=500,
        steps_per_eval_batch=0,
        steps_per_eval_image=0,
        steps_per_eval_all_images=0,
        mixed_precision=False,
        machine=MachineConfig(device_type="cuda" if torch.cuda.is_available() else "cpu"),
        logging=LoggingConfig(local_writer=LocalWriterConfig(enable=False), profiler="none"),
        pipeline=ThermoxelsPipelineConfig(
            datamanager=ThermalDataManagerConfig(), model=ThermoxelsModelConfig(voxel_pixels=VOXEL_PIXELS)
        ),
        optimizers={
            "density": _group(0.3, 0.03, optimizer),
            "sh": _group(0.1, 0.002, optimizer, values),
            "temperature": _group(0.02, 0.0004, optimizer, values),
            "background": _group(0.05, 0.001, dense, values),
            "surroundings_density": _group(0.3, 0.03, optimizer),
            "surroundings_sh": _group(0.1, 0.002, optimizer, values),
            "surroundings_temperature": _group(0.02, 0.0004, optimizer, values),
            "corrections": _group(0.002, 0.0002, dense),
        },
        viewer=ViewerConfig(websocket_host=LOCAL_HOST, quit_on_train_completion=True),
        vis="viewer",
    )


def _preset(name: str, default: ThermoxelsTrainerConfig) -> MethodSpecification:
    content = read_yaml(configs_folder() / f"{name}.yaml")
    description = content.pop("description")
    return MethodSpecification(with_overrides(default, content), description)


thermoxels = MethodSpecification(_trainer(), "RGB and thermal photographs to a voxel model that heat can be solved on.")
thermoxels_paper = _preset(
    "thermoxels-paper", _trainer(RowRMSpropConfig, RowRMSpropConfig, ExponentialDecaySchedulerConfig)
)
thermoxels_arco = _preset("thermoxels-arco", _trainer())
plenoxels_t = _preset("plenoxels-t", _trainer())
