import math
from pathlib import Path

import numpy as np
import pytest
import torch
from nerfstudio.data.scene_box import SceneBox

from thermoxels_ns.core.units import TemperatureRange
from thermoxels_ns.data.dataparser import ThermalDataParserConfig
from thermoxels_ns.synthetic.scene_folder import make_scene, write_scene
from thermoxels_ns.training.model import ThermoxelsModel
from thermoxels_ns.training.model_config import MOST_VOXELS, ThermoxelsModelConfig


@pytest.mark.parametrize(
    ("voxels", "expected"),
    [
        (113.0, (32, 64, 128)),
        (128.0, (32, 64, 128)),
        (160.0, (40, 80, 160)),
        (220.0, (56, 112, 224)),
        (230.0, (64, 128, 256)),
        (5000.0, (96, 192, 384)),
        (1.0, (8, 16, 32)),
        (math.inf, (32, 64, 128)),
    ],
)
def test_resolutions_follow_the_photographs_up_to_a_limit(voxels, expected):
    config = ThermoxelsModelConfig(voxel_pixels=2.0).suited_to(voxels)
    assert config.resolutions == expected and max(config.prune_at) < config.thin_at[0]
    own = ThermoxelsModelConfig(voxel_pixels=2.0, refine_at=(5, 9)).suited_to(voxels)
    assert own.refine_at == (5, 9) and own.resolutions[-1] <= 192, "steps of one's own stay"
    assert ThermoxelsModelConfig(voxel_pixels=0.0).suited_to(voxels).resolutions == (32, 64, 128), "nothing is asked"
    config.check()
    assert config.resolutions[-1] <= MOST_VOXELS * 128


@pytest.mark.parametrize(
    ("pixel_size", "expected"), [(2.0 / 160 / 1.6, (40, 80, 160)), (1e-6, (96, 192, 384)), (None, (32, 64, 128))]
)
def test_a_model_has_the_voxels_that_its_photographs_ask_for(pixel_size, expected):
    metadata = {"temperature_range": TemperatureRange(10.0, 30.0)}
    if pixel_size is not None:
        metadata["pixel_size"] = pixel_size
    box = SceneBox(aabb=torch.tensor([[-1.0, -1.0, -0.5], [1.0, 1.0, 0.5]]))
    config = ThermoxelsModelConfig(voxel_pixels=1.6)
    model = config.setup(scene_box=box, num_train_data=4, metadata=metadata)
    assert isinstance(model, ThermoxelsModel) and model.config.resolutions == expected
    assert max(model.grid.lattice.cell_shape) == expected[0]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return write_scene(
        make_scene("sphere"), tmp_path_factory.mktemp("pixels"), 12, 2, width=160, height=120, progress=False
    )


@pytest.mark.parametrize("given", [False, True])
@pytest.mark.parametrize("factor", [None, 2])
def test_a_pixel_is_as_wide_as_it_is_where_the_body_stands(folder, factor, given):
    scene = make_scene("sphere")
    box = tuple(tuple(corner) for corner in np.asarray(scene.scene_box).tolist()) if given else None
    config = ThermalDataParserConfig(data=folder, scene_box=box, downscale_factor=factor)
    outputs = config.setup().get_dataparser_outputs()
    away = np.linalg.norm(np.concatenate(scene.poses(12, 2))[:, :3, 3], axis=1)
    focal = float(outputs.cameras.fx[0])
    size = outputs.metadata["pixel_size"] / outputs.dataparser_scale
    radius = 0.5 * np.ptp(np.asarray(scene.scene_box), axis=0).max()
    assert (away.mean() - radius) / focal < size < away.mean() / focal
