"""What many large photographs cost: memory and seconds of a short training beside that with small ones.

    python tests/benchmarks/photograph_memory.py --output RUNS --frames 300 --widths 320 4000

The drawn house is photographed at 320 x 240 pixels and enlarged, with a mask beside each photograph, so that a folder
of 300 photographs of 12 megapixels is written in a minute or two. Both folders are trained for some steps by the
command that a user types. Printed are the most resident memory, the seconds of the whole command, and those per step.
"""

import json
import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import tyro
from measuring import peak_memory_bytes, print_head, print_row, run_quietly
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
        print_head("photographs", "most resident memory", "seconds", "seconds per step at the end")
        for width in self.widths:
            scene = self.output / f"scene-{width}"
            if not (scene / "transforms.json").is_file():
                write_scene(make_scene("house-corner"), scene, self.frames, 6, *_SMALL, progress=False)
                if width > _SMALL[0]:
                    _enlarge(scene, width)
            began = time.perf_counter()
            peak, per_step = self.train(scene)
            seconds = time.perf_counter() - began
            size = f"{self.frames} of {width} x {width * _SMALL[1] // _SMALL[0]}"
            print_row(size, f"{peak / 1e9:.2f} GB", f"{seconds:.0f}", f"{per_step:.3f}")

    def train(self, scene: Path) -> tuple[float, float]:
        """Train; return the most resident memory, [bytes], and the seconds per step of the second half."""
        command = [
            *("ns-train", "thermoxels", "--output-dir", str(self.output / "outputs"), "--vis", "tensorboard"),
            *("--max-num-iterations", str(self.steps), "--logging.steps-per-log", "10"),
            *("thermal-data", "--data", str(scene)),
        ]
        log = self.output / f"{scene.name}.log"
        run_quietly([Path(sys.executable).name, str(Path(__file__).resolve()), "--run", *command], log)
        found = json.loads(log.read_text(encoding="utf-8").splitlines()[-1])
        return found["peak"], found["per_step"]


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


def run(words: list[str]) -> None:
    """Run ns-train in this process; write its most resident memory and seconds per step as a last line."""
    from importlib.metadata import entry_points

    (command,) = entry_points(group="console_scripts", name=words[0])
    begin, times = command.load(), list[float]()
    from thermoxels_ns.training.pipeline import ThermoxelsPipeline

    step = ThermoxelsPipeline.get_train_loss_dict

    def timed(*args, **options):
        times.append(time.perf_counter())
        return step(*args, **options)

    ThermoxelsPipeline.get_train_loss_dict = timed
    sys.argv = words
    begin()
    half = len(times) // 2
    print(
        json.dumps({"peak": peak_memory_bytes(), "per_step": (times[-1] - times[half]) / (len(times) - 1 - half)}),
        flush=True,
    )


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    if sys.argv[1:2] == ["--run"]:
        run(sys.argv[2:])
    else:
        tyro.cli(PhotographMemory).main()
