"""Draw pictures of a mesh coloured by temperature, without a screen."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import BoolArray, FloatArray, IntArray
from thermoxels_ns.core.checks import check_direction, replace_when_done
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.tetrahedra import FACET_BOX, SUPPORT, TetMesh, support_of_facets
from thermoxels_ns.reports.numbers import duration_text, figure
from thermoxels_ns.reports.page import image_file

if TYPE_CHECKING:
    import pyvista as pv

# Part of the picture that the mesh may fill, as (left, bottom, right, top) shares of width and height. The title is
# above this part, the colour bar is to the right, and the axes and the size of the mesh are below.
_MESH_AREA = (0.04, 0.16, 0.80, 0.90)
_INK = "#202020"
_SUPPORT_COLOURS: tuple[str, ...] = ("green", "gold", "red", "grey")
HEAT_PICTURES = ("surface-end.png", "cut.png")
"""File names of the pictures of a heat run."""
_MATTER = {"ambient": 0.5, "diffuse": 0.65, "smooth_shading": False}  # Light that keeps colours readable in the shade
_DARKEST = 0.1  # Share of the colour map inferno left out at its dark end, where shading would look like cold


def voxel_surface(cells: BoolArray) -> tuple[FloatArray, IntArray]:
    """Return the surface of the voxels that are True: points in lattice indices, (n, 3), and triangles, (m, 3)."""
    squares = [np.zeros((0, 4, 3), np.int64)]
    for axis in range(3):
        u, v = np.eye(3, dtype=np.int64)[[(axis + 1) % 3, (axis + 2) % 3]]
        low = np.argwhere(np.diff(cells, axis=axis, prepend=False, append=False))
        squares.append(low[:, None] + np.stack([0 * u, u, u + v, v]))
    points, corners = np.unique(np.concatenate(squares).reshape(-1, 3), axis=0, return_inverse=True)
    return points.astype(np.float64), corners.reshape(-1, 4)[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)


def image_of_surface(
    points_m: FloatArray,
    facets: IntArray,
    values: npt.NDArray[np.floating],
    *,
    title: str = "",
    clim: tuple[float, float] | None = None,
    up: Sequence[float] = (0.0, 0.0, 1.0),
    view_direction: Sequence[float] | None = None,
    painted: Sequence[tuple[str, str, BoolArray]] = (),
    colour_map: str = "inferno",
    bar_title: str = "temperature [°C]",
    words: Sequence[str] = (),
    labels: Sequence[tuple[str, Sequence[float]]] = (),
    ghost: tuple[FloatArray, IntArray] | None = None,
    window_size: tuple[int, int] = (1200, 900),
) -> npt.NDArray[np.uint8]:
    """Return a picture of a surface coloured by values, in parallel projection, shape (height, width, 3).

    Args:
        points_m: Nodes, shape (n, 3).
        facets: Triangles of the surface, shape (f, 3).
        values: Values of nodes, shape (n,), or of triangles, (f,), such as temperatures [degrees Celsius].
        title: Text above the picture.
        clim: Values at the ends of the colour bar; None: those of `colour_range`, whose note is written below.
        up: Direction that points up in the picture.
        view_direction: Direction from the camera to the surface; None: obliquely from above.
        painted: Groups of triangles that show one colour instead of values: a description, the colour, and a boolean
            for each triangle, shape (f,). A line below the picture explains the colours.
        colour_map: Name of a colour map of matplotlib, such as "coolwarm" for changes to both sides of 0.
        bar_title: Quantity and unit, written beside the colour bar.
        words: Lines below the picture.
        labels: Short texts and the points where the texts stand, in front of everything else.
        ghost: Points (n, 3) and triangles (m, 3) of a second surface, drawn in transparent grey.
        window_size: Width and height, [pixels].
    """
    # Without a screen VTK draws through Mesa, which loads the system's LLVM. If triton (torch's compiler) is loaded
    # after Mesa, the program ends in a segmentation fault; if triton is loaded first, both work.
    with suppress(ImportError):
        import triton  # noqa: F401
    import matplotlib
    import pyvista as pv
    from matplotlib.colors import ListedColormap
    from vtkmodules.vtkCommonCore import vtkLogger

    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)  # without a display VTK warns that it found no X server
    nodes = np.unique(facets)
    of_triangles = len(values) == len(facets) != len(points_m)
    (low, high), note = colour_range(values if of_triangles else values[nodes]) if clim is None else (clim, "")
    if not high - low > 1e-3:  # the colours of a constant temperature span 1 K
        low, high = low - 0.5, high + 0.5
    plain = np.any([which for *_, which in painted], axis=0) if painted else np.zeros(len(facets), dtype=bool)
    below = [
        *words,
        textwrap.fill("; ".join(f"{colour}: {what}" for what, colour, which in painted if which.any()), 58),
    ]
    if not plain.all():
        below.append(note)

    height = window_size[1]
    plotter = pv.Plotter(off_screen=True, window_size=list(window_size))
    try:
        plotter.renderer.set_background("white")
        if not plain.all():
            surface = pv.PolyData.from_regular_faces(points_m, facets[~plain])
            data = surface.cell_data if of_triangles else surface.point_data
            data["value"] = values[~plain] if of_triangles else values
            start = _DARKEST if colour_map == "inferno" else 0.0
            colours = ListedColormap(matplotlib.colormaps[colour_map](np.linspace(start, 1.0, 256)))
            decimals = max(1, 2 - math.floor(math.log10(high - low)))  # so that no two labels are equal
            # From VTK 9.6 on, formats are written as in Python instead of as in printf.
            form = f"{{:.{decimals}f}}" if pv.vtk_version_info >= (9, 6) else f"%.{decimals}f"
            bar_look: Any = {"title": f"{bar_title}\n", "fmt": form, "color": _INK, "unconstrained_font_size": True}
            bar_look |= {"vertical": True, "position_x": 0.86, "position_y": 0.2, "width": 0.06, "height": 0.6}
            bar_look |= {"title_font_size": round(height / 38), "label_font_size": round(height / 38)}
            plotter.add_mesh(surface, cmap=colours, clim=(low, high), scalar_bar_args=bar_look, **_MATTER)
        for _, colour, which in painted:
            if which.any():
                plotter.add_mesh(pv.PolyData.from_regular_faces(points_m, facets[which]), color=colour, **_MATTER)
        in_sight = points_m[nodes]
        if ghost is not None and len(ghost[1]):
            plotter.add_mesh(pv.PolyData.from_regular_faces(*ghost), color="grey", opacity=0.35, **_MATTER)
            in_sight = np.concatenate((in_sight, ghost[0]))
        if labels:
            look: Any = {"font_size": round(height / 45), "text_color": _INK, "shape_color": "white"}
            points = np.array([point for _, point in labels], dtype=np.float64)
            texts = [text for text, _ in labels]
            plotter.add_point_labels(points, texts, show_points=False, always_visible=True, **look)
        written: Any = {"viewport": True, "color": _INK}
        plotter.add_text(title, position=(0.04, 0.925), font_size=round(height / 60), **written)
        lines = "\n".join(line for line in below if line)
        plotter.add_text(lines, position=(0.17, 0.04), font_size=round(height / 78), **written)
        plotter.renderer.add_axes(viewport=(0.0, 0.0, 0.15, 0.155), color=_INK)
        _frame(plotter, in_sight, _unit("up", up), _towards_camera(up, view_direction))
        return np.array(plotter.screenshot(return_img=True))
    finally:
        plotter.close()


def write_picture(path: Path, image: npt.NDArray[np.uint8]) -> None:
    """Write a picture, shape (h, w, 3), as a PNG file; an interrupted write leaves no broken file."""
    with replace_when_done(path) as temporary:
        temporary.write_bytes(image_file(image, "PNG"))


def image_of_mesh(
    mesh: TetMesh, values: FloatArray | None = None, length_unit: str = "m", note: str = "", **look: Any
) -> npt.NDArray[np.uint8]:
    """Draw the boundary of a mesh, shape (height, width, 3), with the size of the mesh and `note` written below.

    `values`, (n,), are values of nodes; None: temperatures. `look` are arguments of `image_of_surface`.
    """
    shown = mesh.temperature_c if values is None else values
    if values is None and not mesh.has_temperatures and "painted" not in look:
        look["painted"] = [("no temperatures, photographs alone", "grey", np.ones(len(mesh.facets), dtype=bool))]
    return image_of_surface(mesh.points_m, mesh.facets, shown, words=(_size_of(mesh, length_unit), note), **look)


def _size_of(mesh: TetMesh, length_unit: str) -> str:
    size = " x ".join(f"{side:.3g}" for side in np.ptp(mesh.points_m, axis=0))
    return f"{size} {length_unit}, {len(mesh.tets):,} tetrahedra"


def colour_range(values: npt.NDArray[np.floating]) -> tuple[tuple[float, float], str]:
    """Return the values at both ends of a colour bar, and a note to be written below the picture.

    The ends are the least and the largest value, and the note is empty. But if the range of all values is more than
    twice the range of the middle 99 %, the ends are those of the middle 99 %, and the note gives least and largest.
    """
    least, low, high, largest = np.quantile(values, (0.0, 0.005, 0.995, 1.0)).tolist()
    if largest - least > 2.0 * (high - low) > 0.0:
        return (low, high), f"colours: middle 99 %; all: {figure(least)} to {figure(largest)}"
    return (least, largest), ""


def _towards_camera(up: Sequence[float], view_direction: Sequence[float] | None) -> FloatArray:
    """Return the unit vector from the surface to the camera; obliquely upwards if `view_direction` is None."""
    if view_direction is not None:
        return -_unit("view_direction", view_direction)
    upwards = _unit("up", up)
    side = _unit("up", np.cross(np.roll(np.eye(3)[np.argmax(np.abs(upwards))], 2), upwards))
    return _unit("view", 0.85 * side + 0.6 * np.cross(upwards, side) + 0.65 * upwards)


def _unit(name: str, vector: npt.ArrayLike) -> FloatArray:
    return check_direction(name, vector, "Pass for instance (0, 0, 1).", MeshError)


def _frame(plotter: pv.Plotter, points: FloatArray, up: FloatArray, towards_camera: FloatArray) -> None:
    """Set a parallel camera so that `points` just fill `_MESH_AREA`."""
    if np.linalg.norm(np.cross(up, towards_camera)) < 1e-6:  # seen along up: any other axis may point up instead
        up = np.eye(3)[np.argmin(np.abs(towards_camera))]
    right = _unit("right", np.cross(up, towards_camera))
    axes = np.stack((right, np.cross(towards_camera, right), towards_camera))
    width, height = plotter.window_size
    left, bottom, area_right, top = _MESH_AREA
    low, high = (points @ axes.T).min(axis=0), (points @ axes.T).max(axis=0)
    across, along, depth = high - low
    camera = plotter.camera
    camera.enable_parallel_projection()
    camera.parallel_scale = 0.5 * max(along / (top - bottom), across / (area_right - left) * height / width, 1e-12)
    middle = 0.5 * (low + high) @ axes
    camera.focal_point = tuple(middle)
    camera.position = tuple(middle + (4.0 * camera.parallel_scale + depth) * towards_camera)
    camera.up = tuple(axes[1])
    camera.SetWindowCenter(1.0 - left - area_right, 1.0 - bottom - top)  # the area's centre is not the picture's
    plotter.camera_set = True
    plotter.reset_camera_clipping_range()


def draw_surface(
    folder: Path, mesh: TetMesh, states_c: FloatArray, times_s: FloatArray, up: tuple[float, float, float]
) -> None:
    """Write the pictures `HEAT_PICTURES` of the last state of a heat run into a folder.

    Colours of the surface span the part that photographs show, because the inside of a heated building is far warmer.
    `states_c` are nodal temperatures, shape (s, n), at `times_s`, shape (s,).
    """
    seen = (mesh.facet_tags != FACET_BOX) & mesh.boundary.seen
    shown = np.unique(mesh.facets[seen] if seen.any() else mesh.facets)
    when = ", steady" if len(times_s) == 1 else f" at {duration_text(float(times_s[-1]))}"
    clim, note = colour_range(states_c[-1][shown])
    title = f"Surface temperature{when}"
    image = image_of_mesh(mesh, states_c[-1], up=up, title=title, clim=clim, note=note)
    write_picture(folder / HEAT_PICTURES[0], image)
    points, facets, values, view = cut_open(mesh, states_c[-1], up)
    title, words = f"Cut through the middle{when}", [_size_of(mesh, "m")]
    image = image_of_surface(points, facets, values, title=title, words=words, up=up, view_direction=view.tolist())
    write_picture(folder / HEAT_PICTURES[1], image)


def cut_open(
    mesh: TetMesh, nodal_c: FloatArray, up: tuple[float, float, float]
) -> tuple[FloatArray, IntArray, FloatArray, FloatArray]:
    """Cut a body by a vertical plane through its middle, and remove the half in front of the plane.

    Returns nodes (n, 3), triangles (f, 3) and nodal temperatures (n,) of the surface of the half that is kept, and a
    direction from the camera to the cut, shape (3,). `nodal_c` are temperatures of the mesh's nodes.
    """
    import pyvista as pv
    from vtkmodules.vtkFiltersGeometry import vtkDataSetSurfaceFilter

    upwards = np.array(up) / np.linalg.norm(up)
    # The plane is at right angles to the shorter horizontal extent, so that the cut is as large as possible.
    sides = [axis - (axis @ upwards) * upwards for axis in np.eye(3)]
    sides = [side / np.linalg.norm(side) for side in sides if np.linalg.norm(side) > 0.5]
    towards = min(sides, key=lambda side: float(np.ptp(mesh.points_m @ side)))
    across = mesh.points_m @ towards
    origin = towards * 0.5 * float(across.min() + across.max())
    grid = pv.UnstructuredGrid({pv.CellType.TETRA: mesh.tets}, mesh.points_m)
    grid.point_data["value"] = nodal_c
    outside = vtkDataSetSurfaceFilter()
    outside.SetInputData(grid.clip(normal=tuple(towards), origin=tuple(origin)))
    outside.Update()
    surface: Any = pv.wrap(outside.GetOutput()).triangulate()
    view = -(towards + 0.25 * np.cross(upwards, towards) + 0.3 * upwards)
    facets = np.array(surface.regular_faces, dtype=np.int64)
    return np.array(surface.points, np.float64), facets, np.array(surface.point_data["value"], np.float64), view


def draw_support(path: Path, mesh: TetMesh, look: Mapping[str, Any]) -> None:
    """Write a picture of two views of the mesh, from opposite sides, coloured by the classes of `SUPPORT`.

    `look` are the arguments `up` and `view_direction` of `image_of_surface`; `mesh.boundary.photographs` must be known.
    """
    support = support_of_facets(mesh)
    assert support is not None
    painted = [(*of, support == number) for number, of in enumerate(zip(SUPPORT.values(), _SUPPORT_COLOURS))]
    painted.append(("cut by the scene box or the region", "white", support < 0))
    up, ahead = _unit("up", look["up"]), -_towards_camera(look["up"], look["view_direction"])
    views = {"Support by photographs": ahead, "From the other side": 2.0 * (ahead @ up) * up - ahead}
    beside = {"painted": painted, "up": up, "window_size": (700, 700)}
    panels = [image_of_mesh(mesh, title=title, view_direction=view, **beside) for title, view in views.items()]
    write_picture(path, np.concatenate(panels, axis=1))
