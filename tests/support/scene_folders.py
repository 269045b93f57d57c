"""A maker of tiny scene folders whose every pixel is known."""

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from thermoxels_ns.synthetic.scene_truth import look_at


@dataclass
class Folder:
    """A scene on disk and what was written into it."""

    path: Path
    meta: dict[str, Any]
    names: list[str]
    counts: list[np.ndarray] = field(default_factory=list)

    def rewrite(self) -> None:
        """Write `meta` again after a change."""
        (self.path / "transforms.json").write_text(json.dumps(self.meta))

    def add_masks(self) -> np.ndarray:
        """Mask all but 25 pixels of every photograph of 24 x 18; returns the mask."""
        mask = np.zeros((18, 24), np.uint8)
        mask[4:9, 3:8] = 255
        for frame in self.meta["frames"]:
            frame["mask_path"] = frame["file_path"].replace("images/", "mask_")
            Image.fromarray(mask).save(self.path / frame["mask_path"])
        self.rewrite()
        return mask


def look_at_origin(angle: float, radius: float = 4.0, height: float = 1.0) -> np.ndarray:
    """Camera-to-world in OpenGL axes on a circle around the z axis."""
    return look_at((radius * np.cos(angle), radius * np.sin(angle), height), (0.0, 0.0, 0.0))


def write_counts(path: Path, counts: np.ndarray) -> None:
    if path.suffix == ".npy":
        np.save(path, counts)
    else:
        Image.fromarray(counts).save(path)


@pytest.fixture
def scene_folder(tmp_path: Path) -> Callable[..., Folder]:
    """Make a ThermoScenes folder: random 16-bit counts, bounds 10 to 30 C, cameras on a circle, box -1..1 or None."""

    def make(
        frames: int = 10,
        size: tuple[int, int] = (24, 18),
        thermal_size: tuple[int, int] | None = None,
        suffix: str = ".png",
        names: list[str] | None = None,
        distortion: dict[str, float] | None = None,
        bounds: bool = True,
        own_camera: bool = False,
        counts: Callable[[int, tuple[int, int]], np.ndarray] | None = None,
        **extra: Any,
    ) -> Folder:
        root = tmp_path / "scene"
        (root / "images").mkdir(parents=True)
        (root / "thermal").mkdir()
        rng = np.random.default_rng(7)
        width, height = size
        thermal_width, thermal_height = thermal_size or size
        names = names or [f"frame_{'eval' if i % 5 == 2 else 'train'}_{i:03d}" for i in range(frames)]
        meta: dict[str, Any] = {
            "camera_model": "OPENCV",
            "w": width,
            "h": height,
            "fl_x": 1.1 * width,
            "fl_y": 1.15 * width,
            "cx": 0.48 * width,
            "cy": 0.53 * height,
            **(distortion or {}),
            "scene_box": [[-1, -1, -1], [1, 1, 1]],
            "frames": [],
            **extra,
        }
        meta = {key: value for key, value in meta.items() if value is not None}
        folder = Folder(root, meta, names)
        for number, name in enumerate(names):
            pixels = rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
            Image.fromarray(pixels).save(root / "images" / f"{name}.png")
            shape = (thermal_height, thermal_width)
            made = rng.integers(0, 65536, shape).astype(np.uint16) if counts is None else counts(number, shape)
            folder.counts.append(made)
            write_counts(root / "thermal" / f"{name}{suffix}", made)
            pose = look_at_origin(2 * np.pi * number / len(names))
            frame = {"file_path": f"images/{name}.png", "transform_matrix": pose.tolist()}
            if own_camera:
                shift = np.eye(4)
                shift[:3, 3] = [0.1, 0.02, 0.0]
                frame["thermal_transform_matrix"] = (pose @ shift).tolist()
            meta["frames"].append(frame)
        if own_camera:
            meta["thermal_camera"] = {
                "w": thermal_width,
                "h": thermal_height,
                "fl_x": 1.3 * thermal_width,
                "fl_y": 1.3 * thermal_width,
                "cx": 0.5 * thermal_width,
                "cy": 0.5 * thermal_height,
                "k1": -0.05,
            }
        if bounds:
            text = {"absolute_min_temperature": 10.0, "absolute_max_temperature": 30.0}
            (root / "temperature_bounds.json").write_text(json.dumps(text))
        folder.rewrite()
        return folder

    return make
