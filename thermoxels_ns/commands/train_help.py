"""The first page of help of ``ns-train thermoxels``: the options that people need, by task, on one screen."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table

TASKS: dict[str, dict[str, str]] = {
    "What most people need": {
        "--data SCENE": "folder of the scene",
        "--quality draft|standard|fine": "a minute or two for a first look, minutes (default), many minutes",
        "--output-dir FOLDER": "where the run goes: FOLDER/scene/method/time (default: outputs)",
        "--vis viewer|tensorboard": "watch in a browser while it trains (default), or not",
        "--load-dir RUN/nerfstudio_models": "go on with a run that was interrupted; repeat its --quality",
    },
    "The scene": {
        "--layout NAME": "how the folder is read (docs/data.md); rgb: photographs alone",
        "--thermal-bounds LOW HIGH": "degrees of black and white in grey thermal pictures",
        "--missing-thermal skip": "leave out photographs without a thermal image",
        "--scene-box XMIN YMIN ZMIN XMAX YMAX ZMAX": "the box to reconstruct; by default where photographs agree",
        "--downscale-factor 2": "photographs of half the width, which is faster",
        "--eval-mode interval --eval-interval 8": "which frames are held out to judge by",
        "--refine-poses given": "keep the given poses, also where photographs say that they are off",
    },
    "Size and speed": {
        "--pipeline.model.voxel-pixels 2": "width of a voxel in pixels of the photographs (default: 1.6)",
        "--pipeline.model.memory-budget-gb 8": "what the voxels may take; more is refused before it is taken",
        "--pipeline.cpu-threads 1": "leave processors to others; the result is the same",
    },
    "Cameras and backgrounds": {
        "--pipeline.model.exposure on|off": "photographs differ in brightness (default: corrected where found)",
        "--pipeline.model.per-image-offset on|off": "the thermal camera drifts (default: corrected where found)",
        "--pipeline.model.surroundings off": "what is outside the box lies at infinity: faster, blurred near by",
        "--pipeline.model.near-plane 0.05": "cameras stand inside the box",
    },
}
"""Options with an example, and what they are for, by task."""


def print_first_page(method: str) -> None:
    """Print `TASKS` as the help of a method, and where all other options are."""
    console = Console(highlight=False)
    console.print(f"usage: ns-train {method} --data SCENE [OPTIONS]\n", markup=False)
    for task, options in TASKS.items():
        table = Table.grid(padding=(0, 2))
        table.add_column(no_wrap=True)
        for option, purpose in options.items():
            table.add_row(f"  {option}", purpose)
        console.print(task, style="bold")
        console.print(table)
    more = f"\nEvery option: ns-train {method} --help-all; of the scene: ns-train {method} thermal-data --help"
    console.print(more, markup=False, soft_wrap=True)
