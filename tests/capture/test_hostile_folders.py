"""Folders as they are not meant to be: strange names, links, shut folders, pipes, and none that belongs together."""

import os
from pathlib import Path

import pytest

from tests.support.camera_card import counts, photograph, write_pairs
from thermoxels_ns.capture.folder_scan import scan_folder
from thermoxels_ns.capture.settings import CaptureSettings
from thermoxels_ns.commands.capture import capture_folder
from thermoxels_ns.core.errors import SceneError, ThermoxelsError, printable


def capture(card: Path, **more: object) -> None:
    capture_folder(card, card.parent / "scene", CaptureSettings(**more))  # type: ignore[arg-type]


def no_pairs_said(card: Path, **more: object) -> str:
    with pytest.raises(SceneError) as caught:
        capture(card, **more)
    return str(caught.value)


@pytest.mark.parametrize(
    ("photographs", "thermal", "said"),
    [
        ((), (), ("1 files of other kinds",)),
        (("a0", "a1", "a2"), (), ("3 photographs", "no partner")),
        (("a",), ("b",), ("1 photographs, 1 thermal images", "--clock-offset-s")),
    ],
)
def test_a_folder_without_pairs_says_what_is_in_it_and_what_helps(tmp_path, photographs, thermal, said):
    card = tmp_path / "card"
    card.mkdir()
    (card / "film.mp4").write_bytes(b"1")
    for name in photographs:
        photograph(card / f"{name}.jpg")
    for name in thermal:
        counts(card / f"{name}.tiff")
    message = no_pairs_said(card)
    assert all(words in message for words in said)


def test_links_that_lead_nowhere_in_circles_or_to_folders_and_pipes_are_passed_over(tmp_path):
    card, outside = tmp_path / "card", tmp_path / "outside"
    photograph(outside / "a-visible.jpg")
    counts(card / "a-radiometric.tiff")
    (card / "more").symlink_to(outside)
    (card / "gone.jpg").symlink_to("nowhere.jpg")
    (card / "loop.jpg").symlink_to("loop.jpg")
    os.mkfifo(card / "pipe.jpg")
    assert [file.path.name for file in scan_folder(card).files] == ["a-radiometric.tiff"]


@pytest.mark.parametrize("name", [b"two\nlines.jpg", b"caf\xe9.jpg", b"\x1b[31mred.jpg"])
def test_a_name_that_cannot_be_printed_is_refused_and_can_be_left_out(tmp_path, name):
    path = photograph(Path(os.fsdecode(os.fsencode(tmp_path / "card") + b"/" + name)))
    photograph(tmp_path / "card" / "ok.jpg")
    found = scan_folder(tmp_path / "card")
    assert "Rename the file" in found.unreadable[path]
    assert [file.path.name for file in found.files] == ["ok.jpg"]
    for text in (printable(path.name), found.unreadable[path], no_pairs_said(tmp_path / "card", skip_bad=True)):
        assert text.isprintable() and text.encode("utf-8")


def test_an_input_inside_the_output_is_not_touched(tmp_path):
    """The images of an earlier capture are replaced by the next one: they are no input for it."""
    scene = tmp_path / "scene"
    (scene / ".capture").mkdir(parents=True)
    kept = photograph(scene / "images" / "a-visible.jpg")
    counts(scene / "images" / "a-radiometric.tiff")
    for source in (scene / "images", scene):
        with pytest.raises(SceneError, match="output: expected another folder"):
            capture_folder(source, scene, CaptureSettings())
    assert kept.is_file()


def test_what_colmap_cannot_open_says_how_to_begin_anew(tmp_path):
    write_pairs(tmp_path / "card")
    with pytest.raises(SceneError):  # grey photographs have no features; what is left is that of an interrupted stage
        capture(tmp_path / "card")
    (tmp_path / "scene" / ".capture" / "poses" / "features.db").write_bytes(b"no database" * 500)
    with pytest.raises(ThermoxelsError, match="--from-stage poses"):
        capture(tmp_path / "card")
    with pytest.raises(SceneError, match="photographs that fit together"):
        capture(tmp_path / "card", from_stage="poses")
