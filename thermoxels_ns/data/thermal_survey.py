"""One pass over all thermal files of a scene: sizes, temperature range and dead pixels."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.errors import ThermalFileError
from thermoxels_ns.core.units import TemperatureRange
from thermoxels_ns.radiometry.dead_pixels import find_dead_pixels
from thermoxels_ns.radiometry.thermal_files import ThermalUnit, read_temperature_c

_MOST_FRAMES = 64
"""Frames per resolution that the search for dead pixels keeps in memory."""


@dataclass(frozen=True)
class ThermalSurvey:
    """What the thermal files of a scene have in common."""

    shapes: dict[Path, tuple[int, int]]
    """Height and width of every file."""
    temperature_range: TemperatureRange
    """From temperature_bounds.json and the extremes of the training files' valid pixels."""
    dead_pixels: dict[tuple[int, int], npt.NDArray[np.bool_]]
    """Mask of stuck pixels for every resolution that has some."""


def survey_thermal_files(
    paths: Sequence[Path],
    unit: ThermalUnit,
    valid_range_c: tuple[float, float],
    bounds_c: tuple[float, float] | None,
    training: Collection[Path] | None = None,
) -> ThermalSurvey:
    """Read every thermal file once.

    Args:
        paths: All thermal files of the scene, training and evaluation.
        unit: Meaning of the numbers in the files.
        valid_range_c: Temperatures outside are masked, [degrees Celsius].
        bounds_c: Range the scene declares, [degrees Celsius]. It is widened to the extremes of training files that hold
            temperatures of their own; files that hold shares of the range cannot exceed it.
        training: The files that training uses; range and stuck pixels come from them alone. None: all.

    Raises:
        ThermalFileError: A file cannot be read or has no valid pixel at all.
    """
    shapes: dict[Path, tuple[int, int]] = {}
    extremes: dict[Path, tuple[float, float]] = {}
    kept: dict[tuple[int, int], list[npt.NDArray[np.float32]]] = {}
    trains = [training is None or path in training for path in paths]
    # Counted among the training files: every other file of all may be an evaluation's.
    step = -(-sum(trains) // _MOST_FRAMES)
    for path, is_training in zip(paths, trains):
        temperature_c = read_temperature_c(path, unit, valid_range_c)
        height, width = temperature_c.shape
        shapes[path] = (height, width)
        if not np.isfinite(temperature_c).any():
            raise ThermalFileError(
                str(path),
                expected=f"temperatures from {valid_range_c[0]} to {valid_range_c[1]} C",
                got="no valid pixel",
                remedy="Check thermal_unit or temperature_bounds.json, or widen --valid-range-c.",
            )
        if not is_training:
            continue
        if len(extremes) % step == 0:
            kept.setdefault((height, width), []).append(temperature_c)
        extremes[path] = (float(np.nanmin(temperature_c)), float(np.nanmax(temperature_c)))
    dead = {shape: find_dead_pixels(np.stack(frames)) for shape, frames in kept.items()}
    dead = {shape: mask for shape, mask in dead.items() if mask.any()}
    for path in extremes:
        if shapes[path] in dead:  # the extremes of these files may be a stuck pixel's
            live = read_temperature_c(path, unit, valid_range_c)[~dead[shapes[path]]]
            if np.isfinite(live).any():
                extremes[path] = (float(np.nanmin(live)), float(np.nanmax(live)))
    lows, highs = zip(*extremes.values())
    low, high = min(lows), max(highs)
    if bounds_c is not None:
        low, high = min(low, bounds_c[0]), max(high, bounds_c[1])
    return ThermalSurvey(shapes, TemperatureRange.spanning(low, high), dead)
