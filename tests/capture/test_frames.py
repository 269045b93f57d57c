import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.support.camera_card import FlirFile, counts, photograph, picture_bytes
from thermoxels_ns.capture.frames import read_frames
from thermoxels_ns.capture.pairs import Pair
from thermoxels_ns.capture.photograph import read_photograph_facts
from thermoxels_ns.capture.settings import CaptureSettings


def pair(folder: Path, name: str, temperature_c: np.ndarray | None = None, **exif) -> Pair:
    photograph(folder / f"{name}-visible.jpg", **exif)
    counts(folder / f"{name}-radiometric.tiff", temperature_c)
    return Pair(f"{name}-visible.jpg", f"{name}-radiometric.tiff", "equal names")


def read(pairs, tmp_path, skip_bad=False):
    work = tmp_path / "work"
    work.mkdir(exist_ok=True)
    return read_frames(pairs, tmp_path / "card", work, CaptureSettings(skip_bad=skip_bad))


def test_degrees_and_what_the_files_say(tmp_path):
    temperature_c = np.linspace(10, 30, 192).reshape(12, 16)
    one = pair(tmp_path / "card", "a", temperature_c, taken_at="2024:01:02 03:04:05", focal=(4.0, 100.0))
    frames = read([one], tmp_path)
    (frame,) = frames.frames
    assert np.load(frame.thermal) == pytest.approx(temperature_c, abs=0.013)
    assert (frame.focal_px, frame.camera) == (40.0, "Workswell WIRIS Pro")
    assert (frame.name, frame.thermal_source) == ("a-visible.jpg", "a-radiometric.tiff")
    assert (frames.photograph_size, frames.thermal_size) == ((32, 24), (16, 12))


def test_a_photograph_inside_a_flir_file_is_taken_out(tmp_path):
    pixels = np.full((24, 32, 3), (200, 30, 30), dtype=np.uint8)
    card = tmp_path / "card"
    card.mkdir()
    flir = FlirFile(np.full((12, 16), 14000, np.uint16), photograph=picture_bytes(pixels), alignment=(1.2, 3, -4))
    (card / "F.jpg").write_bytes(flir.jpeg())
    (frame,) = read([Pair("F.jpg", "F.jpg", "")], tmp_path).frames
    assert np.asarray(Image.open(frame.photograph)).mean(axis=(0, 1)) == pytest.approx((200, 30, 30), abs=3)
    assert (
        frame.metadata.picture_in_picture is not None
        and frame.metadata.picture_in_picture.real_to_thermal == pytest.approx(1.2)
    )
    assert not frame.photograph.is_relative_to(card)


def test_the_rest_goes_on_without_damaged_files(tmp_path):
    card = tmp_path / "card"
    pairs = {name: pair(card, name) for name in ("thermal", "photo")}
    for path in (card / pairs["thermal"].thermal, card / pairs["photo"].photograph):
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    frames = read([*pairs.values(), pair(card, "good")], tmp_path, skip_bad=True)
    assert [frame.name for frame in frames.frames] == ["good-visible.jpg"]
    assert set(frames.dropped) == {pair.photograph for pair in pairs.values()}
    assert all(name.split("-")[0] in why for name, why in frames.dropped.items())


def test_a_frame_of_another_thermal_camera_is_dropped_by_name(tmp_path):
    card = tmp_path / "card"
    pairs = [pair(card, "a"), pair(card, "b"), pair(card, "odd", np.full((6, 8), 20.0))]
    frames = read(pairs, tmp_path)
    assert [frame.name for frame in frames.frames] == ["a-visible.jpg", "b-visible.jpg"]
    assert "8 x 6 pixels, most have 16 x 12" in frames.dropped["odd-visible.jpg"]


def test_stuck_pixels_become_nan(tmp_path):
    rng = np.random.default_rng(0)
    pairs = []
    for number in range(6):
        temperature_c = rng.uniform(10, 30, (12, 16))
        temperature_c[5, 7] = 99.0
        pairs.append(pair(tmp_path / "card", f"p{number}", temperature_c))
    frames = read(pairs, tmp_path)
    assert frames.dead_pixels == 1
    for frame in frames.frames:
        missing = np.isnan(np.load(frame.thermal))
        assert missing[5, 7] and missing.sum() == 1 == frame.masked


@pytest.mark.parametrize(("fraction", "microsecond"), [("25", 250000), ("782/1000", 782000), ("x", 0), (None, 0)])
def test_time_with_its_fraction(tmp_path, fraction, microsecond):
    facts = read_photograph_facts(photograph(tmp_path / "a.jpg", taken_at="2024:10:30 10:50:43", fraction=fraction))
    assert (facts.taken_at.second, facts.taken_at.microsecond) == (43, microsecond)


@pytest.mark.parametrize("altitude_m", [12.5, -430.5])
def test_place_lens_and_orientation(tmp_path, altitude_m):
    path = photograph(tmp_path / "a.jpg", gps=(-33.5, 151.25, altitude_m), orientation=6, focal=(4.0, 100.0))
    facts = read_photograph_facts(path)
    assert (facts.gps.latitude_deg, facts.gps.longitude_deg) == pytest.approx((-33.5, 151.25), abs=1e-8)
    assert facts.gps.altitude_m == pytest.approx(altitude_m)
    assert facts.focal_px == pytest.approx(40.0)  # 4 mm at 10 pixels per mm
    assert facts.orientation == 6
    facts = read_photograph_facts(photograph(tmp_path / "b.jpg"))  # without tags
    assert (facts.taken_at, facts.gps, facts.focal_px, facts.gimbal_deg, facts.orientation) == (None,) * 4 + (1,)
    assert (facts.width, facts.height) == (32, 24)


@pytest.mark.parametrize("form", ['drone-dji:GimbalPitchDegree="-30.5"', "<drone-dji:GimbalPitchDegree>-30.5</x>"])
def test_gimbal_angles_of_xmp(tmp_path, form):
    path = photograph(tmp_path / "a.jpg")
    content = path.read_bytes()
    xmp = f'http://ns.adobe.com/xap/1.0/\0<x:xmpmeta {form} drone-dji:GimbalRollDegree="+1.5"/>'.encode()
    path.write_bytes(content[:2] + b"\xff\xe1" + struct.pack(">H", len(xmp) + 2) + xmp + content[2:])
    assert read_photograph_facts(path).gimbal_deg == (-30.5, 1.5)
