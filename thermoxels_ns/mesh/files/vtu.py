"""Conversion of meshes to and from pyvista objects and VTK files: the body (.vtu) and its tagged boundary (.vtp)."""

from __future__ import annotations

import base64
import binascii
import json
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias
from xml.sax.saxutils import escape

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.core.checks import check_array, plain_os_errors, replace_when_done
from thermoxels_ns.core.errors import HeatError, MeshError, OutputError
from thermoxels_ns.core.json_values import plain_values, read_json_object
from thermoxels_ns.mesh.boundary.patches import DEFAULT_REGION, PatchRules, with_patches
from thermoxels_ns.mesh.quality.checks import boundary_facets, component_of, count_wrong_facets, group_faces
from thermoxels_ns.mesh.quality.tet_shapes import signed_volumes
from thermoxels_ns.mesh.tetrahedra import (
    FACET_BOX,
    FACET_SURFACE,
    Boundary,
    TetMesh,
    facet_area_vectors,
    facet_areas,
    facet_normals,
    nodes_and_triangles,
)

if TYPE_CHECKING:
    import pyvista as pv

BODY, BOUNDARY = "body", "boundary"  # Names of the two blocks of a mesh
_REMEDY = "Export the mesh again with ns-export thermoxels-mesh, or correct the grid."
_REGION = "region:"
_TETRAHEDRON = 10  # VTK's number for tetrahedra
_DISK_IS_FULL = 20007  # VTK's error code
_MOST_COMPRESSION = 1040  # largest ratio by which zlib can compress, 1032, and a margin


def write_vtk(path: Path, data: pv.PolyData | pv.UnstructuredGrid) -> None:
    """Write polygons (.vtp) or a grid (.vtu) for ParaView and pyvista; raise `OutputError` if writing fails."""
    from vtkmodules.vtkCommonDataModel import vtkFieldData
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter, vtkXMLUnstructuredGridWriter

    writer: Any = vtkXMLPolyDataWriter() if path.suffix == ".vtp" else vtkXMLUnstructuredGridWriter()
    fields, data = vtkFieldData(), data.copy(deep=False)
    fields.DeepCopy(data.GetFieldData())
    data.SetFieldData(fields)
    for array in map(fields.GetAbstractArray, range(fields.GetNumberOfArrays())):
        array.SetName(escape(array.GetName()))  # VTK writes names of arrays into its XML as they are
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
    """Keep VTK from writing to the terminal; yield an object whose `events` list the errors that VTK reports."""
    import pyvista as pv
    from vtkmodules.vtkCommonCore import vtkLogger

    before = vtkLogger.GetCurrentVerbosityCutoff()
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    try:
        with pv.VtkErrorCatcher(raise_errors=False, send_to_logging=False) as catcher:
            yield catcher
    finally:
        vtkLogger.SetStderrVerbosity(before)


def boundary_path(path: Path | str) -> Path:
    """Return the path of the boundary file that belongs to a mesh file.

    >>> boundary_path("house/mesh.vtu").as_posix()
    'house/mesh-boundary.vtp'
    """
    path = Path(path)
    return path.with_name(f"{path.stem}-boundary.vtp")


def read_mesh(path: Path | str) -> TetMesh:
    """Return the mesh in ``NAME.vtu`` and the ``NAME-boundary.vtp`` beside it.

    The mesh equals the written mesh bit for bit, except for colours, because files hold them as bytes.

    Raises:
        MeshError: A file is missing, damaged or lacks an array, the cells are not tetrahedra that conform, or the
            boundary file belongs to another body.
    """
    path = Path(path)
    if path.suffix != ".vtu":
        raise _wrong("mesh file", "a name that ends in .vtu", path.name, "Pass the mesh.vtu of an export.")
    beside = boundary_path(path)
    return mesh_of(_read(path), _read(beside), path.name, beside.name)


def read_surface(path: Path) -> TetMesh:
    """Return a boundary file as a mesh without tetrahedra; raise `MeshError` if it lacks an array."""
    data = _read(path)
    points = np.array(data.points, dtype=np.float64)
    data.point_data["node"] = np.arange(len(points))  # not those of the mesh, which is not there
    facets, facet_tags, tags = _boundary(data, points, path.name)
    return TetMesh(
        points_m=points,
        tets=np.zeros((0, 4), dtype=np.int64),
        temperature_c=_array(data.point_data, "temperature_c", path.name).astype(np.float64),
        observed=_array(data.point_data, "observed", path.name) != 0,
        facets=facets,
        facet_tags=facet_tags,
        region=np.zeros(0, dtype=np.int64),
        boundary=tags,
    )


AnyMesh: TypeAlias = "pv.MultiBlock | pv.UnstructuredGrid | TetMesh | Path | str"
"""A mesh in each of the forms that `any_mesh` takes."""


def any_mesh(data: AnyMesh, up: Sequence[float] | None = None) -> tuple[TetMesh, dict[str, Any]]:
    """Return a mesh and a dictionary about it: from its summary.json, from the user_dict of its blocks, or empty.

    `data` is the path of an export's mesh.vtu, blocks as from `blocks_of`, a grid as for `mesh_of_grid`, or a mesh.
    `up` replaces the entry "up" of the dictionary; None: the entry is kept. Raises `MeshError` if the mesh is damaged
    or of another type, `HeatError` if its length unit is not metres.
    """
    import pyvista as pv

    about: dict[str, Any] = {}
    if isinstance(data, (str, Path)):
        mesh, about = read_mesh(data), read_export_summary(Path(data))
    elif isinstance(data, pv.MultiBlock) and {BODY, BOUNDARY} <= set(data.keys()):
        mesh, about = mesh_of(data[BODY], data[BOUNDARY]), json.loads(str(data.user_dict))
        _check_in_metres(about)
    elif isinstance(data, pv.UnstructuredGrid):
        mesh = mesh_of_grid(data, (0.0, 0.0, 1.0) if up is None else up)
    elif isinstance(data, TetMesh):
        data.check()
        mesh = data
    else:
        expected = f"a path, a TetMesh, a pyvista UnstructuredGrid, or a MultiBlock of {BODY} and {BOUNDARY}"
        raise _wrong("mesh", expected, type(data).__name__, "Make it with scene.mesh() or with pyvista.")
    return mesh, about if up is None else {**about, "up": tuple(up)}


def read_export_summary(mesh: Path, say: Callable[[str], None] = lambda _: None) -> dict[str, Any]:
    """Return the content of the summary.json beside the mesh file `mesh`; if there is none, warn by `say` and return
    {}. Raises `MeshError` if the file is damaged, `HeatError` if the mesh is not in metres."""
    path = mesh.with_name("summary.json")
    if not path.is_file():
        say(f"Warning: {path} is missing; the mesh is taken to be in metres.")
        return {}
    summary = read_json_object(path, "Export the mesh again, or move the file away.", MeshError)
    _check_in_metres(summary)
    try:
        if summary.get("up") is not None:
            x, y, z = map(float, summary["up"])
            summary["up"] = (x, y, z)
    except (TypeError, ValueError) as problem:
        name, remedy = f"{path}: up", "Pass --up 0 0 1, or export the mesh again."
        raise MeshError(name, expected="three numbers", got=repr(summary["up"]), remedy=remedy) from problem
    return summary


def _check_in_metres(summary: Mapping[str, Any]) -> None:
    if summary.get("length_unit", "m") != "m":
        got = f"one in {summary['length_unit']}s"
        remedy = "Export again with --metres-per-unit or --known-distance; in Python, load(run, metres_per_unit=1.0)."
        raise HeatError("scale of the mesh", expected="an export in metres", got=got, remedy=remedy)


def _read(path: Path) -> Any:
    """Return the data set in a VTK file; raise `MeshError` if the file is missing, damaged or empty."""
    import pyvista as pv
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader, vtkXMLUnstructuredGridReader

    if not path.is_file():
        remedy = "Pass the mesh.vtu in the --output-dir of an export, and leave mesh-boundary.vtp beside it."
        raise _wrong(path.name, f"a file at {path}", "none", remedy)
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
    """Return False if a VTK file made by `write_vtk` states array sizes larger than its bytes can hold. VTK ends the
    process if a damaged size exceeds the memory. Files in another layout are not checked: True."""
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
    """Decode `count` little-endian numbers of `width` bytes from base64; missing or undecodable bytes become 255."""
    try:
        found = base64.b64decode(letters + b"=" * (-len(letters) % 4), validate=True)
    except binascii.Error:
        found = b""
    whole = found + b"\xff" * max(0, width * count - len(found))
    return [int.from_bytes(whole[width * k : width * (k + 1)], "little") for k in range(count)]


def blocks_of(mesh: TetMesh, about: Mapping[str, Any]) -> pv.MultiBlock:
    """Return the blocks "body" (`body_grid`) and "boundary" (`boundary_surface`), with `about` as their user_dict."""
    import pyvista as pv

    blocks = pv.MultiBlock({BODY: body_grid(mesh), BOUNDARY: boundary_surface(mesh)})
    blocks.user_dict = plain_values(about, "about", MeshError)
    return blocks


def node_arrays(mesh: TetMesh) -> dict[str, npt.NDArray]:
    """Return arrays per node by name: `temperature_c` and `observed` if known, and `colour` as bytes if known."""
    arrays: dict[str, npt.NDArray] = {}
    if mesh.has_temperatures:
        arrays["temperature_c"] = mesh.temperature_c
        arrays["observed"] = mesh.observed.astype(np.uint8)
    if mesh.colour is not None:
        arrays["colour"] = np.floor(np.clip(mesh.colour, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
    return arrays


def body_grid(mesh: TetMesh) -> pv.UnstructuredGrid:
    """Return the tetrahedra as the grid that .vtu files hold.

    If temperatures are known, point arrays are `temperature_c` [degrees Celsius] and `observed` (1: measured, 0:
    extended); if colours are known, `colour` (red, green, blue as bytes). The cell array is `region`. A field array
    `region:NAME` holds the number of each region, from 1. Raises `MeshError` if an array does not fit or is not finite.
    """
    import pyvista as pv

    mesh.check()
    grid = pv.UnstructuredGrid({pv.CellType.TETRA: mesh.tets}, mesh.points_m)
    for name, values in node_arrays(mesh).items():
        grid.point_data[name] = values
    grid.cell_data["region"] = mesh.region + 1
    # Regions are field arrays of numbers, because meshio refuses a file that holds text.
    for number, name in enumerate(mesh.region_names, start=1):
        grid.field_data[f"{_REGION}{name}"] = [number]
    if mesh.has_temperatures:
        grid.set_active_scalars("temperature_c")
    return grid


def boundary_surface(mesh: TetMesh) -> pv.PolyData:
    """Return the boundary triangles with their tags as .vtp files hold them.

    Cell arrays: `normal` (outward), `area_m2`, `seen` (1: a camera sees the triangle), `patch` (number of the patch,
    from 1, in the field array `patch_names`), `on_box` (1: the scene box or the region cuts the solid there) and, if
    photographs were compared, `photographs_seen` and `photographs_supporting`, see `Boundary.photographs`. Point
    arrays: `node` (number in the mesh, from 0) and those of `body_grid`. Raises `MeshError` as `body_grid` does.
    """
    import pyvista as pv
    from vtkmodules.vtkCommonCore import vtkStringArray

    mesh.check()
    tags, (nodes, triangles) = mesh.boundary, nodes_and_triangles(mesh.facets)
    arrays: dict[str, npt.NDArray] = {
        "area_m2": facet_areas(mesh.points_m, mesh.facets),
        "normal": facet_normals(mesh.points_m, mesh.facets),
        "on_box": (mesh.facet_tags == FACET_BOX).astype(np.uint8),
        "patch": tags.patch + 1,
        "seen": tags.seen.astype(np.uint8),
    }
    if tags.photographs is not None:
        arrays["photographs_seen"], arrays["photographs_supporting"] = tags.photographs.T.astype(np.int32)

    data = pv.PolyData.from_regular_faces(mesh.points_m[nodes], triangles)
    data.point_data["node"] = nodes
    for name, values in node_arrays(mesh).items():
        data.point_data[name] = values[nodes]
    for name, values in arrays.items():
        data.cell_data[name] = values
    names = vtkStringArray()  # pyvista's own way takes ASCII names only
    names.SetName("patch_names")
    for name in tags.patch_names:
        names.InsertNextValue(name)
    data.GetFieldData().AddArray(names)
    if mesh.has_temperatures:
        data.set_active_scalars("temperature_c")
    return data


def mesh_of(body: Any, surface: Any, name: str = BODY, beside: str = BOUNDARY) -> TetMesh:
    """Return the mesh of a body made by `body_grid` and a surface made by `boundary_surface`.

    The cell arrays `region` and `patch` may hold names in place of numbers. Messages call the body `name` and the
    surface `beside`. Raises `MeshError` under the conditions of `read_mesh`.
    """
    _check_tetrahedra(body, name)
    points = np.array(body.points, dtype=np.float64)
    colour = body.point_data.get("colour")
    facets, facet_tags, tags = _boundary(surface, points, beside)
    region, region_names = _numbered(_array(body.cell_data, "region", name), _names(body, name))
    alone = not {"temperature_c", "observed"} & set(body.point_data.keys())  # photographs alone trained
    temperature_c, observed = np.full(len(points), np.nan), np.zeros(len(points), dtype=bool)
    if not alone:
        temperature_c = _array(body.point_data, "temperature_c", name).astype(np.float64)
        observed = _array(body.point_data, "observed", name) != 0
    mesh = TetMesh(
        points_m=points,
        tets=np.array(body.cell_connectivity, dtype=np.int64).reshape(-1, 4),
        temperature_c=temperature_c,
        observed=observed,
        facets=facets,
        facet_tags=facet_tags,
        region=region,
        region_names=region_names,
        boundary=tags,
        colour=None if colour is None else (np.asarray(colour) / 255.0).astype(np.float32),
    )
    return _checked(mesh, name, beside)


def mesh_of_grid(grid: pv.UnstructuredGrid, up: npt.ArrayLike = (0.0, 0.0, 1.0)) -> TetMesh:
    """Return the mesh of any grid of tetrahedra in metres with a point array `temperature_c`, [degrees Celsius].

    The cell array `region`, if there is one, holds the name or number of the region of each tetrahedron. Boundary
    triangles get the default patches by their direction relative to `up`: exterior-..., or interior-... around closed
    cavities. Nodes without a point array `observed` count as measured.

    Raises:
        MeshError: The grid has other cells or none, no temperatures, or faces that three tetrahedra share.
    """
    name = "grid"
    _check_tetrahedra(grid, name)
    if "temperature_c" not in grid.point_data:
        remedy = 'Set grid.point_data["temperature_c"] = 20.0, or to what was measured.'
        got = ", ".join(grid.point_data.keys()) or "none"
        raise _wrong(name, "a point array temperature_c [degrees Celsius]", got, remedy)
    points, tets = np.array(grid.points, np.float64), np.array(grid.cell_connectivity, np.int64).reshape(-1, 4)
    turned = signed_volumes(points, tets) < 0.0
    tets[turned] = tets[turned][:, [0, 2, 1, 3]]
    facets = boundary_facets(tets)
    # Normals point out of the body: those around a cavity point into it, so that its volume comes out negative.
    part = component_of(len(points), facets[:, :2].ravel(), facets[:, 1:].ravel())[facets[:, 0]]
    middle = points[facets].mean(axis=1) - points.mean(axis=0)
    volume = np.einsum("fi,fi->f", middle, facet_area_vectors(points, facets))
    region, region_names = np.zeros(len(tets), np.int64), (DEFAULT_REGION,)
    if "region" in grid.cell_data:
        found = _names(grid, name) if any(key.startswith(_REGION) for key in grid.field_data) else ()
        region, region_names = _numbered(grid.cell_data["region"], found)
    mesh = TetMesh(
        points_m=points,
        tets=tets,
        temperature_c=_array(grid.point_data, "temperature_c", name).astype(np.float64),
        observed=np.asarray(grid.point_data.get("observed", np.ones(len(points)))) != 0,
        facets=facets,
        facet_tags=np.full(len(facets), FACET_SURFACE, np.int64),
        region=region,
        region_names=region_names,
    )
    seen = np.bincount(part, volume)[part] > 0.0
    tagged, _ = with_patches(replace(mesh, boundary=replace(mesh.boundary, seen=seen)), PatchRules(), up)
    return _checked(tagged, name, name)


def _check_tetrahedra(grid: Any, name: str) -> None:
    others = np.count_nonzero(grid.celltypes != _TETRAHEDRON)
    if others or not grid.n_cells:
        remedy = "Keep grid.extract_cells_by_type(10), the tetrahedra, or make some with grid.triangulate()."
        raise _wrong(name, "tetrahedra only", f"{others} cells of other kinds" if others else "none", remedy)


def _checked(mesh: TetMesh, name: str, beside: str) -> TetMesh:
    mesh.check(name if name == beside else f"{name} with {beside}", _REMEDY)
    faces = group_faces(mesh.tets)
    wrong = count_wrong_facets(mesh, faces)
    crowded = faces.sizes.max() > 2
    if (wrong or crowded) and (doubled := len(mesh.tets) - len(np.unique(np.sort(mesh.tets, axis=1), axis=0))):
        raise _wrong(name, "every tetrahedron once", f"{doubled} of {len(mesh.tets)} listed again")
    if wrong:
        expected, got = "every face of one tetrahedron alone, and no other", f"{wrong} missing, inside or turned over"
        raise _wrong(beside, expected, got)
    if crowded:
        remedy = "Remove tetrahedra that lie in each other, or export the mesh again."
        raise _wrong(name, "faces of one or two tetrahedra each", "faces of more", remedy)
    return mesh


def _numbered(values: npt.NDArray, names: tuple[str, ...]) -> tuple[IntArray, tuple[str, ...]]:
    """Return numbers from 0, shape (n,), and the names that they index. `values` (n,) are names, or numbers from 1 that
    index `names`. If `names` is empty, the numbers become names."""
    values = np.asarray(values)
    if values.dtype.kind == "U" or not names:
        found, number = np.unique(values.astype(str), return_inverse=True)
        return number.reshape(-1).astype(np.int64), tuple(found.tolist())
    return values.astype(np.int64) - 1, names


def _names(body: Any, name: str) -> tuple[str, ...]:
    """Return the names of the regions in the order of their numbers, read from field arrays `region:NAME`."""
    arrays = {key.removeprefix(_REGION): one for key, one in body.field_data.items() if key.startswith(_REGION)}
    numbers = {one.item(): key for key, one in arrays.items() if np.size(one) == 1}
    if set(numbers) != set(range(1, len(numbers) + 1)) or not numbers:
        raise _wrong(name, f"field arrays {_REGION}NAME numbered from 1", [*numbers] or "none")
    return tuple(numbers[number] for number in range(1, len(numbers) + 1))


def _boundary(surface: Any, points: FloatArray, name: str) -> tuple[IntArray, IntArray, Boundary]:
    """Return boundary triangles (f, 3), their `FACET_BOX` or `FACET_SURFACE` (f,), and their other tags. `points` (n,
    3) are the nodes of the body; messages begin with `name`. Raises `MeshError` if the two do not fit."""

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
    facet_tags = np.where(array("on_box") != 0, FACET_BOX, FACET_SURFACE).astype(np.int64)
    every = _array(surface.field_data, "patch_names", name).ravel()
    patch, patch_names = _numbered(array("patch"), tuple(map(str, every.tolist())))
    counts = [f"photographs_{what}" for what in ("seen", "supporting")]
    counted = any(count in surface.cell_data for count in counts)
    return (
        facets,
        facet_tags,
        Boundary(
            seen=array("seen") != 0,
            patch=patch,
            patch_names=patch_names,
            photographs=np.stack([array(count) for count in counts], axis=1).astype(np.int64) if counted else None,
        ),
    )


def _array(data: Any, array: str, name: str) -> npt.NDArray:
    if array not in data:
        raise _wrong(name, f"an array {array}", f"{', '.join(sorted(data.keys())) or 'none'}")
    values = np.array(data[array])
    return values if values.dtype.kind == "U" else check_array(f"{name}: {array}", values, None, _REMEDY, MeshError)


def _wrong(name: str, expected: str, got: object, remedy: str = _REMEDY) -> MeshError:
    return MeshError(name, expected=expected, got=got, remedy=remedy)
