import io
import struct
import zlib
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.support.camera_card import counts, photograph
from tests.support.flir_file import FlirFile, dji_jpeg, picture_bytes, segment, smooth_counts
from thermoxels_ns.capture.folder_scan import identify
from thermoxels_ns.capture.photograph import open_photograph, read_photograph_facts
from thermoxels_ns.core.errors import SceneError, ThermalFileError, ThermoxelsError
from thermoxels_ns.radiometry.thermogram import RadiometryOptions, read_thermogram

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
    for path in (tmp_path / "wide.png", tmp_path / "wide.jpg"):
        Image.new("L", (1, 1)).save(path)
    png = (tmp_path / "wide.png").read_bytes()
    head = b"IHDR" + struct.pack(">II", 20000, 15000) + png[24:29]
    (tmp_path / "wide.png").write_bytes(png[:12] + head + struct.pack(">I", zlib.crc32(head)) + png[33:])
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
