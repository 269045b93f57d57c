"""The command ``thermoxels capture``: make a scene from camera files. Only light imports at the top, for --help."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from thermoxels_ns.capture.settings import CaptureSettings

if TYPE_CHECKING:
    from thermoxels_ns.capture.stages import CaptureResult

_LISTED = 10


@dataclass(frozen=True)
class Capture(CaptureSettings):
    """Turn camera files into a scene: pair photographs with thermal images, read temperatures, find poses, scale, the
    rig between the two cameras and drift; write a scene for thermal-data, and a page by which to judge the scene."""

    source: tyro.conf.Positional[Path] = field(kw_only=True)
    """Folder of camera files; it is only read."""
    output: Path = field(kw_only=True)
    """Folder for the scene and capture.html; made if it does not exist. If the folder holds an earlier capture, its
    poses and rig are kept where nothing that they depend on has changed, and the scene is written anew."""

    def main(self) -> None:
        """Run the capture and print what was left out; raises `ThermoxelsError` if nothing can be made of the files."""
        result = capture_folder(self.source, self.output, self, partial(print, flush=True))
        print(f"{len(result.scene.frames)} frames of {len(result.pairs)} pairs are in the scene.")
        if result.dropped:
            print(f"Left out: {len(result.dropped)}")
            for name, why in list(result.dropped.items())[:_LISTED]:
                print(f"  {name}: {why}")
            if len(result.dropped) > _LISTED:
                print(f"  and {len(result.dropped) - _LISTED} more, listed in {result.page}")
        if not result.scene.rig.determined:
            print(f"The rig was not determined. {result.scene.rig.explanation}")
        if result.scene.scale is None:
            print(f"The scale is unknown: {result.scale_missing}. Give a length when you export.")
        print(f"What was found, with pictures to judge it by: {result.page}")
        print(f"Train with: ns-train thermoxels --data {shlex.quote(str(self.output))}")


def capture_folder(
    source: Path, output: Path, settings: CaptureSettings, say: Callable[[str], None] = lambda _: None
) -> CaptureResult:
    """Turn a folder of camera files into a scene, and write its page; raises the errors of `run_capture`."""
    from thermoxels_ns.capture.stages import run_capture
    from thermoxels_ns.reports.capture_page import write_capture_page

    return run_capture(source, output, settings, write_capture_page, say)
