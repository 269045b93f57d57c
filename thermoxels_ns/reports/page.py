"""Build html pages from templates; a page is one file that loads nothing else and runs no script."""

from __future__ import annotations

import base64
import io
import math
from functools import cache
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt
from jinja2 import Environment, PackageLoader, StrictUndefined
from PIL import Image

from thermoxels_ns.core.checks import replace_when_done
from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.reports import numbers

Picture: TypeAlias = tuple[bytes, str]
"""Content of a PNG or JPEG file, and its caption."""

_SIGNATURES = {b"\x89PNG\r\n\x1a\n": "image/png", b"\xff\xd8\xff": "image/jpeg"}


def build_page(template: str, **shown: Any) -> str:
    """Return the html text of a page, made from a file in the folder ``templates`` and the values of its variables.

    Equal arguments give equal text. Raises `ThermoxelsError` for a picture that is neither PNG nor JPEG.
    """
    return _environment().get_template(template).render(**shown)


def write_page(path: Path, text: str) -> None:
    """Write a page to a file; an interrupted write leaves no broken file."""
    with replace_when_done(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def image_file(picture: npt.NDArray[np.uint8], kind: Literal["PNG", "JPEG"] = "JPEG", quality: int = 82) -> bytes:
    """Return the content of a PNG or JPEG file that shows a picture, shape (height, width, 3)."""
    stream = io.BytesIO()
    Image.fromarray(picture).save(stream, format=kind, quality=quality)
    return stream.getvalue()


def image_address(image: bytes, words: str) -> str:
    """Return a PNG or JPEG file as a ``data:`` address; raises a `ThermoxelsError` about `words` for other content."""
    kind = next((kind for signature, kind in _SIGNATURES.items() if image.startswith(signature)), None)
    if kind is None:
        got, remedy = f"{len(image)} bytes that begin with {image[:8]!r}", "Draw the picture again."
        raise ThermoxelsError(words, expected="the content of a PNG or JPEG file", got=got, remedy=remedy)
    return f"data:{kind};base64,{base64.b64encode(image).decode()}"


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("thermoxels_ns.reports"),
        autoescape=True,  # templates mark charts, which this package writes, as safe
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "address": image_address,
        "area": numbers.area_text,
        "count": "{:,}".format,
        "degrees": numbers.degrees,
        "duration": numbers.duration_text,
        "figure": numbers.figure,
        "finite": math.isfinite,
        "interval": numbers.interval_text,
        "lines": numbers.interval_lines,
        "point": numbers.point_text,
        "stated": numbers.stated_text,
        "unit": numbers.unit_signs,
    }
    return environment
