"""The command ``thermoxels split``: cut a scene that is too large for one lattice into overlapping blocks."""

from __future__ import annotations

# Only light imports at the top, so that ``thermoxels --help`` answers at once.
import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import tyro

from thermoxels_ns.core.arrays import BoolArray, FloatArray
from thermoxels_ns.core.checks import remove_file, replace_when_done, result_folder
from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.core.json_values import write_json
from thermoxels_ns.data.layouts import LayoutName

if TYPE_CHECKING:
    from thermoxels_ns.core.camera import Camera
    from thermoxels_ns.data.scene_file import Frame, SceneFile

LIST, _JSON = "blocks.csv", "transforms.json"
_PARTS = 8
"""Parts of a block's longest side; neighbours overlap by one. Last resolutions are multiples of this number, so that
the voxels of neighbours coincide."""
_SLACK = 1e-5  # Share of a part by which a block is shorter than a whole number of them, at either end: round-off
_IN_BLOCK = 0.1
"""A photograph belongs to a block if at least this share of what it shows of the scene lies in the block, or more than
in any other block."""
_PROBES = 10_000  # Points of the scene, about, by which this is judged; random ones in the box if none are known
_KEPT = ("metres_per_unit", "up", "thermal_unit")  # Entries of the scene's json that each block gets
_BOUNDS = "temperature_bounds.json"
_SPLITS = ("train_filenames", "val_filenames", "test_filenames")


@dataclass
class Split:
    """Cut a scene that is too large for one lattice, such as a row of houses, into overlapping blocks.

    Each block is a scene of its own, which names the photographs where they are, and a line of blocks.csv, a list for
    thermoxels batch. ns-export thermoxels-mesh --load-config FIRST --beside OTHERS joins the trained blocks.
    """

    scene: tyro.conf.Positional[Path]
    """Scene folder, in any layout of docs/data.md."""
    blocks: int
    """Number of blocks along the longest side of the scene's box, 2 to 1000."""
    output_dir: Path = Path("blocks")
    """Folder for the blocks and the list; made if it does not exist."""
    layout: LayoutName | None = None
    """Layout of the scene folder, as for ns-train; left out: the first that fits."""
    missing_thermal: Literal["error", "skip"] = "error"
    """What to do with a photograph that has no thermal image: stop, or leave it out."""

    def main(self) -> None:
        """Write the blocks; raises `ThermoxelsError` if the scene cannot be read, or too few photographs show one."""
        from thermoxels_ns.data.dataparser import refine_poses, split_frames
        from thermoxels_ns.data.scene_box import find_scene_box
        from thermoxels_ns.data.scene_file import read_scene_file
        from thermoxels_ns.data.tracks import find_tracks

        if not 2 <= self.blocks <= 1000:
            raise SceneError("blocks", expected="2 to 1000", got=self.blocks, remedy="Pass --blocks 3, for example.")
        file, tracks = read_scene_file(self.scene, self.missing_thermal, self.layout), None
        training = split_frames([frame.name for frame in file.frames], file.meta, "auto", 8, file.left_out).train
        try:
            tracks = find_tracks(file)
        except SceneError as problem:
            print(f"Tracks: the COLMAP model is not used: {problem}")
        if tracks is None:  # once for all blocks: each for itself would move its poses
            file = refine_poses(file, training, print)[0]
        found = find_scene_box(file, None, training, tracks)
        boxes = boxes_of_blocks(found.box, self.blocks)
        points = np.random.default_rng(0).uniform(*found.box, size=(_PROBES, 3))
        if found.points is not None:
            inside = found.points[((found.points >= found.box[0]) & (found.points <= found.box[1])).all(axis=1)]
            points = inside[:: max(len(inside) // _PROBES, 1)]
        shown = photographs_of(file.frames, points, boxes)
        if not shown.any(axis=0).all():
            print(
                f"{np.count_nonzero(~shown.any(axis=0))} photographs show nothing of the scene's box, and are left out"
            )
        if shown.sum(axis=1).min() < 3:
            expected, got = "at least 3 photographs of each block", f"{shown.sum(axis=1).min()} of one"
            raise SceneError("blocks", expected=expected, got=got, remedy="Pass fewer --blocks.")
        names = [f"block-{number + 1}" for number in range(self.blocks)]
        folder = result_folder(
            self.output_dir, (LIST, *(f"{n}/{part}" for n in names for part in (_JSON, _BOUNDS))), LIST
        )
        with replace_when_done(folder / LIST) as temporary, temporary.open("w", newline="", encoding="utf-8") as out:
            csv.writer(out).writerows([("name", "scene"), *((name, name) for name in names)])
        for name, box, chosen in zip(names, boxes, shown):
            write_block(folder / name, file, box, chosen, found.pixel_size(file.frames))
            low, high = (", ".join(f"{value:.4g}" for value in corner) for corner in box)
            print(f"{name}: {chosen.sum()} photographs, from ({low}) to ({high})")
        print(f"Written to {folder}. Train them, for example with: thermoxels batch {folder / LIST}")


def boxes_of_blocks(box: FloatArray, count: int) -> FloatArray:
    """Return the boxes, (count, 2, 3), of equal blocks along the longest side of a box (2, 3).

    Neighbours overlap by one of the `_PARTS` parts of a block's longest side, and are as far apart as a whole number of
    them. Together, the blocks may be a little longer than the box.

    >>> boxes_of_blocks(np.array([[0.0, 0.0, 0.0], [15.0, 2.0, 1.0]]), 2).round(3)[:, :, 0].tolist()
    [[0.0, 8.0], [7.0, 15.0]]
    """
    sides = box[1] - box[0]
    axis = int(np.argmax(sides))
    across = float(np.delete(sides, axis).max())
    length = sides[axis] / (count - (count - 1) / _PARTS)
    part = max(length, across) / _PARTS
    parts = max(2, int(np.ceil(length / part - 1e-9)))  # in blocks that are wider than long
    while (count * parts - (count - 1)) * part < sides[axis] - 1e-9 * sides[axis]:
        parts += 1
    boxes = np.repeat(box[None], count, axis=0)
    middle, whole = 0.5 * (box[0, axis] + box[1, axis]), (count * parts - (count - 1)) * part
    starts = middle - 0.5 * whole + part * (parts - 1) * np.arange(count)
    boxes[:, 0, axis], boxes[:, 1, axis] = starts + _SLACK * part, starts + (parts - _SLACK) * part
    return boxes


def photographs_of(frames: Sequence[Frame], points: FloatArray, boxes: FloatArray) -> BoolArray:
    """Return which photographs belong to each block, (blocks, photographs), by the points (n, 3) that they show.

    A photograph belongs to each block that holds the share `_IN_BLOCK` of these points, or the most of them.
    """
    from thermoxels_ns.data.scene_box import depths_in_view

    seen = np.isfinite(depths_in_view(points, frames))
    inside = np.stack([((points >= low) & (points <= high)).all(axis=1) for low, high in boxes])
    shares = (inside[:, None] & seen).sum(axis=2) / np.maximum(seen.sum(axis=1), 1)
    return (shares > 0.0) & ((shares >= _IN_BLOCK) | (shares == shares.max(axis=0)))


def write_block(folder: Path, file: SceneFile, box: FloatArray, chosen: BoolArray, pixel_size: float) -> None:
    """Write a block's transforms.json: the `chosen` frames, (frames,), its box, and the width of a pixel, which gives
    all blocks voxels of one size, [input units]."""
    frames, named = list[dict[str, Any]](), dict[str, str]()
    for frame, is_chosen in zip(file.frames, chosen):
        if is_chosen:
            entry = {"file_path": str(frame.image.absolute()), "transform_matrix": frame.pose.tolist()}
            named[frame.name] = entry["file_path"]
            for key, path in (("thermal_file_path", frame.thermal), ("mask_path", frame.mask)):
                entry |= {} if path is None else {key: str(path.absolute())}
            if frame.thermal_pose is not None:
                entry["thermal_transform_matrix"] = frame.thermal_pose.tolist()
            if frame.thermal_intrinsics is not None:
                entry["thermal_camera"] = _lens(frame.thermal_intrinsics)
            frames.append(entry | _lens(frame.intrinsics))
    content: dict[str, Any] = {key: file.meta[key] for key in _KEPT if key in file.meta}
    for key in _SPLITS:
        names = (Path(str(name)).as_posix() for name in file.meta.get(key, ()))
        listed = [named[name] for name in names if name in named]
        content |= {key: listed} if listed else {}
    folder.mkdir(parents=True, exist_ok=True)
    remove_file(folder / _BOUNDS)
    if file.bounds_c is not None:
        low, high = file.bounds_c
        write_json(folder / _BOUNDS, {"absolute_min_temperature": low, "absolute_max_temperature": high})
    content |= {"scene_box": box, "pixel_size": pixel_size, "poses_refined": True}
    write_json(folder / _JSON, content | {"frames": frames})


def _lens(camera: Camera) -> dict[str, Any]:
    return camera.entries() | {"k3": camera.k3, "k4": camera.k4}
