import base64
import re
from typing import Any

import pytest

from tests.reports.test_page import HOSTILE, Outline, picture
from thermoxels_ns.audit.draws import Interval
from thermoxels_ns.commands.demo_results import Compared, Target
from thermoxels_ns.reports.page import build_page

MET = Target("PSNR", 27.0, 26.0, True, "{:.2f} dB", "")
MISSED = Target("Error", 1.2, 1.0, False, "{:.2f} °C", "In K.")


@pytest.fixture
def shown() -> dict[str, Any]:
    return {
        "scene": "house",
        "photographs": 42,
        "targets": (MET, MISSED),
        "others": (("Volume", "0.1 m³"),),
        "compared": (Compared("door", "W/(m2 K)", 3.6, Interval(4.0, 3.7, 4.2)), Compared("psi", "W/(m K)", 0.7, None)),
        "inputs": [(picture("white", "JPEG"), picture("black", "JPEG"))],
        "views": [(f"frame_eval_{n}", [picture(c) for c in ("red", "green", "blue", "yellow")]) for n in (1, 2)],
        "gradient": ["#000004", "#fcffa4"],
        "ends_c": [10.0, 30.0],
        "heat": [picture(colour) for colour in ("grey", "orange", "pink")],
        "mesh": picture("brown"),
        "measured": picture("purple"),
        "seconds": [("Train", 30.0), ("Export", 10.0)],
        "commands": ["ns-train thermoxels", "ns-eval --load-config 'a b'"],
        "next_steps": [("ns-viewer --load-config x", "Look at it:")],
    }


def test_results_times_and_commands_are_shown(shown) -> None:
    text = build_page("demo.html.j2", **shown)
    outline = Outline(text)
    for row in (
        ["PSNR", "27.00 dB", "≥ 26.00 dB", "yes"],
        ["ErrorIn K.", "1.20 °C", "≤ 1.00 °C", "no"],
        ["Volume", "0.1 m³"],
        ["door", "3.60", "4.00 (3.70 to 4.20)\xa0W/(m²\xa0K)", "no"],
        ["psi", "0.70", "not found", "no"],
        ["Train", "30.0 s", ""],
        ["all together", "40.0 s", ""],
    ):
        assert row in outline.rows
    assert re.findall(r"width: ([\d.]+)%\"", text) == ["75.0", "25.0"]
    assert "width: 0.0%" in build_page("demo.html.j2", **shown | {"seconds": [("Train", 0.0)]})
    words = outline.words
    assert "ns-train thermoxels" in words and "ns-eval --load-config 'a b'" in words
    assert words.index("Look at it:") < words.index("ns-viewer --load-config x")
    ticks = re.findall(r"<span>([^<]*)</span>", text)
    assert ticks == ["10.0", "15.0", "20.0", "25.0", "30.0\xa0°C"]
    assert "audit/audit.html" in text and "audit/audit.html" not in build_page(
        "demo.html.j2", **shown | {"compared": ()}
    )


def test_every_picture_is_embedded_in_the_order_of_its_place(shown) -> None:
    images = Outline(build_page("demo.html.j2", **shown)).images
    contents = [base64.b64decode(str(image["src"]).split("base64,")[1]) for image in images]
    expected = [*shown["inputs"][0], shown["mesh"], *shown["inputs"][0]]
    expected += [image for _, pictures in shown["views"] for image in pictures]
    expected += [*shown["heat"], shown["measured"]]
    assert contents == expected and all(image["alt"] for image in images)


def test_nothing_is_fetched_and_words_stay_words(shown) -> None:
    text = build_page("demo.html.j2", **shown)
    assert text == build_page("demo.html.j2", **shown)
    files = ("scene/", "outputs/", "eval.json", "renders/", "export/", "logs/", "audit/", "survey/")
    assert all(address.startswith(("data:", *files)) for address in Outline(text).addresses)
    assert not re.search(r"<script|https?:|@import|url\(|\bon\w+=", text)
    hostile = {
        "scene": HOSTILE,
        "targets": (Target(HOSTILE, 1.0, 1.0, True, HOSTILE.replace("{", ""), HOSTILE),),
        "others": ((HOSTILE, HOSTILE),),
        "compared": (Compared(HOSTILE, HOSTILE, 1.0, Interval(1.0, 0.5, 2.0)),),
        "views": [(HOSTILE, shown["views"][0][1])],
        "gradient": [HOSTILE, "red"],
        "seconds": [(HOSTILE, 1.0)],
        "commands": [HOSTILE],
        "next_steps": [(HOSTILE, HOSTILE)],
    }
    text = build_page("demo.html.j2", **shown | hostile)
    assert "<script" not in text
    # Title, heading, target (name, figure, bound, meaning), figures (2), compared (name, unit), view, step, command and
    # next (2); colours are no words.
    assert "".join(Outline(text).words).count(HOSTILE) == 15
