import struct

import pytest

from tests.support.camera_card import photograph
from thermoxels_ns.capture.photograph import read_photograph_facts


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


@pytest.mark.parametrize("form", ['drone-dji:GimbalPitchDegree="-30.5"', "<drone-dji:GimbalPitchDegree>-30.5</x>"])
def test_gimbal_angles_of_xmp(tmp_path, form):
    path = photograph(tmp_path / "a.jpg")
    content = path.read_bytes()
    xmp = f'http://ns.adobe.com/xap/1.0/\0<x:xmpmeta {form} drone-dji:GimbalRollDegree="+1.5"/>'.encode()
    path.write_bytes(content[:2] + b"\xff\xe1" + struct.pack(">H", len(xmp) + 2) + xmp + content[2:])
    assert read_photograph_facts(path).gimbal_deg == (-30.5, 1.5)
