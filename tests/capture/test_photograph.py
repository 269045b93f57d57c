"""What photographs say of themselves: time, place, lens and level; and damaged ones."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest

from tests.support.camera_card import photograph
from thermoxels_ns.capture.photograph import open_photograph, read_photograph_facts
from thermoxels_ns.core.errors import SceneError


@pytest.mark.parametrize(("fraction", "microsecond"), [("25", 250000), ("782/1000", 782000), ("x", 0), (None, 0)])
def test_time_with_its_fraction(tmp_path, fraction, microsecond):
    facts = read_photograph_facts(photograph(tmp_path / "a.jpg", taken_at="2024:10:30 10:50:43", fraction=fraction))
    assert facts.taken_at is not None
    assert (facts.taken_at.second, facts.taken_at.microsecond) == (43, microsecond)


@pytest.mark.parametrize("altitude_m", [12.5, -430.5])
def test_place_lens_and_orientation(tmp_path, altitude_m):
    path = photograph(tmp_path / "a.jpg", gps=(-33.5, 151.25, altitude_m), orientation=6, focal=(4.0, 100.0))
    facts = read_photograph_facts(path)
    assert facts.gps is not None
    assert (facts.gps.latitude_deg, facts.gps.longitude_deg) == pytest.approx((-33.5, 151.25), abs=1e-8)
    assert facts.gps.altitude_m == pytest.approx(altitude_m)
    assert facts.focal_px == pytest.approx(40.0)  # 4 mm at 10 pixels per mm
    assert facts.orientation == 6


def test_a_photograph_without_tags_says_nothing(tmp_path):
    facts = read_photograph_facts(photograph(tmp_path / "a.jpg"))
    assert (facts.taken_at, facts.gps, facts.focal_px, facts.gimbal_deg, facts.orientation) == (None,) * 4 + (1,)
    assert (facts.width, facts.height) == (32, 24)


def test_a_position_of_zero_is_none(tmp_path):
    assert read_photograph_facts(photograph(tmp_path / "a.jpg", gps=(0.0, 0.0, 0.0))).gps is None


def test_a_focal_length_that_no_lens_has_is_not_believed(tmp_path):
    assert read_photograph_facts(photograph(tmp_path / "a.jpg", focal=(4.0, 1e6))).focal_px is None


@pytest.mark.parametrize("form", ['drone-dji:GimbalPitchDegree="-30.5"', "<drone-dji:GimbalPitchDegree>-30.5</x>"])
def test_gimbal_angles_of_xmp(tmp_path, form):
    path = photograph(tmp_path / "a.jpg")
    content = path.read_bytes()
    xmp = f'http://ns.adobe.com/xap/1.0/\0<x:xmpmeta {form} drone-dji:GimbalRollDegree="+1.5"/>'.encode()
    path.write_bytes(content[:2] + b"\xff\xe1" + struct.pack(">H", len(xmp) + 2) + xmp + content[2:])
    assert read_photograph_facts(path).gimbal_deg == (-30.5, 1.5)


def test_a_photograph_that_is_cut_off_is_named(tmp_path):
    rng = np.random.default_rng(0)
    path = photograph(tmp_path / "cut.jpg", rng.integers(0, 255, (200, 200, 3), dtype=np.uint8))
    path.write_bytes(path.read_bytes()[:5000])
    read_photograph_facts(path)  # its header is whole
    with pytest.raises(SceneError, match=r"cut\.jpg"):
        open_photograph(path)


def test_an_absurd_header_is_refused_before_anything_is_allocated(tmp_path):
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", 30000, 30000, 8, 2, 0, 0, 0)
    path = tmp_path / "wide.png"
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", b"") + chunk(b"IEND", b""))
    for read in (read_photograph_facts, open_photograph):
        with pytest.raises(SceneError, match=r"wide\.png"):
            read(path)
