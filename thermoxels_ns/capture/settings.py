"""What a user can say about a capture; light to import, so that the command's help answers at once."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Optional

from thermoxels_ns.capture.stages import StageName


@dataclass
class CaptureSettings:
    """All settings of ``thermoxels capture`` but the folders."""

    from_stage: Optional[StageName] = None  # noqa: UP045 - read by tyro
    """Do this stage and all later ones again. Without it only those whose input or options have changed."""
    skip_bad: bool = False
    """Leave files out that cannot be read and name them, instead of stopping."""
    camera: Optional[  # noqa: UP045 - read by tyro
        Literal["workswell", "flir-high-gain", "flir-low-gain", "flir-duo", "sensefly"]
    ] = None
    """Which camera's counts TIFF files hold. Default: by what the file says, which some files leave open."""
    celsius_per_count: Optional[float] = None  # noqa: UP045 - read by tyro
    """Degrees per count of TIFF, PNG or whole-number NPY files, in place of a camera's."""
    celsius_offset: Optional[float] = None  # noqa: UP045 - read by tyro
    """Temperature of count zero, in degrees C; goes with --celsius-per-count."""
    emissivity: Optional[float] = None  # noqa: UP045 - read by tyro
    """Emissivity of what was photographed, above 0, at most 1. Default: the camera's setting."""
    reflected_c: Optional[float] = None  # noqa: UP045 - read by tyro
    """Apparent temperature of what the objects mirror, in degrees C. Default: the camera's setting."""
    distance_m: Optional[float] = None  # noqa: UP045 - read by tyro
    """From the camera to the objects, for the air between, in metres. Default: the camera's setting."""
    relative_humidity: Optional[float] = None  # noqa: UP045 - read by tyro
    """Of the air, 0 to 1. Default: the camera's setting."""
    air_c: Optional[float] = None  # noqa: UP045 - read by tyro
    """Air temperature, in degrees C. Default: the camera's setting."""
    dji_library: Optional[Path] = None  # noqa: UP045 - read by tyro
    """Path of DJI's libdirp.so or libdirp.dll, for DJI R-JPEG (from the DJI Thermal SDK)."""
    pairs: Optional[Path] = None  # noqa: UP045 - read by tyro
    """CSV file with one photograph and its thermal image per line, relative to the input folder. Default: pairs are
    found by content, names and times."""
    time_limit_s: float = 1.5
    """Longest time between the exposures of a pair that is found by its times alone, in seconds."""
    clock_offset_s: float = 0.0
    """How far the thermal camera's clock is ahead of that of the photographs, in seconds."""
    poses: Optional[Path] = None  # noqa: UP045 - read by tyro
    """Poses that exist already: folder of a COLMAP model, or a transforms.json. Default: found from the photographs."""
    matching: Literal["auto", "exhaustive", "sequential"] = "auto"
    """Which photographs are compared: each with each, or each with its neighbours in time. auto: each with each up to
    80 photographs."""
    lens: Literal["SIMPLE_RADIAL", "RADIAL", "OPENCV"] = "SIMPLE_RADIAL"
    """Lens model of the photographs, by COLMAP's names. OPENCV fits strong distortion and needs many photographs."""
    image_size: int = 1600
    """Longest side to which photographs are reduced for finding poses, in pixels. The scene keeps the originals."""
    max_features: int = 4000
    """Features per photograph. More of them find poses in poor texture and take longer."""
    threads: int = 2
    """Threads for finding poses."""
    seed: int = 0
    """Of all random choices; the same seed gives the same poses."""
    known_distance: Optional[tuple[str, float, float, float, float, float]] = None  # noqa: UP045 - read by tyro
    """A length that was measured: name of a photograph, pixel x y of one end, x y of the other, metres."""
    known_distance_error_m: Optional[float] = None  # noqa: UP045 - read by tyro
    """Standard error of that length, in metres."""
    marker_side_m: Optional[float] = None  # noqa: UP045 - read by tyro
    """Side of the black square of printed ArUco markers (dictionary 4x4, numbers 0 to 49) in the scene, in metres."""
    marker_error_m: Optional[float] = None  # noqa: UP045 - read by tyro
    """Standard error of that side, in metres."""
    thermal_field_of_view_deg: Optional[float] = None  # noqa: UP045 - read by tyro
    """Horizontal angle of view of the thermal lens, in degrees, where the search for it begins. Default: what the files
    say."""
    rig: Optional[Path] = None  # noqa: UP045 - read by tyro
    """transforms.json of an earlier capture with the same camera: its thermal camera and rig are used as they are, and
    lengths follow the two scales where both are known."""
    board_photos: Optional[Path] = None  # noqa: UP045 - read by tyro
    """Folder with pictures of a heated (or foil) checker board, taken by both cameras in at least three places: the rig
    comes from them instead of from the scene. Needs --board, --board-square-m and a known scale."""
    board: Optional[str] = None  # noqa: UP045 - read by tyro
    """Inner corners of that board along both sides, such as 7x5 for 8 x 6 squares."""
    board_square_m: Optional[float] = None  # noqa: UP045 - read by tyro
    """Side of one of its squares, in metres."""
    drift: Literal["auto", "off"] = "auto"
    """Correct offsets between thermal images and vignetting, if points that the fit does not see agree better."""
    find_overlays: bool = True
    """Mask text and logos that the camera drew over all photographs."""
    masks: Optional[Path] = None  # noqa: UP045 - read by tyro
    """Folder of masks for photographs, each named like its photograph: white where it may be used."""
    thermal_mask: Optional[Path] = None  # noqa: UP045 - read by tyro
    """One mask for all thermal images: white where they may be used."""
