"""What many large photographs cost: memory and seconds of a short training beside that with small ones.

    python tests/benchmarks/photograph_memory.py --output RUNS --frames 300 --widths 320 4000

The drawn house is photographed at 320 x 240 pixels and enlarged, with a mask beside each photograph, so that a folder
of 300 photographs of 12 megapixels is written in a minute or two. Both folders are trained for some steps by the
command that a user types. Printed are the most resident memory and the seconds of the whole command.
"""

import json
import os
from dataclasses import dataclass
from pathlib import Path

import cv2
import tyro
from measuring import print_head, print_row, run_quietly
from PIL import Image

from thermoxels_ns.synthetic.drawn_scenes import make_scene
from thermoxels_ns.synthetic.scene_folder import write_scene

_SMALL = (320, 240)


@dataclass
class PhotographMemory:
    output: Path
    """Folder for scenes and runs."""
    frames: int = 300
    """Photographs that train."""
    widths: tuple[int, ...] = (320, 4000)
    """Widths of the photographs of each training, [pixels]; they are 4:3."""
    steps: int = 200
    """Training steps."""

    def main(self) -> None:
        print_head("photographs", "most resident memory", "seconds")
        for width in self.widths:
            scene = self.output / f"scene-{width}"
            if not (scene / "transforms.json").is_file():
                write_scene(make_scene("house-corner"), scene, self.frames, 6, *_SMALL, progress=False)
                if width > _SMALL[0]:
                    _enlarge(scene, width)
            command = [
                *("ns-train", "thermoxels", "--output-dir", str(self.output / "outputs"), "--vis", "tensorboard"),
                *("--max-num-iterations", str(self.steps), "--logging.steps-per-log", "10"),
                *("thermal-data", "--data", str(scene)),
            ]
            cost = run_quietly(command, self.output / f"{scene.name}.log")
            size = f"{self.frames} of {width} x {width * _SMALL[1] // _SMALL[0]}"
            print_row(size, f"{cost.peak_memory_gb:.2f} GB", f"{cost.seconds:.0f}")


def _enlarge(scene: Path, width: int) -> None:
    """Enlarge the photographs of a scene, and give each the same mask, without its outermost pixels."""
    path = scene / "transforms.json"
    content, size = json.loads(path.read_text(encoding="utf-8")), (width, width * _SMALL[1] // _SMALL[0])
    mask = Image.new("L", size, 0)
    mask.paste(255, (8, 8, size[0] - 8, size[1] - 8))
    mask.save(scene / "mask.png")
    for frame in content["frames"]:
        photograph = scene / frame["file_path"]
        picture = cv2.resize(cv2.imread(str(photograph)), size, interpolation=cv2.INTER_LINEAR)
        cv2.imwrite(str(photograph), picture)
        frame["mask_path"] = "mask.png"
    for name in ("w", "h", "fl_x", "fl_y", "cx", "cy"):
        content[name] *= width / _SMALL[0]
    content |= {"w": size[0], "h": size[1]}
    path.write_text(json.dumps(content), encoding="utf-8")


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    tyro.cli(PhotographMemory).main()
