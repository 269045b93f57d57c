"""Draws docs/house-corner.png: photographs of the synthetic house, the mesh made from them, and heat flowing in it.

    make demo
    python tests/benchmarks/house_picture.py --scene demo/scene --export demo/export --output docs/house-corner.png

The mesh is seen from where the photograph was taken, all temperatures in one range of colours. Arrows show the
direction of the heat flow in the plane of the cut at the end of the export's heat computation; their length grows with
the cube root of its size.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyvista as pv
import tyro
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from PIL import Image

from thermoxels_ns.core.checks import replace_when_done

Vector = npt.NDArray[np.float64]

_COLOURS = ListedColormap(colormaps["inferno"](np.linspace(0.08, 1.0, 256)))
_INK = "#1d2430"
_PIXELS = 1200
_MARGIN = 1.04
_ARROW_EVERY_M, _ARROW_M = 0.42, 0.40


@dataclass(frozen=True)
class Pose:
    """Where a photograph was taken."""

    centre: Vector
    """The camera, [m]."""
    back: Vector
    """Away from what it sees."""
    up: Vector
    """Upwards in the picture."""


def pose_of(scene: Path, frame: str) -> Pose:
    """Look a frame's pose up."""
    content = json.loads((scene / "transforms.json").read_text())
    matrix = next(f["transform_matrix"] for f in content["frames"] if Path(f["file_path"]).stem == frame)
    pose = np.asarray(matrix, dtype=np.float64)
    return Pose(pose[:3, 3], pose[:3, 2], pose[:3, 1])


def temperatures_of(scene: Path, frame: str) -> Vector:
    """A thermal image, [degrees Celsius]."""
    bounds = json.loads((scene / "temperature_bounds.json").read_text())
    low, high = (float(bounds[f"absolute_{end}_temperature"]) for end in ("min", "max"))
    counts = np.asarray(Image.open(scene / "thermal" / f"{frame}.png"), dtype=np.float64)
    return low + counts / 65535.0 * (high - low)


def plotter_for(points: Vector, pose: Pose, shape: float) -> pv.Plotter:
    """A white stage seen from a pose, wide enough that all points are in it; `shape` is width over height."""
    plotter = pv.Plotter(off_screen=True, window_size=[round(_PIXELS * shape), _PIXELS], lighting="none")
    plotter.set_background("white")  # pyright: ignore[reportArgumentType, reportCallIssue]
    focus = 0.5 * (points.min(axis=0) + points.max(axis=0))
    ahead = (focus - pose.centre) / np.linalg.norm(focus - pose.centre)
    right = np.cross(ahead, pose.up)
    right /= np.linalg.norm(right)
    true_up = np.cross(right, ahead)
    away = points - pose.centre
    depth = away @ ahead
    # Shift the picture rather than turn the camera: upright edges stay upright.
    across, along = away @ right / depth, away @ true_up / depth
    half = 0.5 * _MARGIN * max(float(np.ptp(along)), float(np.ptp(across)) / shape)
    camera = plotter.camera
    camera.position, camera.focal_point, camera.up = tuple(pose.centre), tuple(pose.centre + ahead), tuple(true_up)
    camera.view_angle = float(np.degrees(2 * np.arctan(half)))
    middle_x, middle_y = 0.5 * (across.max() + across.min()), 0.5 * (along.max() + along.min())
    camera.SetWindowCenter(middle_x / half / shape, middle_y / half)
    for direction, strength in (
        (-ahead + 0.6 * true_up - 0.7 * right, 0.75),
        (-ahead + 0.2 * true_up + 1.2 * right, 0.35),
        (true_up, 0.3),
    ):
        light = pv.Light(position=tuple(direction), focal_point=(0, 0, 0), intensity=strength, light_type="scene light")
        light.positional = False
        plotter.add_light(light)
    plotter.enable_anti_aliasing("ssaa")
    plotter.camera_set = True
    return plotter


def picture_of(plotter: pv.Plotter) -> npt.NDArray[np.uint8]:
    """Draw what is on a stage."""
    plotter.reset_camera_clipping_range()
    picture = np.asarray(plotter.screenshot(return_img=True))
    plotter.close()
    return picture


def surface(grid: Any, pose: Pose, clim: tuple[float, float], shape: float) -> npt.NDArray[np.uint8]:
    """The body from outside."""
    points = np.asarray(grid.points, dtype=np.float64)
    plotter = plotter_for(points, pose, shape)
    matter: dict[str, Any] = {"ambient": 0.6, "diffuse": 0.5, "smooth_shading": False}
    outside = grid.extract_surface(algorithm="dataset_surface")
    plotter.add_mesh(outside, scalars="temperature_c", cmap=_COLOURS, clim=clim, show_scalar_bar=False, **matter)
    return picture_of(plotter)


def cut_open(grid: Any, pose: Pose, clim: tuple[float, float], shape: float) -> npt.NDArray[np.uint8]:
    """The body without the part in front of an upright plane, its tetrahedra, and the heat flow in the plane."""
    points = np.asarray(grid.points, dtype=np.float64)
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    towards = np.sign(pose.back) * np.eye(3)[np.argmax(np.abs(pose.back[:2]))]
    half = grid.clip(normal=towards, origin=middle).extract_surface(algorithm="dataset_surface")
    plane = grid.slice(normal=towards, origin=middle + 1e-3 * towards)
    plotter = plotter_for(np.asarray(half.points, dtype=np.float64), pose, shape)
    matter: dict[str, Any] = {"scalars": "temperature_c", "cmap": _COLOURS, "clim": clim, "show_scalar_bar": False}
    plotter.add_mesh(half, ambient=0.6, diffuse=0.5, smooth_shading=False, **matter)
    edges: dict[str, Any] = {"show_edges": True, "edge_color": "white", "edge_opacity": 0.28, "line_width": 1.0}
    plotter.add_mesh(plane, lighting=False, **edges, **matter)

    from scipy.spatial import KDTree

    flow = -np.asarray(plane.point_data["gradient"], dtype=np.float64)
    flow -= np.outer(flow @ towards, towards)
    across = np.cross([0.0, 0.0, 1.0], towards)
    where = np.asarray(plane.points, dtype=np.float64)
    flat = np.stack([where @ across, where[:, 2]], axis=1)
    low, high = flat.min(axis=0), flat.max(axis=0)
    lattice = np.stack(
        np.meshgrid(*(np.arange(a + 0.5 * _ARROW_EVERY_M, b, _ARROW_EVERY_M) for a, b in zip(low, high))), axis=-1
    ).reshape(-1, 2)
    on_plane = lattice[:, :1] * across + lattice[:, 1:] * [0.0, 0.0, 1.0] + (where[0] @ towards) * towards
    _, closest = plane.find_closest_cell(on_plane, return_closest_point=True)
    inside = np.linalg.norm(closest - on_plane, axis=1) < 1e-3
    _, nearest = KDTree(flat).query(lattice[inside], k=8)
    mean = flow[nearest].mean(axis=1)
    size = np.linalg.norm(mean, axis=1)
    arrows = pv.PolyData(on_plane[inside] + 0.05 * towards)
    arrows.point_data["flow"] = mean / size[:, None]
    arrows.point_data["length"] = _ARROW_M * np.clip(np.cbrt(size / np.quantile(size, 0.9)), 0.35, 1.0)
    shaft = pv.Arrow(start=(-0.5, 0, 0), tip_length=0.4, tip_radius=0.17, shaft_radius=0.055)
    glyphs: Any = arrows.glyph(orient="flow", scale="length", geom=shaft)
    plotter.add_mesh(glyphs, color="white", lighting=False)
    return picture_of(plotter)


def show(axis: Axes, picture: Any, words: str, **how: Any) -> Any:
    """One panel and the words below it."""
    shown = axis.imshow(picture, **how)
    axis.set_axis_off()
    below: dict[str, Any] = {"xycoords": "axes fraction", "textcoords": "offset points", "va": "top"}
    axis.annotate(words, (0.0, 0.0), (0.0, -9.0), fontsize=13, color=_INK, **below)
    return shown


def draw(scene: Path, export: Path, output: Path, frame: str = "frame_train_00026") -> None:
    """Draw the picture.

    Args:
        scene: The scene's folder.
        export: The folder of an export of it in metres.
        output: The picture to write, ending in .png.
        frame: The photograph to show.
    """
    pose = pose_of(scene, frame)
    photograph = Image.open(scene / "images" / f"{frame}.png").convert("RGB")
    large = photograph.resize((photograph.width * 3, photograph.height * 3), Image.Resampling.LANCZOS)
    thermal = temperatures_of(scene, frame)
    grid = pv.UnstructuredGrid(export / "mesh.vtu")
    heat: Any = pv.UnstructuredGrid(sorted((export / "heat").glob("step-*.vtu"))[-1])
    heat = heat.compute_derivative(scalars="temperature_c", gradient=True)
    warm = np.asarray(grid.point_data["temperature_c"])
    clim = float(np.floor(warm.min())), float(np.ceil(warm.max()))
    pairs = len(list((scene / "images").glob("frame_train_*")))

    width, gap, left = 16.0, 0.25, 3.7
    large_width = (width - 2 * gap - left - 0.85) / 2
    inner = 0.5
    height = 2 * 0.75 * left + inner
    words = 0.42
    shape = large_width / height
    figure = Figure(figsize=(width, height + words), dpi=100, facecolor="white")
    total = height + words

    def axis(x: float, y: float, w: float, h: float) -> Axes:
        return figure.add_axes((x / width, y / total, w / width, h / total))

    small = 0.75 * left
    show(axis(0.0, words + small + inner, left, small), large, f"{pairs} photographs", aspect="auto")
    colours: dict[str, Any] = {"cmap": _COLOURS, "norm": Normalize(*clim)}
    shown = show(
        axis(0.0, words, left, small),
        thermal,
        f"{pairs} thermal photographs",
        interpolation="lanczos",
        aspect="auto",
        **colours,
    )
    number = f"{grid.n_cells / 1e6:.1f} million tetrahedra" if grid.n_cells > 1e6 else f"{grid.n_cells:,} tetrahedra"
    show(
        axis(left + gap, words, large_width, height),
        surface(grid, pose, clim, shape),
        f"become a solid with temperatures: {number},",
        aspect="auto",
    )
    show(
        axis(left + 2 * gap + large_width, words, large_width, height),
        cut_open(heat, pose, clim, shape),
        "in which heat flows (cut open)",
        aspect="auto",
    )
    bar = figure.colorbar(shown, cax=axis(width - 0.75, words + 0.25 * height, 0.2, 0.5 * height))
    bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue, reportAttributeAccessIssue]
    bar.ax.tick_params(labelsize=11, colors=_INK, length=0)
    bar.ax.set_title("\N{DEGREE SIGN}C", fontsize=12, color=_INK, pad=8)
    stream = BytesIO()
    figure.savefig(stream, format="png")
    with replace_when_done(output) as temporary:
        Image.open(stream).convert("RGB").save(temporary, format="PNG", optimize=True)


if __name__ == "__main__":
    tyro.cli(draw)
