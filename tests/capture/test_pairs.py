from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from tests.support.camera_card import FlirFile, counts, photograph, picture_bytes
from thermoxels_ns.capture.folder_scan import CameraFile, CameraFolder, scan_folder
from thermoxels_ns.capture.pairs import PairSearch, find_pairs

ROOT = Path("/card")
NOON = datetime(2024, 5, 1, 12)


def of(*files: tuple[str, str] | tuple[str, str, float], clock_offset_s: float = 0.0) -> PairSearch:
    """Pair files given as name, role and (optional) seconds after noon."""
    listed = tuple(
        CameraFile(ROOT / f[0], f[1], None if len(f) == 2 else NOON + timedelta(seconds=f[2]))  # type: ignore[arg-type]
        for f in files
    )
    return find_pairs(CameraFolder(ROOT, listed), clock_offset_s=clock_offset_s)


def names(search: PairSearch) -> list[tuple[str, str]]:
    return [(Path(pair.photograph).name, Path(pair.thermal).name) for pair in search.pairs]


@pytest.mark.parametrize(
    ("photo", "thermal"),
    [
        ("10-58-15-636-visible.jpg", "10-58-15-636-radiometric.tiff"),
        ("visible/a7.jpg", "thermal/a7.npy"),
        ("RGB_0004.png", "IR_0004.tif"),
        ("20180528_120000_V.jpg", "20180528_120000_R.tiff"),
        ("Halle (2) rgb.JPG", "Halle (2) thermal.csv"),
        ("Küche_visible.jpg", "Ku\u0308che_thermal.tif"),
        ("壁-rgb.png", "壁-ir.npy"),
    ],
)
def test_equal_names_belong_together(photo, thermal):
    search = of((photo, "photograph"), (thermal, "thermal"), ("other.jpg", "photograph"))
    assert names(search) == [(Path(photo).name, Path(thermal).name)]
    assert list(search.unpaired) == ["other.jpg"]


def test_one_name_in_two_folders_is_told_apart_by_the_folder_and_two_thermal_images_of_it_are_ambiguous():
    search = of(
        *(("day1/visible/a.jpg", "photograph"), ("day1/thermal/a.tif", "thermal")),
        *(("day2/visible/a.jpg", "photograph"), ("day2/thermal/a.tif", "thermal")),
    )
    assert [(p.photograph[:4], p.thermal[:4]) for p in search.pairs] == [("day1", "day1"), ("day2", "day2")]
    search = of(("a.jpg", "photograph"), ("a.npy", "thermal"), ("a.csv", "thermal"))
    assert search.pairs == ()
    assert set(search.unpaired) == {"a.jpg", "a.npy", "a.csv"}
    assert all("ambiguous" in why for why in search.unpaired.values())


def test_dji_names_pair_though_their_times_differ_by_a_second():
    search = of(
        ("DJI_20220723151219_0001_T.JPG", "thermal"),
        *(("DJI_20220723151220_0001_V.JPG", "photograph"), ("DJI_20220723151220_0001_Z.JPG", "photograph")),
        *(("DJI_20220723160000_0001_V.JPG", "photograph"), ("DJI_0002_T.JPG", "thermal")),
        *(("DJI_0002_W.JPG", "photograph"), ("DJI_0002_Z.JPG", "photograph")),
        *(("DJI_20240501235959_0003_T.JPG", "thermal"), ("DJI_20240502000000_0003_V.JPG", "photograph")),
    )
    assert sorted(names(search)) == [
        ("DJI_0002_W.JPG", "DJI_0002_T.JPG"),
        ("DJI_20220723151220_0001_V.JPG", "DJI_20220723151219_0001_T.JPG"),
        ("DJI_20240502000000_0003_V.JPG", "DJI_20240501235959_0003_T.JPG"),
    ]
    assert "DJI_0002_W.JPG is the partner" in search.unpaired["DJI_0002_Z.JPG"]
    assert "DJI_20220723160000_0001_V.JPG" in search.unpaired


def test_times_pair_what_names_do_not_unless_two_are_about_as_near():
    search = of(
        *(("IMG_1.jpg", "photograph", 0.0), ("IMG_2.jpg", "photograph", 10.0), ("IMG_3.jpg", "photograph", 60.0)),
        *(("FLIR7.jpg", "thermal", 0.4), ("FLIR8.jpg", "thermal", 10.9)),
    )
    assert names(search) == [("IMG_1.jpg", "FLIR7.jpg"), ("IMG_2.jpg", "FLIR8.jpg")]
    assert "49.1 s away" in search.unpaired["IMG_3.jpg"]
    files = (("a.jpg", "photograph", 0.0), ("b.npy", "thermal", 3600.2))  # a clock that is ahead
    assert of(*files).pairs == ()
    assert names(of(*files, clock_offset_s=3600.0)) == [("a.jpg", "b.npy")]
    search = of(("x.jpg", "photograph", 1.0), ("p.npy", "thermal", 0.5), ("q.npy", "thermal", 1.6))
    assert search.pairs == () and "about as near" in search.unpaired["x.jpg"]


def test_every_file_is_in_a_pair_or_explained():
    rng = np.random.default_rng(0)
    files = [(f"p{n}.jpg", "photograph", float(rng.uniform(0, 100))) for n in range(30)]
    files += [(f"t{n}q.npy", "thermal", float(rng.uniform(0, 100))) for n in range(25)]
    search = of(*files)
    paired = [path for pair in search.pairs for path in (pair.photograph, pair.thermal)]
    assert len(search.pairs) > 3
    assert len(paired) == len(set(paired))
    assert set(paired) | set(search.unpaired) == {f[0] for f in files}
    assert not set(paired) & set(search.unpaired)


def test_a_card_is_read_by_content(tmp_path):
    card = tmp_path / "card"
    photograph(card / "1-visible.jpg")
    counts(card / "1-radiometric.tiff")
    flir = FlirFile(np.full((6, 8), 14000, dtype=np.uint16), photograph=picture_bytes(np.zeros((24, 32, 3), np.uint8)))
    (card / "FLIR2.jpg").write_bytes(flir.jpeg())
    (card / "log.txt").write_text("not ours")
    (card / "3-visible.jpg").write_bytes(b"")
    (card / "4-visible.jpg").write_bytes(b"no picture at all")
    (card / ".trash").mkdir()
    photograph(card / ".trash" / "9-visible.jpg")
    found = scan_folder(card)
    assert {f.path.name: f.role for f in found.files} == {
        "1-visible.jpg": "photograph",
        "1-radiometric.tiff": "thermal",
        "FLIR2.jpg": "both",
    }
    assert {path.name for path in found.unreadable} == {"3-visible.jpg", "4-visible.jpg"}
    assert all(path.name in why for path, why in found.unreadable.items())
    assert found.others == 1
    search = find_pairs(found)
    assert [pair.in_one_file for pair in search.pairs] == [False, True]


def test_a_plain_jpeg_that_is_named_thermal_is_no_photograph(tmp_path):
    photograph(tmp_path / "thermal" / "a.jpg")
    photograph(tmp_path / "visible" / "a.jpg")
    photograph(tmp_path / "thermal rgb" / "visible" / "b.jpg")
    roles = {f.path.relative_to(tmp_path).as_posix(): f.role for f in scan_folder(tmp_path).files}
    assert roles == {
        "thermal/a.jpg": "thermal picture",
        "visible/a.jpg": "photograph",
        "thermal rgb/visible/b.jpg": "photograph",
    }
