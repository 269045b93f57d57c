"""The result of a heat computation as one html page: nothing is fetched, no script runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from thermoxels_ns.reports.page_style import embedded_image, html_page, scrolling


@dataclass(frozen=True)
class Table:
    """Rows of text under a heading; figures are aligned to the right."""

    columns: tuple[str, ...]
    """Headings of the columns."""
    rows: tuple[tuple[str, ...], ...]
    """As many entries each as there are columns; further lines of an entry are written small below its first."""
    figures_from: int = 1
    """First column of figures."""
    note: str = ""
    """A sentence below."""


@dataclass(frozen=True)
class Section:
    """A heading and what stands below it, in this order."""

    heading: str
    """What it is about."""
    words: tuple[str, ...] = ()
    """Paragraphs."""
    tables: tuple[Table, ...] = ()
    """Tables; one without rows is left out."""
    svg: str = ""
    """A plot as an svg element."""
    pictures: tuple[tuple[bytes, str], ...] = ()
    """PNG files with their captions."""
    lines: tuple[str, ...] = ()
    """Lines as they are typed or written, in a box."""


@dataclass(frozen=True)
class HeatReport:
    """Everything the page says."""

    title: str
    """Heading of the page."""
    summary: str
    """One or two sentences below it."""
    figures: tuple[tuple[str, str], ...]
    """The figures that matter most: value with unit, and what it is."""
    sections: tuple[Section, ...]
    """The rest."""
    doubts: tuple[str, ...] = ()
    """What to know before any figure is believed; stands above the figures."""


def build_report(report: HeatReport) -> str:
    """Build the html text; it depends on `report` alone.

    Raises:
        ThermoxelsError: A picture is no PNG.
    """
    cards = "".join(
        f"<div><strong>{escape(value)}</strong><span>{escape(name)}</span></div>" for value, name in report.figures
    )
    body = "".join(_section(section) for section in report.sections)
    header = f"<header><h1>{escape(report.title)}</h1><p>{escape(report.summary)}</p></header>"
    doubts = _section(Section("Look at this first", words=report.doubts)) if report.doubts else ""
    return html_page(report.title, f"{header}\n{doubts}<div class=cards>{cards}</div>\n{body}", _STYLE)


def _section(section: Section) -> str:
    parts = [f"<p>{escape(words)}</p>" for words in section.words]
    parts += [_table(table) for table in section.tables if table.rows]
    if section.svg:
        parts.append(f"<div class=plot>{section.svg}</div>")
    if section.pictures:
        parts.append("<div class=pictures>" + "".join(_picture(*entry) for entry in section.pictures) + "</div>")
    if section.lines:
        parts.append("<pre>" + "".join(f"<div>{escape(line)}</div>" for line in section.lines) + "</pre>")
    return f"<section><h2>{escape(section.heading)}</h2>\n" + "\n".join(parts) + "\n</section>\n"


def _table(table: Table) -> str:
    def cells(tag: str, row: Sequence[str]) -> str:
        return "".join(
            f"<{tag}{' class=num' if number >= table.figures_from else ''}>{_cell(text)}</{tag}>"
            for number, text in enumerate(row)
        )

    rows = "".join(f"<tr>{cells('td', row)}</tr>" for row in table.rows)
    head = f"<thead><tr>{cells('th', table.columns)}</tr></thead>" if any(table.columns) else ""
    note = f"<p class=note>{escape(table.note)}</p>" if table.note else ""
    return f"{scrolling(f'<table>{head}<tbody>{rows}</tbody></table>')}{note}"


def _cell(text: str) -> str:
    """The first line of an entry, and the others small below it."""
    first, *more = text.split("\n")
    return escape(first) + "".join(f"<small>{escape(line)}</small>" for line in more)


def _picture(png: bytes, caption: str) -> str:
    return f"<figure>{embedded_image(png, caption)}<figcaption>{escape(caption)}</figcaption></figure>"


_STYLE = """
.cards { display: grid; gap: .75rem; grid-template-columns: repeat(auto-fit, minmax(11.5rem, 1fr));
  margin-top: 1.5rem; }
.cards div { border: 1px solid var(--line); border-radius: 4px; padding: .7rem .9rem;
  break-inside: avoid; }
.cards strong { display: block; font-size: 1.35rem; font-variant-numeric: tabular-nums; white-space: nowrap; }
.cards span { font-size: .85rem; color: var(--soft); }
@media print { .cards { grid-template-columns: repeat(3, 1fr); } .plot svg { max-height: 120mm; } }
"""
