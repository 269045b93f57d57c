"""The demo's result as one html page: pictures are embedded, nothing is fetched, no script runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.reports.page_style import embedded_image, html_page, scrolling


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
    meaning: str = ""
    """What the figure says, for somebody who meets it for the first time."""


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
    at_a_glance: tuple[Figure, ...]
    """What went in and what came out, side by side."""
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
    next_steps: tuple[tuple[str, str], ...]
    """Commands to try next, and what each does."""
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
        f'<div class="glance">{"".join(map(_figure, page.at_a_glance))}</div>',
        _section("Result", _checks(page.checks) + _more_figures(page.more_figures)),
    ]
    if page.training_pairs:
        pairs = "".join(
            "<div>"
            + embedded_image(rgb, f"input photograph {n}")
            + embedded_image(thermal, f"input thermal image {n}")
            + "</div>"
            for n, (rgb, thermal) in enumerate(page.training_pairs, start=1)
        )
        parts.append(_section("What went in", f'<div class="inputs">{pairs}</div>'))
    parts += [
        _section("Views that training never saw", _bar(page.colour_bar) + "".join(map(_view, page.views))),
        _section(
            "The mesh, before and after heat",
            f'<div class="pictures">{"".join(map(_figure, page.mesh_pictures))}</div>',
        ),
        _section("What it cost", _seconds(page.seconds)),
        _section("Do it yourself", _commands(page.commands)),
        _section("What next", _next_steps(page.next_steps)),
        _section("Where the files lie", _files(page.files)),
    ]
    return html_page(page.title, "\n".join(parts), _STYLE)


def _section(heading: str, content: str) -> str:
    return f"<section><h2>{escape(heading)}</h2>{content}</section>"


def _checks(checks: Sequence[Check]) -> str:
    rows = "".join(map(_check, checks))
    head = "<tr><th></th><th class=num>measured</th><th class=num>target</th><th>met</th></tr>"
    table = f"<table class=checks><thead>{head}</thead><tbody>{rows}</tbody></table>"
    return f"<div class=result>{scrolling(table)}</div>"


def _check(check: Check) -> str:
    meaning = f"<small>{escape(check.meaning)}</small>" if check.meaning else ""
    figures = "".join(f"<td class=num>{escape(text)}</td>" for text in (check.measured, check.target))
    met = "yes" if check.met else "no"
    return f"<tr><td>{escape(check.name)}{meaning}</td>{figures}<td class={met}>{met}</td></tr>"


def _more_figures(rows: Sequence[tuple[str, str]]) -> str:
    if not rows:
        return ""
    body = "".join(f"<tr><td>{escape(name)}</td><td class=num>{escape(value)}</td></tr>" for name, value in rows)
    table = scrolling(f"<table><tbody>{body}</tbody></table>")
    return f"<details class=result><summary>More figures</summary>{table}</details>"


def _view(view: HeldOutView) -> str:
    cells = "".join(
        f"<figure>{embedded_image(image, f'{view.name}, {words}')}<figcaption>{words}</figcaption></figure>"
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
    return f"<figure>{embedded_image(figure.image, figure.caption)}<figcaption>{caption}</figcaption></figure>"


def _bar(bar: ColourBar) -> str:
    """A strip of colours with five temperatures below it."""
    if len(bar.colours) < 2:
        raise ThermoxelsError(
            "colour bar",
            expected="at least two colours",
            got=len(bar.colours),
            remedy="Sample the colour map more often.",
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
    rows += f"<tr class=total><td>all together</td><td class=num>{total:.1f} s</td><td></td></tr>"
    return f"<div class=cost>{scrolling(f'<table><tbody>{rows}</tbody></table>')}</div>"


def _commands(commands: Sequence[str]) -> str:
    return "<pre>" + "".join(f"<div>{escape(command)}</div>" for command in commands) + "</pre>"


def _files(files: Sequence[tuple[str, str]]) -> str:
    rows = "".join(
        f'<tr><td><a href="{escape(path, quote=True)}"><code>{escape(path)}</code></a></td><td>{escape(what)}</td></tr>'
        for path, what in files
    )
    return f"<div class=files>{scrolling(f'<table><tbody>{rows}</tbody></table>')}</div>"


def _next_steps(steps: Sequence[tuple[str, str]]) -> str:
    return "".join(f"<p>{escape(what)}</p><pre>{escape(command)}</pre>" for command, what in steps)


_STYLE = """
.result, .files, .cost { max-width: 50rem; }
.glance { display: grid; grid-template-columns: repeat(3, 1fr); gap: .75rem; margin-top: 1.5rem; }
.total td { font-weight: 600; }
.share { width: 40%; vertical-align: middle; }
.share div { height: .6rem; background: var(--accent); border-radius: 2px; opacity: .75; }
.inputs { display: grid; grid-template-columns: repeat(6, 1fr); gap: .4rem; }
.inputs img + img { margin-top: .4rem; }
.view { display: grid; grid-template-columns: repeat(4, 1fr); gap: .6rem; break-inside: avoid; }
.bar { max-width: 46rem; margin-bottom: .5rem; }
.bar > div:first-child { height: .9rem; border-radius: 3px; }
.ticks { display: flex; justify-content: space-between; font-size: .8rem; color: var(--soft);
  font-variant-numeric: tabular-nums; }
@media screen and (max-width: 640px) {
  .view { grid-template-columns: repeat(2, 1fr); gap: .4rem; }
  .inputs { grid-template-columns: repeat(3, 1fr); }
  .glance { grid-template-columns: repeat(2, 1fr); }
  .glance figure:last-child { grid-column: 1 / -1; }
  .checks tr { display: grid; grid-template-columns: 5fr 5fr 2fr; border-bottom: 1px solid var(--line); }
  .checks td, .checks th { border: 0; padding-right: 0; text-align: left; }
  .checks td:first-child { grid-column: 1 / -1; padding-bottom: 0; }
  .checks th:first-child { display: none; }
  .result details td { width: 50%; }
  .result details td.num { white-space: normal; }
}
"""
