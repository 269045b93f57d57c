"""The pictures of an export: the mesh, what of it was measured, and what heat did to it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermoxels_ns.core.checks import replace_when_done

if TYPE_CHECKING:
    from thermoxels_ns.fem.solution import HeatSolution
    from thermoxels_ns.mesh.tetrahedra import TetMesh

Look = Mapping[str, Any]


def draw_mesh(paths: Sequence[Path], mesh: TetMesh, look: Look, length_unit: str) -> None:
    """Draw the mesh twice: all temperatures, and with grey where no thermal ray measured one.

    Args:
        paths: The two files, each ending in .png.
        mesh: The mesh.
        look: Arguments `up` and `view_direction` of `picture_of_mesh`.
        length_unit: Name of the unit of the node positions.
    """
    from thermoxels_ns.reports.mesh_pictures import picture_of_mesh

    every, measured = paths
    picture_of_mesh(every, mesh, title="Surface temperature", length_unit=length_unit, **look)
    title = "Measured surface temperature"
    picture_of_mesh(measured, mesh, title=title, grey_unobserved=True, length_unit=length_unit, **look)


def draw_heat(path: Path, mesh: TetMesh, solution: HeatSolution, look: Look) -> None:
    """Draw the temperatures before and after in one range of colours, and beside them the change in its own.

    Args:
        path: The file, ending in .png.
        mesh: The mesh, nodes in metres.
        solution: Temperatures on its nodes.
        look: Arguments `up` and `view_direction` of `picture_of_mesh`.
    """
    import tempfile

    from PIL import Image

    from thermoxels_ns.reports.mesh_pictures import change_colours, picture_of_mesh

    shown = np.unique(mesh.facets)
    before, after = solution.temperature_c[0], solution.temperature_c[-1]
    change = after - before
    ends = np.concatenate([before[shown], after[shown]])
    diverging, note = change_colours(change[shown])
    first, last = f"{solution.times_s[0]:g} s", f"{solution.times_s[-1]:g} s"
    same: Any = {"clim": (float(ends.min()), float(ends.max()))}
    panels = []
    with tempfile.TemporaryDirectory() as scratch:
        for number, (title, values, colours) in enumerate(
            (
                (f"Surface temperature at {first}", before, same),
                (f"Surface temperature at {last}", after, same),
                (f"Change from {first} to {last}", change, {**diverging, "note": note}),
            )
        ):
            panel_path = Path(scratch) / f"{number}.png"
            picture_of_mesh(panel_path, mesh, values, title=title, **colours, **look)
            with Image.open(panel_path) as image:
                panels.append(image.convert("RGB"))
    picture = Image.new("RGB", (sum(p.width for p in panels), max(p.height for p in panels)), "white")
    left = 0
    for panel in panels:
        picture.paste(panel, (left, 0))
        left += panel.width
    with replace_when_done(path) as temporary:
        picture.save(temporary)
