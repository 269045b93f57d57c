"""Meshes as VTK files: the body (.vtu) and its tagged boundary (.vtp)."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.checks import replace_when_done, writable_folder
from thermoxels_ns.core.errors import MeshError, OutputError
from thermoxels_ns.core.json_values import plain_values
from thermoxels_ns.mesh.files.content import check_suffix, colour_bytes, file_content, node_arrays, surface_of
from thermoxels_ns.mesh.quality.checks import facet_areas
from thermoxels_ns.mesh.tetrahedra import FACET_BOX, TetMesh

_DISK_IS_FULL = 20007  # VTK's own number


def write_vtu(path: Path | str, mesh: TetMesh, *, temperature_c: npt.NDArray[np.floating] | None = None) -> None:
    """Write a mesh as a VTK unstructured grid (.vtu, read by ParaView, pyvista and meshio).

    Point arrays: `temperature_c` [degrees Celsius], `temperature_k` [K], `observed` (1: measured, 0: extended) and,
    if the mesh has colours, `colour` (red, green, blue as bytes). Cell array: `region`; field
    arrays `region:NAME` hold the number of each region.

    `temperature_c` takes the place of the mesh's own.

    Raises:
        MeshError: An array does not fit the mesh or is not finite.
        OutputError: The file cannot be written.
    """
    import pyvista as pv
    from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridWriter

    path = check_suffix(path, ".vtu")
    content = file_content(mesh, temperature_c)
    grid = pv.UnstructuredGrid({pv.CellType.TETRA: content.tets}, content.points_m)
    for name, values in node_arrays(mesh, content).items():
        grid.point_data[name] = values
    grid.cell_data["region"] = content.region
    # As numbers: meshio refuses a file that holds text.
    for number, name in enumerate(content.region_names):
        grid.field_data[f"region:{name}"] = [number]
    grid.set_active_scalars("temperature_c")
    write_vtk(vtkXMLUnstructuredGridWriter(), path, grid)


def write_vtk(writer: Any, path: Path, data: Any) -> None:
    """Write a VTK data set with the XML writer for its kind; the folder is made if need be."""
    writable_folder(path.parent)
    with replace_when_done(path) as temporary:
        writer.SetFileName(str(temporary))
        writer.SetInputData(data)
        writer.SetCompressionLevel(1)  # a quarter of the time of the default, for files 5 % larger
        with silent_vtk():
            written = writer.Write() and not writer.GetErrorCode() and temporary.is_file()
        if not written:
            remedy = "Check the free space and the permissions of the folder."
            code = writer.GetErrorCode()  # below 20,000 it is the system's
            got = "no space left for it" if code == _DISK_IS_FULL else os.strerror(code)
            raise OutputError("mesh file", expected=f"to write {path}", got=got, remedy=remedy)


@contextmanager
def silent_vtk() -> Iterator[Any]:
    """Keep VTK from writing to the terminal; gives what collects its complaints as `events`."""
    import pyvista as pv
    from vtkmodules.vtkCommonCore import vtkLogger

    before = vtkLogger.GetCurrentVerbosityCutoff()
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    try:
        with pv.VtkErrorCatcher(raise_errors=False, send_to_logging=False) as catcher:
            yield catcher
    finally:
        vtkLogger.SetStderrVerbosity(before)


def write_summary(path: Path | str, summary: Mapping[str, Any]) -> None:
    """Write figures, nested as you like, as indented json in the order given; the folder is made if need be.

    Raises:
        MeshError: A number is NaN or infinite (json has neither), or a value has no place in json.
    """
    text = summary_text(summary)
    path = Path(path)
    writable_folder(path.parent)
    with replace_when_done(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def summary_text(summary: Mapping[str, Any]) -> str:
    """Text of the file that `write_summary` writes; raises the same `MeshError`."""
    return json.dumps(plain_values(summary, "summary", MeshError), indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def boundary_path(path: Path | str) -> Path:
    """Name the file of the boundary that belongs to a mesh file.

    >>> boundary_path("house/mesh.vtu").as_posix()
    'house/mesh-boundary.vtp'
    """
    path = Path(path)
    return path.with_name(f"{path.stem}-boundary.vtp")


def write_boundary_vtp(path: Path | str, mesh: TetMesh) -> None:
    """Write the boundary triangles and their tags as VTK polygons (.vtp, read by ParaView and pyvista).

    Cell arrays: `normal` (outward, of the true surface), `area_m2` (of the true surface that the triangle stands
    for), `area_factor` (that over the triangle's own area), `seen` (1: a camera saw it), `patch` (an index into the
    field array `patch_names`), `on_box` (1: where the scene box cuts the solid) and, where photographs were compared,
    `photographs_seen` and `photographs_supporting`, see `Boundary.photographs`. Point arrays: `temperature_c`,
    `observed`, `node` (number in the mesh, from 0) and, if the mesh has colours, `colour` as bytes.

    A mesh without boundary tags is written with the triangles' own normals and areas, one patch "boundary", and
    without `seen`, which nobody knows.

    Arguments and errors are those of `thermoxels_ns.mesh.files.formats.write_mesh`.
    """
    import pyvista as pv
    from vtkmodules.vtkCommonCore import vtkStringArray
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    path = check_suffix(path, ".vtp")
    content = file_content(mesh)
    surface = surface_of(content.points_m, content.facets)
    arrays: dict[str, npt.NDArray] = {
        "area_factor": content.area_factor,
        "area_m2": facet_areas(content.points_m, content.facets) * content.area_factor,
        "normal": content.normal,
        "on_box": (mesh.facet_tags == FACET_BOX).astype(np.uint8),
        "patch": content.patch,
    }
    if mesh.boundary is not None:
        arrays["seen"] = mesh.boundary.seen.astype(np.uint8)
        if mesh.boundary.photographs is not None:
            arrays["photographs_seen"], arrays["photographs_supporting"] = mesh.boundary.photographs.T.astype(np.int32)

    data = pv.PolyData.from_regular_faces(surface.points_m, surface.triangles)
    data.point_data["temperature_c"] = content.temperature_c[surface.nodes]
    data.point_data["observed"] = mesh.observed[surface.nodes].astype(np.uint8)
    data.point_data["node"] = surface.nodes
    if mesh.colour is not None:
        data.point_data["colour"] = colour_bytes(mesh.colour[surface.nodes])
    for name, values in arrays.items():
        data.cell_data[name] = values
    names = vtkStringArray()  # pyvista itself takes ASCII only
    names.SetName("patch_names")
    for name in content.patch_names:
        names.InsertNextValue(name)
    data.GetFieldData().AddArray(names)
    data.set_active_scalars("temperature_c")
    write_vtk(vtkXMLPolyDataWriter(), path, data)
