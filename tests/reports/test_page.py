import base64
import re
from html.parser import HTMLParser
from io import BytesIO

import numpy as np
import pytest
from PIL import Image

from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.reports.charts import bars, curves_over_time, histogram
from thermoxels_ns.reports.page import Gallery, Page, Picture, Section, Table, build_page, image_address

HOSTILE = "<script>alert('1')</script>\"'&"


def picture(colour: str, kind: str = "PNG") -> bytes:
    stream = BytesIO()
    Image.new("RGB", (2, 2), colour).save(stream, format=kind)
    return stream.getvalue()


class Outline(HTMLParser):
    """Collects what a page shows; fails where a tag is not closed."""

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


@pytest.fixture
def page() -> Page:
    tables = (
        Table(("", "W"), (("roof", "12\nat (1, 2)"),), note="A note.", summary="All", look="rows"),
        Table(("a", "b"), ()),
    )
    gallery = Gallery((Picture(picture("red"), "first"), Picture(picture("blue", "JPEG"), "second")), 3, "Both")
    section = Section("Heat", ("Words.",), (gallery,), histogram(np.arange(9.0), "x"), tables, ("thermoxels heat",))
    return Page("House", "A body.", (section,), (("2,464 W", "heat loss"),), ("No rooms.",))


def test_everything_is_shown_in_order(page: Page) -> None:
    text = build_page(page)
    outline = Outline(text)
    wanted = ("No rooms.", "2,464 W", "Heat", "Words.", "Both", "first", "second", "All", "roof", "A note.")
    places = [outline.words.index(words) for words in (*wanted, "thermoxels heat")]
    assert places == sorted(places)
    assert outline.rows == [["", "W"], ["roof", "12at (1, 2)"]] and "<small>at (1, 2)</small>" in text
    contents = [base64.b64decode(str(image["src"]).split("base64,")[1]) for image in outline.images]
    assert contents == [picture("red"), picture("blue", "JPEG")]
    assert [image["alt"] for image in outline.images] == ["first", "second"]


def test_what_is_empty_leaves_nothing_behind() -> None:
    body = build_page(Page("House", "", (Section("Heat", tables=(Table(("a",), ()),)),))).split("</header>")[1]
    assert not re.search(r"<table|<pre|<div|<svg|Look at this first", body)


def test_nothing_is_fetched_and_no_script_runs(page: Page) -> None:
    text = build_page(page)
    assert text.startswith("<!doctype html>") and text == build_page(page)
    assert all(address.startswith("data:image/") for address in Outline(text).addresses)
    # Names of the SVG language are no addresses, and its clip paths lie in the chart itself.
    fetched = re.sub(r'xmlns(:\w+)?="[^"]*"|<metadata>.*?</metadata>', "", text, flags=re.DOTALL)
    assert not re.search(r"<script|https?:|@import|url\((?!#)|<link|\bon\w+=", fetched)


def test_words_stay_words() -> None:
    table = Table((HOSTILE,), ((HOSTILE,),), note=HOSTILE, summary=HOSTILE)
    gallery = Gallery((Picture(picture("red"), HOSTILE),), 2, HOSTILE)
    section = Section(HOSTILE, (HOSTILE,), (gallery,), bars([1.0, -2.0], HOSTILE), (table,), (HOSTILE,))
    text = build_page(Page(HOSTILE, HOSTILE, (section,), ((HOSTILE, HOSTILE),), (HOSTILE,)))
    assert "<script" not in text
    assert "".join(Outline(text).words).count(HOSTILE) == 16


def test_what_is_no_picture_is_refused() -> None:
    with pytest.raises(ThermoxelsError, match=r"the roof: expected the content of a PNG or JPEG file, got 6 bytes"):
        image_address(b"GIF89a", "the roof")


def test_charts_are_the_same_for_the_same_figures_and_none_without_values() -> None:
    times = np.arange(4.0)

    def over_time() -> str:
        band = ("all", times - 1, times + 1)
        return curves_over_time(times, "h", [("mean", times)], band, [("stored", times[1:])], ("C", "W"))

    assert over_time() == over_time()
    assert over_time().startswith("<svg") and over_time().endswith("</svg>") and ">mean<" in over_time()
    assert histogram(np.array([np.nan]), "x") == "" == bars([], "x")
    assert "<b>" not in histogram(np.arange(4.0), "<b>&\"'")
