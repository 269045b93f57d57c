"""Who took a picture and when, from its EXIF tags."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from PIL import Image

_MAKE, _MODEL, _CHANGED_AT, _TAKEN_AT, _EXIF = 271, 272, 306, 36867, 34665
_BODY_SERIAL, _DNG_SERIAL = 42033, 50735


@dataclass(frozen=True)
class ExifFacts:
    """None: the file does not say."""

    make: str | None
    model: str | None
    serial: str | None
    taken_at: datetime | None  # without a time zone, as the camera's clock showed it

    @property
    def camera(self) -> str | None:
        """Maker and model."""
        return " ".join(word for word in (self.make, self.model) if word) or None


def read_exif_facts(image: Image.Image) -> ExifFacts:
    """Read the tags of an opened image; its pixels are not touched."""
    exif = image.getexif()
    tags: Mapping[int, Any] = {**exif, **exif.get_ifd(_EXIF)}
    return ExifFacts(
        _text(tags.get(_MAKE)),
        _text(tags.get(_MODEL)),
        _text(tags.get(_BODY_SERIAL)) or _text(tags.get(_DNG_SERIAL)),
        _time(tags.get(_TAKEN_AT)) or _time(tags.get(_CHANGED_AT)),
    )


def _text(value: object) -> str | None:
    return value.split("\0", 1)[0].strip() or None if isinstance(value, str) else None


def _time(value: object) -> datetime | None:
    try:
        return datetime.strptime(str(value), "%Y:%m:%d %H:%M:%S")
    except ValueError:
        return None
