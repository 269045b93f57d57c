"""Options of a capture; light to import, so that the help answers at once."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

StageName = Literal["pairs", "temperatures", "poses", "scale", "board", "rig", "drift", "scene", "page"]
"""The stages of a capture in order."""
Matching = Literal["auto", "exhaustive", "sequential"]
LensModel = Literal["SIMPLE_RADIAL", "RADIAL", "OPENCV"]


@dataclass
class CaptureSettings:
    """All settings of ``thermoxels capture`` but the folders."""

    from_stage: StageName | None = None
    """Do this stage and all later ones again. Without it only those whose input or options have changed."""
    skip_bad: bool = False
    """Leave files out that cannot be read and name them, instead of stopping."""
    camera: Literal["workswell", "flir-high-gain", "flir-low-gain", "flir-duo", "sensefly"] | None = None
    """Which camera's counts TIFF files hold. Default: by what the file says, which some files leave open."""
    celsius_per_count: float | None = None
    """Degrees per count of TIFF, PNG or whole-number NPY files, in place of a camera's."""
    celsius_offset: float | None = None
    """Temperature of count zero, in degrees C; goes with --celsius-per-count."""
    emissivity: float | None = None
    """Emissivity of what was photographed, above 0, at most 1. Default: the camera's setting."""
    reflected_c: float | None = None
    """Apparent temperature of what the objects mirror, in degrees C. Default: the camera's setting."""
    distance_m: float | None = None
    """From the camera to the objects, for the air between, in metres. Default: the camera's setting."""
    relative_humidity: float | None = None
    """Of the air, 0 to 1. Default: the camera's setting."""
    air_c: float | None = None
    """Air temperature, in degrees C. Default: the camera's setting."""
    dji_library: Path | None = None
    """Path of DJI's libdirp.so or libdirp.dll, for DJI R-JPEG (from the DJI Thermal SDK)."""
    pairs: Path | None = None
    """CSV file with one photograph and its thermal image per line, relative to the input folder. Default: pairs are
    found by content, names and times."""
    time_limit_s: float = 1.5
    """Longest time between the exposures of a pair that is found by its times alone, in seconds."""
    clock_offset_s: float = 0.0
    """How far the thermal camera's clock is ahead of that of the photographs, in seconds."""
    poses: Path | None = None
    """Poses that exist already: folder of a COLMAP model, or a transforms.json. Default: found from the photographs."""
    matching: Matching = "auto"
    """Which photographs are compared: each with each, or each with its neighbours in time. auto: each with each up to
    80 photographs."""
    lens: LensModel = "SIMPLE_RADIAL"
    """Lens model of the photographs, by COLMAP's names. OPENCV fits strong distortion and needs many photographs."""
    image_size: int = 1600
    """Longest side to which photographs are reduced for finding poses, in pixels. The scene keeps the originals."""
    max_features: int = 4000
    """Features per photograph. More of them find poses in poor texture and take longer."""
    threads: int = 2
    """Threads for finding poses."""
    seed: int = 0
    """Of all random choices; the same seed gives the same poses."""
    known_distance: tuple[str, float, float, float, float, float] | None = None
    """A length that was measured: name of a photograph, pixel x y of one end, x y of the other, metres."""
    known_distance_error_m: float | None = None
    """Standard error of that length, in metres."""
    marker_side_m: float | None = None
    """Side of the black square of printed ArUco markers (dictionary 4x4, numbers 0 to 49) in the scene, in metres."""
    marker_error_m: float | None = None
    """Standard error of that side, in metres."""
    thermal_field_of_view_deg: float | None = None
    """Horizontal angle of view of the thermal lens, in degrees, where the search for it begins. Default: what the files
    say."""
    rig: Path | None = None
    """transforms.json of an earlier capture with the same camera: its thermal camera and rig are used as they are, and
    lengths follow the two scales where both are known."""
    board_photos: Path | None = None
    """Folder with pictures of a heated (or foil) checker board, taken by both cameras in at least three places: the rig
    comes from them instead of from the scene. Needs --board, --board-square-m and a known scale."""
    board: str | None = None
    """Inner corners of that board along both sides, such as 7x5 for 8 x 6 squares."""
    board_square_m: float | None = None
    """Side of one of its squares, in metres."""
    drift: Literal["auto", "off"] = "auto"
    """Correct offsets between thermal images and vignetting, if points that the fit does not see agree better."""
    find_overlays: bool = True
    """Mask text and logos that the camera drew over all photographs."""
    masks: Path | None = None
    """Folder of masks for photographs, each named like its photograph: white where it may be used."""
    thermal_mask: Path | None = None
    """One mask for all thermal images: white where they may be used."""
