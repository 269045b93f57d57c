import base64
import re
from dataclasses import replace

import pytest

from tests.reports.test_page import HOSTILE, Outline, picture
from thermoxels_ns.reports.demo_page import Check, ColourBar, DemoPage, HeldOutView, build_page
from thermoxels_ns.reports.page import Picture, Table


def view(name: str) -> HeldOutView:
    return HeldOutView(name, picture("red"), picture("green"), picture("blue"), picture("yellow"))


@pytest.fixture
def page() -> DemoPage:
    return DemoPage(
        title="Demo <of> & all",
        summary='A "small" scene.',
        at_a_glance=(Picture(picture("pink"), "In"), Picture(picture("brown"), "Out")),
        checks=(Check("PSNR", "27.00 dB", "≥ 26.00 dB", True), Check("Error", "1.20 °C", "≤ 1.00 °C", False, "In K.")),
        more_figures=Table(("", ""), (("Volume", "0.1 m³"),), summary="More figures"),
        training_pairs=((picture("white", "JPEG"), picture("black", "JPEG")),),
        views=(view("frame_eval_00001"), view("frame_eval_00002")),
        colour_bar=ColourBar(("#000004", "#fcffa4"), 10.0, 30.0),
        mesh_pictures=(Picture(picture("grey"), "Before"), Picture(picture("orange"), "After")),
        next_steps=(("ns-viewer --load-config x", "Look at it:"),),
        seconds=(("Train", 30.0), ("Export", 10.0)),
        commands=("ns-train thermoxels", "ns-eval --load-config 'a b'"),
        files=(("export/mesh.vtu", "the mesh"),),
    )


def test_results_times_and_commands_are_shown(page: DemoPage) -> None:
    text = build_page(page)
    outline = Outline(text)
    for row in (
        ["PSNR", "27.00 dB", "≥ 26.00 dB", "yes"],
        ["ErrorIn K.", "1.20 °C", "≤ 1.00 °C", "no"],
        ["Volume", "0.1 m³"],
        ["Train", "30.0 s", ""],
        ["all together", "40.0 s", ""],
    ):
        assert row in outline.rows
    assert re.findall(r"width: ([\d.]+)%\"", text) == ["75.0", "25.0"]
    assert "width: 0.0%" in build_page(replace(page, seconds=(("Train", 0.0),)))
    words = outline.words
    assert "ns-train thermoxels" in words and "ns-eval --load-config 'a b'" in words
    assert words.index("Look at it:") < words.index("ns-viewer --load-config x")


def test_every_picture_is_embedded_in_the_order_of_its_place(page: DemoPage) -> None:
    images = Outline(build_page(page)).images
    contents = [base64.b64decode(str(image["src"]).split("base64,")[1]) for image in images]
    expected = [one.image for one in page.at_a_glance]
    expected += [image for pair in page.training_pairs for image in pair]
    for seen in page.views:
        expected += [seen.measured_rgb, seen.rendered_rgb, seen.measured_thermal, seen.rendered_thermal]
    expected += [one.image for one in page.mesh_pictures]
    assert contents == expected and all(image["alt"] for image in images)


def test_nothing_is_fetched_and_words_stay_words(page: DemoPage) -> None:
    text = build_page(page)
    assert text == build_page(replace(page))
    assert all(a.startswith("data:") or a == "export/mesh.vtu" for a in Outline(text).addresses)
    assert not re.search(r"<script|https?:|@import|url\(|\bon\w+=", text)
    changed = replace(
        page,
        title=HOSTILE,
        summary=HOSTILE,
        at_a_glance=(replace(page.at_a_glance[0], caption=HOSTILE),),
        checks=(Check(HOSTILE, HOSTILE, HOSTILE, True, HOSTILE),),
        more_figures=Table(("", ""), ((HOSTILE, HOSTILE),)),
        views=(replace(page.views[0], name=HOSTILE),),
        mesh_pictures=(replace(page.mesh_pictures[0], caption=HOSTILE),),
        next_steps=((HOSTILE, HOSTILE),),
        seconds=((HOSTILE, 1.0),),
        commands=(HOSTILE,),
        files=((HOSTILE, HOSTILE),),
        colour_bar=ColourBar((HOSTILE, "red"), 0.0, 1.0),
    )
    text = build_page(changed)
    assert "<script" not in text
    # Title, heading, summary, glance, check (4), figures (2), view, caption, step, command, next (2), file (2); colours
    # are no words.
    assert "".join(Outline(text).words).count(HOSTILE) == 18
