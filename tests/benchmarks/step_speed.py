"""How long a training step takes: fused against reference, and how it grows with the resolution.

Run it on an otherwise idle machine:

    python tests/benchmarks/step_speed.py --resolutions 64 128 256

A synthetic house with a thermal camera of its own is trained to the middle of its last stage; then single steps with
4096 RGB and 4096 thermal rays are timed on one and the same state, and a view of 320 x 240 is rendered. Colour is the
same from all sides there, as it is for the first four fifths of a training. On a busy machine, `--threads 1 --clock
processor` counts the time that this process had.

Every figure is a median; ratios are against the named baseline of the same run. There are two: the reference (plain
torch on the same sparse lattice, skipping what is empty), and once a dense step (plain torch on the whole lattice,
every sample reading all values of its corners), as in `dense_torch_step.py`.
"""

import statistics
import tempfile
import time
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
import tyro
from dense_torch_step import dense_step_seconds
from measuring import take_turns  # noqa: F401 (finds tests.support)
from nerfstudio.utils.rich_utils import CONSOLE

from tests.support.short_training import Training
from thermoxels_ns.config import thermoxels
from thermoxels_ns.core.threads import num_threads
from thermoxels_ns.field.refine import widen_colour
from thermoxels_ns.synthetic.scene_folder import make_scene, write_scene
from thermoxels_ns.training.schedule import schedule_for


@dataclass
class StepSpeed:
    resolutions: tuple[int, ...] = (64, 128, 256)
    """Voxels along the longest side."""
    scene: str = "house-corner"
    """Synthetic scene."""
    rays: int = 4096
    """Rays of each stream."""
    steps: int = 600
    """Length of the training whose middle is timed."""
    repeats: int = 7
    """Steps per median."""
    reference_up_to: int = 128
    """Finest lattice on which the reference is timed too."""
    threads: int | None = None
    """Threads of the compiled kernels; default: one per processor."""
    clock: Literal["wall", "processor"] = "wall"
    """wall: time that passes; processor: time that all threads of this process spend."""
    dense: int = 128
    """The lattice on which a dense step in plain torch is timed too, once; 0: none."""

    def main(self) -> None:
        rows = []
        with tempfile.TemporaryDirectory() as folder:
            scene = write_scene(
                make_scene(self.scene), Path(folder) / "scene", own_thermal_camera=True, thermal_width=320
            )
            for resolution in self.resolutions:
                rows.append(self.measure(scene, resolution))
        print(
            f"\n{self.scene}, {self.rays} RGB + {self.rays} thermal rays, {num_threads()} threads, "
            f"medians of {self.repeats}, {self.clock} time\n"
        )
        print(
            "| voxels | kept | fused step | against the lattice before | reference step | reference / fused "
            "| dense torch step | dense / fused | 320 x 240 view | beside the kernels |"
        )
        print("|---|---|---|---|---|---|---|---|---|---|")
        before = None
        for row in rows:
            fused, reference, dense = row["fused"], row["reference"], row["dense"]
            print(
                f"| {row['resolution']} | {row['kept']:.1%} | {1e3 * fused:.0f} ms "
                f"| {'' if before is None else f'{fused / before:.2f}'} "
                f"| {'' if reference is None else f'{reference:.2f} s'} "
                f"| {'' if reference is None else f'{reference / fused:.0f}'} "
                f"| {'' if dense is None else f'{dense:.1f} s'} "
                f"| {'' if dense is None else f'{dense / fused:.0f}'} "
                f"| {1e3 * row['view']:.0f} ms | {row['overhead']:.0%} |"
            )
            before = fused

    def measure(self, scene: Path, resolution: int) -> dict:
        schedule = schedule_for(resolution, self.steps)
        rays: Any = {"train_num_rays_per_batch": self.rays, "thermal_num_rays_per_batch": self.rays}
        pipeline = {
            "datamanager": {"data": scene, **rays},
            "model": {"photo_depth": "off"},  # rays of photographs and thermal images alone
            "cpu_threads": self.threads,
        }
        config: Any = deepcopy(thermoxels.config)
        config.follow_schedule(schedule)
        run = Training(pipeline, schedule.steps, config)
        if self.threads is not None:
            torch.set_num_threads(max(1, self.threads // 2))
        datamanager: Any = run.pipeline.datamanager
        with CONSOLE.status(f"{resolution} voxels"):
            run.advance((max((*schedule.prune_at, *schedule.refine_at)) + schedule.thin_at[0]) // 2)
            config, model = run.pipeline.model.config, run.pipeline.model
            fused = self.median(run.take_step)
            kernels = self.median_of_kernels(run)
            reference = None
            if resolution <= self.reference_up_to:
                config.backend = "reference"
                torch.set_num_threads(num_threads())
                reference = self.median(run.take_step)
                config.backend = "auto"
                torch.set_num_threads(max(1, num_threads() // 2))
            dense = None
            if resolution == self.dense:
                torch.set_num_threads(num_threads())
                rays, _ = datamanager.next_train(run.step)
                whole = deepcopy(model.grid)  # published code stores all harmonics from the start
                assert config.sh_degree is not None
                widen_colour(whole, config.sh_degree)
                dense = dense_step_seconds(whole, rays, config.steps_per_voxel)
                torch.set_num_threads(max(1, num_threads() // 2))
            run.pipeline.eval()
            camera = datamanager.eval_dataset.cameras[0:1]
            view = self.median(lambda: model.get_outputs_for_camera(camera))
        voxels = model.grid.voxels
        return {
            "resolution": resolution,
            "kept": len(voxels) / voxels.mask().size,
            "fused": fused,
            "reference": reference,
            "dense": dense,
            "view": view,
            "overhead": (fused - kernels) / fused,
        }

    def now(self) -> float:
        """The clock of choice, [s]."""
        return time.perf_counter() if self.clock == "wall" else time.process_time()

    def median(self, work: Callable[[], object]) -> float:
        """Median time of one call, after one that does not count."""
        work()
        times = []
        for _ in range(self.repeats):
            start = self.now()
            work()
            times.append(self.now() - start)
        return statistics.median(times)

    def median_of_kernels(self, run: Training) -> float:
        """Time per step that is spent in compiled kernels: renderer forward and backward, and row optimisers."""
        from thermoxels_ns.render import fused
        from thermoxels_ns.training.optimizers import RowOptimizer

        spent = [0.0]

        def timed(function):
            def call(*args, **kwargs):
                start = self.now()
                try:
                    return function(*args, **kwargs)
                finally:
                    spent[0] += self.now() - start

            return call

        forward, backward = fused._Render.forward, fused._Render.backward
        rows = [o for o in run.optimizers.optimizers.values() if isinstance(o, RowOptimizer)]
        updates = [o.update_rows for o in rows]
        fused._Render.forward, fused._Render.backward = staticmethod(timed(forward)), staticmethod(timed(backward))
        for optimizer, update in zip(rows, updates):
            optimizer.update_rows = timed(update)  # type: ignore[method-assign]
        times = []
        try:
            for _ in range(self.repeats + 1):
                spent[0] = 0.0
                run.take_step()
                times.append(spent[0])
        finally:
            fused._Render.forward, fused._Render.backward = staticmethod(forward), staticmethod(backward)
            for optimizer, update in zip(rows, updates):
                optimizer.update_rows = update  # type: ignore[method-assign]
        return statistics.median(times[1:])


if __name__ == "__main__":
    tyro.cli(StepSpeed).main()
