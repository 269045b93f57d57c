"""Records inside a FLIR file (FFF): counts, calibration and settings."""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image

from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.core.units import kelvin_to_celsius
from thermoxels_ns.radiometry.conditions import Conditions
from thermoxels_ns.radiometry.decoders import check_thermal_size
from thermoxels_ns.radiometry.measurement_model import AirConstants, PlanckConstants

RAW_DATA, EMBEDDED_PICTURE, CAMERA_INFO, PICTURE_IN_PICTURE = 0x01, 0x0E, 0x20, 0x2A
"""Record types that are read; palettes, measuring tools and voice notes are not."""

_PNG_START = b"\x89PNG\r\n\x1a\n"
_IMAGE_HEADER_BYTES = 32
_MOST_RECORDS = 1000
_MOST_PIXELS = 2**24
"""Counts of an R-JPEG: several times its largest images. A PNG of zeros, which is small, can claim far more."""


class DamagedRecordError(ValueError):
    """A record is missing, cut off or contradicts another; the message says which."""


class Record:
    """The bytes of one record; numbers are read in its own byte order."""

    def __init__(self, content: bytes, name: str, order_mark: int | None = 2) -> None:
        self.content = content
        self.name = name
        self.order = "<"
        if order_mark is not None:
            marks = [order for order in "<>" if content[:2] == struct.pack(f"{order}H", order_mark)]
            if not marks:
                raise DamagedRecordError(f"a {name} record that starts with {content[:2]!r}")
            self.order = marks[0]

    def numbers(self, offset: int, codes: str) -> tuple[float, ...]:
        """Numbers at a byte offset; `codes` are those of `struct`."""
        try:
            return struct.unpack_from(self.order + codes, self.content, offset)
        except struct.error as problem:
            length = len(self.content)
            raise DamagedRecordError(f"a {self.name} record of {length} bytes without byte {offset}") from problem

    def text(self, offset: int, length: int) -> str | None:
        """Text up to the first zero byte; None where there is none."""
        raw = self.content[offset : offset + length].split(b"\0", 1)[0]
        return raw.decode("latin-1").strip() or None


@dataclass(frozen=True)
class PictureInPicture:
    """How the camera lays its thermal image over the photograph, in its own numbers: start values, no calibration.

    What they mean is not published, and they hold for one distance: things nearer or farther lie elsewhere.
    """

    real_to_thermal: float  # Real2IR: ratio of the two images' scales
    offset_x: int  # shift of the thermal image's centre to the right, roughly in pixels of the photograph
    offset_y: int  # the same downwards


@dataclass(frozen=True)
class CameraInfo:
    """Calibration, settings and make of a FLIR camera."""

    planck: PlanckConstants
    air: AirConstants
    conditions: Conditions  # the camera's own settings when the picture was taken (or edited)
    raw_range: tuple[int, int]  # counts from and to which the calibration holds
    field_of_view_deg: float | None  # horizontal, as the camera states it; some state nonsense such as 180
    model: str | None
    serial: str | None
    lens: str | None
    taken_at: datetime | None


def fff_records(fff: bytes) -> Iterator[tuple[int, memoryview]]:
    """Yield type and content of every record that an FFF block lists; the content is a view into the block.

    An R-JPEG carries one FFF block in its APP1 segments. Layout and field offsets are those of the public tag tables of
    ExifTool (FLIR tags); every record says its own byte order.

    Raises:
        DamagedRecordError: The block or a record of it is cut off.
    """
    if fff[:4] not in (b"FFF\0", b"AFF\0"):
        raise DamagedRecordError(f"a FLIR block that starts with {fff[:4]!r}")
    for order in "><":
        if len(fff) >= 64 and 100 <= struct.unpack_from(f"{order}I", fff, 20)[0] < 200:  # version of the format
            break
    else:
        raise DamagedRecordError("a FLIR block without a version from 100 to 199")
    start, count = struct.unpack_from(f"{order}II", fff, 24)
    if count > _MOST_RECORDS or start + 32 * count > len(fff):
        raise DamagedRecordError(f"a list of {count} records at byte {start} of a FLIR block of {len(fff)} bytes")
    for number in range(count):
        kind, _, _, _, offset, length = struct.unpack_from(f"{order}HHIIII", fff, start + 32 * number)
        if kind == 0:
            continue
        if offset + length > len(fff):
            beyond = f"up to byte {offset + length} of {len(fff)}: the file is cut off"
            raise DamagedRecordError(f"record {number} (type {kind:#04x}) {beyond}")
        yield kind, memoryview(fff)[offset : offset + length]


def read_counts(path: Path, content: bytes) -> npt.NDArray[np.uint16]:
    """Read the raw counts, stored plainly or as a PNG, shape (height, width).

    Most cameras write the PNG's 16 bits in the wrong byte order and none says so. A thermal image is smooth, and with
    its bytes swapped it is noise; so the order with the smaller mean difference between neighbours is right.

    Raises:
        ThermalFileError: The header claims an absurd size.
        DamagedRecordError: There are fewer bytes than pixels, or the PNG is another image.
    """
    record = Record(content, "raw data")
    width, height = (int(number) for number in record.numbers(2, "HH"))
    check_thermal_size(path, width, height)
    if width * height > _MOST_PIXELS:
        raise DamagedRecordError(f"{width} x {height} counts, more than {_MOST_PIXELS}")
    data = content[_IMAGE_HEADER_BYTES:]
    if not data.startswith(_PNG_START):
        if len(data) < 2 * width * height:
            raise DamagedRecordError(f"{len(data)} bytes of counts for {width} x {height} pixels")
        counts = np.frombuffer(data, dtype=f"{record.order}u2", count=width * height)
        return counts.reshape(height, width).astype(np.uint16)
    try:
        with Image.open(io.BytesIO(data), formats=("PNG",)) as image:
            if image.size != (width, height) or not image.mode.startswith("I"):
                raise DamagedRecordError(f"a PNG of {image.size} and mode {image.mode} for {width} x {height} counts")
            counts = np.asarray(image).astype(np.uint16)
    except (OSError, SyntaxError, struct.error, Image.DecompressionBombError) as problem:
        raise DamagedRecordError(f"counts in a PNG that cannot be decoded ({problem})") from problem
    return min((counts.byteswap(), counts), key=_roughness)


def _roughness(counts: npt.NDArray[np.uint16]) -> float:
    plain = counts.astype(np.float64)
    return float(np.abs(np.diff(plain, axis=0)).sum() + np.abs(np.diff(plain, axis=1)).sum())


def read_camera_info(content: bytes) -> CameraInfo:
    """Read calibration and settings; a `DamagedRecordError` where a value is missing or cannot be."""
    record = Record(content, "camera info")
    emissivity, distance, reflected, air, window, window_transmission = record.numbers(0x20, "6f")
    (humidity,) = record.numbers(0x3C, "f")
    r1, b, f = record.numbers(0x58, "3f")
    (o,), (r2,) = record.numbers(0x308, "i"), record.numbers(0x30C, "f")
    low, high = record.numbers(0x310, "HH")
    (field_of_view,) = record.numbers(0x1B4, "f")
    model = record.text(0xD4, 32)
    try:
        return CameraInfo(
            planck=PlanckConstants(r1=r1, r2=r2, b=b, f=f, o=float(o)),
            air=AirConstants(*record.numbers(0x70, "5f")),
            conditions=Conditions(
                emissivity=emissivity,
                reflected_c=_celsius(reflected),
                distance_m=distance,
                relative_humidity=humidity / 100.0 if humidity > 2.0 else humidity,  # some write percent
                air_c=_celsius(air),
                window_transmission=window_transmission or 1.0,  # a camera without the setting writes 0
                window_c=_celsius(window),
            ),
            raw_range=(int(low), int(high)) if low < high else (0, 0xFFFF),
            field_of_view_deg=field_of_view if field_of_view > 0 else None,
            model=model if model is None or model.lower().startswith("flir") else f"FLIR {model}",
            serial=record.text(0x104, 16),
            lens=record.text(0x170, 32),
            taken_at=_taken_at(record),
        )
    except ThermoxelsError as problem:
        raise DamagedRecordError(f"a camera info record with a wrong value: {problem}") from problem


def _celsius(kelvin: float) -> float | None:
    """A temperature, or None where the camera has not set it and writes 0 K."""
    return float(kelvin_to_celsius(kelvin)) if kelvin != 0.0 else None


def _taken_at(record: Record) -> datetime | None:
    """Time of the shutter with its zone; None where the clock was never set or the record is of an old kind."""
    try:
        seconds, milliseconds, zone = record.numbers(0x384, "IIh")
        east = timezone(timedelta(minutes=-int(zone)))
        return datetime.fromtimestamp(int(seconds) + (int(milliseconds) & 0xFFFF) / 1000.0, east) if seconds else None
    except (DamagedRecordError, ValueError, OverflowError, OSError):
        return None


def read_picture_in_picture(content: bytes) -> PictureInPicture:
    """Read the factory alignment of photograph and thermal image."""
    record = Record(content, "picture in picture", order_mark=None)
    scale, x, y = record.numbers(0, "fhh")
    if not 0.01 < scale < 100.0:  # the record has no mark of its byte order
        record.order = ">"
        scale, x, y = record.numbers(0, "fhh")
    return PictureInPicture(scale, int(x), int(y))


def read_embedded_picture(content: bytes) -> bytes | None:
    """Return the photograph's bytes as they are, a JPEG or PNG; None where it is stored in the camera's own way."""
    data = content[_IMAGE_HEADER_BYTES:]
    return data if data.startswith((b"\xff\xd8\xff", _PNG_START)) else None
