"""The masks of a capture's photographs: what the user gives, and what the camera drew."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from thermoxels_ns.capture.frames import CaptureFrame
from thermoxels_ns.capture.masks import PhotographMasks, find_overlay, mask_files
from thermoxels_ns.capture.photograph import read_photograph_facts
from thermoxels_ns.core.errors import SceneError

_LOOKED_AT = 40
"""Photographs that overlays are looked for in."""


def find_masks(frames: Sequence[CaptureFrame], folder: Path | None, look_for_overlays: bool) -> PhotographMasks:
    """Masks for photographs of the size that most of them have.

    Args:
        frames: At least one.
        folder: The user's masks; None: there are none.
        look_for_overlays: Whether to look for what the camera drew.

    Raises:
        SceneError: The user's masks are not named like photographs, or a photograph cannot be read.
    """
    sizes = []
    for frame in frames:
        facts = read_photograph_facts(frame.photograph)
        sizes.append((facts.width, facts.height))
    size = max(dict.fromkeys(sizes), key=sizes.count)
    same = [frame for frame, own in zip(frames, sizes) if own == size]
    drawn = None
    if look_for_overlays:
        some = np.linspace(0, len(same) - 1, min(len(same), _LOOKED_AT)).round().astype(int)
        drawn = find_overlay([same[i].photograph for i in np.unique(some)])
    return PhotographMasks(size, drawn, user_masks(same, folder))


def user_masks(frames: Sequence[CaptureFrame], folder: Path | None) -> dict[str, Path]:
    """The user's masks by frame: those named like a photograph, or like a frame.

    Raises:
        SceneError: None of them is.
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
        raise SceneError(
            "masks",
            expected="masks named like photographs",
            got=f"{len(files)} pictures in {folder}, none of them named so",
            remedy=f"Name them like {Path(frames[0].photograph_source).stem}.png.",
        )
    return found
