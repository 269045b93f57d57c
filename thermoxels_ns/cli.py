"""The command ``thermoxels``, with the subcommands that nerfstudio's own commands do not offer."""

from __future__ import annotations

# All imports at the top are light, so that ``--help`` answers at once.
import os
import shlex
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Union

import tyro

from thermoxels_ns.commands.audit import Audit
from thermoxels_ns.commands.batch import Batch
from thermoxels_ns.commands.capture import Capture
from thermoxels_ns.commands.cost import Cost
from thermoxels_ns.commands.demo import Demo
from thermoxels_ns.commands.heat import Heat
from thermoxels_ns.commands.split import Split
from thermoxels_ns.core import quiet_warnings
from thermoxels_ns.core.errors import ThermoxelsError, exit_status
from thermoxels_ns.data.layouts import LayoutName
from thermoxels_ns.synthetic.imperfections import Imperfections


@dataclass
class Synthetic:
    """Write a synthetic scene, whose shape and temperature are known exactly, as photographs and thermal images."""

    scene: tyro.conf.Positional[str]
    """Name of the scene: hot-object, house-corner, sphere, courtyard, pipes, wall-object, living-room, facade, street,
    or random-N or wild-N, which are made from the seed N; wild scenes have smooth, plain or textured surroundings, and
    some have plain walls, mirroring panes or a thin railing. After the name, in any order: +sky=R,G,B for a sky or
    backdrop of one colour (0 to 1), +street for houses and trees around, +room for a room around, +white for white
    plaster under a white sky (house-corner only); for example house-corner+sky=0.55,0.57,0.60 or random-3+street."""
    output_dir: Path
    """Folder for the scene; made if it does not exist. An earlier synthetic scene in it is replaced."""
    layout: LayoutName = "thermoscenes"
    """Layout of the folder, see docs/data.md; rgb: photographs alone."""
    num_train: int = 42
    """Number of training views."""
    num_eval: int = 6
    """Number of held-out views, which are half-way between training views."""
    width: int = 320
    """Width of the photographs, [pixels]."""
    height: int = 240
    """Height of the photographs, [pixels]."""
    seed: int = 0
    """Seed of the random numbers of the imperfections; the same seed writes the same files."""
    own_thermal_camera: bool = False
    """Take the thermal images with a second camera beside the first, with a lens and poses of its own."""
    imperfections: tyro.conf.OmitArgPrefixes[Imperfections] = field(default_factory=Imperfections)
    """Errors of cameras and poses, none unless given. The true errors are written to truth.json."""

    def main(self) -> None:
        """Write the scene and print the command that trains it; `ThermoxelsError`: a wrong option or folder."""
        from thermoxels_ns.synthetic.scene_folder import make_scene, write_scene

        folder = write_scene(
            make_scene(self.scene),
            self.output_dir,
            **{name: value for name, value in vars(self).items() if name not in ("scene", "output_dir")},
        )
        print(f"Written to {folder}. Train with: ns-train thermoxels --data {shlex.quote(str(folder))}")


Commands = tyro.conf.FlagConversionOff[
    Union[  # noqa: UP007 - read by tyro
        Annotated[Capture, tyro.conf.subcommand(name="capture")],
        Annotated[Demo, tyro.conf.subcommand(name="demo")],
        Annotated[Synthetic, tyro.conf.subcommand(name="synthetic")],
        Annotated[Cost, tyro.conf.subcommand(name="cost")],
        Annotated[Heat, tyro.conf.subcommand(name="heat")],
        Annotated[Audit, tyro.conf.subcommand(name="audit")],
        Annotated[Batch, tyro.conf.subcommand(name="batch")],
        Annotated[Split, tyro.conf.subcommand(name="split")],
    ]
]


def main(arguments: list[str] | None = None) -> int:
    """Run a subcommand; `arguments` are the words after ``thermoxels``, None: the arguments of this process.

    Errors are printed. Returns the exit status: 0, 130 after the user's interrupt, or `errors.exit_status` of an error.
    """
    about = "RGB and thermal photographs to a solid with heat."
    try:
        tyro.cli(Commands, prog="thermoxels", args=arguments, description=about).main()
    except ThermoxelsError as problem:
        print(f"Error: {problem}", file=sys.stderr)
        return exit_status(problem)
    except MemoryError as problem:
        print(f"Error: memory does not suffice: {problem}", file=sys.stderr)
        return exit_status(problem)
    except KeyboardInterrupt:
        print("Interrupted.", file=sys.stderr)
        return 130
    return 0


def entrypoint() -> None:
    """Run `main` as the console script and end the process with its exit status."""
    quiet_warnings.silence()
    try:
        try:
            status = main()
        finally:
            sys.stdout.flush()
    except BrokenPipeError:  # the reader of a pipe, such as head, closed it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        status = 1
    sys.exit(status)


if __name__ == "__main__":
    entrypoint()
