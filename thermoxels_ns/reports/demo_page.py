"""The demo's result as one html page."""

from __future__ import annotations

from dataclasses import dataclass

from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.reports.page import Picture, Section, Table
from thermoxels_ns.reports.page import build_page as build_html


@dataclass(frozen=True)
class Check:
    """A measured figure and whether it meets its target, as text."""

    name: str
    measured: str
    target: str
    met: bool
    meaning: str = ""  # What the figure says, for somebody who meets it for the first time


@dataclass(frozen=True)
class HeldOutView:
    """One view that took no part in training, as PNG or JPEG files; thermal images in the page's colours."""

    name: str
    measured_rgb: bytes
    rendered_rgb: bytes
    measured_thermal: bytes
    rendered_thermal: bytes

    @property
    def pictures(self) -> tuple[tuple[str, bytes], ...]:
        """What each picture is, and the picture."""
        return (
            ("photograph", self.measured_rgb),
            ("rendered", self.rendered_rgb),
            ("thermal image", self.measured_thermal),
            ("rendered", self.rendered_thermal),
        )


@dataclass(frozen=True)
class ColourBar:
    """The colours that temperatures are shown in.

    >>> ColourBar(("#000000", "#ffffff"), 10.0, 30.0).ticks
    ('10.0', '15.0', '20.0', '25.0', '30.0\\xa0°C')
    """

    colours: tuple[str, ...]  # Html colours at even steps from the coldest to the hottest; at least two
    min_c: float  # Temperature of the first colour, [degrees Celsius]
    max_c: float  # Temperature of the last colour, [degrees Celsius]

    def __post_init__(self) -> None:
        if len(self.colours) < 2:
            got, remedy = len(self.colours), "Sample the colour map more often."
            raise ThermoxelsError("colour bar", expected="at least two colours", got=got, remedy=remedy)

    @property
    def ticks(self) -> tuple[str, ...]:
        """Five temperatures at even steps."""
        span = self.max_c - self.min_c
        return (*(f"{self.min_c + share * span:.1f}" for share in (0, 0.25, 0.5, 0.75)), f"{self.max_c:.1f}\xa0°C")


@dataclass(frozen=True)
class DemoPage:
    """Everything the page says; steps in order with the time each took, [s]."""

    title: str
    summary: str  # One or two sentences on what the page shows
    at_a_glance: tuple[Picture, ...]  # What went in and what came out, side by side
    checks: tuple[Check, ...]
    more_figures: Table
    training_pairs: tuple[tuple[bytes, bytes], ...]  # Some of the photographs that went in, each with its thermal image
    views: tuple[HeldOutView, ...]
    colour_bar: ColourBar
    """Colours of all thermal images of the page, but not of the mesh pictures, which have their own."""
    mesh_pictures: tuple[Picture, ...]  # The mesh, before and after heat
    next_steps: tuple[tuple[str, str], ...]  # Commands to try next, and what each does
    seconds: tuple[tuple[str, float], ...]
    commands: tuple[str, ...]
    files: tuple[tuple[str, str], ...]  # Files and folders relative to the page, and what they hold
    sections: tuple[Section, ...] = ()  # What else was compared with the truth


def build_page(page: DemoPage) -> str:
    """Build the html text, which depends on `page` alone; raises `ThermoxelsError` for an image not PNG or JPEG."""
    return build_html(page, "demo.html.j2")
