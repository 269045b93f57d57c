import re
from html.parser import HTMLParser
from io import BytesIO

import numpy as np
from PIL import Image

from thermoxels_ns.audit.draws import Interval
from thermoxels_ns.commands.demo_results import Compared, Target
from thermoxels_ns.reports.page import _environment, build_page, colours

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
        self.words: list[str] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
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
    table = """{% call parts.table("from1", "", "W", none, note="A note.") %}
        {% for name in names %}{{ parts.row(name, "12\nat (1, 2)", none) }}{% endfor %}{% endcall %}"""
    text = rendered(table, names=("roof", "wall"))
    outline = Outline(text)
    assert outline.rows == [["", "W"], ["roof", "12at (1, 2)"], ["wall", "12at (1, 2)"]]
    assert "<small>at (1, 2)</small>" in text and "A note." in outline.words


def test_words_stay_words() -> None:
    source = """{{ parts.warnings([evil]) }}{{ parts.card(evil, evil) }}{{ parts.gallery([(png, evil)]) }}
        {{ parts.box([evil]) }}{% call parts.table("from1", evil, note=evil) %}{{ parts.row(evil) }}
        {{ parts.row(evil ~ "\n" ~ evil) }}{% endcall %}"""
    text = rendered(source, evil=HOSTILE, png=picture("red"))
    assert "<script" not in text
    assert "".join(Outline(text).words).count(HOSTILE) == 10


def test_colours_go_from_dark_to_bright_and_nan_is_black() -> None:
    shown = colours(np.array([[0.0, 5.0, 10.0, np.nan]]), (0.0, 10.0)).sum(axis=2)[0]
    assert shown[0] < shown[1] < shown[2]
    assert shown[3] == 0
    assert (colours(np.full((2, 2), np.nan)) == 0).all()


MET = Target("PSNR", 27.0, 26.0, True, "{:.2f} dB", "")
MISSED = Target("Error", 1.2, 1.0, False, "{:.2f} °C", "In K.")


def test_results_times_and_commands_are_shown() -> None:
    shown = {
        "photographs": 42,
        "targets": (MET, MISSED),
        "compared": (Compared("door", "W/(m2 K)", 3.6, Interval(4.0, 3.7, 4.2)), Compared("psi", "W/(m K)", 0.7, None)),
        "inputs": [(picture("white", "JPEG"), picture("black", "JPEG"))],
        "views": [(f"{HOSTILE}{n}", [picture(c) for c in ("red", "green", "blue", "yellow")]) for n in (1, 2)],
        "gradient": ["#000004", "#fcffa4"],
        "ends_c": [10.0, 30.0],
        "night": picture("navy"),
        "mesh": picture("brown"),
        "measured": picture("purple"),
        "seconds": [("Train", 30.0), ("Export", 10.0)],
        "commands": ["ns-train thermoxels", "ns-eval --load-config 'a b'"],
        "config": "run/config.yml",
        "exported": "export/mesh.vtu",
    }
    text = build_page("demo.html.j2", **shown)
    outline = Outline(text)
    for row in (
        ["PSNR", "27.00 dB", "≥ 26.00 dB", "yes"],
        ["ErrorIn K.", "1.20 °C", "≤ 1.00 °C", "no"],
        ["door", "3.60", "4.00 (3.70 to 4.20)\xa0W/(m²\xa0K)", "no"],
        ["psi", "0.70", "not found", "no"],
        ["Train", "30.0 s", ""],
        ["all together", "40.0 s", ""],
    ):
        assert row in outline.rows
    assert re.findall(r"width: ([\d.]+)%\"", text) == ["75.0", "25.0"]
    assert "width: 0.0%" in build_page("demo.html.j2", **shown | {"seconds": [("Train", 0.0)]})
    words = outline.words
    assert "<script" not in text and f"{HOSTILE}2" in words
    assert "ns-train thermoxels" in words and "ns-eval --load-config 'a b'" in words
    assert "ns-viewer --load-config run/config.yml" in words
    assert "thermoxels heat export/mesh.vtu --scene original" in words
    ticks = re.findall(r"<span>([^<]*)</span>", text)
    assert ticks == ["10.0", "15.0", "20.0", "25.0", "30.0\xa0°C"]
