"""Build html pages from templates, print them as PDF, and show temperatures in colours.

A page is one file that loads nothing else. Only the pages of audits and batches run a script.
"""

from __future__ import annotations

import base64
import hashlib
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt
from jinja2 import Environment, PackageLoader, StrictUndefined
from PIL import Image

from thermoxels_ns.core.checks import plain_os_errors, replace_when_done
from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.core.version import __version__
from thermoxels_ns.reports import numbers

PERCENTILES = (2.0, 98.0)  # Percentiles of a thermal image's temperatures at its darkest and brightest colour
Picture: TypeAlias = tuple[bytes, str]
"""Content of a PNG or JPEG file, and its caption."""


@dataclass(frozen=True)
class Report:
    """What a report was made of: the same inputs, choices and version give the same number."""

    number: str  # Such as 0F3A-99C2-71B0
    version: str  # Version of Thermoxels
    inputs: tuple[tuple[str, str], ...]  # Name and SHA-256 of each file

    @property
    def digest(self) -> str:
        """SHA-256 of the digests of all inputs, written one after the other."""
        return hashlib.sha256("".join(digest for _, digest in self.inputs).encode()).hexdigest()


def identify(files: Sequence[Path], *choices: object) -> Report:
    """Return the report number that follows from the contents of those `files` that exist, `choices` and version."""
    with plain_os_errors(files[0], "a file that can be read", "Check its permissions.", ThermoxelsError):
        inputs = tuple((path.name, hashlib.sha256(path.read_bytes()).hexdigest()) for path in files if path.is_file())
    digest = hashlib.sha256(repr((__version__, inputs, choices)).encode()).hexdigest()[:12].upper()
    return Report("-".join((digest[:4], digest[4:8], digest[8:])), __version__, inputs)


def build_page(template: str, **shown: Any) -> str:
    """Return a page's html text from a file in ``templates`` and its variables `shown`; equal ones give equal text."""
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


def image_address(image: bytes) -> str:
    """Return a PNG or JPEG file as a ``data:`` address."""
    kind = "png" if image.startswith(b"\x89PNG") else "jpeg"
    return f"data:image/{kind};base64,{base64.b64encode(image).decode()}"


def why_no_pdf() -> str:
    """Return a sentence that says what WeasyPrint lacks here and how to get it; "" if it can be used."""
    from PIL import ImageFile

    damaged_too = ImageFile.LOAD_TRUNCATED_IMAGES
    try:
        import weasyprint  # noqa: F401
    except ImportError:
        return "WeasyPrint is not installed; install it with: pip install weasyprint."
    except OSError as problem:
        library = "apt install libpango-1.0-0 libpangoft2-1.0-0 (Debian, Ubuntu) or brew install pango (macOS)"
        return f"WeasyPrint does not find its system library pango ({problem}); install that: {library}."
    finally:
        ImageFile.LOAD_TRUNCATED_IMAGES = damaged_too  # else this process would take half photographs for whole ones
    return ""


def write_pdf(path: Path, page: str) -> None:
    """Print the html text of a page into a PDF file, whole or not at all.

    The page must contain its pictures. Raises `ThermoxelsError` if WeasyPrint cannot be used, see `why_no_pdf`.
    """
    lacking = why_no_pdf()
    if lacking:
        raise ThermoxelsError(str(path), expected="a PDF file", got="none", remedy=lacking)
    from weasyprint import HTML

    with replace_when_done(path) as temporary:
        HTML(string=page).write_pdf(temporary)


def gradient() -> str:
    """Return the colours that `colours` uses, from dark to bright, as a list for a CSS gradient."""
    shown = colours(np.linspace(0.0, 1.0, 17)[None], (0.0, 1.0))[0]
    return ", ".join(f"rgb({red} {green} {blue})" for red, green, blue in shown.tolist())


def colours(temperature_c: npt.NDArray, limits: tuple[float, float] | None = None) -> npt.NDArray[np.uint8]:
    """Return colours, (h, w, 3), of temperatures, (h, w), black where NaN.

    `limits` are the temperatures of the darkest and of the brightest colour; None: the `PERCENTILES`.
    """
    import cv2

    known = np.isfinite(temperature_c)
    if limits is None:
        low, high = np.percentile(temperature_c[known], PERCENTILES) if known.any() else (0.0, 1.0)
    else:
        low, high = limits
    share = np.nan_to_num((temperature_c - low) / max(float(high - low), 1e-6))
    levels = np.clip(255 * share, 0, 255).astype(np.uint8)
    shown = np.array(cv2.applyColorMap(levels, cv2.COLORMAP_INFERNO)[..., ::-1], dtype=np.uint8)
    shown[~known] = 0
    return shown


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
        "count": "{:,}".format,
        "degrees": numbers.degrees,
        "duration": numbers.duration_text,
        "figure": numbers.figure,
        "finite": math.isfinite,
        "interval": numbers.interval_text,
        "lines": numbers.interval_lines,
        "plain": numbers.plain_names,
        "point": numbers.point_text,
        "stated": numbers.stated_text,
        "unit": numbers.unit_signs,
    }
    return environment
