"""Pictures of a mesh coloured by temperature, drawn without a screen."""

from __future__ import annotations

import math
import os
import tempfile
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import BoolArray, FloatArray, IntArray
from thermoxels_ns.core.checks import check_direction, replace_when_done, writable_folder
from thermoxels_ns.core.errors import MeshError, OutputError
from thermoxels_ns.mesh.boundary.tags import SUPPORT, support_of_facets
from thermoxels_ns.mesh.tetrahedra import TetMesh

if TYPE_CHECKING:
    import pyvista as pv

    from thermoxels_ns.fem.solution import HeatSolution

# The part of the picture that the mesh may fill, as (left, bottom, right, top) shares of width and height: the title
# is above, the colour bar to the right, the axes and the size below.
_MESH_AREA = (0.04, 0.16, 0.80, 0.90)
_INK = "#202020"
_SUPPORT_COLOURS: tuple[str, ...] = ("green", "gold", "red", "grey")
BAR_TITLE = "temperature [°C]"  # What a colour bar says unless told otherwise
_LEAST_CHANGE_K = 1e-3  # Half the span of the smallest scale of changes, [K]
_SHARE_OF_CHANGES = 0.95
_DARKEST = 0.1  # Share of inferno left out at its dark end, where shading could not be told from cold


def picture_of_mesh(
    path: Path | str,
    mesh: TetMesh,
    temperature_c: npt.NDArray[np.floating] | None = None,
    *,
    title: str = "",
    clim: tuple[float, float] | None = None,
    up: Sequence[float] = (0.0, 0.0, 1.0),
    view_direction: Sequence[float] | None = None,
    painted: Sequence[tuple[str, str, BoolArray]] = (),
    length_unit: str = "m",
    colour_map: str = "inferno",
    bar_title: str = BAR_TITLE,
    note: str = "",
    labels: Sequence[tuple[str, Sequence[float]]] = (),
    size: bool = True,
    ghost: tuple[FloatArray, IntArray] | None = None,
    window_size: tuple[int, int] = (1200, 900),
) -> None:
    """Draw the surface of a mesh, coloured by temperature, as a PNG: all of it, in parallel projection.

    Args:
        path: File to write, ending in .png; its folder is made if need be.
        mesh: The mesh.
        temperature_c: Nodal values to show, shape (n,), [degrees Celsius] unless `bar_title` says otherwise; the
            mesh's own temperatures if left out.
        title: Text above the picture.
        clim: Values at the ends of the colour bar. If left out, the data's extremes; or, where a few nodes stretch
            the range to more than twice that of the middle 99 %, the range of those, and the words below the picture
            give the extremes.
        up: Direction that points up in the picture, in mesh coordinates.
        view_direction: Direction from the camera to the mesh; obliquely from above if left out.
        painted: Boundary triangles that do not show values: what they are, their colour, and a boolean for each
            triangle of the mesh. The words below the picture say which colour is what.
        length_unit: Name of the unit of the node positions, written below the picture.
        colour_map: Name of a colour map of matplotlib, such as "coolwarm" for changes to both sides of 0.
        bar_title: Quantity and unit, written beside the colour bar.
        note: Words below the size of the mesh.
        labels: Short words and the points of the mesh that they stand at, in front of everything.
        size: Write the size of the mesh below the picture.
        ghost: Points (n, 3) and triangles (m, 3) of something beside the mesh, in a grey that one looks through.
        window_size: Width and height, [pixels].
    """
    # Without a screen VTK draws through Mesa, which loads the system's LLVM. A triton (torch's compiler) that is loaded
    # after that ends in a segmentation fault; loaded before, both work.
    with suppress(ImportError):
        import triton  # noqa: F401
    import matplotlib
    import pyvista as pv
    from matplotlib.colors import ListedColormap

    path = Path(path)
    if path.suffix != ".png":
        raise OutputError("picture", expected="a name that ends in .png", got=path.name, remedy="Rename the file.")
    values = np.asarray(mesh.temperature_c if temperature_c is None else temperature_c, dtype=np.float64)
    right, true_up, towards_camera = _view_axes(up, view_direction)
    shown = values[np.unique(mesh.facets)]
    ends = _without_outliers(shown) if clim is None else np.asarray(clim, dtype=np.float64)
    low, high = float(ends.min()), float(ends.max())
    if not high - low > 1e-3:  # a constant temperature gets 1 K around it
        low, high = low - 0.5, high + 0.5
    beyond = clim is None and (float(shown.min()) < low or float(shown.max()) > high)
    extremes = (float(shown.min()), float(shown.max())) if beyond else None

    plain = np.any([which for *_, which in painted], axis=0) if painted else np.zeros(len(mesh.facets), dtype=bool)
    folder = writable_folder(path.parent)
    with _quiet_vtk(), replace_when_done(folder / path.name) as temporary:
        plotter = pv.Plotter(off_screen=True, window_size=list(window_size), lighting="none")
        try:
            plotter.renderer.set_background("white")
            _add_lights(plotter, right, true_up, towards_camera)
            # DejaVu Sans, which comes with matplotlib and has every sign the pictures need.
            font = str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf")
            matter = {"ambient": 0.62, "diffuse": 0.45, "specular": 0.0, "smooth_shading": False}
            if not plain.all():
                start = _DARKEST if colour_map == "inferno" else 0.0
                surface = pv.PolyData.from_regular_faces(mesh.points_m, mesh.facets[~plain])
                surface.point_data["temperature_c"] = values
                plotter.add_mesh(
                    surface,
                    scalars="temperature_c",
                    cmap=ListedColormap(matplotlib.colormaps[colour_map](np.linspace(start, 1.0, 256))),
                    clim=(low, high),
                    show_scalar_bar=False,
                    **matter,
                )
                _add_colour_bar(plotter, font, bar_title, high - low)
            for _, colour, which in painted:
                if which.any():
                    surface = pv.PolyData.from_regular_faces(mesh.points_m, mesh.facets[which])
                    plotter.add_mesh(surface, color=colour, **matter)
            words = "; ".join(f"{colour}: {what}" for what, colour, which in painted if which.any())
            about = _size_of(mesh, length_unit) if size else ""
            in_sight = mesh.points_m[np.unique(mesh.facets)]
            if ghost is not None and len(ghost[1]):
                plotter.add_mesh(pv.PolyData.from_regular_faces(*ghost), color="grey", opacity=0.35, **matter)
                in_sight = np.concatenate((in_sight, ghost[0]))
            _add_words(plotter, title, font, about, note, words, None if plain.all() else extremes)
            if labels:
                _add_labels(plotter, font, labels)
            _frame(plotter, in_sight, right, true_up, towards_camera)
            plotter.screenshot(str(temporary), return_img=False)
        finally:
            plotter.close()


def change_colours(change: npt.NDArray[np.floating]) -> tuple[dict[str, Any], str]:
    """Colours for changes to both sides of 0, [K], as arguments of `picture_of_mesh`, and a note to write below it.

    Where a few nodes changed far more than the rest, all others would be as grey as no change: the scale then ends
    where 95 % of the sizes do, and the note says so; else it is empty.
    """
    size = np.abs(change)
    most, end = float(size.max()), float(np.quantile(size, _SHARE_OF_CHANGES))
    beyond = most > 2.0 * end > _LEAST_CHANGE_K
    end = max(end if beyond else most, _LEAST_CHANGE_K)
    extremes = f"{float(change.min()):.2g} to {float(change.max()):.2g} K"
    note = f"colours: {100 * _SHARE_OF_CHANGES:.0f} % of the nodes; all: {extremes}" if beyond else ""
    return {"clim": (-end, end), "colour_map": "coolwarm", "bar_title": "change [K]"}, note


def _view_axes(
    up: Sequence[float], view_direction: Sequence[float] | None
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Unit vectors of the picture: right, up, and from the mesh to the camera."""
    upwards = _unit("up", up)
    if view_direction is None:
        side = _unit("up", np.cross(np.roll(np.eye(3)[np.argmax(np.abs(upwards))], 2), upwards))
        towards_camera = _unit("view", 0.85 * side + 0.6 * np.cross(upwards, side) + 0.65 * upwards)
    else:
        towards_camera = -_unit("view_direction", view_direction)
    right = np.cross(upwards, towards_camera)
    if np.linalg.norm(right) < 1e-6:
        # Looking along the up axis: any direction across it is as good as another.
        right = np.cross(np.eye(3)[np.argmin(np.abs(towards_camera))], towards_camera)
    right = _unit("right", right)
    return right, np.cross(towards_camera, right), towards_camera


def _unit(name: str, vector: npt.ArrayLike) -> FloatArray:
    array = check_direction(name, vector, "Pass for instance (0, 0, 1).", MeshError)
    return array / float(np.linalg.norm(array))


def _without_outliers(values: FloatArray) -> FloatArray:
    """The values, or the middle 99 % of them where the others stretch their range to more than twice as much."""
    low, high = np.quantile(values, (0.005, 0.995))
    few = np.ptp(values) > 2.0 * (high - low) > 0.0
    return values[(values >= low) & (values <= high)] if few else values


def _add_colour_bar(plotter: pv.Plotter, font: str, title: str, span: float) -> None:
    import pyvista as pv

    height = plotter.window_size[1]
    decimals = 1 if span > 2.0 else 2 + max(0, math.ceil(-math.log10(span)))
    bar = plotter.add_scalar_bar(  # pyright: ignore[reportCallIssue]  (pyvista wraps it without self)
        title=title,
        vertical=True,
        position_x=0.86,
        position_y=0.2,
        width=0.06,
        height=0.6,
        title_font_size=round(height / 38),
        label_font_size=round(height / 38),
        n_labels=5,
        # VTK 9.6 went from printf's to Python's way of writing formats.
        fmt=f"{{:.{decimals}f}}" if pv.vtk_version_info >= (9, 6) else f"%.{decimals}f",
        color=_INK,
        unconstrained_font_size=True,
        render=False,
    )
    bar.SetVerticalTitleSeparation(round(height / 40))
    for words in (bar.GetTitleTextProperty(), bar.GetLabelTextProperty()):
        words.SetFontFamily(4)  # VTK_FONT_FILE
        words.SetFontFile(font)


def _add_lights(plotter: pv.Plotter, right: npt.NDArray, up: npt.NDArray, towards_camera: npt.NDArray) -> None:
    """Three soft parallel lights, so that faces of different direction differ while colours stay readable."""
    import pyvista as pv

    for direction, strength in (
        (towards_camera + 0.6 * up - 0.5 * right, 0.75),
        (towards_camera + 0.2 * up + 1.2 * right, 0.35),
        (up, 0.25),
    ):
        light = pv.Light(position=tuple(direction), focal_point=(0, 0, 0), intensity=strength, light_type="scene light")
        light.positional = False
        plotter.add_light(light)


def _add_words(
    plotter: pv.Plotter,
    title: str,
    font: str,
    about: str,
    note: str,
    painted: str,
    extremes: tuple[float, float] | None,
) -> None:
    """Title, size of the mesh, axes, what plain colours mean, and extremes that the others do not reach."""
    height = plotter.window_size[1]
    how: Any = {"viewport": True, "color": _INK, "font_file": font}
    if title:
        plotter.add_text(title, position=(0.04, 0.925), font_size=round(height / 60), **how)
    beyond = "" if extremes is None else f"colours: middle 99 %; all: {extremes[0]:.1f} to {extremes[1]:.1f}"
    words = "\n".join(line for line in (about, textwrap.fill(painted, 58), beyond, note) if line)
    plotter.add_text(words, position=(0.17, 0.04), font_size=round(height / 78), **how)
    plotter.renderer.add_axes(viewport=(0.0, 0.0, 0.15, 0.155), line_width=3, color=_INK)


def _size_of(mesh: TetMesh, length_unit: str) -> str:
    size = mesh.points_m.max(axis=0) - mesh.points_m.min(axis=0)
    return f"{size[0]:.3g} x {size[1]:.3g} x {size[2]:.3g} {length_unit}, {len(mesh.tets):,} tetrahedra"


def _add_labels(plotter: pv.Plotter, font: str, labels: Sequence[tuple[str, Sequence[float]]]) -> None:
    plotter.add_point_labels(
        np.array([point for _, point in labels], dtype=np.float64),
        [words for words, _ in labels],
        font_size=round(plotter.window_size[1] / 45),
        font_file=font,
        text_color=_INK,
        shape_color="white",
        shape_opacity=0.85,
        margin=4,
        show_points=False,
        always_visible=True,
        reset_camera=False,
    )


def _frame(
    plotter: pv.Plotter, points: FloatArray, right: npt.NDArray, up: npt.NDArray, towards_camera: npt.NDArray
) -> None:
    """Point a parallel camera so that `points` just fill the mesh's area."""
    width, height = plotter.window_size
    left, bottom, area_right, top = _MESH_AREA
    across, along = points @ right, points @ up
    depth = points @ towards_camera
    view_height = max(np.ptp(along) / (top - bottom), np.ptp(across) / (area_right - left) * height / width, 1e-12)
    # The area's centre is off the picture's centre; shift the focal point the other way.
    shift_x = (0.5 * (left + area_right) - 0.5) * view_height * width / height
    shift_y = (0.5 * (bottom + top) - 0.5) * view_height
    focus = (
        (0.5 * (across.min() + across.max()) - shift_x) * right
        + (0.5 * (along.min() + along.max()) - shift_y) * up
        + 0.5 * (depth.min() + depth.max()) * towards_camera
    )
    distance = 2.0 * view_height + float(np.ptp(depth))
    camera = plotter.camera
    camera.focal_point = tuple(focus)
    camera.position = tuple(focus + distance * towards_camera)
    camera.up = tuple(up)
    camera.enable_parallel_projection()
    camera.parallel_scale = 0.5 * view_height
    plotter.camera_set = True
    plotter.reset_camera_clipping_range()


@contextmanager
def _quiet_vtk() -> Iterator[None]:
    """Without a display VTK draws in software and warns that it found no X server, which nobody needs to read."""
    from vtkmodules.vtkCommonCore import vtkLogger

    if os.environ.get("DISPLAY"):
        yield
        return
    before = vtkLogger.GetCurrentVerbosityCutoff()
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)
    try:
        yield
    finally:
        vtkLogger.SetStderrVerbosity(before)


def draw_mesh(paths: Sequence[Path], mesh: TetMesh, look: Mapping[str, Any], length_unit: str) -> None:
    """Draw the mesh twice: all temperatures, and with grey where no thermal ray measured one.

    `look` are the arguments `up` and `view_direction` of `picture_of_mesh`.
    """
    every, measured = paths
    picture_of_mesh(every, mesh, title="Surface temperature", length_unit=length_unit, **look)
    painted = [("no thermal ray", "grey", ~mesh.observed[mesh.facets].all(axis=1))]
    title = "Measured surface temperature"
    picture_of_mesh(measured, mesh, title=title, painted=painted, length_unit=length_unit, **look)


def draw_heat(path: Path, mesh: TetMesh, solution: HeatSolution, look: Mapping[str, Any]) -> None:
    """Draw the temperatures before and after in one range of colours, and beside them the change in its own.

    `look` are the arguments `up` and `view_direction` of `picture_of_mesh`.
    """
    from PIL import Image

    shown = np.unique(mesh.facets)
    before, after = solution.temperature_c[0], solution.temperature_c[-1]
    change = after - before
    ends = np.concatenate([before[shown], after[shown]])
    diverging, note = change_colours(change[shown])
    first, last = f"{solution.times_s[0]:g} s", f"{solution.times_s[-1]:g} s"
    same: Any = {"clim": (float(ends.min()), float(ends.max()))}
    panels = [
        _panel(mesh, values, title=title, **colours, **look)
        for title, values, colours in (
            (f"Surface temperature at {first}", before, same),
            (f"Surface temperature at {last}", after, same),
            (f"Change from {first} to {last}", change, {**diverging, "note": note}),
        )
    ]
    with replace_when_done(path) as temporary:
        Image.fromarray(np.concatenate(panels, axis=1)).save(temporary)


def add_support(path: Path, mesh: TetMesh, look: Mapping[str, Any]) -> None:
    """Add to a picture of a mesh's quality two views, from opposite sides, of how photographs support its surface.

    `look` are the arguments `up` and `view_direction` of `picture_of_mesh`. The mesh must know its photographs.
    """
    from PIL import Image

    support = support_of_facets(mesh)
    assert support is not None
    painted = [(*of, support == number) for number, of in enumerate(zip(SUPPORT.values(), _SUPPORT_COLOURS))]
    painted.append(("cut by the scene box or the region", "white", support < 0))
    with Image.open(path) as image:
        above = np.asarray(image.convert("RGB"))
    width, up = above.shape[1], _unit("up", look["up"])
    ahead = -_view_axes(look["up"], look["view_direction"])[2]
    beside = {"painted": painted, "up": up, "window_size": (width // 2, width // 2)}
    panels = [
        _panel(mesh, title="Support by photographs", view_direction=ahead, **beside),
        _panel(mesh, title="From the other side", view_direction=2.0 * (ahead @ up) * up - ahead, **beside),
    ]
    row = np.full((panels[0].shape[0], *above.shape[1:]), 255, dtype=np.uint8)
    row[:, : 2 * (width // 2)] = np.concatenate(panels, axis=1)
    with replace_when_done(path) as temporary:
        Image.fromarray(np.concatenate((above, row))).save(temporary)


def _panel(mesh: TetMesh, temperature_c: FloatArray | None = None, **how: Any) -> npt.NDArray[np.uint8]:
    """A picture of the mesh as an array, shape (h, w, 3); the arguments are those of `picture_of_mesh`."""
    from PIL import Image

    with tempfile.TemporaryDirectory() as scratch:
        picture_of_mesh(Path(scratch) / "panel.png", mesh, temperature_c, **how)
        with Image.open(Path(scratch) / "panel.png") as image:
            return np.asarray(image.convert("RGB"))
