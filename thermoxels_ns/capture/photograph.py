"""Reads photographs, and from their headers time, place, lens and orientation."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta
from fractions import Fraction
from pathlib import Path
from typing import Any

from PIL import Image

from thermoxels_ns.radiometry.decoders import errors_name, read_exif_facts

_EXPECTED = "a photograph that can be decoded"
_REMEDY = "The file is damaged; copy it from the camera again, or go on without it with --skip-bad True."
_EXIF, _GPS = 34665, 34853
_ORIENTATION, _SUBSECOND = 274, (37521, 37520)
_FOCAL_MM, _FOCAL_35MM, _PLANE_X, _PLANE_UNIT = 37386, 41989, 41486, 41488
_MM_PER_PLANE_UNIT = {1: 25.4, 2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_FILM_WIDTH_MM = 36.0


@dataclass(frozen=True)
class GpsFix:
    """Position of a camera as its GPS receiver states it."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float | None


@dataclass(frozen=True)
class PhotographFacts:
    """Contents of a photograph's header. A field is None if the header does not state it."""

    width: int
    height: int
    camera: str | None  # maker and model
    taken_at: datetime | None  # time that the camera's clock showed, with fractions of a second if the file has them
    focal_px: float | None
    """Focal length, [pixels], from the lens's length and the sensor's pixel pitch, else from the 35 mm equivalent."""
    orientation: int
    """EXIF orientation, 1 to 8: how to turn the stored pixels to make the picture upright; 1 if not stated."""
    gps: GpsFix | None
    gimbal_deg: tuple[float, float] | None
    """Pitch (0 is level, -90 looks straight down) and roll of the camera against gravity, [degrees]."""


def read_photograph_facts(path: Path) -> PhotographFacts:
    """Return the contents of a photograph's header; raise `SceneError` if it is no picture or states an absurd size."""
    with errors_name(path, _EXPECTED, _REMEDY), Image.open(path) as image:
        width, height = image.size
        camera, taken_at = read_exif_facts(image)
        exif = image.getexif()
        tags, gps = {**exif, **exif.get_ifd(_EXIF)}, exif.get_ifd(_GPS)
        with path.open("rb") as stream:
            head = stream.read(2**18)
    orientation = tags.get(_ORIENTATION, 1)
    return PhotographFacts(
        width=width,
        height=height,
        camera=camera,
        taken_at=_with_fraction(taken_at, tags),
        focal_px=_focal_px(tags, width, height),
        orientation=int(orientation) if orientation in range(1, 9) else 1,
        gps=_gps_fix(gps),
        gimbal_deg=_gimbal(head),
    )


def open_photograph(path: Path) -> Image.Image:
    """Return a photograph's RGB pixels as stored, not turned by EXIF; raise `SceneError` if it cannot be decoded."""
    with errors_name(path, _EXPECTED, _REMEDY), Image.open(path) as image:
        return image.convert("RGB")


def _number(value: object) -> float | None:
    """Return an EXIF value (number or fraction) as a finite float, or None if it is no finite number."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) else None


def _with_fraction(taken_at: datetime | None, tags: Mapping[int, Any]) -> datetime | None:
    """Return `taken_at` plus the fraction of a second in EXIF `tags`, stored as decimal digits or as a fraction."""
    if taken_at is None:
        return None
    for tag in _SUBSECOND:
        text = str(tags.get(tag, "")).split("\0")[0].strip()
        try:
            share = float(Fraction(text if "/" in text else f"0.{text}"))
        except (ValueError, ZeroDivisionError):
            continue
        if 0.0 <= share < 1.0:
            return taken_at + timedelta(seconds=share)
    return taken_at


def _focal_px(tags: Mapping[int, Any], width: int, height: int) -> float | None:
    longest = max(width, height)
    focal_mm, per_unit, film_mm = (_number(tags.get(tag)) or 0.0 for tag in (_FOCAL_MM, _PLANE_X, _FOCAL_35MM))
    unit_mm = _MM_PER_PLANE_UNIT.get(tags.get(_PLANE_UNIT, 2), math.inf)
    candidates = focal_mm * per_unit / unit_mm, film_mm / _FILM_WIDTH_MM * longest
    # The limits mean lenses of 7 to 157 degrees; values outside belong to another resolution or are wrong.
    return next((px for px in candidates if 0.1 * longest < px < 8.0 * longest), None)


def _gps_fix(gps: Mapping[int, Any]) -> GpsFix | None:
    latitude = _degrees(gps.get(2), gps.get(1), "S")
    longitude = _degrees(gps.get(4), gps.get(3), "W")
    if latitude is None or longitude is None or abs(latitude) > 90 or abs(longitude) > 180:
        return None
    if latitude == 0.0 and longitude == 0.0:  # cameras without a fix write zeros
        return None
    altitude = _number(gps.get(6))
    below = gps.get(5) in (1, b"\x01")
    return GpsFix(latitude, longitude, -altitude if altitude is not None and below else altitude)


def _degrees(parts: object, side: object, negative: str) -> float | None:
    if not isinstance(parts, tuple) or len(parts) != 3:
        return None
    numbers = [_number(part) for part in parts]
    if any(number is None for number in numbers):
        return None
    value = sum(number / 60.0**power for power, number in enumerate(numbers) if number is not None)
    return -value if str(side).strip("\0 ").upper() == negative else value


def _gimbal(head: bytes) -> tuple[float, float] | None:
    found = [re.search(rb"""Gimbal%sDegree(?:=["']|>)\s*([-+0-9.eE]+)""" % name, head) for name in (b"Pitch", b"Roll")]
    pitch, roll = (_number(match.group(1)) if match else None for match in found)
    if pitch is None or abs(pitch) > 180.0:
        return None
    return pitch, roll if roll is not None and abs(roll) <= 180.0 else 0.0
