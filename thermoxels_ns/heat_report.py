"""The result of a heat computation as one html page: nothing is fetched, no script runs."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from thermoxels_ns.errors import ThermoxelsError, explain

_PNG = b"\x89PNG\r\n\x1a\n"


@dataclass(frozen=True)
class Table:
    """Rows of text under a heading; figures are aligned to the right."""

    columns: tuple[str, ...]
    """Headings of the columns."""
    rows: tuple[tuple[str, ...], ...]
    """As many entries each as there are columns."""
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


def build_report(report: HeatReport) -> str:
    """Build the html text; it depends on `report` alone.

    Raises:
        ThermoxelsError: A picture is no PNG.
    """
    cards = "".join(
        f"<div><strong>{escape(value)}</strong><span>{escape(name)}</span></div>" for value, name in report.figures
    )
    body = "".join(_section(section) for section in report.sections)
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(report.title)}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n<main>\n"
        f"<header><h1>{escape(report.title)}</h1><p>{escape(report.summary)}</p></header>\n"
        f"<div class=cards>{cards}</div>\n{body}</main>\n</body>\n</html>\n"
    )


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
            f"<{tag}{' class=num' if number >= table.figures_from else ''}>{escape(text)}</{tag}>"
            for number, text in enumerate(row)
        )

    rows = "".join(f"<tr>{cells('td', row)}</tr>" for row in table.rows)
    head = f"<thead><tr>{cells('th', table.columns)}</tr></thead>" if any(table.columns) else ""
    note = f"<p class=note>{escape(table.note)}</p>" if table.note else ""
    return f"<div class=scroll><table>{head}<tbody>{rows}</tbody></table></div>{note}"


def _picture(png: bytes, caption: str) -> str:
    if not png.startswith(_PNG):
        raise ThermoxelsError(
            explain(
                caption,
                expected="the content of a PNG file",
                got=f"{len(png)} bytes that begin with {png[:8]!r}",
                remedy="Draw the picture again.",
            )
        )
    source = f"data:image/png;base64,{base64.b64encode(png).decode()}"
    image = f'<img src="{source}" alt="{escape(caption, quote=True)}">'
    return f"<figure>{image}<figcaption>{escape(caption)}</figcaption></figure>"


_STYLE = """
:root { color-scheme: light; --ink: #1d2430; --soft: #5c6675; --line: #e1e5ea; --accent: #b3431e; }
* { box-sizing: border-box; }
body { margin: 0; background: #fff; color: var(--ink);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; }
main { max-width: 1100px; margin: 0 auto; padding: 2rem 1.25rem 4rem; }
h1 { font-size: 1.9rem; line-height: 1.2; margin: 0 0 .5rem; }
header p { color: var(--soft); max-width: 50rem; margin: 0; }
h2 { font-size: 1.2rem; margin: 2.5rem 0 .75rem; padding-bottom: .3rem; border-bottom: 2px solid var(--accent); }
section p { max-width: 50rem; margin: .5rem 0; }
.note { font-size: .85rem; color: var(--soft); margin: .35rem 0 1rem; }
.cards { display: flex; flex-wrap: wrap; gap: .75rem; margin-top: 1.5rem; }
.cards div { flex: 1 1 11rem; border: 1px solid var(--line); border-radius: 4px; padding: .7rem .9rem; }
.cards strong { display: block; font-size: 1.35rem; font-variant-numeric: tabular-nums; }
.cards span { font-size: .85rem; color: var(--soft); }
.scroll { overflow-x: auto; margin: .75rem 0; }
table { border-collapse: collapse; width: 100%; }
th, td { text-align: left; padding: .4rem .9rem .4rem 0; border-bottom: 1px solid var(--line); vertical-align: top; }
th { font-size: .85rem; font-weight: 600; color: var(--soft); }
th:last-child, td:last-child { padding-right: 0; }
.num { text-align: right; font-variant-numeric: tabular-nums; }
td.num { white-space: nowrap; }
.plot svg { display: block; width: 100%; height: auto; }
.pictures { display: grid; grid-template-columns: repeat(2, 1fr); gap: 1rem; }
figure { margin: 0; }
figcaption { font-size: .8rem; color: var(--soft); margin-top: .15rem; }
img { display: block; width: 100%; height: auto; border: 1px solid var(--line); border-radius: 3px; }
pre { background: #f5f6f8; border: 1px solid var(--line); border-radius: 4px; padding: .8rem; margin: 0;
  white-space: pre-wrap; overflow-wrap: anywhere;
  font: .85rem/1.5 ui-monospace, "DejaVu Sans Mono", Menlo, Consolas, monospace; }
@media (max-width: 640px) {
  main { padding: 1.25rem .9rem 3rem; }
  h1 { font-size: 1.5rem; }
  .pictures { grid-template-columns: 1fr; }
  th, td { font-size: .9rem; }
}
"""
