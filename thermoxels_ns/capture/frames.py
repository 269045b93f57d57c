"""Reads the pairs of a capture: photographs, temperatures and the metadata of their files."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from thermoxels_ns.capture.pairs import Pair
from thermoxels_ns.capture.photograph import GpsFix, open_photograph, read_photograph_facts
from thermoxels_ns.capture.settings import CaptureSettings
from thermoxels_ns.core.checks import writable_folder
from thermoxels_ns.core.errors import SceneError, ThermoxelsError
from thermoxels_ns.radiometry.flir_rjpeg import read_flir_jpeg
from thermoxels_ns.radiometry.measurement_model import RadiometryOptions, conditions_text
from thermoxels_ns.radiometry.thermal_pixels import find_dead_pixels
from thermoxels_ns.radiometry.thermogram import ThermogramMetadata, read_thermogram

_MOST_FOR_DEAD_PIXELS = 60  # at most so many frames are searched for stuck pixels, to save memory


@dataclass(frozen=True)
class CaptureFrame:
    """One pair of photograph and thermal image after reading."""

    name: str  # path of the camera's file with the photograph, relative to the capture folder
    photograph: Path  # a picture file that holds the photograph and no thermal image
    thermal: Path  # a .npy file of float32 degrees C, shape (height, width), NaN in pixels without a temperature
    thermal_source: str  # path of the camera's file with the thermal image, relative to the capture folder
    metadata: ThermogramMetadata  # what the thermal file states besides its temperatures
    camera: str | None = None  # maker and model of the thermal camera, or if unknown, of the photograph's camera
    focal_px: float | None = None  # focal length that the photograph states, [pixels]
    orientation: int = 1  # EXIF's orientation of the photograph, 1 to 8
    gps: GpsFix | None = None
    gimbal_deg: tuple[float, float] | None = None  # pitch and roll of the camera, [degrees]
    thermal_focal_px: float | None = None  # focal length that the thermal file states, [thermal pixels]


@dataclass(frozen=True)
class CaptureFrames:
    """The frames of a capture that could be read, and the reason for each frame that was left out."""

    frames: tuple[CaptureFrame, ...]
    photograph_size: tuple[int, int]  # width and height of all photographs, [pixels]
    thermal_size: tuple[int, int]  # width and height of all thermal images, [pixels]
    dead_pixels: int  # number of sensor pixels that are stuck at one value; these are NaN in every frame
    dropped: dict[str, str] = field(default_factory=dict)  # reason by the name of the frame


def read_frames(
    pairs: Sequence[Pair],
    root: Path,
    folder: Path,
    settings: CaptureSettings,
    say: Callable[[str], None] = lambda _: None,
) -> CaptureFrames:
    """Write each pair's temperatures, and photographs taken out of thermal files, to `folder`; return the frames.

    `pairs` have names relative to `root`. Pixels of the thermal sensor that are stuck at one value become NaN. Pairs
    with a photograph or thermal image of an unusual size are listed in `dropped`; so are pairs with an unreadable file
    if `settings.skip_bad` is on. Raises `ThermoxelsError` if a file cannot be read and `settings.skip_bad` is off, or
    if no pair is left. Raises `OSError` if a result cannot be written.
    """
    for name in ("thermal", "photographs"):
        shutil.rmtree(folder / name, ignore_errors=True)
        writable_folder(folder / name)
    frames, dropped, sizes = [], dict[str, str](), []
    for number, pair in enumerate(pairs, start=1):
        try:
            frame, own = _read(pair, number, root, folder, settings)
            frames.append(frame)
            sizes.append(own)
        except ThermoxelsError as problem:  # a fault of a file that is read; a full disk raises OSError
            if not settings.skip_bad:
                raise
            dropped[pair.photograph] = str(problem)
        if number % 20 == 0:
            say(f"read: {number} of {len(pairs)} pairs")
    if not frames:
        remedy = "Look at the files, or at the pairs that were found in capture.html."
        got = f"none of {len(pairs)}: " + (next(iter(dropped.values())) if dropped else "there are no pairs")
        raise SceneError("pairs", expected="at least one pair whose files can be read", got=got, remedy=remedy)
    usual = [Counter(column).most_common(1)[0][0] for column in zip(*sizes)]
    for frame, own in zip(frames, sizes):
        for file, (width, height), most in zip((frame.name, frame.thermal_source), own, usual):
            if (width, height) != most:
                why = f"{width} x {height} pixels, most have {most[0]} x {most[1]}: another camera or mode"
                dropped[frame.name] = f"{file} has {why}"
    kept = [frame for frame in frames if frame.name not in dropped]
    return CaptureFrames(tuple(kept), usual[0], usual[1], _mask_stuck_pixels(kept), dropped)


_Size = tuple[int, int]  # width and height, [pixels]


def _read(
    pair: Pair, number: int, root: Path, folder: Path, options: RadiometryOptions
) -> tuple[CaptureFrame, tuple[_Size, _Size]]:
    """Read pair number `number` and write its files to `folder`; return the frame, and the sizes of both images."""
    photograph, camera_file = root / pair.photograph, root / pair.thermal
    thermogram = read_thermogram(camera_file, options)
    thermal_focal = None
    if pair.in_one_file:
        content = read_flir_jpeg(photograph).visible
        if content is None:
            remedy = "Export the photograph with the camera's program and put it beside the file."
            got = "none in a form that is known"
            raise SceneError(str(photograph), expected="a photograph inside the file", got=got, remedy=remedy)
        suffix = ".jpg" if content.startswith(b"\xff\xd8") else ".png"
        photograph = folder / "photographs" / f"{number:05d}{suffix}"
        photograph.write_bytes(content)
    elif thermogram.metadata.format in ("TIFF", "DJI R-JPEG"):
        thermal_focal = read_photograph_facts(camera_file).focal_px
    open_photograph(photograph).close()  # a file that is cut off shows only when it is decoded
    facts = read_photograph_facts(photograph)
    holder = read_photograph_facts(camera_file) if pair.in_one_file else facts
    thermal = folder / "thermal" / f"{number:05d}.npy"
    np.save(thermal, thermogram.temperature_c)
    metadata = thermogram.metadata
    frame = CaptureFrame(
        name=pair.photograph,
        photograph=photograph.resolve(),
        thermal=thermal.resolve(),
        thermal_source=pair.thermal,
        metadata=metadata,
        camera=metadata.camera or facts.camera,
        focal_px=facts.focal_px,
        orientation=facts.orientation,
        gps=facts.gps or holder.gps,
        gimbal_deg=facts.gimbal_deg or holder.gimbal_deg,
        thermal_focal_px=thermal_focal,
    )
    height, width = thermogram.temperature_c.shape
    return frame, ((facts.width, facts.height), (width, height))


def _mask_stuck_pixels(frames: list[CaptureFrame]) -> int:
    """Set pixels that are stuck at one value to NaN in the files of all frames; return their number."""
    some = np.linspace(0, len(frames) - 1, min(len(frames), _MOST_FOR_DEAD_PIXELS)).round().astype(int)
    bad = find_dead_pixels(np.stack([np.load(frames[i].thermal) for i in some]))
    for frame in frames if bad.any() else []:
        temperature_c = np.load(frame.thermal)
        temperature_c[bad] = np.nan
        np.save(frame.thermal, temperature_c)
    return int(bad.sum())


def measurement_rows(frames: Sequence[CaptureFrame]) -> list[tuple[str, str]]:
    """Return rows (name, text) for the report: formats of the thermal files, conditions of their temperatures."""
    known = [frame.metadata for frame in frames]
    formats = Counter(
        one.format + ("" if one.celsius_per_count is None else f" with {one.celsius_per_count:.4g} K per count")
        for one in known
    )
    conditions = Counter(conditions_text(one.conditions) for one in known if one.conditions)
    rows = []
    for name, counted in (("thermal files", formats), ("computed with", conditions)):
        listed = [f"{text} ({number} frames)" if len(counted) > 1 else text for text, number in counted.most_common()]
        rows.append((name, "; ".join(listed)))
    return [row for row in rows if row[1]]
