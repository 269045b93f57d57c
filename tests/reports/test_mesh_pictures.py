from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from thermoxels_ns.reports.mesh_pictures import _view_axes, change_colours, picture_of_mesh

SIZE = (400, 300)


def pixels(path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB")).astype(int)


def stage(image: np.ndarray) -> np.ndarray:
    """The part of the picture where the mesh is drawn."""
    return image[int(0.09 * SIZE[1]) : int(0.845 * SIZE[1]), int(0.03 * SIZE[0]) : int(0.81 * SIZE[0])]


def test_mesh_is_in_the_picture_as_a_whole(tmp_path, box_mesh):
    path = tmp_path / "mesh.png"
    picture_of_mesh(path, box_mesh, title="Before", window_size=SIZE)
    image = pixels(path)
    assert image.shape == (SIZE[1], SIZE[0], 3)
    for border in (image[:3], image[-3:], image[:, :3], image[:, -3:]):
        assert np.all(border == 255)
    drawn = np.any(stage(image) < 230, axis=-1)
    rows, columns = np.flatnonzero(drawn.any(axis=1)), np.flatnonzero(drawn.any(axis=0))
    # Fills the stage along one direction at least, and is centred in it.
    fills = max(np.ptp(rows) / (0.74 * SIZE[1]), np.ptp(columns) / (0.76 * SIZE[0]))
    assert 0.95 < fills < 1.03
    assert np.any(image[:, int(0.85 * SIZE[0]) :] < 100)  # colour bar
    assert [p.name for p in tmp_path.iterdir()] == ["mesh.png"]


def test_hot_is_bright_and_the_colour_limits_are_used(tmp_path, box_mesh):
    levels = []
    for temperature in (0.0, 50.0, 100.0):
        same = np.full(len(box_mesh.points_m), temperature)
        picture_of_mesh(tmp_path / "t.png", box_mesh, same, clim=(0.0, 100.0), window_size=SIZE)
        inside = stage(pixels(tmp_path / "t.png"))
        levels.append(np.median(inside[np.any(inside < 230, axis=-1)].sum(axis=-1)))
    assert levels[0] < levels[1] - 60 < levels[2] - 120


def test_unobserved_surface_is_grey(tmp_path, box_mesh):
    half = replace(box_mesh, observed=box_mesh.points_m[:, 0] < 0.1)
    shares = []
    for grey in (False, True):
        painted = [("no thermal ray", "grey", ~half.observed[half.facets].all(axis=1))] if grey else []
        picture_of_mesh(tmp_path / "g.png", half, painted=painted, window_size=SIZE, view_direction=(1, 0.5, -0.5))
        inside = stage(pixels(tmp_path / "g.png"))
        body = inside[np.any(inside < 230, axis=-1)]
        shares.append(np.mean(np.ptp(body, axis=-1) < 8))
    assert shares[0] < 0.1 < 0.3 < shares[1]


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0), (1, 0, 0), (0, 0, -2), (0.3, -0.5, 0.2)])
def test_up_points_up_and_the_camera_looks_down_on_the_mesh(up):
    right, picture_up, towards_camera = _view_axes(up, None)
    axes = np.stack([right, picture_up, towards_camera])
    assert np.allclose(axes @ axes.T, np.eye(3))
    assert np.linalg.det(axes) == pytest.approx(1.0)
    assert np.dot(up, right) == pytest.approx(0.0, abs=1e-12)
    assert np.dot(up, picture_up) > 0
    assert np.dot(up, towards_camera) > 0


def test_a_few_large_changes_do_not_make_all_others_grey() -> None:
    change = np.concatenate([np.linspace(-0.1, 0.1, 99), [-3.4]])
    colours = change_colours(change)
    low, high = colours["clim"]
    assert low == -high and 0.09 < high < 0.11
    assert colours["note"] == "colours: 95 % of the nodes; all: -3.4 to 0.1 K"
    even = change_colours(np.linspace(-2.0, 1.0, 50))
    assert even["clim"] == (-2.0, 2.0) and even["note"] == ""
