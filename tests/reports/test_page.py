from html.parser import HTMLParser
from io import BytesIO

import numpy as np
import pytest
from PIL import Image

from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.reports.charts import bars, colours, histogram
from thermoxels_ns.reports.page import _environment, image_address

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


def rendered(source: str, **shown) -> str:
    text = "{% extends 'page.html.j2' %}{% import 'parts.html.j2' as parts %}{% block title %}{{ title }}{% endblock %}"
    text += "{% block content %}" + source + "{% endblock %}"
    return _environment().from_string(text).render(title="House", **shown)


def test_a_table_has_its_entries_in_order_without_those_that_are_none() -> None:
    table = """{% call parts.table("from1", "A note.") %}{{ parts.head("", "W", none) }}
        {% for name in names %}{{ parts.row(name, "12\nat (1, 2)", none) }}{% endfor %}{% endcall %}"""
    text = rendered(table, names=("roof", "wall"))
    outline = Outline(text)
    assert outline.rows == [["", "W"], ["roof", "12at (1, 2)"], ["wall", "12at (1, 2)"]]
    assert "<small>at (1, 2)</small>" in text and "A note." in outline.words


def test_words_stay_words() -> None:
    source = """{{ parts.warnings([evil]) }}{{ parts.card(evil, evil) }}{{ parts.gallery([(png, evil)]) }}
        {{ parts.box([evil]) }}{% call parts.table("from1", evil) %}{{ parts.head(evil) }}{{ parts.row(evil) }}
        {{ parts.row(evil ~ "\n" ~ evil) }}{% endcall %}{{ chart | safe }}"""
    text = rendered(source, evil=HOSTILE, png=picture("red"), chart=bars(np.array([1.0, -2.0]), HOSTILE))
    assert "<script" not in text
    assert "".join(Outline(text).words).count(HOSTILE) == 11


def test_what_is_no_picture_is_refused() -> None:
    with pytest.raises(ThermoxelsError, match=r"the roof: expected the content of a PNG or JPEG file, got 6 bytes"):
        image_address(b"GIF89a", "the roof")


def test_charts_are_the_same_for_the_same_figures_and_none_without_values() -> None:
    values = np.arange(4.0)
    assert bars(values, "x") == bars(values, "x") and ">x<" in bars(values, "x")
    assert bars(values, "x").startswith("<svg") and bars(values, "x").endswith("</svg>")
    assert histogram(np.array([np.nan]), "x") == "" == bars(np.empty(0), "x")
    assert "<b>" not in histogram(np.arange(4.0), "<b>&\"'")


def test_colours_go_from_dark_to_bright_and_nan_is_black() -> None:
    shown = colours(np.array([[0.0, 5.0, 10.0, np.nan]]), (0.0, 10.0)).sum(axis=2)[0]
    assert shown[0] < shown[1] < shown[2]
    assert shown[3] == 0
    assert (colours(np.full((2, 2), np.nan)) == 0).all()
