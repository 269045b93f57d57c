"""One thermal camera file after reading: degrees, and what the file says about how they were measured."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Literal

import numpy as np
import numpy.typing as npt

from thermoxels_ns.radiometry.conditions import Conditions
from thermoxels_ns.radiometry.flir_records import PictureInPicture
from thermoxels_ns.radiometry.thermal_files import PixelReport, ThermalImage

ThermogramFormat = Literal["FLIR R-JPEG", "DJI R-JPEG", "TIFF", "PNG", "NPY", "CSV"]


@dataclass(frozen=True)
class ThermogramMetadata:
    """What a thermal file says besides its temperatures; None: it does not say."""

    format: ThermogramFormat
    """By content, not by name."""
    camera: str | None = None
    """Maker and model."""
    serial: str | None = None
    """Of the camera."""
    lens: str | None = None
    taken_at: datetime | None = None
    """When; with a time zone where the file has one."""
    field_of_view_deg: float | None = None
    """Horizontal, of the thermal lens, as the camera states it; some state nonsense such as 180."""
    camera_conditions: Conditions | None = None
    """Emissivity and the rest that the camera was set to."""
    conditions: Conditions | None = None
    """Those that the temperatures were computed with: the camera's, with the user's in their place."""
    picture_in_picture: PictureInPicture | None = None
    """Factory alignment of photograph and thermal image."""
    celsius_per_count: float | None = None
    """Step of the file's counts, [K], where they are linear in temperature."""


@dataclass(frozen=True)
class Thermogram:
    """One thermal image in degrees."""

    temperature_c: npt.NDArray[np.float32]
    """Shape (height, width), [degrees C], NaN where the camera measured nothing."""
    metadata: ThermogramMetadata
    report: PixelReport
    """How many pixels are NaN and why."""


def masked_image(
    temperature_c: npt.NDArray[np.floating],
    valid_range_c: tuple[float, float],
    saturated: npt.NDArray[np.bool_] | None = None,
) -> ThermalImage:
    """Mask temperatures that are none and count them.

    Args:
        temperature_c: Shape (height, width), [degrees C].
        valid_range_c: Temperatures outside are masked, [degrees C].
        saturated: Pixels beyond the sensor's calibration, same shape; None: none.
    """
    if saturated is None:
        saturated = np.zeros(temperature_c.shape, dtype=bool)
    nan = ~np.isfinite(temperature_c) & ~saturated
    with np.errstate(invalid="ignore"):
        inside = (temperature_c >= valid_range_c[0]) & (temperature_c <= valid_range_c[1])
    outside = ~inside & ~nan & ~saturated
    masked = np.where(nan | saturated | outside, np.nan, temperature_c).astype(np.float32)
    report = PixelReport(masked.size, int(nan.sum()), int(saturated.sum()), int(outside.sum()))
    return ThermalImage(masked, report)
