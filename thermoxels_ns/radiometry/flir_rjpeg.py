"""Reads FLIR's radiometric JPEG: the counts, calibration and settings that it stores beside the picture."""

from __future__ import annotations

import io
import re
import struct
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image

from thermoxels_ns.core.arrays import Float32Array
from thermoxels_ns.core.errors import ThermalFileError, ThermoxelsError
from thermoxels_ns.core.units import kelvin_to_celsius
from thermoxels_ns.radiometry.decoders import JPEG_START, PNG_START, app_segments, check_thermal_size, errors_name
from thermoxels_ns.radiometry.measurement_model import AirConstants, Conditions, PlanckConstants, RadiometricModel

_RAW_DATA, _PICTURE, _CAMERA_INFO, _PICTURE_IN_PICTURE = 0x01, 0x0E, 0x20, 0x2A
"""Types of the records that are read. All others, such as palettes, measuring tools and voice notes, are ignored."""
_REMEDY = "Copy the file from the camera again; programs that edit pictures drop its thermal part."
_FLIR_HEADER_BYTES, _IMAGE_HEADER_BYTES = 8, 32
_FIRST_SEGMENT = re.compile(rb"\xff\xe1..FLIR\0", re.DOTALL)
_HEAD_BYTES = 2**18  # number of first bytes that are searched for a FLIR segment, as EXIF (up to 64 KiB) precedes it
_MOST_RECORDS = 1000


@dataclass(frozen=True)
class _Record:
    """The bytes of one record, and the byte order of the record, "<" or ">"."""

    content: bytes
    order: str

    @classmethod
    def marked(cls, content: bytes) -> _Record:
        """Return a record of `content`. Its byte order is the one in which its first 16-bit number is 2."""
        return cls(content, "<" if content[:2] == b"\2\0" else ">")

    def numbers(self, offset: int, codes: str) -> tuple[float, ...]:
        """Return the numbers that start at a byte offset; `codes` are their formats in the notation of `struct`."""
        return struct.unpack_from(self.order + codes, self.content, offset)

    def text(self, offset: int, length: int) -> str | None:
        """Return the text at a byte offset, up to its first zero byte or to `length` bytes; None if it is empty."""
        raw = self.content[offset : offset + length].split(b"\0", 1)[0]
        return raw.decode("latin-1").strip() or None


@dataclass(frozen=True)
class PictureInPicture:
    """Factory alignment by which a FLIR camera lays its thermal image over the photograph.

    It gives good start values but is no calibration: the exact meaning of the numbers is not published, and the
    alignment is right at one distance only.
    """

    real_to_thermal: float  # FLIR's Real2IR, the ratio of the two images' scales
    offset_x: int  # shift of the thermal image's centre to the right, roughly in pixels of the photograph
    offset_y: int  # shift of the thermal image's centre downwards, roughly in pixels of the photograph


@dataclass(frozen=True)
class CameraInfo:
    """Calibration, settings and make of a FLIR camera."""

    planck: PlanckConstants
    air: AirConstants
    conditions: Conditions  # the camera's settings when the picture was taken or last edited
    raw_range: tuple[int, int]  # lowest and highest count for which the calibration holds
    field_of_view_deg: float | None  # horizontal angle of view as stated; some cameras state nonsense such as 180
    model: str | None  # maker and model
    taken_at: datetime | None  # time of the shutter, with its time zone


@dataclass(frozen=True)
class FlirImage:
    """Contents of one R-JPEG of a FLIR camera."""

    counts: npt.NDArray[np.uint16]  # raw counts of the sensor, shape (height, width)
    camera: CameraInfo
    picture_in_picture: PictureInPicture | None  # factory alignment; None if the file has none
    visible: bytes | None  # bytes of the photograph's JPEG or PNG; None if absent or in another format

    def temperature_c(self, conditions: Conditions | None = None) -> Float32Array:
        """Return degrees C (height, width) under `conditions` (None: the camera's); NaN outside `camera.raw_range`."""
        model = RadiometricModel(conditions or self.camera.conditions, self.camera.planck, self.camera.air)
        low, high = self.camera.raw_range
        known = (self.counts >= low) & (self.counts <= high)
        return np.where(known, model.temperature_c(self.counts), np.nan).astype(np.float32)


def is_flir_jpeg(path: Path) -> bool:
    """Return whether the first bytes of a file show a JPEG with a FLIR segment."""
    with path.open("rb") as stream:
        head = stream.read(_HEAD_BYTES)
    return head.startswith(JPEG_START) and _FIRST_SEGMENT.search(head) is not None


def read_flir_jpeg(path: Path) -> FlirImage:
    """Return the counts, calibration, settings and photograph of a FLIR R-JPEG.

    This reader is our own because the library flyr has a copyleft licence (EUPL), and because only four kinds of
    records are needed, whose layouts are public. Raises `ThermalFileError` if the file is cut off, if a record is
    missing or damaged, or if the image's size is impossible.
    """
    with errors_name(path, "a whole FLIR R-JPEG, as the camera wrote it", _REMEDY, ThermalFileError):
        parts: dict[int, bytes] = {}
        last = 0
        for name, payload in app_segments(path, whole=True):  # bytes 6 and 7: number of this and the last segment
            if name == "APP1" and payload.startswith(b"FLIR\0") and len(payload) > _FLIR_HEADER_BYTES:
                parts[payload[6]], last = payload[_FLIR_HEADER_BYTES:], max(last, payload[7])
        missing = sorted(set(range(last + 1)) - set(parts))
        if missing:
            raise ValueError(f"{len(parts)} of {last + 1} FLIR segments (missing: {missing})")
        records = _records(b"".join(parts[number] for number in range(last + 1)))
        for kind, name in ((_RAW_DATA, "raw counts"), (_CAMERA_INFO, "calibration")):
            if kind not in records:
                raise ValueError(f"no record with {name}")
        alignment, picture = records.get(_PICTURE_IN_PICTURE), records.get(_PICTURE, b"")[_IMAGE_HEADER_BYTES:]
        return FlirImage(
            _counts(path, records[_RAW_DATA]),
            _camera_info(_Record.marked(records[_CAMERA_INFO])),
            None if alignment is None else _picture_in_picture(alignment),
            picture if picture.startswith((JPEG_START, PNG_START)) else None,  # other formats are the camera's own
        )


def _records(fff: bytes) -> dict[int, bytes]:
    """Return the bytes of the records that this module reads, by record type, from the FFF block of an R-JPEG. The
    caller must have joined the block from the APP1 segments. Layout and field offsets are from ExifTool's public tables
    of FLIR tags. Raises `ValueError` or `struct.error` if the block is damaged."""
    version = {order: struct.unpack_from(f"{order}I", fff, 20)[0] for order in "><"}
    order = next((order for order, number in version.items() if 100 <= number < 200), None)
    if fff[:4] not in (b"FFF\0", b"AFF\0") or order is None:
        raise ValueError(f"a FLIR block that starts with {fff[:24]!r}")
    start, count = struct.unpack_from(f"{order}II", fff, 24)
    records = dict[int, bytes]()
    for number in range(min(count, _MOST_RECORDS)):
        kind, _, _, _, offset, length = struct.unpack_from(f"{order}HHIIII", fff, start + 32 * number)
        # Only one record of each type is copied: a bad file may list a thousand records that each span the whole block.
        if kind in (_RAW_DATA, _PICTURE, _CAMERA_INFO, _PICTURE_IN_PICTURE) and kind not in records:
            if offset + length > len(fff):
                raise ValueError(f"a record up to byte {offset + length} of {len(fff)}: the file is cut off")
            records[kind] = fff[offset : offset + length]
    return records


def _counts(path: Path, content: bytes) -> npt.NDArray[np.uint16]:
    """Return the raw counts (height, width) of a record that holds them as plain numbers or as a PNG. Most cameras
    write the PNG's 16-bit numbers in the wrong byte order, and no file states the order. A thermal image is smooth, and
    with swapped bytes it is noise: the order with the smaller differences between neighbours is taken."""
    record, data = _Record.marked(content), content[_IMAGE_HEADER_BYTES:]
    width, height = (int(number) for number in record.numbers(2, "HH"))
    check_thermal_size(path, width, height)
    if data.startswith(JPEG_START) and len(data) < 2 * width * height:
        expected, got = "counts stored as plain numbers or as PNG", "counts as a JPEG (JPEG-LS), which is not read"
        remedy = "Remove this file and pass --missing-thermal skip."
        raise ThermalFileError(str(path), expected=expected, got=got, remedy=remedy)
    if not data.startswith(PNG_START):
        counts = np.frombuffer(data, dtype=f"{record.order}u2", count=width * height)
        return counts.reshape(height, width).astype(np.uint16)
    with Image.open(io.BytesIO(data), formats=("PNG",)) as image:
        if image.size != (width, height) or not image.mode.startswith("I"):
            raise ValueError(f"a PNG of {image.size} and mode {image.mode} for {width} x {height} counts")
        counts = np.asarray(image).astype(np.uint16)
    orders = counts.byteswap(), counts
    return min(orders, key=lambda c: sum(np.abs(np.diff(c.astype(float), axis=axis)).sum() for axis in (0, 1)))


def _camera_info(record: _Record) -> CameraInfo:
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
            taken_at=_taken_at(record),
        )
    except ThermoxelsError as problem:
        raise ValueError(f"a camera info record with a wrong value: {problem}") from problem


def _celsius(kelvin: float) -> float | None:
    """Return a temperature in degrees C; None for 0 K, which a camera writes for a setting that it does not have."""
    return float(kelvin_to_celsius(kelvin)) if kelvin != 0.0 else None


def _taken_at(record: _Record) -> datetime | None:
    """Return the exposure's time with its time zone; None if the clock was never set or the record has no time."""
    try:
        seconds, milliseconds, zone = record.numbers(0x384, "IIh")
        east = timezone(timedelta(minutes=-int(zone)))
        return datetime.fromtimestamp(int(seconds) + (int(milliseconds) & 0xFFFF) / 1000.0, east) if seconds else None
    except (struct.error, ValueError, OverflowError, OSError):
        return None


def _picture_in_picture(content: bytes) -> PictureInPicture:
    """Return the factory alignment. The record states no byte order: the one with a plausible scale is taken."""
    little, big = (_Record(content, order).numbers(0, "fhh") for order in "<>")
    scale, x, y = little if 0.01 < little[0] < 100.0 else big
    return PictureInPicture(scale, int(x), int(y))
