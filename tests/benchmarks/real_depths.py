"""How far off the depths of real photographs are: compares what held-out frames of a run on saharov32 see.

The scene lies beside the checkout, in ../shared/data/saharov32: photographs of a bronze figure on a granite block, and
``depth.npz``, depths that another program's multi-view stereo found, good to about 1 %. Rays go through the middle of
each pixel of the depth maps, four times as large as a photograph's, by the cameras of the trained run, lens distortion
included. Pixels count where there is a depth and the ray meets the lattice's box:

- ``depth_error``: median relative error of the rendered depth; ``depth_off_share``: share that is more than 2 % off;
- ``opaque_share``: share whose ray loses more than half of its light in the box.

``sky_filled`` is the share of sky pixels of whose rays the same is true. A pixel is sky where there is no depth, no
channel of the photograph lies below 0.7, and pixels of the same kind lead from it to the photograph's right edge, which
is where up is: the photographs lie on their side.
"""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from thermoxels_ns.core.arrays import BoolArray, FloatArray

DARKEST_SKY = 0.7  # Least channel of a pixel that shows the sky, 0 to 1
MOST_OFF = 0.02  # Relative error above which a depth is off


def sky_of(depth: FloatArray, photograph: FloatArray) -> BoolArray:
    """Which pixels of a depth map (h, w), 0 where unknown, show the sky in the photograph (h, w, 3) of its size."""
    bright = (depth == 0) & (photograph.min(axis=2) >= DARKEST_SKY)
    label = np.asarray(cv2.connectedComponents(bright.astype(np.uint8), connectivity=4)[1])
    return bright & np.isin(label, label[:, -1])


def held_out_depths(config: Path, scene: Path) -> dict[str, float]:
    """Compare the depths that a trained run renders for its held-out frames with those of the scene's ``depth.npz``."""
    from nerfstudio.utils.eval_utils import eval_setup

    pipeline: Any = eval_setup(config, test_mode="test")[1]
    manager, known_depths = pipeline.datamanager, np.load(scene / "depth.npz")
    scale = float(manager.train_dataparser_outputs.dataparser_scale)
    cameras = manager.eval_dataset.cameras.to(pipeline.device)
    error, opaque, filled = [], [], []
    for number, path in enumerate(manager.eval_dataset.image_filenames):
        known = known_depths[path.stem].astype(np.float64)
        photograph = manager.eval_dataset.get_data(number)["image"][..., :3].numpy()
        height, width = known.shape
        rows, columns = (
            (np.arange(count) + 0.5) * side / count for count, side in zip(known.shape, photograph.shape[:2])
        )
        coords = torch.from_numpy(np.stack(np.meshgrid(rows, columns, indexing="ij"), -1)).float().to(pipeline.device)
        rays = cameras.generate_rays(camera_indices=number, coords=coords)
        seen = pipeline.model.get_outputs_for_camera_ray_bundle(rays)
        along_axis = -(rays.directions @ cameras.camera_to_worlds[number, :3, 2])
        depth, ends = (seen["depth"][..., 0] * along_axis / scale).cpu().numpy(), seen["accumulation"] > 0.5
        ends, in_box = ends[..., 0].cpu().numpy(), seen["in_box"][..., 0].cpu().numpy() > 0
        counts = (known > 0) & in_box
        error.append(np.abs(depth[counts] / known[counts] - 1.0))
        opaque.append(ends[counts])
        small = cv2.resize(photograph, (width, height), interpolation=cv2.INTER_AREA)
        filled.append(ends[sky_of(known, small)])
    off = np.concatenate(error)
    return {
        "depth_error": float(np.median(off)),
        "depth_off_share": float((off > MOST_OFF).mean()),
        "opaque_share": float(np.concatenate(opaque).mean()),
        "sky_filled": float(np.concatenate(filled).mean()),
    }
