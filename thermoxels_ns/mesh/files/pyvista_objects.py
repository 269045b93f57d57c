"""A mesh as pyvista objects: the grid of tetrahedra and the surface of tagged boundary triangles, and back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.core.checks import check_finite
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.core.json_values import plain_values
from thermoxels_ns.mesh.boundary.patches import DEFAULT_REGION, default_patches
from thermoxels_ns.mesh.files.content import checked_mesh, node_arrays, surface_of
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
)

if TYPE_CHECKING:
    import pyvista as pv

BODY, BOUNDARY = "body", "boundary"
"""Names of the two blocks of a mesh."""

_REMEDY = "Export the mesh again with ns-export thermoxels-mesh, or correct the grid."
_REGION = "region:"
_TETRAHEDRON = 10  # VTK's number for tetrahedra


def blocks_of(
    mesh: TetMesh, temperature_c: npt.NDArray[np.floating] | None = None, about: Mapping[str, Any] | None = None
) -> pv.MultiBlock:
    """Return the blocks "body", see `body_grid`, and "boundary", see `boundary_surface`; `about` is their user_dict."""
    import pyvista as pv

    mesh, _ = checked_mesh(mesh, temperature_c)
    blocks = pv.MultiBlock({BODY: body_grid(mesh), BOUNDARY: boundary_surface(mesh)})
    blocks.user_dict = plain_values(about or {}, "about", MeshError)
    return blocks


def body_grid(mesh: TetMesh, temperature_c: npt.NDArray[np.floating] | None = None) -> pv.UnstructuredGrid:
    """Return the tetrahedra with the arrays that `vtu.write_vtu` names."""
    import pyvista as pv

    mesh, _ = checked_mesh(mesh, temperature_c)
    grid = pv.UnstructuredGrid({pv.CellType.TETRA: mesh.tets}, mesh.points_m)
    for name, values in node_arrays(mesh).items():
        grid.point_data[name] = values
    grid.cell_data["region"] = mesh.region + 1
    # Regions are field arrays of numbers, because meshio refuses a file that holds text.
    for number, name in enumerate(mesh.region_names, start=1):
        grid.field_data[f"{_REGION}{name}"] = [number]
    grid.set_active_scalars("temperature_c")
    return grid


def boundary_surface(mesh: TetMesh) -> pv.PolyData:
    """Return the boundary triangles with the arrays that `vtu.write_boundary_vtp` names."""
    import pyvista as pv
    from vtkmodules.vtkCommonCore import vtkStringArray

    mesh, tags = checked_mesh(mesh)
    surface = surface_of(mesh.points_m, mesh.facets)
    arrays: dict[str, npt.NDArray] = {
        "area_m2": facet_areas(mesh.points_m, mesh.facets),
        "normal": facet_normals(mesh.points_m, mesh.facets),
        "on_box": (mesh.facet_tags == FACET_BOX).astype(np.uint8),
        "patch": tags.patch + 1,
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
    data.set_active_scalars("temperature_c")
    return data


def mesh_of(body: Any, surface: Any, name: str = BODY, beside: str = BOUNDARY) -> TetMesh:
    """Return the mesh that `body_grid` and `boundary_surface` made; `name` and `beside` name the two in messages.

    The cell arrays `region` and `patch` may hold names in place of numbers. Raises `MeshError` as `vtu.read_mesh`.
    """
    _check_tetrahedra(body, name)
    points = np.array(body.points, dtype=np.float64)
    colour = body.point_data.get("colour")
    facets, tags = _boundary(surface, points, beside)
    on_box = _array(surface.cell_data, "on_box", beside) != 0
    region, region_names = _numbered(_array(body.cell_data, "region", name), _names(body, name))
    mesh = TetMesh(
        points_m=points,
        tets=np.array(body.cell_connectivity, dtype=np.int64).reshape(-1, 4),
        temperature_c=_array(body.point_data, "temperature_c", name).astype(np.float64),
        observed=_array(body.point_data, "observed", name) != 0,
        facets=facets,
        facet_tags=np.where(on_box, FACET_BOX, FACET_SURFACE).astype(np.int64),
        region=region,
        region_names=region_names,
        boundary=tags,
        colour=None if colour is None else (np.asarray(colour) / 255.0).astype(np.float32),
    )
    return _checked(mesh, name, beside)


def mesh_of_grid(grid: pv.UnstructuredGrid, up: npt.ArrayLike = (0.0, 0.0, 1.0)) -> TetMesh:
    """Return a mesh of any grid of tetrahedra with a point array `temperature_c`, lengths in metres.

    The cell array `region`, if there is one, holds the region's name or number of each tetrahedron. The boundary gets
    the patches exterior-up, -side and -down and, around closed cavities, interior-up, -side and -down; `up` decides.

    Raises:
        MeshError: The grid has other cells or none, no temperatures, or faces that three tetrahedra share.
    """
    name = "grid"
    _check_tetrahedra(grid, name)
    if "temperature_c" not in grid.point_data:
        remedy = 'Set grid.point_data["temperature_c"] = 20.0, or to what was measured.'
        got = ", ".join(grid.point_data.keys()) or "none"
        raise wrong_mesh(name, "a point array temperature_c [degrees Celsius]", got, remedy)
    points, tets = np.array(grid.points, np.float64), np.array(grid.cell_connectivity, np.int64).reshape(-1, 4)
    turned = signed_volumes(points, tets) < 0.0
    tets[turned] = tets[turned][:, [0, 2, 1, 3]]
    facets = boundary_facets(tets)
    # Normals point out of the body: those around a cavity point into it, so that its volume comes out negative.
    part = component_of(len(points), facets[:, :2].ravel(), facets[:, 1:].ravel())[facets[:, 0]]
    middle = points[facets].mean(axis=1) - points.mean(axis=0)
    volume = np.einsum("fi,fi->f", middle, facet_area_vectors(points, facets))
    seen, on_box = np.bincount(part, volume)[part] > 0.0, np.zeros(len(facets), dtype=bool)
    patch, names = default_patches(facet_normals(points, facets), up, seen, on_box)
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
    return _checked(replace(mesh, boundary=Boundary(seen, patch, names)), name, name)


def _check_tetrahedra(grid: Any, name: str) -> None:
    others = np.count_nonzero(grid.celltypes != _TETRAHEDRON)
    if others or not grid.n_cells:
        remedy = "Keep grid.extract_cells_by_type(10), the tetrahedra, or make some with grid.triangulate()."
        raise wrong_mesh(name, "tetrahedra only", f"{others} cells of other kinds" if others else "none", remedy)


def _checked(mesh: TetMesh, name: str, beside: str) -> TetMesh:
    mesh.check(name if name == beside else f"{name} with {beside}", _REMEDY)
    faces = group_faces(mesh.tets)
    wrong = count_wrong_facets(mesh, faces)
    crowded = faces.sizes.max() > 2
    if (wrong or crowded) and (doubled := len(mesh.tets) - len(np.unique(np.sort(mesh.tets, axis=1), axis=0))):
        raise wrong_mesh(name, "every tetrahedron once", f"{doubled} of {len(mesh.tets)} listed again")
    if wrong:
        expected, got = "every face of one tetrahedron alone, and no other", f"{wrong} missing, inside or turned over"
        raise wrong_mesh(beside, expected, got)
    if crowded:
        remedy = "Remove tetrahedra that lie in each other, or export the mesh again."
        raise wrong_mesh(name, "faces of one or two tetrahedra each", "faces of more", remedy)
    return mesh


def _numbered(values: npt.NDArray, names: tuple[str, ...]) -> tuple[IntArray, tuple[str, ...]]:
    """Return numbers from 0 and their names, from `values` that are names, or numbers from 1 of `names`.

    Without `names`, numbers become names.
    """
    values = np.asarray(values)
    if values.dtype.kind == "U" or not names:
        found, number = np.unique(values.astype(str), return_inverse=True)
        return number.reshape(-1).astype(np.int64), tuple(found.tolist())
    return values.astype(np.int64) - 1, names


def _names(body: Any, name: str) -> tuple[str, ...]:
    """Return the names of the regions in the order of their numbers, read from field arrays `region:NAME`."""
    arrays = body.GetFieldData()
    numbers = {}
    for place in range(arrays.GetNumberOfArrays()):
        array = arrays.GetAbstractArray(place)
        if (array.GetName() or "").startswith(_REGION) and array.GetNumberOfValues() == 1:
            numbers[int(array.GetVariantValue(0).ToInt())] = array.GetName().removeprefix(_REGION)
    if sorted(numbers) != list(range(1, len(numbers) + 1)) or not numbers:
        raise wrong_mesh(name, f"field arrays {_REGION}NAME numbered from 1", sorted(numbers) or "none")
    return tuple(numbers[number] for number in range(1, len(numbers) + 1))


def _boundary(surface: Any, points: FloatArray, name: str) -> tuple[IntArray, Boundary | None]:
    """Return the boundary triangles (f, 3) and their tags; the tags are None for a mesh written without tags."""

    def array(of: str) -> npt.NDArray:
        return _array(surface.cell_data, of, name)

    node = _array(surface.point_data, "node", name).astype(np.int64)
    if not np.isfinite(points).all():
        bad = np.count_nonzero(~np.isfinite(points).all(axis=1))
        raise wrong_mesh(name, "finite positions of nodes", f"{bad} that are not, in the mesh beside it")
    if node.min() < 0 or node.max() >= len(points) or not np.array_equal(points[node], surface.points):
        raise wrong_mesh(name, "the boundary of the mesh beside it", "that of another one")
    if not surface.is_all_triangles:
        raise wrong_mesh(name, "triangles only", "other polygons")
    facets = node[np.asarray(surface.regular_faces, dtype=np.int64)]
    if "seen" not in surface.cell_data and array("patch").dtype.kind != "U":
        return facets, None
    names = surface.GetFieldData().GetAbstractArray("patch_names")
    if names is None:
        raise wrong_mesh(name, "the field array patch_names", "none")
    every = tuple(str(names.GetValue(number)) for number in range(names.GetNumberOfValues()))
    patch, patch_names = _numbered(array("patch"), every)
    counts = [f"photographs_{what}" for what in ("seen", "supporting")]
    counted = any(count in surface.cell_data for count in counts)
    return facets, Boundary(
        seen=array("seen") != 0 if "seen" in surface.cell_data else np.ones(len(facets), dtype=bool),
        patch=patch,
        patch_names=patch_names,
        photographs=np.stack([array(count) for count in counts], axis=1).astype(np.int64) if counted else None,
    )


def _array(data: Any, array: str, name: str) -> npt.NDArray:
    if array not in data:
        raise wrong_mesh(name, f"an array {array}", f"{', '.join(sorted(data.keys())) or 'none'}")
    values = np.array(data[array])
    return values if values.dtype.kind == "U" else check_finite(f"{name}: {array}", values, _REMEDY, MeshError)


def wrong_mesh(name: str, expected: str, got: object, remedy: str = _REMEDY) -> MeshError:
    """Return an error about the mesh `name`; the remedy is to export it again, if no other is given."""
    return MeshError(name, expected=expected, got=got, remedy=remedy)
