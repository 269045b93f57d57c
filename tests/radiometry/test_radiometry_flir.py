"""FLIR R-JPEG: what is read is what is in the file, checked by an independent computation."""

import math
import re
import struct
from datetime import datetime, timezone
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.support.camera_card import FlirFile, picture_bytes, smooth_counts
from thermoxels_ns.core.errors import ThermalFileError
from thermoxels_ns.radiometry.flir_rjpeg import read_flir_jpeg
from thermoxels_ns.radiometry.measurement_model import RadiometryOptions
from thermoxels_ns.radiometry.thermal_pixels import ThermalUnit, read_thermal_file
from thermoxels_ns.radiometry.thermogram import read_thermogram

REAL_SHAPES = {
    "flir_b60_cc0.jpg": (180, 180),
    "flir_e60_cc0.jpg": (240, 320),
    "flir_i7_cc0.jpg": (120, 120),
    "flir_infracam_cc0.jpg": (120, 120),
    "flir_sc640_cc0.jpg": (240, 320),
    "flir_t640_mit.jpg": (480, 640),
}


def write(folder: Path, file: FlirFile, name: str = "FLIR0001.jpg") -> Path:
    path = folder / name
    path.write_bytes(file.jpeg())
    return path


@pytest.mark.parametrize("storage", ["raw", "png", "swapped"])
@pytest.mark.parametrize("order", ["<", ">"])
def test_counts_survive_every_storage_and_byte_order(tmp_path, storage, order):
    counts = smooth_counts()
    flir = read_flir_jpeg(write(tmp_path, FlirFile(counts, order=order, storage=storage)))
    np.testing.assert_array_equal(flir.counts, counts)
    assert flir.camera.planck.b == 1400.0 and flir.camera.planck.o == -6000.0
    assert flir.camera.conditions.emissivity == pytest.approx(0.95, abs=1e-7)


def test_temperatures_are_those_of_the_formula(tmp_path):
    file = FlirFile(smooth_counts())
    file.settings |= {"distance": 3.0, "emissivity": 0.9, "reflected": 280.0}
    got = read_thermogram(write(tmp_path, file))
    np.testing.assert_allclose(got.temperature_c, independent(file.jpeg())[1], atol=1e-4)
    assert got.temperature_c.dtype == np.float32 and np.isfinite(got.temperature_c).all()


def test_overrides_replace_the_cameras_settings(tmp_path):
    file = FlirFile(smooth_counts())
    path = write(tmp_path, file)
    apparent = read_thermogram(path, RadiometryOptions(emissivity=1.0, distance_m=0.0))
    file.settings |= {"emissivity": 1.0, "distance": 0.0}
    np.testing.assert_allclose(apparent.temperature_c, independent(file.jpeg())[1], atol=1e-4)
    as_stored, other = read_thermogram(path), read_thermogram(path, RadiometryOptions(emissivity=0.7))
    assert other.metadata.conditions.emissivity == 0.7
    assert other.metadata.conditions.air_c == as_stored.metadata.conditions.air_c
    assert np.abs(other.temperature_c - as_stored.temperature_c).max() > 0.1


def test_what_the_file_says_of_the_camera(tmp_path):
    photograph = picture_bytes(np.full((20, 30, 3), 7, np.uint8))
    file = FlirFile(smooth_counts(), photograph=photograph, alignment=(3.5, -144, -27))
    flir = read_flir_jpeg(write(tmp_path, file))
    assert flir.visible == photograph
    metadata = read_thermogram(tmp_path / "FLIR0001.jpg").metadata
    assert (metadata.format, metadata.camera) == ("FLIR R-JPEG", "FLIR T999")
    assert flir.camera.taken_at == datetime(2020, 9, 13, 12, 26, 40, 250000, timezone.utc)
    assert flir.camera.taken_at.utcoffset().total_seconds() == 7200
    assert metadata.field_of_view_deg == 24.5
    alignment = metadata.picture_in_picture
    assert (alignment.real_to_thermal, alignment.offset_x, alignment.offset_y) == (3.5, -144, -27)


def test_what_the_camera_does_not_say_is_none_and_humidity_in_percent_is_a_share(tmp_path):
    flir = read_flir_jpeg(write(tmp_path, FlirFile(smooth_counts(), seconds=0, humidity=40.0)))
    assert flir.visible is None and flir.picture_in_picture is None and flir.camera.taken_at is None
    assert flir.camera.conditions.relative_humidity == pytest.approx(0.4, abs=1e-7)


def test_counts_beyond_the_calibration_are_no_temperatures(tmp_path):
    counts = smooth_counts()
    counts[0, :3] = [11000, 11999, 16001]
    got = read_thermogram(write(tmp_path, FlirFile(counts, raw_range=(12000, 16000))))
    assert np.isnan(got.temperature_c[0, :3]).all() and np.isnan(got.temperature_c).sum() == 3
    assert np.isfinite(got.temperature_c).sum() == counts.size - 3


@pytest.mark.parametrize("name", ["thermal.jpg", "thermal.tiff"])
def test_training_reads_the_same_degrees_whatever_the_unit(tmp_path, name):
    path = write(tmp_path, FlirFile(smooth_counts()), name)
    expected = read_thermogram(path).temperature_c
    for unit in (ThermalUnit(), ThermalUnit.bounds(0.0, 1.0), ThermalUnit.linear(0.1, 0.0)):
        np.testing.assert_array_equal(read_thermal_file(path, unit), expected)


def test_many_segments_are_joined_and_a_missing_one_or_a_file_cut_off_is_refused_by_name(tmp_path):
    file = FlirFile(smooth_counts(120, 90), segment_bytes=1000)
    content, path = file.jpeg(), tmp_path / "cut.jpg"
    assert len(re.findall(rb"\xff\xe1..FLIR\x00\x01..", content, re.DOTALL)) > 15
    np.testing.assert_array_equal(read_flir_jpeg(write(tmp_path, file)).counts, file.counts)
    for share in (0.02, 0.1, 0.3, 0.5, 0.8, 0.99, 1.0):
        path.write_bytes(content[: int(share * len(content)) - 2])  # at the end: without the end of the picture
        with pytest.raises(ThermalFileError, match=r"cut\.jpg: expected "):
            read_thermogram(path)
    start = content.index(b"FLIR\0\1\1") - 4
    length = 2 + int.from_bytes(content[start + 2 : start + 4], "big")
    path.write_bytes(content[:start] + content[start + length :])
    with pytest.raises(ThermalFileError, match=r"cut\.jpg.*missing: \[1\]"):
        read_thermogram(path)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"size": (30000, 30)}, "30000 x 30"),
        ({"size": (0, 30)}, "0 x 30"),
        ({"size": (8000, 8000), "storage": "png"}, ""),
        ({"size": (41, 30)}, ""),
        ({"size": (30, 40), "storage": "png"}, "PNG of"),
        ({"planck": {"r1": 0.0, "b": 1400.0, "f": 1.0, "r2": 0.01, "o": -6000}}, "Planck constant R1"),
        ({"settings": {"e": 0.0, "d": 1.0, "r": 293.0, "a": 293.0, "w": 293.0, "p": 1.0}}, "emissivity"),
    ],
)
def test_records_that_cannot_be_are_refused(tmp_path, change, said):
    with pytest.raises(ThermalFileError, match=f"FLIR0001.*{said}"):
        read_thermogram(write(tmp_path, FlirFile(smooth_counts(), **change)))


def test_a_camera_without_air_temperature_is_read_where_none_is_needed(tmp_path):
    settings = {"e": 1.0, "d": 0.0, "r": 0.0, "a": 0.0, "w": 0.0, "p": 1.0}
    got = read_thermogram(write(tmp_path, FlirFile(smooth_counts(), settings=settings)))
    assert got.metadata.conditions.air_c is None and got.metadata.conditions.reflected_c is None
    with pytest.raises(ThermalFileError, match="air_c: expected a temperature, because a distance of 2 m needs one"):
        read_thermogram(write(tmp_path, FlirFile(smooth_counts(), settings={**settings, "d": 2.0})))


@pytest.mark.parametrize("lost", [0x01, 0x20])
def test_a_file_without_counts_or_calibration_is_refused(tmp_path, lost):
    content = FlirFile(smooth_counts()).jpeg()
    entry = struct.pack(">HHII", lost, 1, 100, 1)
    assert content.count(entry) == 1
    (tmp_path / "a.jpg").write_bytes(content.replace(entry, struct.pack(">HHII", 0x7F, 1, 100, 1)))
    with pytest.raises(ThermalFileError, match="no record with"):
        read_thermogram(tmp_path / "a.jpg")


def independent(content: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Counts and degrees of an R-JPEG from its bytes: records are found by what they must hold, not by a directory."""
    fff, at = b"", 0
    while found := re.compile(rb"\xff\xe1(..)FLIR\x00\x01(..)", re.DOTALL).search(content, at):
        length = int.from_bytes(found[1], "big")
        fff += content[found.end() : found.start() + 2 + length]
        at = found.start() + 2 + length
        if found[2][0] == found[2][1]:
            break
    info = fff.index(struct.pack("<f", 0.01262)) - 0x74
    get = lambda offset, code="f": struct.unpack_from("<" + code, fff, info + offset)[0]  # noqa: E731
    width, height = get(2, "H"), get(4, "H")
    png = fff.find(b"\x89PNG")
    if png >= 0:
        counts = cv2.imdecode(np.frombuffer(fff[png:], np.uint8), cv2.IMREAD_UNCHANGED).byteswap()
    else:
        heads = [m.start() for m in re.finditer(re.escape(struct.pack("<HHH", 2, width, height)), fff)]
        (raw,) = [head for head in heads if head != info]
        counts = np.frombuffer(fff, "<u2", width * height, raw + 32).reshape(height, width)
    emissivity, distance, reflected_k, air_k = (get(offset) for offset in (0x20, 0x24, 0x28, 0x2C))
    t = air_k - 273.15
    water = math.sqrt(get(0x3C) * math.exp(1.5587 + 6.939e-2 * t - 2.7816e-4 * t**2 + 6.8455e-7 * t**3))
    x, root = get(0x80), math.sqrt(distance)
    tau = x * math.exp(-root * (get(0x70) + get(0x78) * water))
    tau += (1 - x) * math.exp(-root * (get(0x74) + get(0x7C) * water))
    r1, b, f, o, r2 = get(0x58), get(0x5C), get(0x60), get(0x308, "i"), get(0x30C)
    black = lambda kelvin: r1 / r2 / (math.exp(b / kelvin) - f)  # noqa: E731
    radiance = counts.astype(float) + o  # what is above the offset, so that the offset need not be taken along
    own = (radiance - (1 - emissivity) * tau * black(reflected_k) - (1 - tau) * black(air_k)) / (emissivity * tau)
    celsius = b / np.log(r1 / (r2 * own) + f) - 273.15
    low, high = get(0x310, "H"), get(0x312, "H")
    celsius[(counts < low) | (counts > high)] = np.nan
    return counts, celsius


@pytest.mark.real_data
@pytest.mark.parametrize("name", REAL_SHAPES)
def test_real_cameras_agree_with_an_independent_computation(shared_data, name):
    path = shared_data / "radiometric" / name
    counts, celsius = independent(path.read_bytes())
    got = read_thermogram(path)
    assert got.temperature_c.shape == REAL_SHAPES[name] == counts.shape
    np.testing.assert_array_equal(np.isnan(got.temperature_c), np.isnan(celsius))
    np.testing.assert_allclose(got.temperature_c, celsius, atol=1e-4)
    for statistic in (np.nanmin, np.nanmean, np.nanmax):
        assert float(statistic(got.temperature_c.astype(float))) == pytest.approx(float(statistic(celsius)), abs=1e-4)
    assert np.nanmin(celsius) > -65.0 and np.nanmax(celsius) < 130.0  # a cloudy sky, a hot contactor
    assert np.nanpercentile(np.abs(np.diff(celsius, axis=1)), 50) < 1.0  # a wrong byte order would be noise


@pytest.mark.real_data
def test_real_pairs_have_their_photograph(shared_data):
    flir = read_flir_jpeg(shared_data / "radiometric" / "flir_t640_mit.jpg")
    assert cv2.imdecode(np.frombuffer(flir.visible, np.uint8), cv2.IMREAD_COLOR).shape == (1944, 2592, 3)
    assert flir.picture_in_picture.real_to_thermal == pytest.approx(3.496, abs=1e-3)
    assert flir.camera.taken_at == datetime(2020, 11, 10, 10, 39, 48, 232000, timezone.utc)
