"""How many pixels of photographs get a depth before a training, and how far off these are, on synthetic scenes.

    python tests/benchmarks/photograph_depths.py --output RUNS
    python tests/benchmarks/photograph_depths.py --output RUNS --scenes wild-20 house-corner+white

The photographs are compared as a training compares them, in the box of what they truly see. `body` are pixels that
truly show the scene's solid, `known` the share of them with a depth; median error and the share that is more than 3 %
off are relative to the true depth; `sky` is the share of all depths on pixels that show nothing of the solid (the sky,
or what else stands around). Seconds are those of the comparison.
"""

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from measuring import print_head, print_row, synthetic_scene

from thermoxels_ns.data.dataparser import ThermalDataParserConfig
from thermoxels_ns.data.dataset import ThermalDataset
from thermoxels_ns.multiview.photographs import Photographs, read_photographs
from thermoxels_ns.multiview.stereo import Depths, depths_before_backdrop, depths_of
from thermoxels_ns.synthetic.raycast import first_surface
from thermoxels_ns.synthetic.scene_truth import SyntheticScene


@dataclass
class PhotographDepths:
    """Compare the depths that photographs agree on with the truth."""

    output: Path
    """Folder for scenes; one that is there is not written again."""
    scenes: tuple[str, ...] = ("house-corner", "courtyard", "house-corner+white", "facade", "street")
    """Synthetic scenes by name."""

    def main(self) -> None:
        print_head("scene", "body", "known", "median error", "over 3 % off", "sky", "seconds")
        for name in self.scenes:
            scene = synthetic_scene(name, self.output / name / "scene")
            config = ThermalDataParserConfig(data=self.output / name / "scene", scene_box=scene.scene_box)
            parsed = config.setup().get_dataparser_outputs("train")
            lo, hi = parsed.scene_box.aabb.double().numpy()
            began = time.perf_counter()
            found = depths_of(read_photographs(ThermalDataset(parsed)), lo, hi)
            seconds = time.perf_counter() - began
            assert found is not None
            centre = parsed.dataparser_transform.double().numpy()
            truth = true_depths(scene, found.photographs, centre, float(parsed.dataparser_scale))
            print_row(name, *(f"{share:.2%}" for share in shares(found, truth)), f"{seconds:.0f}")


def true_depths(scene: SyntheticScene, photographs: Photographs, transform: np.ndarray, scale: float) -> np.ndarray:
    """Depth along the optical axis of the solid in each pixel, (pixels,), [world units]; NaN where it shows another."""
    origins, along = photographs.of_pixels(np.arange(len(photographs.colours)))
    origins = (origins / scale - transform[:, 3]) @ transform[:, :3]
    length = np.linalg.norm(along, axis=1)
    distance, own = first_surface(scene, origins, along / length[:, None] @ transform[:, :3])
    return np.where(own, distance * scale / length, np.nan)


def shares(found: Depths, truth: np.ndarray) -> tuple[float, ...]:
    """The columns of the table from `body` to `sky`."""
    body = np.isfinite(truth)
    known = np.isfinite(depths_before_backdrop(found)[0].depth)
    off = np.abs(found.depth / truth - 1.0)[known & body]
    errors = float(np.median(off)), float(np.mean(off > 0.03))
    return body.mean(), known[body].mean(), *errors, 1 - body[known].mean()


if __name__ == "__main__":
    tyro.cli(PhotographDepths).main()
