"""Masks of photographs: what the user shuts out, and what the camera drew over them."""

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

MIN_FRAMES = 8  # fewer photographs cannot tell what is drawn over them from what they all happen to show
_LOOKED_AT = 40  # photographs that overlays are looked for in
_SIDE = 800  # longest side at which overlays are looked for, [pixels]
_STILL = 10.0  # grey levels (of 255) that what is drawn changes by, from JPEG's compression alone
_ALIVE = 30.0  # grey levels that the surroundings change by at least
_EDGE = 25.0  # grey levels by which what is drawn stands out from its surroundings in the mean picture
_AROUND_SHARE = 0.12  # width of the surroundings, as a share of the longest side
_MOST_SHARE = 0.2  # more of the picture than this is no overlay but a scene that does not change


@dataclass(frozen=True)
class PhotographMasks:
    """Where photographs may be used: everywhere but under what the camera drew and what the user shut out."""

    size: tuple[int, int]  # width and height of the photographs, [pixels]
    overlay: BoolArray | None = None
    """False where the camera drew over all photographs, shape (height, width); None: nowhere."""
    files: Mapping[str, Path] = field(default_factory=dict)
    """Masks that the user gives, by frame; frames without one may be used everywhere."""

    @property
    def any(self) -> bool:
        """Whether anything is masked in any photograph."""
        return self.overlay is not None or bool(self.files)

    def of(self, frame: str) -> BoolArray:
        """True where a frame's photograph may be used, shape (height, width); a `SceneError` for an unfit mask."""
        width, height = self.size
        use = np.ones((height, width), dtype=bool) if self.overlay is None else self.overlay.copy()
        return use & read_mask(self.files[frame], width, height) if frame in self.files else use


def find_masks(frames: Sequence[CaptureFrame], folder: Path | None, look_for_overlays: bool) -> PhotographMasks:
    """Find the overlay and the user's masks for the size that most photographs have.

    A `SceneError` is raised where a photograph or a mask cannot be read.
    """
    sizes = [read_photograph_facts(frame.photograph).size for frame in frames]
    size = max(dict.fromkeys(sizes), key=sizes.count)
    same = [frame for frame, own in zip(frames, sizes) if own == size]
    some = np.unique(np.linspace(0, len(same) - 1, min(len(same), _LOOKED_AT)).round().astype(int))
    overlay = find_overlay([same[i].photograph for i in some]) if look_for_overlays else None
    return PhotographMasks(size, overlay, user_masks(same, folder))


def user_masks(frames: Sequence[CaptureFrame], folder: Path | None) -> dict[str, Path]:
    """The user's masks by frame: those named like a photograph, or like a frame; a `SceneError` where none is."""
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
    """Find what the camera drew over all photographs of one size: text, scales and logos, at the same place in each.

    A pixel belongs to an overlay if it stays the same in all photographs, stands out from its surroundings in their
    mean, and the surroundings change. Numbers that change from frame to frame are found by their outlines only.

    Returns:
        True where the scene shows, shape (height, width) of the photographs; None where nothing is drawn, or where
        there are too few photographs or they are too much alike to tell.
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
    """Masks in a folder by the stem of their names, in small letters; a `SceneError` where there is no such folder."""
    if not folder.is_dir():
        raise SceneError("masks", expected="a folder of masks", got=f"no folder at {folder}", remedy="Check the path.")
    return {
        path.stem.lower(): path for path in sorted(folder.iterdir()) if path.suffix.lower() in (".png", ".jpg", ".jpeg")
    }
