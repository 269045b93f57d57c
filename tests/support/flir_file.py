"""Writes FLIR R-JPEG files whose every number is known, and what tells DJI's."""

import io
import struct
from dataclasses import dataclass, field

import numpy as np
from PIL import Image

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
        record[0x104:0x108] = b"1234"
        record[0x170:0x175] = b"FOL25"
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
