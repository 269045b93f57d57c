"""The application segments of a JPEG, where cameras keep what is no picture."""

from __future__ import annotations

import re
from collections.abc import Iterator

JPEG_START = b"\xff\xd8\xff"
APP1, APP3 = 0xE1, 0xE3
_START_OF_SCAN, _END_OF_IMAGE, _FILL = 0xDA, 0xD9, 0xFF
_FILL_BYTES = re.compile(rb"\xff+")


class DamagedJpegError(ValueError):
    """The bytes are no whole JPEG; the message says where they break off."""


def jpeg_segments(content: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield marker and payload of every segment of a file before the picture's data (ITU-T T.81, annex B).

    Raises:
        DamagedJpegError: A segment reaches beyond the end of the file, or there is no picture after the segments.
    """
    at = 2
    while at + 4 <= len(content):
        if content[at] != 0xFF:
            raise DamagedJpegError(f"no marker at byte {at}")
        marker = content[at + 1]
        if marker == _FILL:
            # Any number of fill bytes may stand before a marker; the last of them begins it.
            at = _FILL_BYTES.match(content, at).end() - 1  # type: ignore[union-attr]
            continue
        if marker == _START_OF_SCAN:
            # The last one ends the picture; those of thumbnails lie in segments before it.
            if content.rfind(bytes((0xFF, _END_OF_IMAGE)), at) < 0:
                raise DamagedJpegError(f"the picture that starts at byte {at} has no end: the file is cut off")
            return
        end = at + 2 + int.from_bytes(content[at + 2 : at + 4], "big")
        if end > len(content):
            raise DamagedJpegError(f"a segment of {end - at} bytes at byte {at} of {len(content)}: the file is cut off")
        yield marker, content[at + 4 : end]
        at = end
    raise DamagedJpegError(f"no picture in {len(content)} bytes: the file is cut off")


def check_jpeg(content: bytes) -> None:
    """Raise a `DamagedJpegError` if a JPEG's segments are not whole or no picture comes after them."""
    for _ in jpeg_segments(content):
        pass
