import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from thermoxels_ns.capture.folder_scan import identify
from thermoxels_ns.core.errors import ThermalFileError
from thermoxels_ns.radiometry.thermal_pixels import ThermalUnit, find_dead_pixels, read_thermal_file
from thermoxels_ns.radiometry.thermogram import read_thermogram

BOUNDS = ThermalUnit.bounds(-10.0, 40.0)
COUNTS = ThermalUnit.linear(0.025, -100.0)
CELSIUS = ThermalUnit()


def save(path: Path, pixels: np.ndarray) -> Path:
    Image.fromarray(pixels).save(path)
    return path


@pytest.mark.parametrize("kind", [np.uint16, np.uint8])
def test_bounds_keep_every_step_of_eight_and_sixteen_bits(tmp_path, kind):
    counts = np.arange(np.iinfo(kind).max + 1, dtype=kind).reshape(16, -1)
    got = read_thermal_file(save(tmp_path / "a.png", counts), BOUNDS)
    assert got.dtype == np.float32
    np.testing.assert_allclose(got, -10.0 + counts / counts.max() * 50.0, atol=4e-6)
    assert len(np.unique(got)) == counts.size


def test_equal_channels_count_as_grey_and_keep_sixteen_bits(tmp_path):
    counts = np.array([[0, 1, 65535], [40000, 40001, 3]], np.uint16)
    for name in ("deep.png", "deep.tiff"):
        assert cv2.imwrite(str(tmp_path / name), np.repeat(counts[..., None], 3, axis=2))
        unsaturated = read_thermal_file(tmp_path / name, COUNTS)[1]
        np.testing.assert_allclose(unsaturated, 0.025 * counts[1] - 100.0, atol=4e-5)
    spanned = read_thermal_file(tmp_path / "deep.png", BOUNDS)
    np.testing.assert_allclose(spanned, -10 + counts / 65535.0 * 50, atol=4e-6)
    eight = np.array([[1, 2], [3, 255]], np.uint8)
    path = save(tmp_path / "grey.png", np.repeat(eight[..., None], 3, axis=2))
    np.testing.assert_allclose(read_thermal_file(path, BOUNDS), -10 + eight / 255.0 * 50, atol=4e-6)


def test_transparent_pixels_are_no_data(tmp_path):
    pixels = np.full((2, 2, 4), 200, np.uint8)
    pixels[0, 1, 3] = 0
    read = read_thermal_file(save(tmp_path / "a.png", pixels), BOUNDS)
    assert np.isnan(read[0, 1]) and np.isfinite(read).sum() == 3


def test_counts_with_linear_unit_and_saturation(tmp_path):
    counts = np.array([[0, 4000, 65535], [4800, 4801, 4840]], np.uint16)
    read = read_thermal_file(save(tmp_path / "a.tiff", counts), COUNTS)
    expected = np.array([[np.nan, 0.0, np.nan], [20.0, 20.025, 21.0]])
    np.testing.assert_allclose(read, expected, atol=2e-6)


def test_float_tiff_is_celsius_unless_linear(tmp_path):
    values = np.array([[1.25, np.nan], [np.inf, 3000.0]], np.float32)
    path = save(tmp_path / "a.tif", values)
    read = read_thermal_file(path, CELSIUS)
    np.testing.assert_array_equal(read, np.array([[1.25, np.nan], [np.nan, np.nan]], np.float32))
    np.testing.assert_array_equal(read_thermal_file(path, BOUNDS), read)
    kelvin = save(tmp_path / "k.tif", np.full((2, 2), 293.15, np.float32))
    assert read_thermal_file(kelvin, ThermalUnit.linear(1.0, -273.15)) == pytest.approx(20.0, abs=1e-4)


def test_npy_and_csv_are_celsius(tmp_path):
    values = np.array([[20.5, -3.25], [np.nan, 7.0]])
    np.save(tmp_path / "a.npy", values)
    (tmp_path / "comma.csv").write_text("20.5,-3.25,\n,7.0\n".replace(",\n,", "\nNaN,"))
    (tmp_path / "semicolon.csv").write_text("20,5;-3,25;\n-;7\n", encoding="utf-8-sig")
    for name in ("a.npy", "comma.csv", "semicolon.csv"):
        got = read_thermal_file(tmp_path / name, BOUNDS)
        np.testing.assert_array_equal(got, values.astype(np.float32))


def test_counts_without_unit_wrong_shapes_unknown_suffixes_and_pages_are_refused(tmp_path):
    save(tmp_path / "a.png", np.ones((3, 3), np.uint16))
    (tmp_path / "a.seq").write_bytes(b"x")
    page = Image.fromarray(np.ones((3, 3), np.uint16))
    page.save(tmp_path / "two.tiff", save_all=True, append_images=[page])
    np.save(tmp_path / "row.npy", np.ones(4))
    np.save(tmp_path / "none.npy", np.ones((0, 3)))
    for name, unit, said in (
        ("a.png", CELSIUS, r"a\.png.*temperature_bounds\.json"),
        ("a.seq", CELSIUS, r"\.npy"),
        ("two.tiff", COUNTS, "2 pages"),
        *((name, CELSIUS, "height, width") for name in ("row.npy", "none.npy")),
    ):
        with pytest.raises(ThermalFileError, match=said):
            read_thermal_file(tmp_path / name, unit)


def test_quiet_background_is_not_dead():
    """Noise-free scene: a third of the image always shows the same sky, an object moves below it."""
    stack = np.full((8, 30, 30), -20.0, np.float32)
    for number in range(8):
        stack[number, 8:] = 20.0 + np.arange(30) + number
    assert not find_dead_pixels(stack).any()
    assert not find_dead_pixels(np.full((8, 5, 5), 20.0, np.float32)).any()
    few = np.random.default_rng(1).normal(20, 1, (4, 20, 30)).astype(np.float32)  # too few to tell
    few[:, :, 7] = 21.5
    assert not find_dead_pixels(few).any()


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("kind", ["<f4", "<f8", ">f4", ">f8"])
def test_a_tiff_of_floating_point_numbers_is_celsius(tmp_path, kind, packed):
    values, path = np.array([[1.25, -3.5, 20.0], [np.nan, 7.0, 8.0]]), tmp_path / "a.tiff"
    strip, order = (zlib.compress if packed else bytes)(values.astype(kind).tobytes()), kind[0]
    tags = {256: 3, 257: 2, 258: 8 * int(kind[2]), 259: 8 if packed else 1, 262: 1, 273: 134, 277: 1, 278: 2, 339: 3}
    tags = dict(sorted((tags | {279: len(strip)}).items()))  # the strip begins behind 8 + 2 + 12 * 10 + 4 bytes
    entries = b"".join(struct.pack(f"{order}HHII", tag, 4, 1, value) for tag, value in tags.items())
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(f"{order}IH", 8, len(tags))
    path.write_bytes(head + entries + bytes(4) + strip)
    for got in (read_thermal_file(path, BOUNDS), read_thermogram(path).temperature_c):
        np.testing.assert_array_equal(got, values.astype(np.float32))
    assert identify(path, tmp_path).role == "thermal"


@pytest.mark.parametrize(
    ("name", "pixels", "named"),
    [
        ("a.tiff", np.full((3, 3), 9, np.int32), "give in transforms.json .*thermal_unit"),
        ("a.tiff", np.full((3, 3), 9, np.uint16), "give in transforms.json .*thermal_unit"),
        ("a.png", np.full((3, 3), 65535, np.uint16), "65535"),
        ("a.png", np.full((3, 3), 255, np.uint8), "255"),
    ],
)
def test_counts_that_bounds_do_not_explain_are_refused(tmp_path, name, pixels, named):
    with pytest.raises(ThermalFileError, match=rf"{name}: .*{named}"):
        read_thermal_file(save(tmp_path / name, pixels), BOUNDS)


def test_a_damaged_header_of_an_array_is_not_quoted(tmp_path):
    np.save(tmp_path / "a.npy", np.ones((3, 3)))
    whole = (tmp_path / "a.npy").read_bytes()
    (tmp_path / "a.npy").write_bytes(whole.replace(b"descr", b"d\n\xffcr"))
    for read in (lambda path: read_thermal_file(path, CELSIUS), read_thermogram):
        with pytest.raises(ThermalFileError, match=r"a\.npy: ") as caught:
            read(tmp_path / "a.npy")
        assert "fortran_order" not in str(caught.value)
