"""The frame of the html pages: complete in one file, closed, and fit for narrow screens and paper."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from io import BytesIO

import pytest
from PIL import Image

from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.reports.page_style import embedded_image, html_page, scrolling


def luminance(colour: str) -> float:
    """Relative luminance of #rrggbb, 0 to 1, as WCAG 2 defines it."""
    shares = [int(colour[n : n + 2], 16) / 255 for n in (1, 3, 5)]
    linear = [share / 12.92 if share <= 0.03928 else ((share + 0.055) / 1.055) ** 2.4 for share in shares]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


class Tags(HTMLParser):
    """Fails where a tag is not closed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        if tag not in {"meta", "img"}:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_a_page_is_whole_and_fetches_nothing() -> None:
    page = html_page("A <title> & more", "<p>Words</p>", ".mine { color: red; }")
    assert page.startswith("<!doctype html>") and Tags(page).open == []
    assert "<title>A &lt;title&gt; &amp; more</title>" in page and "<p>Words</p>" in page
    assert not re.search(r"<script|https?:|@import|url\(|<link|\bon\w+=", page)
    assert page == html_page("A <title> & more", "<p>Words</p>", ".mine { color: red; }")


def test_rules_of_one_page_do_not_win_over_those_for_phones_and_paper() -> None:
    page = html_page("x", "", ".mine { color: red; }")
    assert page.index(".scroll") < page.index(".mine") < page.index("max-width: 640px") < page.index("@media print")
    assert page.count("{") == page.count("}")
    assert 'name="viewport" content="width=device-width' in page


def test_text_is_dark_on_white() -> None:
    """A contrast of 4.5 : 1 at least is what WCAG 2 asks of text."""
    page = html_page("x", "")
    assert "background: #fff;" in page
    for name in ("ink", "soft", "accent"):
        colour = re.search(rf"--{name}: (#[0-9a-f]{{6}})", page)
        assert colour is not None
        assert 1.05 / (luminance(colour[1]) + 0.05) > 4.5, name


def test_wide_tables_scroll_on_screens_and_are_whole_on_paper() -> None:
    page = html_page("x", scrolling("<table><tbody></tbody></table>"))
    screen, paper = page.split("@media print")
    assert "<div class=scroll><table>" in paper
    assert re.search(r"\.scroll \{[^}]*overflow-x: auto", screen) and ".scroll { overflow: visible; }" in paper


@pytest.mark.parametrize("kind", ["PNG", "JPEG"])
def test_a_picture_is_in_the_page(kind: str) -> None:
    stream = BytesIO()
    Image.new("RGB", (2, 2), "red").save(stream, format=kind)
    image = embedded_image(stream.getvalue(), 'a "red" & <small> one')
    assert image.startswith(f'<img src="data:image/{kind.lower()};base64,')
    assert 'alt="a &quot;red&quot; &amp; &lt;small&gt; one"' in image


def test_what_is_no_picture_is_refused() -> None:
    with pytest.raises(ThermoxelsError, match=r"the roof: expected the content of a PNG or JPEG file, got 6 bytes"):
        embedded_image(b"GIF89a", "the roof")
