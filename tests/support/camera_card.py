"""Small camera files for tests: photographs with EXIF, count images, FLIR R-JPEG whose every number is known, DJI's."""

import io
import struct
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

import numpy as np
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

COUNTS_PER_K, ZERO_C = 40, -100.0


def photograph(
    path: Path,
    pixels: np.ndarray | None = None,
    taken_at: str | None = None,
    fraction: str | None = None,
    gps: tuple[float, float, float] | None = None,
    orientation: int | None = None,
    focal: tuple[float, float] | None = None,
) -> Path:
    """A JPEG; `taken_at` as EXIF writes it, `focal` in mm and pixels per cm."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.full((24, 32, 3), 90, dtype=np.uint8) if pixels is None else pixels
    exif = Image.Exif()
    details = exif.get_ifd(34665)
    if taken_at:
        details[36867] = taken_at
    if fraction:
        details[37521] = fraction
    if orientation:
        exif[274] = orientation
    if focal:
        details[37386], details[41486], details[41488] = IFDRational(focal[0]), IFDRational(focal[1]), 3
    if gps:
        latitude, longitude, altitude = gps
        exif.get_ifd(34853).update(
            {
                1: "N" if latitude >= 0 else "S",
                2: degrees(abs(latitude)),
                3: "E" if longitude >= 0 else "W",
                4: degrees(abs(longitude)),
                5: b"\x01" if altitude < 0 else b"\x00",
                6: IFDRational(round(abs(altitude) * 1000), 1000),
            }
        )
    Image.fromarray(pixels).save(path, format="JPEG", quality=95, exif=exif)
    return path


def degrees(value: float) -> tuple[IFDRational, IFDRational, IFDRational]:
    whole = int(value)
    minutes = int((value - whole) * 60)
    seconds = ((value - whole) * 60 - minutes) * 60
    return IFDRational(whole), IFDRational(minutes), IFDRational(round(seconds * 10**6), 10**6)


def counts(path: Path, temperature_c: np.ndarray | None = None, taken_at: datetime | None = None) -> Path:
    """A 16-bit TIFF in Workswell's counts."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temperature_c = np.full((12, 16), 20.0) if temperature_c is None else temperature_c
    image = Image.fromarray(np.round((temperature_c - ZERO_C) * COUNTS_PER_K).astype(np.uint16))
    tags = {271: "Workswell", 272: "WIRIS Pro"}
    if taken_at:
        tags[306] = taken_at.strftime("%Y:%m:%d %H:%M:%S")
    image.save(path, format="TIFF", tiffinfo=tags)
    return path


def write_pairs(card: Path, names: str = "abc") -> Path:
    """Grey photographs and counts, a pair for each letter."""
    for name in names:
        photograph(card / f"{name}-visible.jpg")
        counts(card / f"{name}-radiometric.tiff")
    return card


PLANCK = {"r1": 11800.0, "b": 1400.0, "f": 1.0, "r2": 0.0125, "o": -6000}
SETTINGS = {"emissivity": 0.95, "distance": 1.0, "reflected": 293.15, "air": 293.15, "window": 293.15, "passes": 1.0}


@dataclass
class FlirFile:
    """What goes into the file; change a field to make another one."""

    counts: np.ndarray
    order: str = "<"
    """Byte order of the records."""
    storage: str = "raw"
    """raw, png (bytes in the right order) or swapped (as most cameras write their PNG)."""
    planck: dict[str, float] = field(default_factory=lambda: dict(PLANCK))
    settings: dict[str, float] = field(default_factory=lambda: dict(SETTINGS))
    humidity: float = 0.5
    raw_range: tuple[int, int] = (0, 65535)
    size: tuple[int, int] | None = None
    """Width and height in the header, if they are to be wrong."""
    photograph: bytes = b""
    alignment: tuple[float, int, int] | None = None
    segment_bytes: int = 60000
    picture: np.ndarray | None = None
    seconds: int = 1_600_000_000
    zone_minutes_west: int = -120

    def raw_record(self) -> bytes:
        width, height = self.size or self.counts.shape[::-1]
        head = struct.pack(f"{self.order}HHH", 2, width, height).ljust(32, b"\0")
        if self.storage == "raw":
            return head + self.counts.astype(f"{self.order}u2").tobytes()
        stream = io.BytesIO()
        counts = self.counts.astype(np.uint16)
        Image.fromarray(counts.byteswap() if self.storage == "swapped" else counts).save(stream, "PNG")
        return head + stream.getvalue()

    def info_record(self) -> bytes:
        record = bytearray(0x3A0)

        def put(offset: int, codes: str, *values: float) -> None:
            struct.pack_into(self.order + codes, record, offset, *values)

        put(0, "3H", 2, *self.counts.shape[::-1])
        put(0x20, "6f", *self.settings.values())
        put(0x3C, "f", self.humidity)
        put(0x58, "3f", self.planck["r1"], self.planck["b"], self.planck["f"])
        put(0x70, "5f", 0.006569, 0.01262, -0.002276, -0.00667, 1.9)
        record[0xD4:0xDD] = b"FLIR T999"
        put(0x1B4, "f", 24.5)
        put(0x308, "if", int(self.planck["o"]), self.planck["r2"])
        put(0x310, "HH", *self.raw_range)
        put(0x384, "IIh", self.seconds, 250, self.zone_minutes_west)
        return bytes(record)

    def fff(self) -> bytes:
        records = [(0x20, self.info_record()), (0x01, self.raw_record())]
        if self.photograph:
            records.append((0x0E, bytes(32) + self.photograph))
        if self.alignment:
            records.append((0x2A, struct.pack("<fhh", *self.alignment)))
        start = 64 + 32 * (len(records) + 1)
        listed, content = b"", b""
        for kind, record in records:
            listed += struct.pack(">HHIIII", kind, 1, 100, 1, start + len(content), len(record)).ljust(32, b"\0")
            content += record
        listed += bytes(32)  # cameras leave unused entries
        head = b"FFF\0" + b"TEST".ljust(16, b"\0") + struct.pack(">III", 100, 64, len(records) + 1)
        return head.ljust(64, b"\0") + listed + content

    def jpeg(self) -> bytes:
        fff = self.fff()
        parts = [fff[at : at + self.segment_bytes] for at in range(0, len(fff), self.segment_bytes)]
        segments = b"".join(
            segment(0xE1, b"FLIR\0\1" + bytes((number, len(parts) - 1)) + part) for number, part in enumerate(parts)
        )
        plain = picture_bytes(self.picture)
        return plain[:2] + segments + plain[2:]


def segment(marker: int, payload: bytes) -> bytes:
    return bytes((0xFF, marker)) + (len(payload) + 2).to_bytes(2, "big") + payload


def picture_bytes(pixels: np.ndarray | None = None, kind: str = "JPEG") -> bytes:
    stream = io.BytesIO()
    Image.fromarray(np.full((8, 8, 3), 90, np.uint8) if pixels is None else pixels).save(stream, kind)
    return stream.getvalue()


def dji_jpeg(first: bytes = b"DJI") -> bytes:
    """What tells DJI's R-JPEG: its name in the first segment and counts in the third kind."""
    plain = picture_bytes()
    return plain[:2] + segment(0xE1, first) + segment(0xE3, bytes(24)) + plain[2:]


def smooth_counts(width: int = 40, height: int = 30) -> np.ndarray:
    """Counts of a smooth warm scene, between 12000 and 16000."""
    y, x = np.mgrid[:height, :width]
    return (14000 + 1500 * np.sin(x / 9.0) + 400 * np.cos(y / 7.0)).astype(np.uint16)
