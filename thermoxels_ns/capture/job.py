"""One capture that is being made: what the user gave, where it goes, and what was left out so far."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from thermoxels_ns.capture.rig.board_rig import CheckerBoard
from thermoxels_ns.capture.settings import CaptureSettings
from thermoxels_ns.capture.stages import StageCache
from thermoxels_ns.radiometry.camera_file import RadiometryOptions

PAGE_NAME = "capture.html"
"""Of the page, in the output folder."""


@dataclass
class CaptureJob:
    """What every stage of a capture is given."""

    source: Path
    """Folder of the camera's files."""
    output: Path
    """Folder of the scene and of the stages' results."""
    settings: CaptureSettings
    cache: StageCache
    """Runs the stages and keeps their results."""
    say: Callable[[str], None]
    """Told how far it is, one line at a time."""
    board: CheckerBoard | None = None
    """What the user's pictures of a checker board show."""
    dropped: dict[str, str] = field(default_factory=dict)
    """Files and frames that are left out, and why; stages add to it."""

    def radiometry(self) -> RadiometryOptions:
        """How the user wants thermal files read."""
        settings = self.settings
        return RadiometryOptions(
            camera=settings.camera,
            celsius_per_count=settings.celsius_per_count,
            celsius_offset=settings.celsius_offset,
            dji_library=settings.dji_library,
            emissivity=settings.emissivity,
            reflected_c=settings.reflected_c,
            distance_m=settings.distance_m,
            relative_humidity=settings.relative_humidity,
            air_c=settings.air_c,
        )
