from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from thermoxels_ns.reports.mesh_pictures import colour_range, image_of_mesh, voxel_surface, write_picture

SIZE = (400, 300)


def stage(image: np.ndarray) -> np.ndarray:
    """The part of the picture where the mesh is drawn."""
    return image[int(0.09 * SIZE[1]) : int(0.845 * SIZE[1]), int(0.03 * SIZE[0]) : int(0.81 * SIZE[0])]


def test_mesh_is_in_the_picture_as_a_whole(tmp_path, box_mesh):
    path = tmp_path / "mesh.png"
    write_picture(path, image_of_mesh(box_mesh, title="Before", window_size=SIZE))
    with Image.open(path) as picture:
        image = np.asarray(picture).astype(int)
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


def test_hot_is_bright_and_the_colour_limits_are_used(box_mesh):
    levels = []
    for temperature in (0.0, 50.0, 100.0):
        same = np.full(len(box_mesh.points_m), temperature)
        inside = stage(image_of_mesh(box_mesh, same, clim=(0.0, 100.0), window_size=SIZE).astype(int))
        levels.append(np.median(inside[np.any(inside < 230, axis=-1)].sum(axis=-1)))
    assert levels[0] < levels[1] - 60 < levels[2] - 120


def test_unobserved_surface_is_grey(box_mesh):
    half = replace(box_mesh, observed=box_mesh.points_m[:, 0] < 0.1)
    shares = []
    for grey in (False, True):
        painted = [("no thermal ray", "grey", ~half.observed[half.facets].all(axis=1))] if grey else []
        image = image_of_mesh(half, painted=painted, window_size=SIZE, view_direction=(1, 0.5, -0.5))
        inside = stage(image.astype(int))
        body = inside[np.any(inside < 230, axis=-1)]
        shares.append(np.mean(np.ptp(body, axis=-1) < 8))
    assert shares[0] < 0.1 < 0.3 < shares[1]


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0), (1, 0, 0), (0, 0, -2), (0.3, -0.5, 0.2)])
def test_up_points_up_and_the_camera_looks_down_on_the_mesh(box_mesh, up):
    """What is hot lies above what is cold, and of a body whose upper side alone is hot, that side is seen."""
    height = box_mesh.points_m @ np.array(up)
    inside = stage(image_of_mesh(box_mesh, height, up=up, window_size=SIZE).astype(int))
    body, bright = np.any(inside < 230, axis=-1), inside.sum(axis=-1)
    middle = np.median(bright[body])
    rows = np.arange(len(inside))[:, None] * np.ones(inside.shape[1])
    assert rows[body & (bright > middle)].mean() < rows[body & (bright < middle)].mean() - 0.1 * SIZE[1]
    if sum(part != 0 for part in up) == 1:
        top = np.where(height > height.max() - 1e-9, 1.0, 0.0)
        hot = stage(image_of_mesh(box_mesh, top, up=up, window_size=SIZE).astype(int))
        assert np.mean(hot[body].sum(axis=-1) > 500) > 0.1


def test_a_few_large_values_do_not_make_all_others_grey() -> None:
    (low, high), note = colour_range(np.concatenate([np.linspace(-0.1, 0.1, 999), [-3.4]]))
    assert -0.11 < low < -0.09 and 0.09 < high < 0.11
    assert note == "colours: middle 99 %; all: -3.40 to 0.100"
    assert colour_range(np.linspace(-2.0, 1.0, 50)) == ((-2.0, 1.0), "")


def test_the_surface_of_voxels_has_their_outer_sides_alone() -> None:
    cells = np.zeros((4, 4, 3), bool)
    cells[:2, :3, :1] = cells[3, 3, 2] = True  # a block of 2 x 3 x 1 and one voxel by itself
    points, triangles = voxel_surface(cells)
    first, second, third = points[triangles].transpose(1, 0, 2)
    area = np.linalg.norm(np.cross(second - first, third - first), axis=1) / 2.0
    assert np.allclose(area, 0.5) and area.sum() == 22.0 + 6.0
    assert points.min(axis=0).tolist() == [0.0, 0.0, 0.0] and points.max(axis=0).tolist() == [4.0, 4.0, 3.0]
    assert [len(part) for part in voxel_surface(np.zeros_like(cells))] == [0, 0]
