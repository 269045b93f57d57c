import io
import struct
import warnings
import zlib
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.support.camera_card import FlirFile, counts, dji_jpeg, photograph, picture_bytes, segment, smooth_counts
from thermoxels_ns.capture.folder_scan import identify
from thermoxels_ns.capture.photograph import open_photograph, read_photograph_facts
from thermoxels_ns.core.errors import SceneError, ThermalFileError, ThermoxelsError
from thermoxels_ns.radiometry.decoders import LARGEST_SIDE
from thermoxels_ns.radiometry.measurement_model import Conditions, RadiometryOptions, corrected_temperature_c
from thermoxels_ns.radiometry.thermal_pixels import ThermalUnit, read_thermal_file
from thermoxels_ns.radiometry.thermogram import COUNT_SCALES, read_thermogram, recognised_camera

WALL_C = np.array([[18.25, 19.5, 20.75], [21.0, 22.25, 23.5]])


def save_tiff(path: Path, pixels: np.ndarray, make: str = "", model: str = "") -> Path:
    exif = Image.Exif()
    exif[271], exif[272], exif[36867], exif[50735] = make, model, "2024:10:30 10:50:42", "77"
    Image.fromarray(pixels).save(path, "TIFF", exif=exif)
    return path


def counts_of(celsius: np.ndarray, per_count: float, offset: float) -> np.ndarray:
    return np.rint((celsius - offset) / per_count).astype(np.uint16)


@pytest.mark.parametrize(
    ("camera", "count", "celsius"),
    [
        ("workswell", 4800, 20.0),
        ("flir-high-gain", 7500, 26.85),
        ("flir-low-gain", 750, 26.85),
        ("flir-duo", 29315, 20.0),
        ("sensefly", 12000, 20.0),
    ],
)
def test_presets_by_hand(tmp_path, camera, count, celsius):
    path = save_tiff(tmp_path / "a.tiff", np.full((2, 3), count, np.uint16))
    got = read_thermogram(path, RadiometryOptions(camera=camera))
    np.testing.assert_allclose(got.temperature_c, celsius, atol=1e-5)
    assert got.metadata.celsius_per_count == COUNT_SCALES[camera][0].scale


def test_a_camera_that_the_file_names_needs_no_preset_but_the_users_word_comes_first(tmp_path):
    path = save_tiff(tmp_path / "a.tiff", counts_of(WALL_C, 0.025, -100.0), "Workswell", "WIRIS Pro")
    got = read_thermogram(path)
    np.testing.assert_allclose(got.temperature_c, WALL_C, atol=1e-5)
    assert got.metadata.camera == "Workswell WIRIS Pro"
    path = save_tiff(tmp_path / "b.tiff", counts_of(WALL_C, 0.04, -273.15), "Workswell", "WIRIS Pro")
    for options in ({"camera": "flir-high-gain"}, {"celsius_per_count": 0.04, "celsius_offset": -273.15}):
        got = read_thermogram(path, RadiometryOptions(**options))
        np.testing.assert_allclose(got.temperature_c, WALL_C, atol=0.021)


def test_counts_of_an_unknown_camera_are_refused_with_the_choices(tmp_path):
    path = save_tiff(tmp_path / "a.tiff", counts_of(WALL_C, 0.04, -273.15), "FLIR", "Duo Pro R")
    with pytest.raises(ThermalFileError, match=r"counts of FLIR Duo Pro R.*flir-high-gain.*--celsius-per-count"):
        read_thermogram(path)
    assert recognised_camera(None) is None and recognised_camera("Workswell WIRIS") is None


def test_whole_numbers_in_an_array_need_a_unit(tmp_path):
    np.save(tmp_path / "a.npy", counts_of(WALL_C, 0.01, -273.15))
    with pytest.raises(ThermalFileError, match="uint16 counts of a NPY and no unit"):
        read_thermogram(tmp_path / "a.npy")
    got = read_thermogram(tmp_path / "a.npy", RadiometryOptions(camera="flir-duo"))
    np.testing.assert_allclose(got.temperature_c, WALL_C, atol=1e-5)


def test_content_decides_and_not_the_name(tmp_path):
    np.save(tmp_path / "a.npy", WALL_C)
    np.savetxt(tmp_path / "a.csv", WALL_C, delimiter=";", fmt="%.2f")
    save_tiff(tmp_path / "a.tiff", WALL_C.astype(np.float32))
    Image.fromarray(counts_of(WALL_C, 0.01, -100.0)).save(tmp_path / "a.png")
    for name, wrong, camera in (
        *(("a.npy", "b.jpg", None), ("a.csv", "c.tiff", None)),
        *(("a.tiff", "d.csv", None), ("a.png", "e.npy", "sensefly")),
    ):
        (tmp_path / name).rename(tmp_path / wrong)
        got = read_thermogram(tmp_path / wrong, RadiometryOptions(camera=camera))
        assert got.metadata.format == name[2:].upper() and got.temperature_c.dtype == np.float32
        np.testing.assert_allclose(got.temperature_c, WALL_C, atol=1e-5)


def test_stored_temperatures_are_corrected_by_the_model(tmp_path):
    np.save(tmp_path / "a.npy", WALL_C)
    options = RadiometryOptions(emissivity=0.9, reflected_c=10.0, distance_m=5.0, air_c=12.0)
    got = read_thermogram(tmp_path / "a.npy", options)
    after = Conditions(emissivity=0.9, reflected_c=10.0, distance_m=5.0, air_c=12.0)
    np.testing.assert_allclose(got.temperature_c, corrected_temperature_c(WALL_C, after), atol=1e-5)
    assert (got.temperature_c > WALL_C).all()  # warmer than the surroundings it mirrors
    assert got.metadata.conditions == after


def test_pixels_that_cannot_be_under_the_settings_are_masked_and_counted(tmp_path):
    np.save(tmp_path / "a.npy", np.array([[20.0, -60.0, np.nan]]))
    got = read_thermogram(tmp_path / "a.npy", RadiometryOptions(emissivity=0.5, reflected_c=20.0))
    assert got.temperature_c[0, 0] == pytest.approx(20.0, abs=1e-4)
    assert np.isnan(got.temperature_c[0, 1:]).all()


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"celsius_per_count": 0.04}, "or neither"),
        ({"celsius_offset": 0.0}, "or neither"),
        ({"celsius_per_count": 0.0, "celsius_offset": 0.0}, "other than 0"),
        ({"celsius_per_count": 0.1, "celsius_offset": 0.0, "camera": "workswell"}, "a preset or a scale"),
    ],
)
def test_options_that_cannot_be_are_refused_at_once(values, said):
    with pytest.raises(ThermoxelsError, match=said):
        RadiometryOptions(**values)


def bad_png(width: int, height: int) -> bytes:
    header = b"IHDR" + struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    body = b"IDAT" + zlib.compress(b"\0" * 64)
    chunks = b"".join(
        struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
        for chunk in (header, body, b"IEND")
    )
    return b"\x89PNG\r\n\x1a\n" + chunks


def bad_tiff(width: int, height: int) -> bytes:
    tags = [(256, 4, width), (257, 4, height), (258, 3, 16), (259, 3, 1), (262, 3, 1), (273, 4, 8), (279, 4, 2)]
    entries = b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in tags)
    return b"II*\0" + struct.pack("<I", 10) + b"\0\0" + struct.pack("<H", len(tags)) + entries + bytes(4)


COLOURS = np.random.default_rng(1).integers(0, 255, (20, 30, 3), dtype=np.uint8)


def stored(values: np.ndarray, end: int | None = None) -> bytes:
    stream = io.BytesIO()
    np.save(stream, values, allow_pickle=True)
    return stream.getvalue()[:end]


HARD: dict[str, tuple[bytes, str, str]] = {
    "palette.jpg": (picture_bytes(COLOURS), "false-colour", "as the camera wrote it"),
    "palette.png": (picture_bytes(COLOURS, "PNG"), "a picture for the eye", "Export"),
    "palette.tiff": (picture_bytes(COLOURS, "TIFF"), "image mode RGB", "Export"),
    "grey8.tiff": (picture_bytes(COLOURS[..., 0].copy(), "TIFF"), "image mode L", "Export"),
    "truncated.jpg": (FlirFile(smooth_counts()).jpeg()[:2000], "expected a whole", "Copy"),
    "truncated.tiff": (picture_bytes(smooth_counts(), "TIFF")[:1200], "readable", "copy"),
    "truncated.npy": (stored(WALL_C, -9), "readable", "copy"),
    "truncated.png": (bad_png(40, 30), "readable", "copy"),
    "zero.tiff": (b"", "zero bytes", "Copy"),
    "zero.jpg": (b"", "zero bytes", "Copy"),
    "wide.png": (bad_png(30000, 4), "30000 x 4", "damaged"),
    "wide.tiff": (bad_tiff(30000, 4), "30000 x 4", "damaged"),
    "wide.npy": (stored(np.zeros((4, 30000), np.float32)), "30000 x 4", "damaged"),
    "wide.csv": (b",".join([b"1.5"] * 30000), "30000 x", "damaged"),
    "tall.csv": (b"1\n" * (LARGEST_SIDE + 1), "1 x", "damaged"),
    "huge.png": (bad_png(30000, 30000), "30000|size", "damaged"),
    "text.tiff": (b"Dear camera,\nplease", "starts with b'Dear", "Export"),
    "program.jpg": (b"\x7fELF\2\1\1\0" + bytes(100), "starts with", "Export"),
    "ragged.csv": (b"1,2,3\n4,5", "lengths", "damaged"),
    "words.csv": (b"warm,cold\nvery,not", "starts with", "Export"),
    "cube.npy": (stored(np.ones((2, 3, 4))), "one temperature per pixel", "single-channel"),
    "pickle.npy": (stored(np.array([{"a": 1}], dtype=object)), "readable", "damaged"),
}


@pytest.mark.parametrize("name", HARD)
def test_files_that_are_no_thermal_images_are_refused_by_name(tmp_path, name, monkeypatch):
    content, said, remedy = HARD[name]
    if name.startswith(("wide", "huge")):  # a header alone allocates nothing
        monkeypatch.setattr(Image.Image, "load", lambda _: pytest.fail("pixels were decoded"))
    (tmp_path / name).write_bytes(content)
    options = RadiometryOptions(camera="workswell") if name.endswith(("tiff", "png")) else None
    with warnings.catch_warnings(), pytest.raises(ThermalFileError, match=said) as caught:
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        read_thermogram(tmp_path / name, options)
    message = str(caught.value)
    assert isinstance(caught.value, SceneError)
    assert str(tmp_path / name) in message and "expected" in message and "got" in message and remedy in message
    if name != "grey8.tiff":  # which bounds may explain in training
        with warnings.catch_warnings(), pytest.raises(ThermalFileError, match=name):
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            read_thermal_file(tmp_path / name, ThermalUnit.bounds(-10.0, 40.0))


def test_a_missing_file_and_a_folder_are_named(tmp_path):
    for path in (tmp_path / "nowhere.tiff", tmp_path):
        with pytest.raises(ThermalFileError, match="nothing there"):
            read_thermogram(path)


READERS: tuple[Callable[[Path], object], ...] = (
    lambda path: identify(path, path.parent),
    read_photograph_facts,
    open_photograph,
    lambda path: read_thermogram(path, RadiometryOptions(camera="workswell")),
)


def whole_files(folder: Path) -> dict[str, bytes]:
    pixels = np.random.default_rng(0).integers(0, 255, (16, 24, 3), dtype=np.uint8)
    photo = photograph(folder / "p.jpg", pixels, "2024:01:01 10:00:00", "5", (47.0, 8.0, 400.0), 6, (4.5, 2000.0))
    double, lzw, deep = io.BytesIO(), io.BytesIO(), io.BytesIO()
    Image.fromarray(pixels).save(double, "MPO", save_all=True, append_images=[Image.fromarray(pixels)])
    Image.fromarray(pixels).save(lzw, "TIFF", compression="tiff_lzw")
    Image.fromarray(smooth_counts()).save(deep, "PNG")
    return {
        "photo.jpg": photo.read_bytes(),
        "double.jpg": double.getvalue(),
        "counts.tiff": counts(folder / "c.tiff", taken_at=datetime(2024, 1, 1)).read_bytes(),
        "lzw.tif": lzw.getvalue(),
        "deep.png": deep.getvalue(),
        "flir.jpg": FlirFile(smooth_counts(), photograph=picture_bytes(), alignment=(1.0, 0, 0)).jpeg(),
    }


@pytest.mark.parametrize("name", ["photo.jpg", "double.jpg", "counts.tiff", "lzw.tif", "deep.png", "flir.jpg"])
def test_random_damage_ends_in_an_error_that_names_the_file(tmp_path, name, capfd, recwarn):
    content = whole_files(tmp_path)[name]
    rng = np.random.default_rng(sum(name.encode()))
    path = tmp_path / f"damaged-{name}"
    refused = 0
    for _ in range(120):
        damaged = bytearray(content)
        for at in rng.integers(0, min(len(damaged), 600), int(rng.integers(1, 6))):
            damaged[at] = int(rng.choice([0, 1, 255, rng.integers(256)]))
        path.write_bytes(damaged[: len(damaged) - int(rng.integers(0, 2) * rng.integers(0, 40))])
        for read in READERS:
            try:
                read(path)
            except ThermoxelsError as problem:
                assert path.name in str(problem)
                refused += 1
    assert refused > 120  # photographs are no thermograms
    assert [str(warning.message) for warning in recwarn] == []
    capfd.readouterr()  # the TIFF library writes to the process's own error stream


def test_a_picture_larger_than_the_decoder_opens_is_refused_by_its_size(tmp_path):
    (tmp_path / "wide.png").write_bytes(bad_png(20000, 15000))
    Image.new("L", (1, 1)).save(tmp_path / "wide.jpg")
    jpeg = (tmp_path / "wide.jpg").read_bytes()
    at = jpeg.index(b"\xff\xc0") + 5
    (tmp_path / "wide.jpg").write_bytes(jpeg[:at] + struct.pack(">HH", 15000, 20000) + jpeg[at + 4 :])
    for name in ("wide.png", "wide.jpg"):
        with pytest.raises(SceneError, match=rf"{name}: .*300000000 pixels.*Reduce the picture"):
            identify(tmp_path / name, tmp_path)


def test_tags_that_point_at_themselves_end(tmp_path):
    """The folder of EXIF tags inside the first one is the first one again."""
    folder_at = 8
    entries = [(0x8769, 4, 1, folder_at), (0x8825, 4, 1, folder_at), (0x0112, 3, 1, 6)]
    tags = b"II*\0" + struct.pack("<IH", folder_at, len(entries))
    tags += b"".join(struct.pack("<HHII", *entry) for entry in entries) + struct.pack("<I", folder_at)
    plain = picture_bytes()
    path = tmp_path / "loop.jpg"
    path.write_bytes(plain[:2] + segment(0xE1, b"Exif\0\0" + tags) + plain[2:])
    assert read_photograph_facts(path).orientation == 6
    assert identify(path, tmp_path).role == "photograph"


@pytest.mark.parametrize(("offset", "length"), [(2**32 - 1, 1), (0, 2**32 - 1), (10**6, 10)])
def test_a_record_outside_the_file_is_refused(tmp_path, offset, length):
    content = FlirFile(smooth_counts()).jpeg()
    at = content.index(struct.pack(">HHII", 0x01, 1, 100, 1))
    damaged = content[: at + 12] + struct.pack(">II", offset, length) + content[at + 20 :]
    (tmp_path / "a.jpg").write_bytes(damaged)
    with pytest.raises(ThermalFileError, match=r"a\.jpg"):
        read_thermogram(tmp_path / "a.jpg")


def test_a_dji_file_that_is_cut_off_never_reaches_djis_library(tmp_path):
    content = dji_jpeg()
    for name, cut in (("inside.jpg", 40), ("end.jpg", len(content) - 2)):
        (tmp_path / name).write_bytes(content[:cut])
        with pytest.raises(ThermalFileError, match=rf"{name}: expected a whole"):
            read_thermogram(tmp_path / name, RadiometryOptions(dji_library=tmp_path / "libdirp.so"))


@pytest.mark.real_data
def test_real_workswell_files_need_no_options(shared_data):
    path = sorted((shared_data / "arco" / "thermal").glob("*.tiff"))[0]
    got = read_thermogram(path)
    counts = np.frombuffer(path.read_bytes()[392 : 392 + 655360], "<u2").reshape(512, 640)
    np.testing.assert_allclose(got.temperature_c, counts * 0.025 - 100.0, atol=1e-5)
    assert got.metadata.camera == "Workswell WIRIS Pro"
