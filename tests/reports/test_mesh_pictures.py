"""Pictures: what is drawn, where and in which colours."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import pyvista
from PIL import Image

from thermoxels_ns.core.errors import MeshError, OutputError
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
        picture_of_mesh(tmp_path / "g.png", half, grey_unobserved=grey, window_size=SIZE, view_direction=(1, 0.5, -0.5))
        inside = stage(pixels(tmp_path / "g.png"))
        body = inside[np.any(inside < 230, axis=-1)]
        shares.append(np.mean(np.ptp(body, axis=-1) < 8))
    assert shares[0] < 0.1 < 0.3 < shares[1]


def test_all_unobserved_is_all_grey(tmp_path, box_mesh):
    nowhere = replace(box_mesh, observed=np.zeros_like(box_mesh.observed))
    picture_of_mesh(tmp_path / "g.png", nowhere, grey_unobserved=True, window_size=SIZE)
    inside = stage(pixels(tmp_path / "g.png"))
    assert np.all(np.ptp(inside, axis=-1) < 8)
    assert np.mean(inside < 230) > 0.1


def test_legend_of_grey_only_where_there_is_grey(tmp_path, box_mesh, monkeypatch):
    words = []
    monkeypatch.setattr(pyvista.Plotter, "add_text", lambda self, text, **_: words.append(text))
    picture_of_mesh(tmp_path / "g.png", box_mesh, title="T", grey_unobserved=True, window_size=SIZE)
    assert words[0] == "T" and not any("grey" in text for text in words)  # only inner nodes are unseen
    unseen = replace(box_mesh, observed=box_mesh.points_m[:, 0] < 0.1)
    picture_of_mesh(tmp_path / "g.png", unseen, title="T", grey_unobserved=True, window_size=SIZE)
    assert words[2] == "T" and words[3].endswith("; grey: no thermal ray")


def test_colour_map_and_its_title_can_be_chosen(tmp_path, box_mesh, monkeypatch):
    bars = []
    add = pyvista.Plotter.add_scalar_bar
    monkeypatch.setattr(
        pyvista.Plotter,
        "add_scalar_bar",
        lambda self, **how: (bars.append((how["title"], how["fmt"])), add(self, **how))[1],
    )
    blues = []
    for change in (-0.01, 0.01):
        same = np.full(len(box_mesh.points_m), change)
        how: Any = {"clim": (-0.01, 0.01), "colour_map": "coolwarm", "bar_title": "change [K]", "window_size": SIZE}
        picture_of_mesh(tmp_path / "c.png", box_mesh, same, **how)
        inside = stage(pixels(tmp_path / "c.png"))
        body = inside[np.any(inside < 230, axis=-1)]
        blues.append(np.median(body[:, 2] - body[:, 0]))
    assert blues[0] > 50 and blues[1] < -50
    assert bars[0][0] == "change [K]" and "4" in bars[0][1]  # digits enough to tell 0.005 from 0.01


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0), (1, 0, 0), (0, 0, -2), (0.3, -0.5, 0.2)])
def test_up_points_up_and_the_camera_looks_down_on_the_mesh(up):
    right, picture_up, towards_camera = _view_axes(up, None)
    axes = np.stack([right, picture_up, towards_camera])
    assert np.allclose(axes @ axes.T, np.eye(3))
    assert np.linalg.det(axes) == pytest.approx(1.0)
    assert np.dot(up, right) == pytest.approx(0.0, abs=1e-12)
    assert np.dot(up, picture_up) > 0
    assert np.dot(up, towards_camera) > 0


def test_view_direction_points_from_the_camera_to_the_mesh():
    _, _, towards_camera = _view_axes((0, 0, 1), (2.0, 0.0, 0.0))
    assert towards_camera.tolist() == [-1.0, 0.0, 0.0]
    right, up, towards_camera = _view_axes((0, 0, 1), (0.0, 0.0, -1.0))  # straight down: up is free
    assert np.allclose(np.cross(right, up), towards_camera)


def test_bad_input_is_refused(tmp_path, box_mesh):
    with pytest.raises(MeshError, match="temperature_c: expected shape"):
        picture_of_mesh(tmp_path / "a.png", box_mesh, np.zeros(3))
    with pytest.raises(MeshError, match="temperature_c: expected finite"):
        picture_of_mesh(tmp_path / "a.png", box_mesh, np.full(60, np.nan))
    with pytest.raises(MeshError, match="up: expected three finite numbers"):
        picture_of_mesh(tmp_path / "a.png", box_mesh, up=(0, 0, 0))
    with pytest.raises(MeshError, match="clim"):
        picture_of_mesh(tmp_path / "a.png", box_mesh, clim=(0.0, np.nan))
    with pytest.raises(OutputError, match=r"ends in \.png"):
        picture_of_mesh(tmp_path / "a.bmp", box_mesh)
    assert not list(tmp_path.iterdir())


def test_a_few_hot_nodes_do_not_take_all_the_colours() -> None:
    from thermoxels_ns.reports.mesh_pictures import _colour_limits, _without_outliers

    level = np.linspace(10.0, 12.0, 1000)
    with_lamp = np.append(level, [77.0, 78.0])
    assert _colour_limits(_without_outliers(with_lamp)) == pytest.approx((10.0, 12.0), abs=0.05)
    assert _colour_limits(_without_outliers(level)) == (10.0, 12.0)
    assert _colour_limits(_without_outliers(np.append(np.full(1000, 5.0), 9.0))) == (5.0, 9.0)


def test_a_few_large_changes_do_not_make_all_others_grey() -> None:
    change = np.concatenate([np.linspace(-0.1, 0.1, 99), [-3.4]])
    colours, note = change_colours(change)
    low, high = colours["clim"]
    assert low == -high and 0.09 < high < 0.11
    assert note == "colours: 95 % of the nodes; all: -3.4 to 0.1 K"
    even, nothing_to_say = change_colours(np.linspace(-2.0, 1.0, 50))
    assert even["clim"] == (-2.0, 2.0) and nothing_to_say == ""


def test_no_change_at_all_has_a_scale() -> None:
    for change in (np.zeros(5), np.array([0.0] * 99 + [1e-9])):
        colours, note = change_colours(change)
        assert colours["clim"] == (-1e-3, 1e-3) and note == ""
    # All but a few did not change: the scale reaches the few.
    colours, note = change_colours(np.array([0.0] * 99 + [2.0]))
    assert colours["clim"] == (-2.0, 2.0) and note == ""
