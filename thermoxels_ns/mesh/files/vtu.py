"""VTK files of meshes, written and read: the body (.vtu) and its tagged boundary (.vtp)."""

from __future__ import annotations

import base64
import binascii
import json
import os
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.checks import plain_os_errors, replace_when_done, writable_folder
from thermoxels_ns.core.errors import HeatError, MeshError, OutputError
from thermoxels_ns.core.json_values import plain_values, read_json_object
from thermoxels_ns.mesh.files.content import write_bytes
from thermoxels_ns.mesh.files.pyvista_objects import (
    BODY,
    BOUNDARY,
    body_grid,
    boundary_surface,
    mesh_of,
    mesh_of_grid,
    wrong_mesh,
)
from thermoxels_ns.mesh.tetrahedra import TetMesh

if TYPE_CHECKING:
    import pyvista as pv

_DISK_IS_FULL = 20007  # VTK's error code
_MOST_COMPRESSION = 1040  # largest ratio by which zlib can compress, 1032, and a margin


def write_vtu(path: Path | str, mesh: TetMesh, *, temperature_c: npt.NDArray[np.floating] | None = None) -> None:
    """Write a mesh as a VTK unstructured grid (.vtu, read by ParaView, pyvista and meshio).

    Point arrays are `temperature_c` [degrees Celsius], `temperature_k` [K], `observed` (1: measured, 0: extended) and,
    if the mesh has colours, `colour` (red, green, blue as bytes). The cell array is `region`; field arrays
    `region:NAME` hold the number of each region, from 1 as in every format. The argument `temperature_c`, if given,
    replaces the mesh's own.

    Raises:
        MeshError: An array does not fit the mesh or is not finite.
        OutputError: The file cannot be written.
    """
    from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridWriter

    write_vtk(vtkXMLUnstructuredGridWriter(), Path(path), body_grid(mesh, temperature_c))


def write_vtk(writer: Any, path: Path, data: Any) -> None:
    """Write `data` by VTK's XML `writer` for such data sets, making the folder; raise `OutputError` on failure."""
    writable_folder(path.parent)
    with replace_when_done(path) as temporary:
        writer.SetFileName(str(temporary))
        writer.SetInputData(data)
        writer.SetCompressionLevel(1)  # a quarter of the time of the default, for files 5 % larger
        with silent_vtk():
            written = writer.Write() and not writer.GetErrorCode() and temporary.is_file()
        if not written:
            remedy = "Check the free space and the permissions of the folder."
            code = writer.GetErrorCode()  # codes below 20,000 are those of the system
            got = "no space left for it" if code == _DISK_IS_FULL else os.strerror(code)
            raise OutputError("mesh file", expected=f"to write {path}", got=got, remedy=remedy)


@contextmanager
def silent_vtk() -> Iterator[Any]:
    """Keep VTK from writing to the terminal; yield an object whose `events` are the errors that VTK reports."""
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
    """Write a nested mapping of figures as indented json, in its order, in a folder that is made if missing.

    Raises:
        MeshError: A number is NaN or infinite (json has neither), or a value has a type that json lacks.
    """
    write_bytes(Path(path), [summary_text(summary).encode()])


def summary_text(summary: Mapping[str, Any]) -> str:
    """Return the json text that `write_summary` writes; raise `MeshError` in the same cases."""
    return json.dumps(plain_values(summary, "summary", MeshError), indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def boundary_path(path: Path | str) -> Path:
    """Return the path of the boundary file that belongs to a mesh file.

    >>> boundary_path("house/mesh.vtu").as_posix()
    'house/mesh-boundary.vtp'
    """
    path = Path(path)
    return path.with_name(f"{path.stem}-boundary.vtp")


def write_boundary_vtp(path: Path | str, mesh: TetMesh) -> None:
    """Write the boundary triangles and their tags as VTK polygons (.vtp, read by ParaView and pyvista).

    Cell arrays: `normal` (outward), `area_m2`, `seen` (1: a camera sees the triangle), `patch` (number of the patch in
    the field array `patch_names`, from 1 as in every format), `on_box` (1: the scene box or the region cuts the solid
    there) and, if photographs were compared, `photographs_seen` and `photographs_supporting`, see
    `Boundary.photographs`. Point arrays: `temperature_c`, `observed`, `node` (number in the mesh, from 0) and, if the
    mesh has colours, `colour` as bytes.
    A mesh without boundary tags is written with one patch, "boundary", and without `seen`, which is unknown.
    """
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    write_vtk(vtkXMLPolyDataWriter(), Path(path), boundary_surface(mesh))


def read_mesh(path: Path | str) -> TetMesh:
    """Return the mesh in ``NAME.vtu`` and the ``NAME-boundary.vtp`` beside it.

    The mesh is equal, bit for bit, to the mesh that was written, except for colours, which files hold as bytes.

    Raises:
        MeshError: A file is missing, damaged or lacks an array, the cells are not sound tetrahedra, or the boundary
            file is not that of the body.
    """
    path = Path(path)
    if path.suffix != ".vtu":
        raise wrong_mesh("mesh file", "a name that ends in .vtu", path.name, "Pass the mesh.vtu of an export.")
    beside = boundary_path(path)
    return mesh_of(_read(path), _read(beside), path.name, beside.name)


AnyMesh: TypeAlias = "pv.MultiBlock | pv.UnstructuredGrid | TetMesh | Path | str"
"""What `any_mesh` takes."""


def any_mesh(data: AnyMesh, up: npt.ArrayLike | None = None) -> tuple[TetMesh, dict[str, Any]]:
    """Return a mesh, and what is known about it: the content of its summary.json, or the user_dict of its blocks.

    Args:
        data: A pyvista MultiBlock as `blocks_of` makes it, a pyvista grid of tetrahedra as `mesh_of_grid` takes it, a
            `TetMesh`, or the path of the mesh.vtu of an export.
        up: Direction that points up; if given, it takes the place of the one that is known.

    Raises:
        MeshError: `data` is none of these, or no sound mesh.
        HeatError: The mesh has no scale.
    """
    import pyvista as pv

    about: dict[str, Any] = {}
    if isinstance(data, TetMesh):
        data.check()
        mesh = data
    elif isinstance(data, (str, Path)):
        mesh, about = read_mesh(data), read_export_summary(Path(data))
    elif isinstance(data, pv.MultiBlock) and {BODY, BOUNDARY} <= set(data.keys()):
        mesh, about = mesh_of(data[BODY], data[BOUNDARY]), json.loads(str(data.user_dict))
        check_in_metres(about)
    elif isinstance(data, pv.UnstructuredGrid):
        mesh = mesh_of_grid(data, (0.0, 0.0, 1.0) if up is None else up)
    else:
        expected = f"blocks {BODY} and {BOUNDARY}, a pyvista UnstructuredGrid, a TetMesh or a path"
        raise wrong_mesh("mesh", expected, type(data).__name__, "Make it with scene.mesh(), or with pyvista.")
    return mesh, about if up is None else {**about, "up": up}


def read_export_summary(mesh: Path, say: Callable[[str], None] = lambda _: None) -> dict[str, Any]:
    """Read the summary.json beside a mesh; empty if there is none. Raises `HeatError` if the mesh has no scale."""
    path = mesh.with_name("summary.json")
    if not path.is_file():
        say(f"Warning: {path} is missing; the mesh is taken to be in metres.")
        return {}
    summary = read_json_object(path, "Export the mesh again, or move the file away.", MeshError)
    check_in_metres(summary)
    try:
        if summary.get("up") is not None:
            x, y, z = map(float, summary["up"])
            summary["up"] = (x, y, z)
    except (TypeError, ValueError) as problem:
        name, remedy = f"{path}: up", "Pass --up 0 0 1, or export the mesh again."
        raise MeshError(name, expected="three numbers", got=repr(summary["up"]), remedy=remedy) from problem
    return summary


def check_in_metres(summary: Mapping[str, Any]) -> None:
    """Raise `HeatError` if the summary of an export says that its mesh is not in metres."""
    if summary.get("length_unit", "m") != "m":
        remedy = "Export again with --metres-per-unit or --known-distance."
        got = f"one in {summary['length_unit']}s"
        raise HeatError("scale of the mesh", expected="an export in metres", got=got, remedy=remedy)


def _read(path: Path) -> Any:
    """Return the data set in a VTK file; raise `MeshError` if the file is missing, damaged or empty."""
    import pyvista as pv
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader, vtkXMLUnstructuredGridReader

    if not path.is_file():
        raise wrong_mesh(path.name, f"a file at {path}", "none")
    reader: Any = vtkXMLPolyDataReader() if path.suffix == ".vtp" else vtkXMLUnstructuredGridReader()
    reader.SetFileName(str(path))
    data = None
    with plain_os_errors(path, "a VTK file that can be read", "Check its permissions.", MeshError):
        sound = _sizes_fit(path.read_bytes())
    with silent_vtk() as complaints:
        if sound and reader.CanReadFile(str(path)):
            reader.Update()
            data = pv.wrap(reader.GetOutput())
    if data is None or complaints.events or reader.GetErrorCode() or not data.n_cells:
        raise wrong_mesh(path.name, f"a VTK file ({path.suffix})", "a damaged or empty one")
    return data


def _sizes_fit(content: bytes) -> bool:
    """Return whether the array sizes in a VTK file made by `write_vtk` are no larger than its bytes can hold.

    VTK ends the process if a damaged size exceeds the memory. For files in another layout the result is True.
    """
    header = re.search(rb'header_type="UInt(32|64)"[^>]*compressor="vtkZLibDataCompressor"', content)
    begin = re.search(rb'<AppendedData encoding="base64">\s*_', content)
    if header is None or begin is None:
        return True
    width = int(header[1]) // 8
    for offset in re.findall(rb'offset="(\d+)', content[: begin.start()]):
        start = begin.end() + int(offset)
        # An array begins with the number of blocks, the size of a block and of the last, and each compressed size.
        blocks, size, last = _numbers(content[start : start + 4 * width], width, 3)
        if blocks * width > len(content) or max(blocks * size, last) > _MOST_COMPRESSION * len(content):
            return False
        letters = -(-(3 + blocks) * width // 3) * 4
        if sum(_numbers(content[start : start + letters], width, 3 + blocks)[3:]) > len(content):
            return False
    return True


def _numbers(letters: bytes, width: int, count: int) -> list[int]:
    """Decode `count` little-endian numbers of `width` bytes from base64; bytes missing or not base64 become 255."""
    try:
        found = base64.b64decode(letters + b"=" * (-len(letters) % 4), validate=True)
    except binascii.Error:
        found = b""
    whole = found + b"\xff" * max(0, width * count - len(found))
    return [int.from_bytes(whole[width * k : width * (k + 1)], "little") for k in range(count)]
