"""VTK files of meshes, written and read: the body (.vtu) and its tagged boundary (.vtp)."""

from __future__ import annotations

import base64
import binascii
import json
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.core.checks import check_finite, plain_os_errors, replace_when_done, writable_folder
from thermoxels_ns.core.errors import MeshError, OutputError
from thermoxels_ns.core.json_values import plain_values
from thermoxels_ns.mesh.files.content import checked_mesh, node_arrays, surface_of, write_bytes
from thermoxels_ns.mesh.quality.checks import count_wrong_facets, group_faces
from thermoxels_ns.mesh.tetrahedra import FACET_BOX, FACET_SURFACE, Boundary, TetMesh, facet_areas, facet_normals

_DISK_IS_FULL = 20007  # VTK's error code
_REMEDY = "Export the mesh again with ns-export thermoxels-mesh."
_REGION = "region:"
_TETRAHEDRON = 10  # VTK's number for tetrahedra
_MOST_COMPRESSION = 1040  # largest ratio by which zlib can compress, 1032, and a margin


def write_vtu(path: Path | str, mesh: TetMesh, *, temperature_c: npt.NDArray[np.floating] | None = None) -> None:
    """Write a mesh as a VTK unstructured grid (.vtu, read by ParaView, pyvista and meshio).

    Point arrays are `temperature_c` [degrees Celsius], `temperature_k` [K] and `observed` (1: measured, 0: extended)
    where temperatures are known, and `colour` (red, green, blue as bytes) where colours are. The cell array is
    `region`; field arrays `region:NAME` hold the number of each region. The argument `temperature_c`, if given,
    replaces the mesh's own.

    Raises:
        MeshError: An array does not fit the mesh or is not finite.
        OutputError: The file cannot be written.
    """
    import pyvista as pv
    from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridWriter

    path = Path(path)
    mesh, _ = checked_mesh(mesh, temperature_c)
    grid = pv.UnstructuredGrid({pv.CellType.TETRA: mesh.tets}, mesh.points_m)
    for name, values in node_arrays(mesh).items():
        grid.point_data[name] = values
    grid.cell_data["region"] = mesh.region
    # Regions are field arrays of numbers, because meshio refuses a file that holds text.
    for number, name in enumerate(mesh.region_names):
        grid.field_data[f"region:{name}"] = [number]
    if mesh.has_temperatures:
        grid.set_active_scalars("temperature_c")
    write_vtk(vtkXMLUnstructuredGridWriter(), path, grid)


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

    Cell arrays: `normal` (outward), `area_m2`, `seen` (1: a camera sees the triangle), `patch` (an index into the field
    array `patch_names`), `on_box` (1: the scene box or the region cuts the solid there) and, if photographs were
    compared, `photographs_seen` and `photographs_supporting`, see `Boundary.photographs`. Point arrays:
    `temperature_c`, `observed`, `node` (number in the mesh, from 0) and, if the mesh has colours, `colour` as bytes.
    A mesh without boundary tags is written with one patch, "boundary", and without `seen`, which is unknown.
    """
    import pyvista as pv
    from vtkmodules.vtkCommonCore import vtkStringArray
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    path = Path(path)
    mesh, tags = checked_mesh(mesh)
    surface = surface_of(mesh.points_m, mesh.facets)
    arrays: dict[str, npt.NDArray] = {
        "area_m2": facet_areas(mesh.points_m, mesh.facets),
        "normal": facet_normals(mesh.points_m, mesh.facets),
        "on_box": (mesh.facet_tags == FACET_BOX).astype(np.uint8),
        "patch": tags.patch,
    }
    if mesh.boundary is not None:
        arrays["seen"] = tags.seen.astype(np.uint8)
    if tags.photographs is not None:
        arrays["photographs_seen"], arrays["photographs_supporting"] = tags.photographs.T.astype(np.int32)

    data = pv.PolyData.from_regular_faces(surface.points_m, surface.triangles)
    data.point_data["node"] = surface.nodes
    for name, values in node_arrays(mesh).items():
        if name != "temperature_k":
            data.point_data[name] = values[surface.nodes]
    for name, values in arrays.items():
        data.cell_data[name] = values
    names = vtkStringArray()  # pyvista's own way takes ASCII names only
    names.SetName("patch_names")
    for name in tags.patch_names:
        names.InsertNextValue(name)
    data.GetFieldData().AddArray(names)
    if mesh.has_temperatures:
        data.set_active_scalars("temperature_c")
    write_vtk(vtkXMLPolyDataWriter(), path, data)


def read_mesh(path: Path | str) -> TetMesh:
    """Return the mesh in ``NAME.vtu`` and the ``NAME-boundary.vtp`` beside it.

    The mesh is equal, bit for bit, to the mesh that was written, except for colours, which files hold as bytes.

    Raises:
        MeshError: A file is missing, damaged or lacks an array, the cells are not sound tetrahedra, or the boundary
            file is not that of the body.
    """
    path = Path(path)
    if path.suffix != ".vtu":
        raise _wrong("mesh file", "a name that ends in .vtu", path.name, "Pass the mesh.vtu of an export.")
    beside = boundary_path(path)
    body, surface = _read(path), _read(beside)
    others = np.count_nonzero(body.celltypes != _TETRAHEDRON)
    if others:
        raise _wrong(path.name, "tetrahedra only", f"{others} cells of other kinds")
    points = np.array(body.points, dtype=np.float64)
    colour = body.point_data.get("colour")
    facets, tags = _boundary(surface, points, beside.name)
    on_box = _array(surface.cell_data, "on_box", beside.name) != 0
    alone = not {"temperature_c", "observed"} & set(body.point_data.keys())  # photographs alone trained
    temperature_c, observed = np.full(len(points), np.nan), np.zeros(len(points), dtype=bool)
    if not alone:
        temperature_c = _array(body.point_data, "temperature_c", path.name).astype(np.float64)
        observed = _array(body.point_data, "observed", path.name) != 0
    mesh = TetMesh(
        points_m=points,
        tets=np.array(body.cell_connectivity, dtype=np.int64).reshape(-1, 4),
        temperature_c=temperature_c,
        observed=observed,
        facets=facets,
        facet_tags=np.where(on_box, FACET_BOX, FACET_SURFACE).astype(np.int64),
        region=_array(body.cell_data, "region", path.name).astype(np.int64),
        region_names=_region_names(body, path.name),
        boundary=tags,
        colour=None if colour is None else (np.asarray(colour) / 255.0).astype(np.float32),
    )
    mesh.check(f"{path.name} with {beside.name}", _REMEDY)
    faces = group_faces(mesh.tets)
    wrong = count_wrong_facets(mesh, faces)
    crowded = faces.sizes.max() > 2
    if (wrong or crowded) and (doubled := len(mesh.tets) - len(np.unique(np.sort(mesh.tets, axis=1), axis=0))):
        raise _wrong(path.name, "every tetrahedron once", f"{doubled} of {len(mesh.tets)} listed again")
    if wrong:
        expected, got = "every face of one tetrahedron alone, and no other", f"{wrong} missing, inside or turned over"
        raise _wrong(beside.name, expected, got)
    if crowded:
        remedy = "Remove tetrahedra that lie in each other, or export the mesh again."
        raise _wrong(path.name, "faces of one or two tetrahedra each", "faces of more", remedy)
    return mesh


def _read(path: Path) -> Any:
    """Return the data set in a VTK file; raise `MeshError` if the file is missing, damaged or empty."""
    import pyvista as pv
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader, vtkXMLUnstructuredGridReader

    if not path.is_file():
        raise _wrong(path.name, f"a file at {path}", "none")
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
        raise _wrong(path.name, f"a VTK file ({path.suffix})", "a damaged or empty one")
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


def _region_names(body: Any, name: str) -> tuple[str, ...]:
    """Return the names of the regions in the order of their numbers, read from field arrays `region:NAME`."""
    arrays = body.GetFieldData()
    numbers = {}
    for place in range(arrays.GetNumberOfArrays()):
        array = arrays.GetAbstractArray(place)
        if (array.GetName() or "").startswith(_REGION) and array.GetNumberOfValues() == 1:
            numbers[int(array.GetVariantValue(0).ToInt())] = array.GetName().removeprefix(_REGION)
    if sorted(numbers) != list(range(len(numbers))) or not numbers:
        raise _wrong(name, f"field arrays {_REGION}NAME numbered from 0", sorted(numbers) or "none")
    return tuple(numbers[number] for number in range(len(numbers)))


def _boundary(surface: Any, points: FloatArray, name: str) -> tuple[IntArray, Boundary | None]:
    """Return the boundary triangles (f, 3) and their tags; the tags are None for a mesh written without tags."""

    def array(of: str) -> npt.NDArray:
        return _array(surface.cell_data, of, name)

    node = _array(surface.point_data, "node", name).astype(np.int64)
    if not np.isfinite(points).all():
        bad = np.count_nonzero(~np.isfinite(points).all(axis=1))
        raise _wrong(name, "finite positions of nodes", f"{bad} that are not, in the mesh beside it")
    if node.min() < 0 or node.max() >= len(points) or not np.array_equal(points[node], surface.points):
        raise _wrong(name, "the boundary of the mesh beside it", "that of another one")
    if not surface.is_all_triangles:
        raise _wrong(name, "triangles only", "other polygons")
    facets = node[np.asarray(surface.regular_faces, dtype=np.int64)]
    if "seen" not in surface.cell_data:
        return facets, None
    names = surface.GetFieldData().GetAbstractArray("patch_names")
    if names is None:
        raise _wrong(name, "the field array patch_names", "none")
    counts = [f"photographs_{what}" for what in ("seen", "supporting")]
    counted = any(count in surface.cell_data for count in counts)
    return facets, Boundary(
        seen=array("seen") != 0,
        patch=array("patch").astype(np.int64),
        patch_names=tuple(str(names.GetValue(number)) for number in range(names.GetNumberOfValues())),
        photographs=np.stack([array(count) for count in counts], axis=1).astype(np.int64) if counted else None,
    )


def _array(data: Any, array: str, name: str) -> npt.NDArray:
    if array not in data:
        raise _wrong(name, f"an array {array}", f"{', '.join(sorted(data.keys())) or 'none'}")
    return check_finite(f"{name}: {array}", np.array(data[array]), _REMEDY, MeshError)


def _wrong(name: str, expected: str, got: object, remedy: str = _REMEDY) -> MeshError:
    return MeshError(name, expected=expected, got=got, remedy=remedy)
