"""Finds the format of thermal files, reads files of a known unit as degrees C, and finds stuck pixels."""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import numpy.typing as npt
from numpy.lib.stride_tricks import sliding_window_view
from PIL import Image, TiffImagePlugin

from thermoxels_ns.core.arrays import BoolArray, Float32Array, FloatArray
from thermoxels_ns.core.errors import ThermalFileError
from thermoxels_ns.radiometry.decoders import JPEG_START, PNG_START, check_not_empty, check_thermal_size, errors_name
from thermoxels_ns.radiometry.dji_rjpeg import is_dji_rjpeg
from thermoxels_ns.radiometry.flir_rjpeg import is_flir_jpeg, read_flir_jpeg

ThermalFormat = Literal["FLIR R-JPEG", "DJI R-JPEG", "JPEG", "TIFF", "PNG", "NPY", "CSV"]
THERMAL_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".npy", ".csv")
"""Suffixes of thermal files and photographs. Other files of a folder (videos, logs) are ignored."""
_HEAD_BYTES = 4096
_STARTS: dict[bytes, ThermalFormat] = {
    b"II*\0": "TIFF",
    b"MM\0*": "TIFF",
    b"II+\0": "TIFF",
    b"MM\0+": "TIFF",
    PNG_START: "PNG",
    b"\x93NUMPY": "NPY",
}
_NUMBERS = re.compile(rb"(?:\xef\xbb\xbf)?[-+0-9.,;eE\s\"]|nan|na|n/a|null|none", re.IGNORECASE)
_TEXT = re.compile(rb"[\t\n\r -~\xef\xbb\xbf]*")
# Pillow can unpack grey TIFFs of 64-bit floating-point numbers, but its table of TIFFs lacks them.
for _order, _packed in ((b"II", "F;64F"), (b"MM", "F;64BF")):
    TiffImagePlugin.OPEN_INFO |= {(_order, lightest, (3,), 1, (64,), ()): ("F", _packed) for lightest in (0, 1)}
VALID_RANGE_C = (-100.0, 2000.0)  # temperatures outside this range are masked, [degrees C]
MIN_FRAMES = 5  # with fewer frames, no pixel counts as stuck
_WINDOW = 2  # half width of a neighbourhood of 5 x 5 pixels, in which a dead column or row is a minority
_EXPECTED = "a readable thermal file"
_REMEDY = "The file is damaged; copy it from the camera again or remove its frame."
_LINEAR_UNIT = 'in transforms.json "thermal_unit": {"celsius_per_count": ..., "celsius_offset": ...}'
_UNIT_REMEDY = (
    "Pass --thermal-bounds -5 42 with the degrees of black and white, or give temperature_bounds.json "
    f"(absolute_min_temperature, absolute_max_temperature) or, {_LINEAR_UNIT}."
)
_COUNTS_REMEDY = (
    f"In a scene give {_LINEAR_UNIT}, as the camera's manual has them; for thermoxels capture pass --camera, or "
    "--celsius-per-count and --celsius-offset. Counts from 0 to 65535 that span the bounds have "
    "(highest - lowest) / 65535 per count and an offset of the lowest."
)


@dataclass(frozen=True)
class ThermalUnit:
    """Conversion of a thermal file's numbers to degrees Celsius, made by `bounds` or `linear`; by default, none."""

    kind: Literal["bounds", "linear", "celsius"] = "celsius"
    """bounds: count 0 to highest count span min to max; linear: count * scale + offset; celsius: no conversion."""
    scale: float = 1.0  # bounds: max minus min, [K]; linear: [K per count]
    offset_c: float = 0.0  # temperature of count zero, [degrees Celsius]

    def __post_init__(self) -> None:
        wrong_scale = not np.isfinite(self.scale) or (self.kind == "linear" and self.scale == 0)
        if wrong_scale or not np.isfinite(self.offset_c):
            expected = "a finite offset and a finite scale (not zero for counts)"
            got = f"scale {self.scale}, offset {self.offset_c} C"
            raise ThermalFileError("thermal unit", expected=expected, got=got, remedy=_UNIT_REMEDY)

    @classmethod
    def bounds(cls, min_c: float, max_c: float) -> ThermalUnit:
        """Return a unit in which count 0 is `min_c` and the highest count, 255 or 65535, is `max_c`, [degrees C]."""
        return cls("bounds", scale=max_c - min_c, offset_c=min_c)

    @classmethod
    def linear(cls, celsius_per_count: float, celsius_offset: float) -> ThermalUnit:
        """Return a unit with temperature = count * `celsius_per_count` + `celsius_offset`, [degrees C]."""
        return cls("linear", scale=celsius_per_count, offset_c=celsius_offset)


def detect_format(path: Path) -> ThermalFormat:
    """Return a file's format, by its content; raise `ThermalFileError` if it is missing, empty or of unknown format."""
    if not path.is_file():
        remedy = "Check the path; in a scene, restore the file, remove its frame or pass --missing-thermal skip."
        raise ThermalFileError("thermal file", expected=f"a file at {path}", got="nothing there", remedy=remedy)
    check_not_empty(path)
    with path.open("rb") as stream:
        head = stream.read(_HEAD_BYTES)
    found: ThermalFormat | None = next((name for start, name in _STARTS.items() if head.startswith(start)), None)
    if found is not None:
        return found
    if head.startswith(JPEG_START):
        return "FLIR R-JPEG" if is_flir_jpeg(path) else "DJI R-JPEG" if is_dji_rjpeg(path) else "JPEG"
    if _TEXT.fullmatch(head) and _NUMBERS.match(head) and re.search(rb"[0-9]", head):  # a table of numbers
        return "CSV"
    expected = "a FLIR or DJI R-JPEG, a TIFF, a 16-bit PNG, or a table of degrees C (.npy, .csv)"
    got, remedy = f"none of them: it starts with {head[:8]!r}", "Export it from the camera's program in one of these."
    raise ThermalFileError(str(path), expected=expected, got=got, remedy=remedy)


def read_thermal_file(path: Path, unit: ThermalUnit) -> Float32Array:
    """Return the temperatures (height, width) [degrees C] of a file whose `unit` is known, NaN in masked pixels.

    The content, not the name, decides the format. A FLIR R-JPEG is converted by the calibration and settings in the
    file, without `unit`. Counts need a unit: bounds or linear for PNG and JPEG, linear for TIFF and NPY. A
    floating-point TIFF is in degrees Celsius unless the unit is linear; CSV and floating-point NPY are always in
    degrees Celsius. With a linear unit, the lowest and highest possible counts are masked as saturated. Raises
    `ThermalFileError` if the file is missing, damaged or a colour picture, or if its counts have no unit.
    """
    values: npt.NDArray[Any]
    no_data = None
    with errors_name(path, _EXPECTED, _REMEDY, ThermalFileError):
        found = detect_format(path)
        if found == "FLIR R-JPEG":
            return masked_image(read_flir_jpeg(path).temperature_c())
        if found == "NPY":
            values = _read_npy(path)
        elif found == "CSV":
            values = _read_csv(path)
        else:
            values, no_data = _read_image(path)
    if values.ndim != 2 or 0 in values.shape:
        expected = "one temperature per pixel, shape (height, width)"
        remedy = "Export a single-channel thermal image."
        raise ThermalFileError(str(path), expected=expected, got=f"shape {values.shape}", remedy=remedy)
    if unit.kind == "linear" and (values.dtype.kind in "ui" or found == "TIFF"):
        celsius = values.astype(np.float64) * unit.scale + unit.offset_c
        if values.dtype.kind in "ui":
            ends = np.iinfo(values.dtype)
            celsius[(values == ends.min) | (values == ends.max)] = np.nan  # saturated
    elif values.dtype.kind == "f":
        celsius = values.astype(np.float64)
    elif unit.kind == "bounds" and found not in ("TIFF", "NPY") and values.dtype in (np.uint8, np.uint16):
        most = np.iinfo(values.dtype).max
        if (values == most).all():
            expected, got = "temperatures below the highest of the bounds", f"count {most} in every pixel"
            remedy = "The sensor saw more than the bounds can say, or the file is no measurement; remove the frame."
            raise ThermalFileError(str(path), expected=expected, got=got, remedy=remedy)
        celsius = values.astype(np.float64) / most * unit.scale + unit.offset_c
    else:
        # Cameras write a TIFF's counts in steps of a fixed size, which bounds do not give.
        got = f"{values.dtype} counts of a {found} " + ("beside bounds" if unit.kind == "bounds" else "and no unit")
        remedy = _COUNTS_REMEDY if unit.kind == "bounds" or found in ("TIFF", "NPY") else _UNIT_REMEDY
        raise ThermalFileError(str(path), expected="counts with a known unit", got=got, remedy=remedy)
    if no_data is not None:
        celsius[no_data] = np.nan
    return masked_image(celsius)


def masked_image(temperature_c: npt.NDArray[np.floating]) -> Float32Array:
    """Return a copy of temperatures (height, width) [degrees C] with NaN for all that are outside `VALID_RANGE_C`."""
    with np.errstate(invalid="ignore"):
        good = (temperature_c >= VALID_RANGE_C[0]) & (temperature_c <= VALID_RANGE_C[1])
    return np.where(good, temperature_c, np.nan).astype(np.float32)


def _read_npy(path: Path) -> npt.NDArray[Any]:
    try:
        values = np.load(path, mmap_mode="r", allow_pickle=False)  # the size is checked before the numbers are read
    except ValueError as problem:  # numpy's message may contain the whole header, so it is not shown
        raise _damaged(path, "a header that is no array's, or fewer numbers than it says") from problem
    if not isinstance(values, np.ndarray) or values.dtype.kind not in "fui":
        raise _damaged(path, f"an array of type {getattr(values, 'dtype', type(values))}")
    if values.ndim >= 2 and values.size:
        check_thermal_size(path, values.shape[1], values.shape[0])
    values = np.array(values)
    return values[..., 0] if values.ndim == 3 and values.shape[-1] == 1 else values


def _read_csv(path: Path) -> FloatArray:
    """Return a table of numbers, split by commas or semicolons. Empty cells and nan, NA, null, none, - are NaN."""
    text = path.read_text(encoding="utf-8-sig")
    semicolons = ";" in text
    rows = []
    for row in csv.reader(text.splitlines(), delimiter=";" if semicolons else ","):
        cells = [cell.strip() for cell in row]
        if cells and cells[-1] == "":
            cells.pop()  # many cameras end each line with a separator
        if cells:
            # With semicolons between the cells, a comma is a decimal comma.
            rows.append([_number(cell.replace(",", ".") if semicolons else cell) for cell in cells])
    if not rows or len({len(row) for row in rows}) != 1:
        raise _damaged(path, f"rows of lengths {sorted({len(row) for row in rows})}")
    check_thermal_size(path, len(rows[0]), len(rows))
    return np.array(rows, dtype=np.float64)


def _number(cell: str) -> float:
    return float("nan") if cell.lower() in ("", "nan", "na", "n/a", "null", "none", "-") else float(cell)


def _read_image(path: Path) -> tuple[npt.NDArray[Any], BoolArray | None]:
    """Return the numbers (height, width) of a grey picture, and a mask of its transparent pixels (None: no alpha)."""
    pixels = None
    with Image.open(path) as opened:
        image: Any = opened
        check_thermal_size(path, *image.size)
        pages = getattr(image, "n_frames", 1)
        if pages != 1:
            remedy = "Save the page that holds the temperatures as a file of its own."
            raise ThermalFileError(str(path), expected="one image", got=f"{pages} pages", remedy=remedy)
        # Pillow swaps the bytes of a compressed TIFF of big-endian floating-point numbers once too often.
        swapped = image.mode == "F" and image.tile[0][0] == "libtiff" and image.tile[0][3][0].endswith("BF")
        image.load()  # raises on truncated data
        if (image.mode in ("L", "F") or image.mode.startswith("I")) and not swapped:
            pixels = np.asarray(image)
            # Some versions of Pillow return 16-bit counts as 32 bits; some files have the other byte order.
            short = image.mode == "I" and image.format == "PNG"
            pixels = pixels.astype(np.uint16 if short else pixels.dtype.newbyteorder("="))
    if pixels is None:  # `swapped`, or a colour picture, of which Pillow would keep only 8 bits
        pixels = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise _damaged(path, "an image that cannot be decoded")
    if pixels.ndim == 2:
        return pixels, None
    has_alpha = pixels.shape[-1] in (2, 4)
    colours = pixels[..., :-1] if has_alpha else pixels
    if not (colours == colours[..., :1]).all():
        remedy = (
            "Export the radiometric data (16-bit PNG or TIFF, .npy, .csv), or a grey palette: pass --thermal-bounds; "
            "or put the camera's own R-JPEG files in its place; or pass --layout rgb to train without."
        )
        got = "a false-colour picture: its palette cannot be turned back into temperatures"
        raise ThermalFileError(str(path), expected="a grey image (all channels equal)", got=got, remedy=remedy)
    return np.ascontiguousarray(colours[..., 0]), pixels[..., -1] == 0 if has_alpha else None


def _damaged(path: Path, problem: object) -> ThermalFileError:
    return ThermalFileError(str(path), expected=_EXPECTED, got=problem, remedy=_REMEDY)


def find_dead_pixels(stack: Float32Array) -> BoolArray:
    """Return a mask (height, width) of pixels that are stuck at one value, from temperatures (frames, height, width).

    A pixel is stuck if it has the same finite value in all frames, fewer than half of all pixels are constant in this
    way, and the median of the 5 x 5 pixels around it differs from its value in at least half of the frames. A constant
    value alone is no proof: live pixels are constant too in a scene of one temperature, or at an image border that
    always shows the same cold sky. With fewer than 5 frames, no pixel counts as stuck.
    """
    frames, height, width = stack.shape
    dead = np.zeros((height, width), dtype=bool)
    constant = np.isfinite(stack[0]) & (stack == stack[:1]).all(axis=0)
    if frames < MIN_FRAMES or not constant.any() or constant.mean() >= 0.5:
        return dead
    side = 2 * _WINDOW + 1
    differs = np.zeros(np.count_nonzero(constant), dtype=np.int64)
    for frame in stack:
        around = sliding_window_view(np.pad(frame, _WINDOW, mode="reflect"), (side, side))[constant]
        differs += np.nanmedian(around, axis=(1, 2)) != frame[constant]
    dead[constant] = 2 * differs >= frames
    return dead
