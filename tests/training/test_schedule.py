"""When things happen in a training, and the named qualities of ns-train."""

from copy import deepcopy

import pytest
import tyro

from thermoxels_ns.config import thermoxels
from thermoxels_ns.training.schedule import QUALITIES, schedule_for


@pytest.mark.parametrize("steps", [10, 33, 400, 20_000])
@pytest.mark.parametrize("resolution", [1, 20, 32, 33, 50, 64, 96, 100, 128, 256, 512, 1024])
def test_a_schedule_is_one_that_a_model_accepts(resolution, steps):
    schedule = schedule_for(resolution, steps)
    assert schedule.resolutions[-1] == resolution and schedule.steps == steps
    assert len(schedule.refine_at) == len(schedule.resolutions) - 1
    assert all(fine == 2 * coarse for coarse, fine in zip(schedule.resolutions, schedule.resolutions[1:]))
    assert schedule.resolutions[0] < 64 or resolution >= 1024
    everything = (*schedule.refine_at, *schedule.prune_at, *schedule.thin_at, *schedule.distortion_ramp)
    assert all(1 <= step < steps for step in everything)
    assert list(schedule.refine_at) == sorted(schedule.refine_at)
    if steps >= 400:
        config = deepcopy(thermoxels.config)
        config.follow_schedule(schedule)
        config.pipeline.model.check()
        assert max(everything) == schedule.thin_at[0]


@pytest.mark.parametrize("quality", QUALITIES)
def test_a_quality_sets_resolution_and_length_and_leaves_the_defaults_alone(quality):
    before = deepcopy(thermoxels.config)
    config = tyro.cli(type(before), default=before, args=["--quality", quality])
    resolution, steps = QUALITIES[quality]
    assert config.max_num_iterations == steps and config.pipeline.model.resolutions[-1] == resolution
    assert {group["scheduler"].max_steps for group in config.optimizers.values()} == {steps}
    assert config.pipeline.model.thin_at == schedule_for(resolution, steps).thin_at
    assert thermoxels.config.max_num_iterations == QUALITIES["standard"][1]
    assert thermoxels.config.pipeline.model.resolutions[-1] == QUALITIES["standard"][0]
