"""How far the depth of trained models is off at points that held-out photographs see.

    python tests/benchmarks/track_depth.py --scene SCENE --configs CONFIG...

SCENE is a scene from `thermoxels capture`; its tracks say which photograph sees which point. Points count that four
photographs see with less than 1.5 pixels of error and that lie in the reconstructed box. Training photographs may have
seen them too: only the sightings are held out. Lengths are in world units, half of the box's longest side.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from nerfstudio.utils.eval_utils import eval_setup

from thermoxels_ns.data.scene_file import read_scene_file
from thermoxels_ns.data.sparse_tracks import read_tracks

_FEWEST_VIEWS, _MOST_ERROR_PX = 4, 1.5


@dataclass
class TrackDepth:
    """Compare rendered depth with points."""

    scene: Path
    """Folder of the scene."""
    configs: tuple[Path, ...]
    """config.yml of each training on it."""

    def main(self) -> None:
        """Print a line per training."""
        for config in self.configs:
            off, opacity = self.measure(config)
            far = np.quantile(off, 0.9)
            print(
                f"{config.parent.parent.parent.name}: {len(off)} sightings, depth off by "
                f"{np.median(off):.4f} (median), {far:.3f} (90 %); opacity above 0.9 at {np.mean(opacity > 0.9):.1%}"
            )

    def measure(self, config: Path) -> tuple[np.ndarray, np.ndarray]:
        """Error of the depth and opacity of each sighting."""
        scene, tracks = read_scene_file(self.scene), read_tracks(self.scene / "sparse_tracks.npz")
        _, pipeline, _, _ = eval_setup(config)
        model: Any = pipeline.model
        outputs = pipeline.datamanager.train_dataset._dataparser_outputs  # type: ignore[union-attr]
        turn, scale = outputs.dataparser_transform.double().numpy(), outputs.dataparser_scale
        lattice = model.grid.lattice
        views = np.bincount(tracks.sighting_point, minlength=len(tracks.points))
        good = (views >= _FEWEST_VIEWS) & (tracks.point_error_px < _MOST_ERROR_PX)
        off, opacity = [], []
        for frame in scene.frames:
            if "_eval_" not in frame.name:
                continue
            seen = tracks.sighting_point[tracks.sighting_frame == tracks.frames.index(frame.name)]
            points = scale * (tracks.points[seen[good[seen]]] @ turn[:, :3].T + turn[:, 3])
            points = points[((points > lattice.lo) & (points < lattice.hi)).all(axis=1)]
            centre = scale * (turn[:, :3] @ frame.pose[:3, 3] + turn[:, 3])
            length = np.linalg.norm(points - centre, axis=1)
            rays = np.tile(centre, (len(points), 1)), (points - centre) / length[:, None]
            with torch.no_grad():
                image = model._image_outputs(model._request(*(torch.from_numpy(v).float() for v in rays)))
            off.append(np.abs(image["depth"][:, 0].numpy() - length))
            opacity.append(image["accumulation"][:, 0].numpy())
        return np.concatenate(off), np.concatenate(opacity)


if __name__ == "__main__":
    tyro.cli(TrackDepth).main()
