import json
import re
import shutil
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from PIL import Image

from tests.support.camera_card import FlirFile, counts, photograph, picture_bytes
from tests.support.posed_model import ring_model
from tests.support.textured_room import RIG, THERMAL, VISIBLE, alignment, poses, write_card
from thermoxels_ns import cli
from thermoxels_ns.capture.frames import read_frames
from thermoxels_ns.capture.pairs import Pair
from thermoxels_ns.capture.photograph import read_photograph_facts
from thermoxels_ns.capture.rig_types import PARAMETERS, RigEstimate, RigFrame
from thermoxels_ns.capture.scene_writer import write_scene_folder
from thermoxels_ns.capture.settings import CaptureSettings
from thermoxels_ns.capture.sfm.poses import scene_names
from thermoxels_ns.capture.sfm.scale_and_up import Up
from thermoxels_ns.capture.stage_cache import prepare_output
from thermoxels_ns.commands.capture import capture_folder
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.data.dataparser import ThermalDataParserConfig
from thermoxels_ns.data.scene_file import read_scene_file
from thermoxels_ns.data.scene_scale import SceneScale, scale_from_scene_file, up_from_scene_file
from thermoxels_ns.data.tracks import find_tracks
from thermoxels_ns.radiometry.thermal_pixels import read_thermal_file
from thermoxels_ns.reports.capture_page import capture_page, thermal_in_photograph

COUNT = 6
DRIFT_K = 0.6
ANGLE_DEG = float(2 * np.degrees(np.arctan(THERMAL.width / 2 / THERMAL.fl_x)))


def settings(**more) -> CaptureSettings:
    return CaptureSettings(**({"max_features": 500, "thermal_field_of_view_deg": ANGLE_DEG} | more))


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A card with a stray pair, a lone photograph and a file that cannot be read; and the result."""
    folder = tmp_path_factory.mktemp("capture")
    card = folder / "card"
    write_card(card, COUNT, DRIFT_K, stray=True)
    photograph(card / "lonely.jpg")
    photograph(card / "shot8-visible.jpg")
    shutil.copy(card / "shot0-radiometric.tiff", card / "shot8-radiometric.tiff")
    (card / "shot9-visible.jpg").write_bytes(b"")
    before = files_of(folder)
    said = []
    result = capture_folder(card, folder / "scene", settings(skip_bad=True), said.append)
    after = {path: changed for path, changed in files_of(folder).items() if not path.is_relative_to(folder / "scene")}
    return card, folder / "scene", result, (before, after)


def files_of(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


def content(scene):
    return json.loads((scene / "transforms.json").read_text())


def entries(scene):
    return sorted(content(scene)["frames"], key=lambda entry: entry["source"])


def test_what_is_left_out_is_named_with_its_reason_and_nothing_is_written_elsewhere(capture):
    dropped, (before, after) = capture[2].dropped, capture[3]
    assert len(before) > 2 * COUNT and after == before
    assert set(dropped) == {f"shot{COUNT}-visible.jpg", "shot8-visible.jpg", "lonely.jpg", "shot9-visible.jpg"}
    assert "too few matches" in dropped[f"shot{COUNT}-visible.jpg"]
    assert "32 x 24 pixels" in dropped["shot8-visible.jpg"]
    assert "zero bytes" in dropped["shot9-visible.jpg"]
    assert (len(capture[2].pairs), len(capture[2].scene.frames)) == (COUNT + 2, COUNT)


def test_the_scene_is_that_of_the_truth_with_z_up(capture):
    _, folder, result, _ = capture
    found, meta = np.array([entry["transform_matrix"] for entry in entries(folder)]), content(folder)
    scale, off_m, off_deg = alignment(found, poses(COUNT))
    assert off_m < 0.01 and off_deg < 0.3
    assert meta["fl_x"] == pytest.approx(VISIBLE.fl_x, rel=0.01)
    assert len(result.scene.model.points) > 200
    assert np.median(result.scene.model.point_error_px) < 0.5
    assert meta["up"] == pytest.approx([0, 0, 1], abs=1e-9)
    # Up in each camera's axes, by the scene and by the truth.
    assert np.degrees(np.arccos(np.einsum("ni,ni->n", found[:, 2, :3], poses(COUNT)[:, 2, :3]))).max() < 2.0
    drift = result.scene.drift
    assert drift.used, drift.explanation
    assert drift.offsets_k == pytest.approx([DRIFT_K * (-1) ** n for n in range(COUNT)], abs=0.1)
    assert drift.after_k < 0.5 * drift.before_k
    assert meta["drift"]["disagreement_after_k"] == pytest.approx(drift.after_k)
    assert result.scene.rig.determined, result.scene.rig.explanation
    thermal = np.array([entry["thermal_transform_matrix"] for entry in entries(folder)])
    apart = np.linalg.norm(thermal[:, :3, 3] - found[:, :3, 3], axis=1) * scale
    assert apart.std() < 1e-6
    assert apart[0] == pytest.approx(np.linalg.norm(RIG[:3, 3]), abs=0.04)


def test_errors_of_photographs_are_those_whose_means_colmap_gives_to_points(capture):
    model = capture[2].scene.model
    numbers, errors = np.concatenate(model.seen), np.concatenate(model.errors_px)
    count = np.bincount(numbers, minlength=len(model.points))
    mean = np.bincount(numbers, errors, len(model.points)) / count
    # COLMAP counts both features of a photograph that shows a point twice.
    assert np.mean(np.isclose(mean, model.point_error_px, rtol=1e-6, atol=1e-9)) > 0.95


def test_the_page_shows_everything_and_fetches_nothing(capture):
    whole = capture[2].page.read_text()
    page = re.sub(r'data:image/jpeg;base64,[^"]+', "data:", whole)  # any four letters stand somewhere in megabytes
    for words in ("shot9-visible.jpg", "lonely.jpg", f"shot{COUNT}", "too few matches", "480 x 360", "160 x 128"):
        assert words in page, words
    assert " °C" in page and "degrees C" not in page
    assert page.count("<img") == 2 * COUNT
    assert not re.search(r"""(src|href)=["'](?!data:|#)""", page)  # "#": a part of the same page
    assert "<script" not in page and "http" not in page.replace("http-equiv", "")
    assert "nan" not in page


JPEG = b"\xff\xd8\xff"


def page_of(result, name="a", **scene) -> str:
    """The page of a result in whose scene some things are others, with one picture."""
    changed = replace(result, scene=replace(result.scene, **scene))
    return capture_page(changed, [(name, JPEG, JPEG, name)], np.linspace(10, 20, 100, dtype=np.float32), 0.0)


def words(result, **scene) -> str:
    return re.sub(r"\s+", " ", re.sub(r"<[^>]*>", " ", page_of(result, **scene)))


def test_numbers_on_the_page_have_their_errors(capture):
    errors = {"rx": 0.003, "ry": 0.004, "rz": 0.012, "log_focal": 0.01, "cx": 0.42, "cy": 0.57}
    covariance = np.diag([errors.get(name, 0.0) ** 2 for name in PARAMETERS])
    rig = RigEstimate(Camera(80, 60, 70.0, 70.0, 41.0, 29.0), np.eye(4), True, "", covariance)
    result = replace(capture[2], start=rig)
    said = words(result, rig=rig)
    assert "41.0, 29.0 41.0 ± 0.4, 29.0 ± 0.6 " in said and "70.0 70.0 ± 0.7 " in said
    assert "turned by 0.00 ± 0.74 degrees" in said
    assert "41.0, 29.0 41.0, 29.0 " in words(result, rig=replace(rig, covariance=np.full((10, 10), np.nan)))
    assert f"unknown ({result.scale_missing}); give a length when you export the mesh" in said
    known = words(result, scale=SceneScale(0.5, 0.01, "GPS."))
    assert "0.5 ± 0.01 (2.0 %) m per unit" in known and "unknown" not in known


def test_names_of_files_are_no_markup(capture):
    evil = "<script>alert(1)</script>"
    frames = [replace(frame, camera=evil) for frame in capture[2].scene.frames]
    pairs = [Pair(f"{evil}.jpg", "a.tiff", evil)]
    changed = replace(capture[2], source=Path(evil), dropped={evil: evil}, pairs=pairs, scale_missing=evil)
    text = page_of(changed, evil, frames=frames)
    assert "<script" not in text
    assert text.count("&lt;script&gt;") >= 8


def test_a_point_of_the_thermal_image_lands_where_the_scene_has_it():
    """A warm spot at the projection of a scene point appears at that point in the photograph."""
    model = ring_model(3)
    seen = model.seen[1]
    points = model.in_camera(1, model.points[seen])
    pixels = model.camera.project(points)
    frame = RigFrame(np.zeros((480, 640)), np.zeros((60, 80)), points, seen)
    thermal, rig = Camera(80, 60, 70.0, 70.0, 41.0, 29.0), np.eye(4)
    rig[:3, 3] = (0.3, -0.1, 0.05)
    chosen = np.argmin(np.linalg.norm(pixels - (320, 240), axis=1))
    spot = thermal.project(points[[chosen]] @ rig[:3, :3].T + rig[:3, 3])[0]
    x, y = np.meshgrid(np.arange(80) + 0.5, np.arange(60) + 0.5)
    temperature_c = 20 + 10 * np.exp(-((x - spot[0]) ** 2 + (y - spot[1]) ** 2) / 8)
    carried = thermal_in_photograph(frame, temperature_c, model.camera, RigEstimate(thermal, rig, True, ""), width=640)
    row, column = np.unravel_index(np.nanargmax(carried), carried.shape)
    assert np.hypot(column + 0.5 - pixels[chosen][0], row + 0.5 - pixels[chosen][1]) < 6  # a thermal pixel is 7 wide
    assert np.isnan(carried).any()


def test_every_eighth_frame_evaluates_and_the_ends_train():
    assert [n for n, name in enumerate(scene_names(40)) if "eval" in name] == [4, 12, 20, 28, 36]
    for count in range(2, 12):
        sides = ["eval" in name for name in scene_names(count)]
        assert sum(sides) == 1 or count > 8
        assert not sides[-1] and len(sides) == count


@pytest.fixture
def written(capture, tmp_path):
    """The scene with a pixel without temperature, vignetting, a scale and an up of its own; and its new folder."""
    scene = capture[2].scene
    temperature_c = np.load(scene.frames[0].thermal)
    temperature_c[0, 0] = np.nan
    np.save(tmp_path / "holed.npy", temperature_c)
    scene = replace(
        scene,
        frames=[replace(scene.frames[0], thermal=tmp_path / "holed.npy"), *scene.frames[1:]],
        drift=replace(scene.drift, radial=(0.5,)),
        scale=SceneScale(0.5, 0.01, "GPS."),
        up=Up(np.array([0.0, 0.6, 0.8]), "Measured."),
    )
    folder = prepare_output(tmp_path / "scene")
    write_scene_folder(scene, folder)
    return scene, folder


def test_numbers_and_tracks_come_back_as_they_went_in(written):
    scene, folder = written
    read = read_scene_file(folder)
    by_source = {entry["source"]: entry for entry in read.meta["frames"]}
    for number, frame in enumerate(scene.frames):
        entry = by_source[frame.name]
        assert np.array(entry["transform_matrix"]) == pytest.approx(scene.model.camera_to_world[number])
        # A scene point: x_thermal = rig @ x_visible, both in OpenCV axes.
        point = scene.model.points[:1]
        in_visible = scene.model.in_camera(number, point)
        thermal_pose = np.array(entry["thermal_transform_matrix"])
        in_thermal = (point - thermal_pose[:3, 3]) @ thermal_pose[:3, :3] * (1, -1, -1)
        rig = scene.rig.visible_to_thermal
        assert in_thermal == pytest.approx(in_visible @ rig[:3, :3].T + rig[:3, 3])
        written_c = read_thermal_file(folder / entry["thermal_file_path"], read.unit)
        expected = np.load(frame.thermal) - scene.drift.offsets_k[number] - scene.drift.radial_k(160, 128)
        np.testing.assert_allclose(written_c, expected, atol=1e-4)
        assert (folder / entry["file_path"]).read_bytes() == frame.photograph.read_bytes()
    scale = scale_from_scene_file(read.meta)
    assert (scale.metres_per_unit, scale.standard_error) == (0.5, 0.01)
    assert up_from_scene_file(read.meta) == pytest.approx((0.0, 0.6, 0.8))
    assert read.meta["fl_x"] == scene.model.camera.fl_x
    assert read.meta["thermal_camera"]["cx"] == scene.rig.thermal_camera.cx
    # Tracks say which training photograph sees which point.
    outputs = ThermalDataParserConfig(data=folder).setup().get_dataparser_outputs("train")
    tracks = find_tracks(read)
    np.testing.assert_allclose(tracks.points, scene.model.points, atol=1e-9)
    np.testing.assert_allclose(tracks.point_error_px, scene.model.point_error_px)
    assert sorted(map(len, tracks.seen.values())) == sorted(map(len, scene.model.seen))
    train = sum(len(points) for name, points in tracks.seen.items() if "train" in name)
    assert 0.5 * train < len(outputs.metadata["feature_rays"].origins) <= train
    stock = NerfstudioDataParserConfig(data=folder, load_3D_points=False, eval_mode="all").setup()
    assert len(stock.get_dataparser_outputs("train").image_filenames) == COUNT


def test_an_earlier_scene_is_replaced_and_nothing_else_or_stays_whole(written, monkeypatch):
    scene, folder = written
    mine = (folder / "notes.txt", folder / "colmap" / "mine" / "notes.txt")
    for path in mine:
        path.parent.mkdir(exist_ok=True)
        path.write_text("mine")
    write_scene_folder(scene, folder)
    assert [path.read_text() for path in mine] == ["mine", "mine"]
    before = (folder / "transforms.json").read_bytes()

    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("thermoxels_ns.capture.scene_writer.write_json", stop)
    with pytest.raises(KeyboardInterrupt):
        write_scene_folder(scene, folder)
    assert (folder / "transforms.json").read_bytes() == before
    assert len(read_scene_file(folder).frames) == COUNT


def test_the_json_has_no_nan(written):
    scene, folder = written
    unknown = RigEstimate(scene.rig.thermal_camera, np.eye(4), False, "Kept.")
    write_scene_folder(replace(scene, rig=unknown, scale=None), folder)
    content = json.loads((folder / "transforms.json").read_text(), parse_constant=lambda name: pytest.fail(name))
    assert content["rig_info"]["determined"] is False
    assert "metres_per_unit" not in content


def test_a_second_run_takes_what_took_minutes_from_the_first(capture):
    card, scene, first, _ = capture
    said, before = [], content(scene)
    again = capture_folder(card, scene, settings(skip_bad=True), said.append)
    assert [line for line in said if "as before" in line] == ["poses: as before", "rig: as before"]
    assert content(scene) == before and again.dropped == first.dropped


def test_a_given_rig_is_taken_and_from_stage_finds_it_again(capture, tmp_path):
    card, earlier, first, _ = capture
    scene = tmp_path / "scene"
    shutil.copytree(earlier, scene)
    said: list[str] = []
    more = {"skip_bad": True, "rig": earlier / "transforms.json", "marker_side_m": 0.2}
    result, given = capture_folder(card, scene, settings(**more), said.append), content(earlier)
    assert content(scene)["rig"] == given["rig"] and content(scene)["thermal_camera"] == given["thermal_camera"]
    assert result.scene.drift.used
    assert result.scene.scale is None and "no photograph shows an ArUco marker" in result.scale_missing
    again = capture_folder(card, scene, settings(from_stage="rig", skip_bad=True), said.append)
    assert [line for line in said if "as before" in line] == 2 * ["poses: as before"]
    np.testing.assert_array_equal(again.scene.rig.visible_to_thermal, first.scene.rig.visible_to_thermal)
    capture_folder(card, scene, settings(thermal_field_of_view_deg=ANGLE_DEG + 1.0, skip_bad=True), said.append)
    assert [line for line in said if "as before" in line] == 3 * ["poses: as before"]


@pytest.mark.parametrize("name", ["poses/model/points3D.bin", "rig/rig.npz"])
def test_damaged_results_of_an_earlier_capture_name_the_stage_to_repeat(capture, tmp_path, name):
    card, earlier, _, _ = capture
    shutil.copytree(earlier, tmp_path / "scene")
    kept = tmp_path / "scene" / ".capture" / name
    half = kept.read_bytes()[: kept.stat().st_size // 2]
    for spoil in (lambda: kept.write_bytes(half), kept.unlink):
        spoil()
        with pytest.raises(ThermoxelsError, match=f"--from-stage {name.split('/')[0]}"):
            capture_folder(card, tmp_path / "scene", settings(skip_bad=True))


def test_the_command(capture, tmp_path, capsys):
    assert cli.main(["capture", str(tmp_path / "nowhere"), "--output", str(tmp_path / "scene")]) == 2
    assert "nothing at" in capsys.readouterr().err
    assert cli.main(["capture", str(tmp_path), "--output", str(tmp_path / "scene"), "--emissivity", "1.5"]) == 2
    assert "emissivity: expected" in capsys.readouterr().err
    card, scene, _, _ = capture
    words = ["--skip-bad", "True", "--max-features", "500", "--thermal-field-of-view-deg", str(ANGLE_DEG)]
    assert cli.main(["capture", str(card), "--output", str(scene), *words]) == 0
    out = capsys.readouterr().out
    assert f"{COUNT} frames of {COUNT + 2} pairs" in out
    assert "shot9-visible.jpg" in out and f"--data {scene}" in " ".join(out.split())


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


def test_the_rest_goes_on_without_damaged_files_and_those_of_another_thermal_camera(tmp_path):
    card = tmp_path / "card"
    good, odd = [pair(card, "a"), pair(card, "b")], pair(card, "odd", np.full((6, 8), 20.0))
    bad = {name: pair(card, name) for name in ("thermal", "photo")}
    for path in (card / bad["thermal"].thermal, card / bad["photo"].photograph):
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    alone, frames = read([*good, odd], tmp_path), read([*bad.values(), *good, odd], tmp_path, skip_bad=True)
    assert [frame.name for found in (alone, frames) for frame in found.frames] == 2 * [one.photograph for one in good]
    assert "8 x 6 pixels, most have 16 x 12" in alone.dropped["odd-visible.jpg"]
    assert set(frames.dropped) == {one.photograph for one in (*bad.values(), odd)}
    assert all(name.split("-")[0] in why for name, why in frames.dropped.items() if name != odd.photograph)


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
        assert missing[5, 7] and missing.sum() == 1


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
