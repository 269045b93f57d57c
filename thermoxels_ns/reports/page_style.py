"""How the html pages look: complete in one file, nothing is fetched, no script runs, fit for phones and for paper."""

from __future__ import annotations

import base64
from html import escape

from thermoxels_ns.core.errors import ThermoxelsError

_SIGNATURES = {b"\x89PNG\r\n\x1a\n": "image/png", b"\xff\xd8\xff": "image/jpeg"}


def html_page(title: str, body: str, own_style: str = "") -> str:
    """Put a page together; it depends on the arguments alone.

    Args:
        title: Plain text.
        body: Html of what the page shows.
        own_style: Rules that only this page needs; they come before those for narrow screens and paper.
    """
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{_STYLE}{own_style}{_NARROW}{_PAPER}</style>\n</head>\n"
        f"<body>\n<main>\n{body}\n</main>\n</body>\n</html>\n"
    )


def scrolling(table: str) -> str:
    """Let a table (html) scroll by itself where the screen is narrower.

    >>> scrolling("<table></table>")
    '<div class=scroll><table></table></div>'
    """
    return f"<div class=scroll>{table}</div>"


def embedded_image(image: bytes, words: str) -> str:
    """Write an image with its content in the page.

    Args:
        image: Content of a PNG or JPEG file.
        words: What it shows, plain text, for those who cannot see it.

    Raises:
        ThermoxelsError: The content is neither.
    """
    kind = next((kind for signature, kind in _SIGNATURES.items() if image.startswith(signature)), None)
    if kind is None:
        raise ThermoxelsError(
            words,
            expected="the content of a PNG or JPEG file",
            got=f"{len(image)} bytes that begin with {image[:8]!r}",
            remedy="Draw the picture again.",
        )
    return f'<img src="data:{kind};base64,{base64.b64encode(image).decode()}" alt="{escape(words, quote=True)}">'


_STYLE = """
:root { color-scheme: light; --ink: #1d2430; --soft: #555f6d; --line: #e1e5ea; --accent: #b3431e; }
* { box-sizing: border-box; }
body { margin: 0; background: #fff; color: var(--ink);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; }
main { max-width: 1100px; margin: 0 auto; padding: 2rem 1.25rem 4rem; }
h1 { font-size: 1.9rem; line-height: 1.2; margin: 0 0 .5rem; overflow-wrap: anywhere; }
h2 { font-size: 1.2rem; margin: 2.5rem 0 .75rem; padding-bottom: .3rem; border-bottom: 2px solid var(--accent); }
h3 { font-size: .9rem; font-weight: 600; color: var(--soft); margin: 1.1rem 0 .3rem; }
header p { color: var(--soft); max-width: 50rem; margin: 0; }
section p { max-width: 50rem; margin: .5rem 0; }
.note { font-size: .85rem; color: var(--soft); margin: .35rem 0 1rem; }
.scroll { overflow-x: auto; margin: .75rem 0; }
table { border-collapse: collapse; width: 100%; }
th, td { text-align: left; padding: .4rem .9rem .4rem 0; border-bottom: 1px solid var(--line); vertical-align: top; }
th { font-size: .85rem; font-weight: 600; color: var(--soft); vertical-align: bottom; }
th:last-child, td:last-child { padding-right: 0; }
.num { text-align: right; font-variant-numeric: tabular-nums; }
td.num { white-space: nowrap; }
td small { display: block; white-space: normal; color: var(--soft); font-size: .8rem; }
.yes { color: #1c7c3c; font-weight: 600; }
.no { color: #c0212c; font-weight: 600; }
details { margin-top: .9rem; }
summary { cursor: pointer; color: var(--soft); }
figure { margin: 0; }
figcaption { font-size: .85rem; color: var(--soft); margin-top: .15rem; }
img { display: block; width: 100%; height: auto; border-radius: 3px; }
svg { display: block; width: 100%; height: auto; }
.pictures { display: grid; grid-template-columns: repeat(2, 1fr); gap: 1rem; }
.pictures img { border: 1px solid var(--line); }
pre { background: #f5f6f8; border: 1px solid var(--line); border-radius: 4px; padding: .8rem; margin: 0;
  white-space: pre-wrap; overflow-wrap: anywhere; }
pre div { padding-left: 2ch; text-indent: -2ch; }
pre div + div { margin-top: .5rem; }
pre, code { font-family: ui-monospace, "DejaVu Sans Mono", Menlo, Consolas, monospace; font-size: .85rem; }
code { overflow-wrap: anywhere; }
a { color: var(--accent); }
"""

_NARROW = """
@media (max-width: 640px) {
  main { padding: 1.25rem .9rem 3rem; }
  h1 { font-size: 1.5rem; }
  .pictures { grid-template-columns: 1fr; }
  th, td { font-size: .9rem; padding-right: .6rem; }
}
"""

_PAPER = """
@page { margin: 15mm; }
@media print {
  * { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
  html { font-size: 13px; }
  body { font-size: 1rem; }
  main { max-width: none; padding: 0; }
  h1, h2, h3, summary, thead { break-after: avoid; }
  h2 { margin-top: 1.4rem; }
  tr, figure, pre, svg { break-inside: avoid; }
  .scroll { overflow: visible; }
  th, td { font-size: .9rem; padding-top: .2rem; padding-bottom: .2rem; }
  .pictures { grid-template-columns: repeat(2, 1fr); }
  pre { border: 1px solid var(--line); }
  a { color: inherit; }
  details::details-content { content-visibility: visible; height: auto; }
}
"""
