"""FLIR's radiometric JPEG: counts and calibration behind the picture."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.errors import ThermalFileError
from thermoxels_ns.radiometry.conditions import Conditions
from thermoxels_ns.radiometry.decoders import errors_name
from thermoxels_ns.radiometry.flir_records import (
    CAMERA_INFO,
    EMBEDDED_PICTURE,
    PICTURE_IN_PICTURE,
    RAW_DATA,
    CameraInfo,
    DamagedRecordError,
    PictureInPicture,
    fff_records,
    read_camera_info,
    read_counts,
    read_embedded_picture,
    read_picture_in_picture,
)
from thermoxels_ns.radiometry.jpeg_segments import APP1, JPEG_START, DamagedJpegError, jpeg_segments
from thermoxels_ns.radiometry.measurement_model import RadiometricModel

_WANTED = (RAW_DATA, CAMERA_INFO, PICTURE_IN_PICTURE, EMBEDDED_PICTURE)
_REMEDY = "Copy the file from the camera again; programs that edit pictures drop its thermal part."
_FLIR_MARK = b"FLIR\0"
_FLIR_HEADER_BYTES = 8
_FIRST_SEGMENT = re.compile(rb"\xff\xe1..FLIR\0", re.DOTALL)
_HEAD_BYTES = 2**18  # the first FLIR segment comes after the EXIF segments, each at most 64 KiB


@dataclass(frozen=True)
class FlirImage:
    """One R-JPEG of a FLIR camera after reading."""

    counts: npt.NDArray[np.uint16]  # what the sensor gave, shape (height, width)
    camera: CameraInfo
    picture_in_picture: PictureInPicture | None
    visible: bytes | None  # the photograph that the camera took with it, a JPEG or PNG file's bytes; None: it took none

    @property
    def outside_calibration(self) -> npt.NDArray[np.bool_]:
        """Pixels whose counts lie outside the range that the camera is calibrated for, shape (height, width)."""
        low, high = self.camera.raw_range
        return (self.counts < low) | (self.counts > high)

    def temperature_c(self, conditions: Conditions | None = None) -> npt.NDArray[np.float32]:
        """Degrees C, shape (height, width), NaN outside the calibrated range; None: with the camera's settings."""
        model = RadiometricModel(conditions or self.camera.conditions, self.camera.planck, self.camera.air)
        temperature_c = model.temperature_c(self.counts)
        return np.where(self.outside_calibration, np.nan, temperature_c).astype(np.float32)


def is_flir_jpeg(path: Path) -> bool:
    """Whether a file is a JPEG with FLIR's segments, by its first bytes (a name says nothing)."""
    with path.open("rb") as stream:
        head = stream.read(_HEAD_BYTES)
    return head.startswith(JPEG_START) and _FIRST_SEGMENT.search(head) is not None


def read_flir_jpeg(path: Path) -> FlirImage:
    """Read a FLIR R-JPEG.

    Read here and not through a library: the one that exists (flyr) is under the EUPL, a copyleft licence, and what is
    needed are five records whose layout is public; so the formats of most users work without an extra to install.

    Raises:
        ThermalFileError: The file is cut off, a record is missing or damaged, or its size cannot be.
    """
    with errors_name(path, "a whole FLIR R-JPEG, as the camera wrote it", _REMEDY, ThermalFileError):
        records = dict[int, bytes]()
        for kind, content in fff_records(_flir_block(path.read_bytes())):
            # Records may overlap: a thousand of them that each claim the whole block are not copied.
            if kind in _WANTED and kind not in records:
                records[kind] = bytes(content)
        for kind, name in ((RAW_DATA, "raw counts"), (CAMERA_INFO, "calibration")):
            if kind not in records:
                raise DamagedRecordError(f"no record with {name}")
        pip = records.get(PICTURE_IN_PICTURE)
        picture = records.get(EMBEDDED_PICTURE)
        return FlirImage(
            read_counts(path, records[RAW_DATA]),
            read_camera_info(records[CAMERA_INFO]),
            None if pip is None else read_picture_in_picture(pip),
            None if picture is None else read_embedded_picture(picture),
        )


def _flir_block(content: bytes) -> bytes:
    """Join the parts of the FFF block: each APP1 segment says its number and the last one's."""
    parts: dict[int, bytes] = {}
    last = -1
    for marker, payload in jpeg_segments(content):
        if marker == APP1 and payload.startswith(_FLIR_MARK) and len(payload) > _FLIR_HEADER_BYTES:
            parts[payload[6]] = payload[_FLIR_HEADER_BYTES:]
            last = max(last, payload[7])
    missing = sorted(set(range(last + 1)) - set(parts))
    if not parts or missing:
        raise DamagedJpegError(f"{len(parts)} of {last + 1} FLIR segments (missing: {missing})")
    return b"".join(parts[number] for number in range(last + 1))
