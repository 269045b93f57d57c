"""Pictures of a heat computation: the surface at its start and end, and temperatures and heat flows over time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from thermoxels_ns.fem.solution import HeatSolution
from thermoxels_ns.mesh.tetrahedra import FACET_BOX, TetMesh
from thermoxels_ns.reports.charts import curves_over_time
from thermoxels_ns.reports.numbers import duration_text, time_unit

Vector = npt.NDArray[np.float64]

PICTURES = ("surface-start.png", "surface-end.png", "surface-change.png", "cut.png")
"""Names of the pictures; of a steady state there are the second and the last only."""

_MOST_LINES = 8  # Curves in one plot; more cannot be told apart


def draw_surface(
    folder: Path, mesh: TetMesh, states_c: Vector, times_s: Vector, up: tuple[float, float, float]
) -> list[str]:
    """Draw the surface at the start, at the end, and the change (of a steady state once), and a cut through the body.

    Colours of the surface span what photographs show of it: inside a heated building it is far warmer. States are nodal
    temperatures, shape (s, n), [degrees Celsius], at times of shape (s,), [s]. Returns the names of the files.
    """
    from thermoxels_ns.reports.mesh_pictures import change_colours, picture_of_mesh

    start, end, change, cut = PICTURES
    seen = mesh.facet_tags != FACET_BOX
    if mesh.boundary is not None:
        seen = seen & mesh.boundary.seen
    shown = np.unique(mesh.facets[seen] if seen.any() else mesh.facets)
    steady = len(times_s) == 1
    ends_c = states_c[[0, -1]][:, shown]
    least, most = float(ends_c.min()), float(ends_c.max())
    low, high = (float(end) for end in np.quantile(ends_c, (0.005, 0.995)))
    # Colours span the middle 99 % where a few values stretch the scale to more than twice that.
    beyond = most - least > 2.0 * (high - low) > 0.0
    low, high = (low, high) if beyond else (least, most)
    same: Any = {"clim": (low, high), "up": up}
    few = "; colours: middle 99 %" if beyond else ""
    first, last = duration_text(float(times_s[0])), duration_text(float(times_s[-1]))
    when = ", steady" if steady else f" at {last}"
    picture_of_mesh(folder / end, mesh, states_c[-1], title=f"Surface temperature{when}{few}", **same)
    half, values, view = cut_open(mesh, states_c[-1], up)
    title = f"Cut through the middle{when}"
    picture_of_mesh(folder / cut, half, values, title=title, up=up, view_direction=view.tolist())
    if steady:
        return [end, cut]
    difference = states_c[-1] - states_c[0]
    diverging, note = change_colours(difference[shown])
    picture_of_mesh(folder / start, mesh, states_c[0], title=f"Surface temperature at {first}{few}", **same)
    title = f"Change from {first} to {last}"
    picture_of_mesh(folder / change, mesh, difference, title=title, note=note, up=up, **diverging)
    return list(PICTURES)


def cut_open(mesh: TetMesh, nodal_c: Vector, up: tuple[float, float, float]) -> tuple[TetMesh, Vector, Vector]:
    """Take away the half of a body in front of an upright plane through its middle.

    Returns what is left, as a mesh to draw (its nodes and boundary triangles are real, its tetrahedra only a number),
    the values at its nodes, and the direction to look in, shape (3,).
    """
    import pyvista as pv
    from vtkmodules.vtkFiltersGeometry import vtkDataSetSurfaceFilter

    upwards = np.array(up) / np.linalg.norm(up)
    # Across the shorter of the two sides, so that the cut is the larger one.
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
    points = np.array(surface.points, dtype=np.float64)
    facets = np.array(surface.regular_faces, dtype=np.int64)
    half = TetMesh(
        points_m=points,
        tets=np.zeros_like(mesh.tets),
        temperature_c=np.array(surface.point_data["value"], dtype=np.float64),
        observed=np.ones(len(points), dtype=bool),
        facets=facets,
        facet_tags=np.zeros(len(facets), np.int64),
        region=mesh.region,
        region_names=mesh.region_names,
    )
    return half, half.temperature_c, -(towards + 0.25 * np.cross(upwards, towards) + 0.3 * upwards)


def plot_over_time(solution: HeatSolution, mean_c: Vector, probes_c: Vector, probe_names: Sequence[str]) -> str:
    """Plot temperatures and heat flows over time as an svg element.

    `mean_c` is that of the volume, shape (s + 1,), `probes_c` has shape (s + 1, p), [degrees Celsius].
    """
    unit, seconds = time_unit(float(solution.times_s[-1]))
    probes = [(name, probes_c[:, column]) for column, name in enumerate(probe_names)][:_MOST_LINES]
    states = solution.temperature_c
    # An effect's heat is a mean over each interval.
    flows = [(heat.effect, heat.heat_w) for heat in strongest(solution)[:_MOST_LINES]]
    return curves_over_time(
        solution.times_s / seconds,
        unit,
        [("mean of the volume", mean_c), *probes],
        ("coldest to hottest", states.min(axis=1), states.max(axis=1)),
        [*flows, ("all together: stored", solution.heat_w)],
        ("temperature [°C]", "heat flow into the body [W]"),
    )


def strongest(solution: HeatSolution) -> list[Any]:
    """Effects with some heat, the strongest first."""
    sizes = {id(heat): float(np.abs(heat.heat_w).max(initial=0.0)) for heat in solution.effects}
    acting = [heat for heat in solution.effects if sizes[id(heat)] > 0.0]
    return sorted(acting, key=lambda heat: -sizes[id(heat)])
