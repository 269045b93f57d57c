"""Masks of photographs: the user's masks, and overlays such as text and logos that the camera drew."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from thermoxels_ns.capture.frames import CaptureFrame
from thermoxels_ns.capture.photograph import open_photograph, read_mask, read_photograph_facts
from thermoxels_ns.core.arrays import BoolArray
from thermoxels_ns.core.errors import SceneError

MIN_FRAMES = 8  # fewer photographs cannot show whether something is an overlay or part of the scene
_LOOKED_AT = 40  # at most so many photographs are searched for an overlay
_SIDE = 800  # longest side to which photographs are reduced for that search, [pixels]
_STILL = 10.0  # an overlay's pixels change by less than this over all photographs, [grey levels of 255]
_ALIVE = 30.0  # an overlay's surroundings change by more than this on average, [grey levels]
_EDGE = 25.0  # an overlay differs from its surroundings by more than this in the mean picture, [grey levels]
_AROUND_SHARE = 0.12  # width of the surroundings, as a share of the longest side
_MOST_SHARE = 0.2  # a larger share of still pixels is no overlay but a scene that does not change


@dataclass(frozen=True)
class PhotographMasks:
    """The usable pixels of all photographs: those outside the camera's overlay and inside the user's masks."""

    size: tuple[int, int]  # width and height of the photographs, [pixels]
    overlay: BoolArray | None = None
    """Array that is False where the camera drew over all photographs, shape (height, width); None: no overlay."""
    files: Mapping[str, Path] = field(default_factory=dict)
    """The user's mask files by frame name; a frame without a mask is usable everywhere outside the overlay."""

    @property
    def any(self) -> bool:
        """True when there is an overlay or at least one mask of the user."""
        return self.overlay is not None or bool(self.files)

    def of(self, frame: str) -> BoolArray:
        """Return a frame's mask (height, width), True where usable; raise `SceneError` if the mask's file is unfit."""
        width, height = self.size
        use = np.ones((height, width), dtype=bool) if self.overlay is None else self.overlay.copy()
        return use & read_mask(self.files[frame], width, height) if frame in self.files else use


def find_masks(frames: Sequence[CaptureFrame], folder: Path | None, look_for_overlays: bool) -> PhotographMasks:
    """Return the masks of photographs: the user's files in `folder`, if any, and the overlay if `look_for_overlays`.

    Only photographs of the most frequent size count. Raises `SceneError` for an unreadable photograph or mask folder.
    """
    sizes = [read_photograph_facts(frame.photograph).size for frame in frames]
    size = max(dict.fromkeys(sizes), key=sizes.count)
    same = [frame for frame, own in zip(frames, sizes) if own == size]
    some = np.unique(np.linspace(0, len(same) - 1, min(len(same), _LOOKED_AT)).round().astype(int))
    overlay = find_overlay([same[i].photograph for i in some]) if look_for_overlays else None
    return PhotographMasks(size, overlay, user_masks(same, folder))


def user_masks(frames: Sequence[CaptureFrame], folder: Path | None) -> dict[str, Path]:
    """Return the user's mask file of each frame, named like its photograph or frame; frames without a mask are absent.

    Raises `SceneError` if `folder` does not exist or no mask fits; without `folder` the result is empty.
    """
    if folder is None:
        return {}
    files = mask_files(folder)
    found = {}
    for frame in frames:
        names = (Path(frame.photograph_source).stem.lower(), frame.name.lower())
        own = next((files[name] for name in names if name in files), None)
        if own is not None:
            found[frame.name] = own
    if not found:
        remedy = f"Name them like {Path(frames[0].photograph_source).stem}.png."
        got = f"{len(files)} pictures in {folder}, none of them named so"
        raise SceneError("masks", expected="masks named like photographs", got=got, remedy=remedy)
    return found


def find_overlay(photographs: Sequence[Path]) -> BoolArray | None:
    """Find text, scales and logos that the camera drew at the same place in all photographs, all of one size.

    A pixel belongs to the overlay if it stays the same in all photographs, stands out from its surroundings in the mean
    picture, and these surroundings change. The result is True where the scene shows, shape (height, width); None if no
    overlay is found, or if the photographs are too few or too similar to tell.
    """
    if len(photographs) < MIN_FRAMES:
        return None
    size = read_photograph_facts(photographs[0]).size
    factor = min(1.0, _SIDE / max(size))
    small = max(1, round(size[0] * factor)), max(1, round(size[1] * factor))
    pictures = (open_photograph(path).convert("L").resize(small, Image.Resampling.BOX) for path in photographs)
    stack = np.stack([np.asarray(picture, dtype=np.float32) for picture in pictures])
    spread = np.ptp(stack, axis=0)
    mean = np.mean(stack, axis=0)
    width = int(_AROUND_SHARE * max(mean.shape)) | 1
    around = cv2.blur(spread, (width, width))
    stands_out = np.abs(mean - cv2.blur(mean, (width, width))) > _EDGE
    drawn = (spread < _STILL) & (around > _ALIVE) & stands_out
    drawn &= cv2.blur(drawn.astype(np.float32), (3, 3)) > 0.3  # single pixels are chance
    if not drawn.any() or drawn.mean() > _MOST_SHARE:
        return None
    grown = cv2.dilate(drawn.astype(np.uint8), np.ones((9, 9), np.uint8))
    return cv2.resize(grown, size, interpolation=cv2.INTER_NEAREST) == 0


def mask_files(folder: Path) -> dict[str, Path]:
    """Return the masks in a folder by their names' stems in lower case; raise `SceneError` without such a folder."""
    if not folder.is_dir():
        raise SceneError("masks", expected="a folder of masks", got=f"no folder at {folder}", remedy="Check the path.")
    return {
        path.stem.lower(): path for path in sorted(folder.iterdir()) if path.suffix.lower() in (".png", ".jpg", ".jpeg")
    }
