"""How long a training step takes: fused against reference, and how it grows with the resolution.

Run it on an otherwise idle machine:

    python tests/benchmarks/step_speed.py --resolutions 64 128 256

A synthetic house with a thermal camera of its own is trained to the middle of its last stage; then single steps with
4096 RGB and 4096 thermal rays are timed on one and the same state, and a view of 320 x 240 is rendered. Colour is the
same from all sides there, as it is for the first four fifths of a training.

Every figure is a median; ratios are against the reference in the same run: plain torch on the same sparse lattice,
which skips what is empty. Where there is a CUDA device, the same state goes on there, by the reference.
"""

import math
import statistics
import tempfile
import time
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from measuring import print_head, print_row, take_turns
from nerfstudio.utils.rich_utils import CONSOLE

from tests.support.short_training import Training
from thermoxels_ns.config import thermoxels
from thermoxels_ns.core.threads import num_threads
from thermoxels_ns.synthetic.scene_folder import make_scene, write_scene
from thermoxels_ns.training.schedule import schedule_for

SCENE = "house-corner"


@dataclass
class StepSpeed:
    resolutions: tuple[int, ...] = (64, 128, 256)
    """Voxels along the longest side."""
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

    def main(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            scene = write_scene(make_scene(SCENE), Path(folder) / "scene", own_thermal_camera=True)
            rows = [self.measure(scene, resolution) for resolution in self.resolutions]
        print(
            f"\n{SCENE}, {self.rays} RGB + {self.rays} thermal rays, {num_threads()} threads, "
            f"medians of {self.repeats}\n"
        )
        print_head(
            *("voxels", "kept", "fused step", "against the lattice before", "reference step", "reference / fused"),
            "320 x 240 view",
            *(("CUDA step", "fused / CUDA", "CUDA view") if torch.cuda.is_available() else ()),
        )
        before = None
        for row in rows:
            fused = row["fused"]
            slow = row["reference"]
            baselines = (f"{slow:.2f} s", f"{slow / fused:.0f}") if slow else ("", "")
            growth = "" if before is None else f"{fused / before:.2f}"
            view = f"{1e3 * row['view']:.0f} ms"
            kept = f"{row['kept']:.1%}"
            on_gpu = ()
            if "cuda" in row:
                ms = [f"{1e3 * row[name]:.1f} ms" for name in ("cuda", "cuda_view")]
                on_gpu = ms[0], f"{fused / row['cuda']:.1f}", ms[1]
            print_row(row["resolution"], kept, f"{1e3 * fused:.0f} ms", growth, *baselines, view, *on_gpu)
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
            model, few, all_threads = run.pipeline.model, torch.get_num_threads(), num_threads()
            figures = {"fused": self.median(run.take_step)}
            figures["reference"] = 0.0
            torch.set_num_threads(all_threads)
            if resolution <= self.reference_up_to:
                model.config.backend = "reference"
                figures["reference"] = self.median(run.take_step)
                model.config.backend = "auto"
            torch.set_num_threads(few)
            run.pipeline.eval()
            camera = datamanager.eval_dataset.cameras[0:1]
            figures["view"] = self.median(lambda: model.get_outputs_for_camera(camera))
            if torch.cuda.is_available():
                there = Training(pipeline, schedule.steps, config, saved=run.save(), device="cuda")
                there.step = run.step
                figures["cuda"] = self.median(lambda: (there.take_step(), torch.cuda.synchronize()))
                there.pipeline.eval()
                on_gpu = camera.to("cuda")
                shown = there.pipeline.model.get_outputs_for_camera
                figures["cuda_view"] = self.median(lambda: (shown(on_gpu), torch.cuda.synchronize()))
        voxels = model.grid.voxels
        return {"resolution": resolution, "kept": len(voxels) / math.prod(voxels.lattice.cell_shape), **figures}

    def median(self, work: Callable[[], object]) -> float:
        """Median time of one call, after one that does not count."""
        return statistics.median(take_turns({"": work}, self.repeats, time.perf_counter)[0][""])


if __name__ == "__main__":
    tyro.cli(StepSpeed).main()
