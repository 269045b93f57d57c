"""Files of a computation through time: a .vtu file per kept time, and the .pvd file that lists them all."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Literal
from xml.etree import ElementTree

import numpy as np

from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.checks import remove_file, replace_when_done, writable_folder
from thermoxels_ns.fem.solution import HeatSolution
from thermoxels_ns.mesh.files.vtu import body_grid, write_vtk
from thermoxels_ns.mesh.tetrahedra import TetMesh

STEP_PATTERN = "step-*.vtu"  # Names of the files of a series


def shown_states(times_s: FloatArray, wanted_s: Literal["all"] | tuple[float, ...]) -> list[int]:
    """Return which kept times go into a series: the first, the last, and the nearest to each of `wanted_s`; or all.

    >>> shown_states(np.array([0.0, 60.0, 120.0, 180.0]), (70.0,))
    [0, 1, 3]
    """
    near = times_s if wanted_s == "all" else (times_s[0], *wanted_s, times_s[-1])
    return np.unique([np.abs(times_s - time_s).argmin() for time_s in near]).tolist()


def write_heat_series(pvd: Path, mesh: TetMesh, solution: HeatSolution, states: list[int]) -> None:
    """Write ``NAME.pvd`` and ``NAME/step-0000.vtu`` and so on, which ParaView and pyvista open as one series.

    `pvd` is the path of ``NAME.pvd``, which is written last, so that all files it lists exist; `states` are numbers of
    kept times. An earlier series is removed first. Raises `OutputError` if writing fails.
    """
    writable_folder(pvd.parent)
    remove_heat_series(pvd)
    folder = writable_folder(pvd.with_suffix(""))
    root = ElementTree.Element("VTKFile", type="Collection", version="0.1", byte_order="LittleEndian")
    collection = ElementTree.SubElement(root, "Collection")
    for number, state in enumerate(states):
        path, time_s = folder / f"step-{number:04d}.vtu", float(solution.times_s[state])
        write_vtk(path, body_grid(replace(mesh, temperature_c=solution.temperature_c[state])))
        name = path.relative_to(pvd.parent).as_posix()
        ElementTree.SubElement(collection, "DataSet", timestep=repr(time_s), part="0", file=name)
    ElementTree.indent(root)
    with replace_when_done(pvd) as temporary:
        ElementTree.ElementTree(root).write(temporary, encoding="utf-8", xml_declaration=True)


def remove_heat_series(pvd: Path) -> None:
    """Remove a series that `write_heat_series` wrote, if there is one; raise `OutputError` if a file stays."""
    folder = pvd.with_suffix("")
    for path in (pvd, *folder.glob(STEP_PATTERN)):
        remove_file(path)
    with suppress(OSError):  # it holds files of others, or there is none
        folder.rmdir()
