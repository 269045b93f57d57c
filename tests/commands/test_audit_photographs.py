import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.support.audited_wall import STATED, UP
from tests.support.heat_bodies import box_mesh, planes
from thermoxels_ns.audit.run import Audit, audit
from thermoxels_ns.commands.audit_photographs import photographs_of_defects
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.data.scene_file import read_scene_file

SCALE = 2.0  # Metres in a unit of the poses
CAMERA = Camera(160, 120, 100.0, 100.0, 80.0, 60.0)


@pytest.fixture(scope="module")
def found() -> Audit:
    """A plate of 3 m by 3 m, seen from y < 0, with a warm strip at a height of 1.5 m."""
    mesh = box_mesh(planes(0, 3, step=0.05), [0.0, 0.2], planes(0, 3, step=0.05), temperature_c=2.0)
    strip = (np.abs(mesh.points_m[:, 2] - 1.5) < 0.06) & (np.abs(mesh.points_m[:, 0] - 1.5) < 1.1)
    front = mesh.boundary.patch == mesh.boundary.patch_names.index("y0")
    seen = replace(mesh, boundary=replace(mesh.boundary, seen=front), temperature_c=np.where(strip, 4.0, 2.0))
    return audit(seen, STATED, UP)


def pose(y_m: float) -> np.ndarray:
    """A camera in front of the plate (y < 0) or behind it, which looks at its middle."""
    ahead = 1.0 if y_m < 0.0 else -1.0
    matrix = np.eye(4)
    matrix[:3, 0], matrix[:3, 1], matrix[:3, 2] = (ahead, 0, 0), (0, 0, 1), (0, -ahead, 0)
    matrix[:3, 3] = np.array([1.5, y_m, 1.5]) / SCALE
    return matrix


def photograph(folder: Path, number: int, y_m: float, shade: int) -> dict:
    """Paint what a camera sees: the strip red, all else grey; 4 and 2 degrees."""
    rays = CAMERA.directions(pose(y_m))[:, :, 0]
    at = pose(y_m)[:3, 3] * SCALE - rays * (y_m / rays[..., 1:2])
    strip = (np.abs(at[..., 2] - 1.5) < 0.1) & (np.abs(at[..., 0] - 1.5) < 1.1)
    picture = np.where(strip[..., None], [200, 0, 0], [shade, shade, shade]).astype(np.uint8)
    Image.fromarray(picture).save(folder / "images" / f"{number}.png")
    np.save(folder / "thermal" / f"{number}.npy", np.where(strip, 4.0, 2.0))
    return {"file_path": f"images/{number}.png", "transform_matrix": pose(y_m).tolist()}


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    """Photographs from behind, from near and from far."""
    folder = tmp_path_factory.mktemp("scene")
    (folder / "images").mkdir()
    (folder / "thermal").mkdir()
    frames = [photograph(folder, n, y, 60 + 20 * n) for n, y in enumerate((1.5, -3.0, -9.0))]
    lens = {"w": 160, "h": 120, "fl_x": 100.0, "fl_y": 100.0, "cx": 80.0, "cy": 60.0}
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    return folder


def pictures_of(scene: Path, found: Audit) -> dict:
    return photographs_of_defects(read_scene_file(scene), SCALE, found)


def shown(image: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(image))).astype(int)


def test_a_defect_is_cut_out_of_the_view_that_shows_it_largest(found, scene) -> None:
    ((number, ((photo, caption), (thermogram, _))),) = pictures_of(scene, found).items()
    assert (number, caption) == (0, "1.png")
    red, _, blue = shown(photo).transpose(2, 0, 1)
    strip = red - blue > 100
    rows = np.flatnonzero(strip.mean(axis=1) > 0.3)
    assert len(rows) and abs(rows.mean() - strip.shape[0] / 2) < 0.05 * strip.shape[0]
    # The same place is bright in the thermal image, and all else is dark; the frame is white in both.
    bright = shown(thermogram).sum(axis=2) > 500
    assert bright[strip].mean() > 0.8 and bright[~strip].mean() < 0.2


def test_what_stands_before_a_defect_hides_it(found, scene) -> None:
    """A screen half-way to the camera."""
    surface = found.surface
    count = np.count_nonzero(surface.counted)
    screen = surface.centroid_m.copy()
    screen[np.flatnonzero(~surface.counted)[:count]] = surface.centroid_m[surface.counted] * (1, 0, 1) - (0, 1.0, 0)
    hidden = replace(found, surface=replace(surface, centroid_m=screen))
    assert pictures_of(scene, hidden) == {}
