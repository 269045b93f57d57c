import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.integration.commands import run
from tests.support.camera_card import COUNTS_PER_K, ZERO_C, counts
from tests.support.textured_room import alignment
from thermoxels_ns.core.camera import Camera

FRAMES = slice(4, 14)
HALF = 2


@pytest.fixture(scope="module")
def card(shared_data, tmp_path_factory):
    """Ten pairs at half size, without any tag, as a memory card has them."""
    folder = tmp_path_factory.mktemp("card")
    for path in sorted((shared_data / "arco" / "visible").glob("*.jpg"))[FRAMES]:
        with Image.open(path) as image:
            image.reduce(HALF).save(folder / path.name, quality=95)
        partner = path.name.replace("-visible.jpg", "-radiometric.tiff")
        with Image.open(shared_data / "arco" / "thermal" / partner) as image:
            full = np.asarray(image).astype(np.float64) / COUNTS_PER_K + ZERO_C
        height, width = full.shape
        counts(folder / partner, full.reshape(height // HALF, HALF, width // HALF, HALF).mean(axis=(1, 3)))
    return folder


@pytest.fixture(scope="module")
def scene(card, tmp_path_factory):
    folder = tmp_path_factory.mktemp("capture") / "scene"
    result = run("thermoxels", "capture", str(card), "--output", str(folder), "--thermal-field-of-view-deg", "45")
    assert result.returncode == 0, result.stdout
    return folder


def lens(entries: dict, factor: float = 1.0) -> Camera:
    names = ("fl_x", "fl_y", "cx", "cy")
    scaled = {name: entries[name] * factor for name in names}
    return Camera(int(entries["w"] * factor), int(entries["h"] * factor), **scaled, k1=entries.get("k1", 0.0))


def poses_of(frames: list[dict], key: str = "transform_matrix") -> np.ndarray:
    return np.array([frame[key] for frame in frames])


def both(scene: Path, shared_data: Path) -> tuple[dict, list[dict], dict, list[dict]]:
    """The new scene and the given one: content and frames in the same order."""
    new = json.loads((scene / "transforms.json").read_text())
    given = json.loads((shared_data / "arco" / "transforms.json").read_text())
    by_name = {Path(frame["file_path"]).name: frame for frame in given["frames"]}
    return new, new["frames"], given, [by_name[Path(frame["source"]).name] for frame in new["frames"]]


@pytest.mark.real_data
def test_poses_and_focal_length_agree_with_the_given_ones(scene, shared_data):
    new, frames, given, same = both(scene, shared_data)
    assert len(frames) == 10
    truth = poses_of(same)
    _, off, off_deg = alignment(poses_of(frames), truth)
    apart = np.linalg.norm(truth[:, None, :3, 3] - truth[None, :, :3, 3], axis=-1).max()
    assert off < 0.02 * apart
    assert off_deg < 1.0
    assert new["fl_x"] == pytest.approx(given["fl_x"] / HALF, rel=0.03)


@pytest.mark.real_data
def test_the_rig_carries_pixels_to_where_the_given_one_does(scene, shared_data):
    """From photograph to thermal image at the depths of the walls; median in pixels of the reduced thermal images."""
    new, frames, given, same = both(scene, shared_data)
    scale, _, _ = alignment(poses_of(frames), poses_of(same))
    grid = np.stack(np.meshgrid(np.linspace(250, 700, 10), np.linspace(50, 490, 8)), axis=-1).reshape(-1, 2)
    off = []
    for depth in (7.0, 10.0):
        theirs = carried(lens(given, 1 / HALF), lens(given["thermal_camera"], 1 / HALF), given["rig"], grid, depth)
        mine = carried(lens(new), lens(new["thermal_camera"]), new["rig"], grid, depth / scale)
        off.append(np.linalg.norm(mine - theirs, axis=1))
    assert np.median(np.concatenate(off)) < 3.0


def carried(visible: Camera, thermal: Camera, rig: list, pixels: np.ndarray, depth: float) -> np.ndarray:
    matrix = np.array(rig)
    return thermal.project(visible.rays(pixels) * depth @ matrix[:3, :3].T + matrix[:3, 3])


@pytest.mark.real_data
def test_drift_is_reduced_by_half(scene):
    drift = json.loads((scene / "transforms.json").read_text())["drift"]
    assert drift["corrected"], drift["explanation"]
    assert drift["disagreement_after_k"] < 0.5 * drift["disagreement_before_k"]
