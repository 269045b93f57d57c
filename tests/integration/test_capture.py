"""Real camera files through the real command, held against poses and a rig that were found in another way."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from tests.capture.camera_card import COUNTS_PER_K, ZERO_C, counts
from tests.capture.textured_room import alignment
from tests.integration.commands import run
from thermoxels_ns.capture.contract import CameraModel

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


def lens(entries: dict, factor: float = 1.0) -> CameraModel:
    names = ("fl_x", "fl_y", "cx", "cy")
    scaled = {name: entries[name] * factor for name in names}
    return CameraModel(int(entries["w"] * factor), int(entries["h"] * factor), **scaled, k1=entries.get("k1", 0.0))


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
def test_scene_points_fall_where_the_given_rig_has_them(scene, shared_data):
    """Median over all frames and the scene points in view of each, in pixels of the reduced thermal images."""
    new, frames, given, same = both(scene, shared_data)
    scale, _, _ = alignment(poses_of(frames), poses_of(same))
    points = np.asarray(trimesh.load(scene / new["ply_file_path"]).vertices, dtype=np.float64)
    a, b = poses_of(frames)[:, :3, 3], poses_of(same)[:, :3, 3]
    left, _, right = np.linalg.svd((b - b.mean(axis=0)).T @ (a - a.mean(axis=0)))
    rotation = left @ np.diag([1, 1, np.sign(np.linalg.det(left @ right))]) @ right
    there = scale * (points - a.mean(axis=0)) @ rotation.T + b.mean(axis=0)
    theirs, mine, off = lens(given["thermal_camera"], 1 / HALF), lens(new["thermal_camera"]), []
    for frame, other in zip(frames, same):
        expected = seen(theirs, other["thermal_transform_matrix"], there)
        found = seen(mine, frame["thermal_transform_matrix"], points)
        inside = theirs.contains(expected)
        off.append(np.linalg.norm(found - expected, axis=1)[inside])
    assert np.median(np.concatenate(off)) < 3.0


def seen(camera: CameraModel, pose: list, points: np.ndarray) -> np.ndarray:
    matrix = np.array(pose)
    return camera.project((points - matrix[:3, 3]) @ matrix[:3, :3] * (1, -1, -1))


@pytest.mark.real_data
def test_drift_is_reduced_by_half(scene):
    drift = json.loads((scene / "transforms.json").read_text())["drift"]
    assert drift["corrected"], drift["explanation"]
    assert drift["disagreement_after_k"] < 0.5 * drift["disagreement_before_k"]
