"""Html pages from templates: complete in one file, nothing fetched, no script."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from thermoxels_ns.core.checks import replace_when_done
from thermoxels_ns.core.errors import ThermoxelsError

_SIGNATURES = {b"\x89PNG\r\n\x1a\n": "image/png", b"\xff\xd8\xff": "image/jpeg"}


@dataclass(frozen=True)
class Table:
    """Rows of text; figures are aligned to the right."""

    columns: tuple[str, ...]  # Headings of the columns; all empty: the table has no head
    rows: tuple[tuple[str, ...], ...]
    """As many entries each as there are columns; further lines of an entry are written small below its first."""
    figures_from: int = 1  # First column of figures
    note: str = ""  # A sentence below
    summary: str = ""  # Words to click on where the table is folded away at first; empty: it is shown
    look: str = ""  # Class of the style sheet: ``rows`` for names with their values, ``cameras`` for few wide columns


@dataclass(frozen=True)
class Picture:
    """One picture with its caption."""

    image: bytes  # Content of a PNG or JPEG file
    caption: str


@dataclass(frozen=True)
class Gallery:
    """Pictures side by side."""

    pictures: tuple[Picture, ...]  # From left to right
    columns: int = 2  # How many stand in a row on a wide screen, 2 to 4
    heading: str = ""  # Words above


@dataclass(frozen=True)
class Section:
    """A heading and what stands below it, in this order."""

    heading: str
    words: tuple[str, ...] = ()
    galleries: tuple[Gallery, ...] = ()
    svg: str = ""  # A chart as an svg element
    tables: tuple[Table, ...] = ()  # Tables; one without rows is left out
    lines: tuple[str, ...] = ()  # Lines as they are typed or written, in a box


@dataclass(frozen=True)
class Page:
    """Everything a page says."""

    title: str
    summary: str  # One or two sentences below it
    sections: tuple[Section, ...]
    figures: tuple[tuple[str, str], ...] = ()  # The figures that matter most: value with unit, and what it is
    warnings: tuple[str, ...] = ()  # What to know before any figure is believed; stands above the figures
    in_short: tuple[str, ...] = ()  # What the reader wants to know first, sentences


def build_page(page: Any, template: str = "page.html.j2") -> str:
    """Build the html text of a page, or of what a template in the folder ``templates`` asks for under this name.

    It depends on the arguments alone; raises `ThermoxelsError` for a picture that is neither PNG nor JPEG.
    """
    return _environment().get_template(template).render(page=page)


def write_page(path: Path, text: str) -> None:
    """Write a page, whole or not at all."""
    with replace_when_done(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def image_address(image: bytes, words: str) -> str:
    """Put a PNG or JPEG file into its own address, or raise a `ThermoxelsError` that names it by `words`."""
    kind = next((kind for signature, kind in _SIGNATURES.items() if image.startswith(signature)), None)
    if kind is None:
        got, remedy = f"{len(image)} bytes that begin with {image[:8]!r}", "Draw the picture again."
        raise ThermoxelsError(words, expected="the content of a PNG or JPEG file", got=got, remedy=remedy)
    return f"data:{kind};base64,{base64.b64encode(image).decode()}"


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("thermoxels_ns.reports"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["address"] = image_address
    # The style sheet and charts are ours; every other text is escaped.
    environment.filters["markup"] = Markup
    return environment
