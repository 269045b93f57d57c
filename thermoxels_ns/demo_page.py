"""The demo's result as one html page: pictures are embedded, nothing is fetched, no script runs."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from thermoxels_ns.errors import ThermoxelsError, explain

_SIGNATURES = {b"\x89PNG\r\n\x1a\n": "image/png", b"\xff\xd8\xff": "image/jpeg"}


@dataclass(frozen=True)
class Check:
    """A measured figure and whether it meets its target, as text."""

    name: str
    """What was measured."""
    measured: str
    """The figure with its unit."""
    target: str
    """What it should be, with its unit."""
    met: bool
    """Whether it is."""


@dataclass(frozen=True)
class HeldOutView:
    """One view that took no part in training, as PNG or JPEG files."""

    name: str
    """Name of the frame."""
    measured_rgb: bytes
    """The photograph."""
    rendered_rgb: bytes
    """The model's colour image."""
    measured_thermal: bytes
    """The thermal image in the colours of the page's colour bar."""
    rendered_thermal: bytes
    """The model's thermal image in the same colours."""


@dataclass(frozen=True)
class ColourBar:
    """The colours that temperatures are shown in."""

    colours: tuple[str, ...]
    """Html colours at even steps from the coldest to the hottest; at least two."""
    min_c: float
    """Temperature of the first colour, [degrees Celsius]."""
    max_c: float
    """Temperature of the last colour, [degrees Celsius]."""


@dataclass(frozen=True)
class Figure:
    """One picture with its caption."""

    image: bytes
    """PNG or JPEG file."""
    caption: str
    """What it shows."""


@dataclass(frozen=True)
class DemoPage:
    """Everything the page says."""

    title: str
    """Heading."""
    intro: str
    """One or two sentences on what the page shows."""
    checks: tuple[Check, ...]
    """The figures that have a target."""
    more_figures: tuple[tuple[str, str], ...]
    """Further figures: name and value with unit."""
    training_pairs: tuple[tuple[bytes, bytes], ...]
    """Some of the photographs that went in, each with its thermal image."""
    views: tuple[HeldOutView, ...]
    """The held-out views."""
    colour_bar: ColourBar
    """Colours of all thermal images of the page, but not of the mesh pictures, which have their own."""
    mesh_pictures: tuple[Figure, ...]
    """The mesh, before and after heat."""
    seconds: tuple[tuple[str, float], ...]
    """Steps in order and the time each took, [s]."""
    commands: tuple[str, ...]
    """The commands that reproduce it, as they are typed."""
    files: tuple[tuple[str, str], ...]
    """Files and folders relative to the page, and what they hold."""


def build_page(page: DemoPage) -> str:
    """Build the html text; it depends on `page` alone.

    Raises:
        ThermoxelsError: An image is neither PNG nor JPEG, or the colour bar has fewer than two colours.
    """
    title = escape(page.title)
    parts = [
        f"<header><h1>{title}</h1><p>{escape(page.intro)}</p></header>",
        _section("Result", _checks(page.checks) + _more_figures(page.more_figures)),
    ]
    if page.training_pairs:
        pairs = "".join(
            f"<div>{_img(rgb, f'input photograph {n}')}{_img(thermal, f'input thermal image {n}')}</div>"
            for n, (rgb, thermal) in enumerate(page.training_pairs, start=1)
        )
        parts.append(_section("What went in", f'<div class="inputs">{pairs}</div>'))
    parts += [
        _section("Views that training never saw", _bar(page.colour_bar) + "".join(map(_view, page.views))),
        _section(
            "The mesh, before and after heat", f'<div class="meshes">{"".join(map(_figure, page.mesh_pictures))}</div>'
        ),
        _section("What it cost", _seconds(page.seconds)),
        _section("Do it yourself", _commands(page.commands)),
        _section("Where the files lie", _files(page.files)),
    ]
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{title}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n<main>\n"
        + "\n".join(parts)
        + "\n</main>\n</body>\n</html>\n"
    )


def _section(heading: str, content: str) -> str:
    return f"<section><h2>{escape(heading)}</h2>{content}</section>"


def _checks(checks: Sequence[Check]) -> str:
    rows = "".join(
        f"<tr><td>{escape(c.name)}</td><td class=num>{escape(c.measured)}</td><td class=num>{escape(c.target)}</td>"
        f"<td class={'yes' if c.met else 'no'}>{'yes' if c.met else 'no'}</td></tr>"
        for c in checks
    )
    head = "<tr><th></th><th class=num>measured</th><th class=num>target</th><th>met</th></tr>"
    return f"<table><thead>{head}</thead><tbody>{rows}</tbody></table>"


def _more_figures(rows: Sequence[tuple[str, str]]) -> str:
    if not rows:
        return ""
    body = "".join(f"<tr><td>{escape(name)}</td><td class=num>{escape(value)}</td></tr>" for name, value in rows)
    return f"<details><summary>More figures</summary><table><tbody>{body}</tbody></table></details>"


def _view(view: HeldOutView) -> str:
    cells = "".join(
        f"<figure>{_img(image, f'{view.name}, {words}')}<figcaption>{words}</figcaption></figure>"
        for words, image in (
            ("photograph", view.measured_rgb),
            ("rendered", view.rendered_rgb),
            ("thermal image", view.measured_thermal),
            ("rendered", view.rendered_thermal),
        )
    )
    return f'<h3>{escape(view.name)}</h3><div class="view">{cells}</div>'


def _figure(figure: Figure) -> str:
    caption = escape(figure.caption)
    return f"<figure>{_img(figure.image, figure.caption)}<figcaption>{caption}</figcaption></figure>"


def _bar(bar: ColourBar) -> str:
    """A strip of colours with five temperatures below it."""
    if len(bar.colours) < 2:
        raise ThermoxelsError(
            explain(
                "colour bar",
                expected="at least two colours",
                got=len(bar.colours),
                remedy="Sample the colour map more often.",
            )
        )
    ticks = "".join(f"<span>{bar.min_c + share * (bar.max_c - bar.min_c):.1f}</span>" for share in (0, 0.25, 0.5, 0.75))
    ticks += f"<span>{bar.max_c:.1f}&nbsp;°C</span>"
    gradient = escape(", ".join(bar.colours), quote=True)
    return (
        f'<div class="bar"><div style="background: linear-gradient(to right, {gradient})"></div>'
        f'<div class="ticks">{ticks}</div></div>'
    )


def _seconds(seconds: Sequence[tuple[str, float]]) -> str:
    total = sum(value for _, value in seconds)
    rows = "".join(
        f'<tr><td>{escape(name)}</td><td class=num>{value:.1f} s</td><td class="share">'
        f'<div style="width: {100.0 * value / total if total > 0 else 0.0:.1f}%"></div></td></tr>'
        for name, value in seconds
    )
    return (
        f"<table><tbody>{rows}<tr class=total><td>all together</td><td class=num>{total:.1f} s</td><td></td></tr>"
        "</tbody></table>"
    )


def _commands(commands: Sequence[str]) -> str:
    return "<pre>" + "".join(f"<div>{escape(command)}</div>" for command in commands) + "</pre>"


def _files(files: Sequence[tuple[str, str]]) -> str:
    rows = "".join(
        f'<tr><td><a href="{escape(path, quote=True)}"><code>{escape(path)}</code></a></td><td>{escape(what)}</td></tr>'
        for path, what in files
    )
    return f"<table><tbody>{rows}</tbody></table>"


def _img(image: bytes, words: str) -> str:
    """Embed an image."""
    kind = next((kind for signature, kind in _SIGNATURES.items() if image.startswith(signature)), None)
    if kind is None:
        raise ThermoxelsError(
            explain(
                words,
                expected="the content of a PNG or JPEG file",
                got=f"{len(image)} bytes that begin with {image[:8]!r}",
                remedy="Write the picture again.",
            )
        )
    return f'<img src="data:{kind};base64,{base64.b64encode(image).decode()}" alt="{escape(words, quote=True)}">'


_STYLE = """
:root { color-scheme: light; --ink: #1d2430; --soft: #5c6675; --line: #e1e5ea; --accent: #b3431e; }
* { box-sizing: border-box; }
body { margin: 0; background: #fff; color: var(--ink);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; }
main { max-width: 1100px; margin: 0 auto; padding: 2rem 1.25rem 4rem; }
h1 { font-size: 1.9rem; line-height: 1.2; margin: 0 0 .5rem; }
header p { color: var(--soft); max-width: 46rem; margin: 0; }
h2 { font-size: 1.2rem; margin: 2.5rem 0 .75rem; padding-bottom: .3rem; border-bottom: 2px solid var(--accent); }
h3 { font-size: .85rem; font-weight: 600; color: var(--soft); margin: 1.1rem 0 .3rem; }
table { border-collapse: collapse; width: 100%; max-width: 46rem; }
th, td { text-align: left; padding: .4rem .75rem .4rem 0; border-bottom: 1px solid var(--line); vertical-align: top; }
th { font-size: .85rem; font-weight: 600; color: var(--soft); }
.num { text-align: right; white-space: nowrap; font-variant-numeric: tabular-nums; }
td.yes { color: #1c7c3c; font-weight: 600; }
td.no { color: #c0212c; font-weight: 600; }
.total td { font-weight: 600; }
.share { width: 40%; vertical-align: middle; }
.share div { height: .6rem; background: var(--accent); border-radius: 2px; opacity: .75; }
details { margin-top: .9rem; }
summary { cursor: pointer; color: var(--soft); }
figure { margin: 0; }
figcaption { font-size: .8rem; color: var(--soft); margin-top: .15rem; }
img { display: block; width: 100%; height: auto; border-radius: 3px; }
.inputs { display: grid; grid-template-columns: repeat(6, 1fr); gap: .4rem; }
.inputs img + img { margin-top: .4rem; }
.view { display: grid; grid-template-columns: repeat(4, 1fr); gap: .6rem; }
.meshes { display: grid; grid-template-columns: repeat(2, 1fr); gap: 1rem; }
.meshes img { border: 1px solid var(--line); }
.bar { max-width: 46rem; margin-bottom: .5rem; }
.bar > div:first-child { height: .9rem; border-radius: 3px; }
.ticks { display: flex; justify-content: space-between; font-size: .8rem; color: var(--soft);
  font-variant-numeric: tabular-nums; }
pre { background: #f5f6f8; border: 1px solid var(--line); border-radius: 4px; padding: .8rem; margin: 0;
  white-space: pre-wrap; overflow-wrap: anywhere; }
pre div { padding-left: 2ch; text-indent: -2ch; }
pre div + div { margin-top: .5rem; }
pre, code { font-family: ui-monospace, "DejaVu Sans Mono", Menlo, Consolas, monospace; font-size: .85rem; }
code { overflow-wrap: anywhere; }
a { color: var(--accent); }
@media (max-width: 640px) {
  main { padding: 1.25rem .9rem 3rem; }
  h1 { font-size: 1.5rem; }
  .view { grid-template-columns: repeat(2, 1fr); gap: .4rem; }
  .inputs { grid-template-columns: repeat(3, 1fr); }
  .meshes { grid-template-columns: 1fr; }
  th, td { padding-right: .5rem; font-size: .9rem; }
}
"""
