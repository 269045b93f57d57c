"""How far the depth of trained models is off at points of structure from motion.

    python tests/benchmarks/track_depth.py --scene SCENE --configs CONFIG...

SCENE is a scene from `thermoxels capture`; its tracks say which photograph sees which point. Points count that four
photographs see with less than 1.5 pixels of error and that lie in the reconstructed box, at their sightings in
photographs that evaluate. Without more, training photographs may have seen these points too: only the sightings are
held out. To hold out the points themselves, train on a copy of the scene whose tracks lack a fifth of them:

    python tests/benchmarks/track_depth.py --scene SCENE --held-out-points COPY
    ns-train thermoxels --data COPY
    python tests/benchmarks/track_depth.py --scene SCENE --held-out-points COPY --configs CONFIG...

Withheld are whole cubes of space, not single points, because a point tells the depth of its neighbours; the second line
of each training counts only points that are two voxels and more from every point that may have trained it. Lengths are
in world units, half of the box's longest side; negative signed errors are too near.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
import tyro
from nerfstudio.utils.eval_utils import eval_setup
from scipy.spatial import KDTree

from thermoxels_ns.core.checks import replace_when_done, writable_folder
from thermoxels_ns.data.scene_file import read_scene_file
from thermoxels_ns.data.sparse_tracks import TRACKS_KEY, SparseTracks, read_tracks, write_tracks

_FEWEST_VIEWS, _MOST_ERROR_PX = 4, 1.5
_CUBES = 24
"""Cubes along the side of a box around the points, the outermost 2 % on each side left out."""
_WITHHELD = 5
"""One of so many cubes is withheld."""
_ALONE_VOXELS = 2.0


@dataclass
class TrackDepth:
    """Compare rendered depth with points."""

    scene: Path
    """Folder of the scene."""
    configs: tuple[Path, ...] = ()
    """config.yml of each training on it, or on the copy without the points held out."""
    held_out_points: Path | None = None
    """Folder of the copy without a fifth of the points (images are links); it is written if it does not exist."""

    def main(self) -> None:
        """Write the copy, if one is asked for, and print two lines per training."""
        tracks = read_tracks(self.scene / "sparse_tracks.npz")
        held_out = np.ones(len(tracks.points), dtype=bool)
        if self.held_out_points is not None:
            held_out = withheld(tracks.points)
            if not self.held_out_points.exists():
                write_copy(self.scene, self.held_out_points, tracks, held_out)
                print(f"{self.held_out_points}: {held_out.mean():.1%} of {len(held_out)} points withheld")
        for config in self.configs:
            sightings = measure(self.scene, tracks, held_out, config)
            name = config.parent.parent.parent.name
            print(f"{name}: {sightings}")
            if self.held_out_points is not None:
                alone = sightings.where(sightings.trained_voxels > _ALONE_VOXELS)
                print(f"{name}, {_ALONE_VOXELS:.0f} voxels and more from what trained: {alone}")


@dataclass(frozen=True, eq=False)
class Sightings:
    """What a model shows where photographs that evaluate see points; arrays of one length."""

    error: npt.NDArray[np.float64]
    """Rendered depth less the point's distance."""
    opacity: npt.NDArray[np.float64]
    trained_voxels: npt.NDArray[np.float64]
    """Distance from the nearest point that may have trained the model, in voxels."""

    def where(self, chosen: npt.NDArray[np.bool_]) -> Sightings:
        """Some of them."""
        return Sightings(self.error[chosen], self.opacity[chosen], self.trained_voxels[chosen])

    def __str__(self) -> str:
        if not len(self.error):
            return "no sightings"
        off = np.abs(self.error)
        return (
            f"{len(off)} sightings, depth off by {np.median(off):.4f} (median), {np.quantile(off, 0.9):.3f} (90 %), "
            f"signed {np.median(self.error):+.4f} (median); opacity above 0.9 at {np.mean(self.opacity > 0.9):.1%}"
        )


def withheld(points: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    """Which points are held out: those in a fifth of the cubes of a grid, the same ones every time."""
    low, high = np.percentile(points, (2, 98), axis=0)
    cube = np.floor((points - low) * (_CUBES / (high - low).max())).astype(np.int64)
    hashed = (cube * np.array([73_856_093, 19_349_663, 83_492_791])).sum(axis=1)
    return (hashed // 7) % _WITHHELD == 0


def write_copy(scene: Path, copy: Path, tracks: SparseTracks, held_out: npt.NDArray[np.bool_]) -> None:
    """Write a scene whose tracks lack some points; all other files are links to the scene's."""
    writable_folder(copy)
    number = np.cumsum(~held_out) - 1
    kept = ~held_out[tracks.sighting_point]
    some = replace(
        tracks,
        points=tracks.points[~held_out],
        point_error_px=tracks.point_error_px[~held_out],
        sighting_frame=tracks.sighting_frame[kept],
        sighting_point=number[tracks.sighting_point[kept]],
    )
    write_tracks(copy / "sparse_tracks.npz", some)
    for path in sorted(scene.resolve().iterdir()):
        if path.name not in ("sparse_tracks.npz", "transforms.json") and not path.name.startswith("."):
            (copy / path.name).symlink_to(path)
    meta = json.loads((scene / "transforms.json").read_text(encoding="utf-8"))
    meta[TRACKS_KEY] = "sparse_tracks.npz"
    with replace_when_done(copy / "transforms.json") as temporary:
        temporary.write_text(json.dumps(meta), encoding="utf-8")


def measure(scene: Path, tracks: SparseTracks, judged: npt.NDArray[np.bool_], config: Path) -> Sightings:
    """Render the sightings of some points in the photographs that evaluate.

    Args:
        scene: Folder of the scene with all points.
        tracks: Its tracks.
        judged: Points that count, if they are well known.
        config: config.yml of a training.
    """
    _, pipeline, _, _ = eval_setup(config)
    model: Any = pipeline.model
    manager: Any = pipeline.datamanager
    outputs = manager.train_dataset._dataparser_outputs
    evaluating = {path.name for path in manager.eval_dataset._dataparser_outputs.image_filenames}
    turn, scale = outputs.dataparser_transform.double().numpy(), outputs.dataparser_scale
    lattice = model.grid.lattice
    views = np.bincount(tracks.sighting_point, minlength=len(tracks.points))
    judged = judged & (views >= _FEWEST_VIEWS) & (tracks.point_error_px < _MOST_ERROR_PX)
    lines = outputs.metadata["feature_rays"]
    trained = KDTree(lines.points[np.unique(lines.point)])
    parts = []
    for frame in read_scene_file(scene).frames:
        if frame.image.name not in evaluating:
            continue
        seen = tracks.sighting_point[tracks.sighting_frame == tracks.frames.index(frame.name)]
        points = scale * (tracks.points[seen[judged[seen]]] @ turn[:, :3].T + turn[:, 3])
        points = points[((points > lattice.lo) & (points < lattice.hi)).all(axis=1)]
        centre = scale * (turn[:, :3] @ frame.pose[:3, 3] + turn[:, 3])
        length = np.linalg.norm(points - centre, axis=1)
        rays = np.tile(centre, (len(points), 1)), (points - centre) / length[:, None]
        with torch.no_grad():
            image = model._image_outputs(model._request(*(torch.from_numpy(v).float() for v in rays)))
        near = trained.query(points)[0] / lattice.voxel_size
        parts.append((image["depth"][:, 0].double().numpy() - length, image["accumulation"][:, 0].numpy(), near))
    return Sightings(*(np.concatenate(columns) for columns in zip(*parts)))


if __name__ == "__main__":
    tyro.cli(TrackDepth).main()
