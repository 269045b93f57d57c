"""Small camera files for tests: photographs with EXIF, count images, and a FLIR file with a photograph inside."""

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
