"""Synthetic scenes for tests of what comes after the box is found."""

import json
from pathlib import Path
from typing import Any

from thermoxels_ns.synthetic.scene_folder import write_scene
from thermoxels_ns.synthetic.scene_truth import SyntheticScene


def write_boxed_scene(scene: SyntheticScene, folder: Path, num_train: int, num_eval: int, **options: Any) -> Path:
    """Write a scene whose json names the exact box, as somebody who knows it may, and whose photographs lose nothing.

    A few tiny photographs do not show where the box ends, and what JPEG does to them drowns what a test looks at.
    """
    options = {"photo_format": "png", "progress": False} | options
    write_scene(scene, folder, num_train, num_eval, **options)
    path = folder / "transforms.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"scene_box": scene.scene_box}))
    return folder
