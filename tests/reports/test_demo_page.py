"""The demo's page: complete, self-contained, well-formed, and nothing in it can break out of its place."""

from __future__ import annotations

import base64
import re
from dataclasses import replace
from html.parser import HTMLParser
from io import BytesIO

import pytest
from PIL import Image

from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.reports.demo_page import Check, ColourBar, DemoPage, Figure, HeldOutView, build_page


def picture(colour: str, kind: str = "PNG") -> bytes:
    stream = BytesIO()
    Image.new("RGB", (2, 2), colour).save(stream, format=kind)
    return stream.getvalue()


def view(name: str) -> HeldOutView:
    return HeldOutView(name, picture("red"), picture("green"), picture("blue"), picture("yellow"))


@pytest.fixture
def page() -> DemoPage:
    return DemoPage(
        title="Demo <of> & all",
        intro='A "small" scene.',
        at_a_glance=(Figure(picture("pink"), "In"), Figure(picture("brown"), "Out")),
        checks=(Check("PSNR", "27.00 dB", "≥ 26.00 dB", True), Check("Error", "1.20 °C", "≤ 1.00 °C", False, "In K.")),
        more_figures=(("Volume", "0.1 m³"),),
        training_pairs=((picture("white", "JPEG"), picture("black", "JPEG")),),
        views=(view("frame_eval_00001"), view("frame_eval_00002")),
        colour_bar=ColourBar(("#000004", "#fcffa4"), 10.0, 30.0),
        mesh_pictures=(Figure(picture("grey"), "Before"), Figure(picture("orange"), "After")),
        next_steps=(("ns-viewer --load-config x", "Look at it:"),),
        seconds=(("Train", 30.0), ("Export", 10.0)),
        commands=("ns-train thermoxels", "ns-eval --load-config 'a b'"),
        files=(("export/mesh.vtu", "the mesh"),),
    )


class Outline(HTMLParser):
    """Collects what the page shows; fails where a tag is not closed."""

    void = {"meta", "img", "br", "link"}

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.rows: list[list[str]] = []
        self.images: list[dict[str, str | None]] = []
        self.addresses: list[str] = []
        self.words: list[str] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        named = dict(attrs)
        self.addresses += [str(named[key]) for key in ("src", "href", "srcset", "action") if key in named]
        if tag == "img":
            self.images.append(named)
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th") and self.rows:
            self.rows[-1].append("")
        if tag not in self.void:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)
        if {"td", "th"} & set(self.open):
            self.rows[-1][-1] += data


def test_results_are_rows_that_say_yes_or_no(page):
    rows = Outline(build_page(page)).rows
    assert ["PSNR", "27.00 dB", "≥ 26.00 dB", "yes"] in rows
    assert ["ErrorIn K.", "1.20 °C", "≤ 1.00 °C", "no"] in rows and "<small>In K.</small>" in build_page(page)
    assert ["Volume", "0.1 m³"] in rows


def test_every_picture_is_embedded_in_the_order_of_its_place(page):
    images = Outline(build_page(page)).images
    contents = [base64.b64decode(str(image["src"]).split("base64,")[1]) for image in images]
    expected = [figure.image for figure in page.at_a_glance]
    expected += [image for pair in page.training_pairs for image in pair]
    for seen in page.views:
        expected += [seen.measured_rgb, seen.rendered_rgb, seen.measured_thermal, seen.rendered_thermal]
    expected += [figure.image for figure in page.mesh_pictures]
    assert contents == expected
    assert all(image["alt"] for image in images)
    kinds = [str(image["src"]).split(";")[0] for image in images]
    assert kinds == ["data:image/png"] * 2 + ["data:image/jpeg"] * 2 + ["data:image/png"] * 10


def test_nothing_is_fetched_and_no_script_runs(page):
    text = build_page(page)
    outline = Outline(text)
    assert all(address.startswith("data:") or address == "export/mesh.vtu" for address in outline.addresses)
    assert not re.search(r"<script|https?:|@import|url\(|\bon\w+=", text)


def test_words_stay_words(page):
    hostile = "<script>alert('1')</script>\"'&"
    changed = replace(
        page,
        title=hostile,
        intro=hostile,
        at_a_glance=(replace(page.at_a_glance[0], caption=hostile),),
        checks=(Check(hostile, hostile, hostile, True, hostile),),
        more_figures=((hostile, hostile),),
        views=(replace(page.views[0], name=hostile),),
        mesh_pictures=(replace(page.mesh_pictures[0], caption=hostile),),
        next_steps=((hostile, hostile),),
        seconds=((hostile, 1.0),),
        commands=(hostile,),
        files=((hostile, hostile),),
        colour_bar=ColourBar((hostile, "red"), 0.0, 1.0),
    )
    text = build_page(changed)
    assert "<script" not in text
    # Title (twice), intro, glance, check (4), figure (2), view, caption, step, command, next (2), file (2); colours are
    # no words.
    assert "".join(Outline(text).words).count(hostile) == 18


def test_the_colour_bar_says_the_temperatures_of_its_quarters(page):
    text = build_page(page)
    ticks = re.findall(r"<span>(.*?)</span>", text)
    assert ticks == ["10.0", "15.0", "20.0", "25.0", "30.0&nbsp;°C"]
    assert "linear-gradient(to right, #000004, #fcffa4)" in text
    with pytest.raises(ThermoxelsError, match="colour bar: expected at least two colours, got 1"):
        build_page(replace(page, colour_bar=ColourBar(("red",), 0.0, 1.0)))


def test_times_add_up_and_bars_show_their_share(page):
    text = build_page(page)
    rows = Outline(text).rows
    assert ["Train", "30.0 s", ""] in rows
    assert ["all together", "40.0 s", ""] in rows
    assert re.findall(r"width: ([\d.]+)%\"", text) == ["75.0", "25.0"]
    assert "width: 0.0%" in build_page(replace(page, seconds=(("Train", 0.0),)))


def test_commands_are_shown_as_typed(page):
    words = Outline(build_page(page)).words
    assert "ns-train thermoxels" in words
    assert "ns-eval --load-config 'a b'" in words
    assert words.index("Look at it:") < words.index("ns-viewer --load-config x")


def test_the_same_page_is_the_same_text(page):
    assert build_page(page) == build_page(replace(page))


def test_what_is_no_picture_is_refused(page):
    broken = replace(page.views[0], rendered_thermal=b"not a picture")
    with pytest.raises(ThermoxelsError, match="frame_eval_00001, rendered: expected the content of a PNG or JPEG"):
        build_page(replace(page, views=(broken,)))
