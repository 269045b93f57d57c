"""Options of a capture. This module is quick to import, so that ``--help`` answers at once."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from thermoxels_ns.radiometry.measurement_model import RadiometryOptions

StageName = Literal["poses", "rig"]  # the stages of a capture whose results are kept, in order
LensModel = Literal["SIMPLE_RADIAL", "RADIAL", "OPENCV"]


@dataclass(frozen=True)
class CaptureSettings(RadiometryOptions):
    """All settings of ``thermoxels capture`` except the input and output folders."""

    from_stage: StageName | None = None
    """Stage to run again, even if nothing changed: poses (the rig then follows) or rig. By default, these two are found
    again only if input or options changed; all else, which takes seconds, is done each time."""
    skip_bad: bool = False
    """Leave out and report files that cannot be read, instead of stopping at the first of them."""
    time_limit_s: float = 1.5
    """Longest time between the two exposures of a pair that is found by time alone, in seconds."""
    clock_offset_s: float = 0.0
    """How far the thermal camera's clock is ahead of the photographs' clock, in seconds."""
    lens: LensModel = "SIMPLE_RADIAL"
    """Lens model of the photographs, by COLMAP's names. OPENCV fits strong distortion and needs many photographs."""
    image_size: int = 1600
    """Longest side to which photographs are reduced for finding poses, in pixels. The scene keeps the originals."""
    max_features: int = 4000
    """Most features per photograph. More features find poses in poorer texture, and take longer."""
    threads: int = 2
    """Number of threads for finding and matching features."""
    seed: int = 0
    """Seed of all random choices; the same seed gives the same poses."""
    marker_side_m: float | None = None
    """Side of the black square of printed ArUco markers (dictionary 4x4, numbers 0 to 49) in the scene, in metres."""
    marker_error_m: float | None = None
    """Standard error of --marker-side-m, in metres. Default: the side counts as exact."""
    thermal_field_of_view_deg: float | None = None
    """Horizontal angle of view of the thermal lens at the start of the search for the rig, in degrees. Default: what
    the files say."""
    rig: Path | None = None
    """transforms.json of an earlier capture with the same camera: its thermal camera and rig are used unchanged, except
    that the rig's lengths are converted where both captures have a scale."""
