"""The tagged boundary of a mesh as a VTK file of its own (.vtp), beside the .vtu of the body."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.checks import check_finite, check_shape
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.boundary.surface import surface_of
from thermoxels_ns.mesh.files.content import check_suffix, colour_bytes, file_content
from thermoxels_ns.mesh.files.vtu import write_vtk
from thermoxels_ns.mesh.quality.checks import facet_area_vectors
from thermoxels_ns.mesh.tetrahedra import FACET_BOX, TetMesh


def boundary_path(path: Path | str) -> Path:
    """Name the file of the boundary that belongs to a mesh file.

    >>> boundary_path("house/mesh.vtu").as_posix()
    'house/mesh-boundary.vtp'
    """
    path = Path(path)
    return path.with_name(f"{path.stem}-boundary.vtp")


def write_boundary_vtp(
    path: Path | str, mesh: TetMesh, *, temperature_c: npt.NDArray[np.floating] | None = None
) -> None:
    """Write the boundary triangles and their tags as VTK polygons (.vtp, read by ParaView and pyvista).

    Cell arrays: `normal` (outward, of the true surface), `area_m2` (of the true surface that the triangle stands
    for), `area_factor` (that over the triangle's own area), `seen` (1: a camera saw it), `patch` (an index into the
    field array `patch_names`) and `on_box` (1: where the scene box cuts the solid). Point arrays: `temperature_c`,
    `observed`, `node` (number in the mesh, from 0) and, if the mesh has colours, `colour` as bytes.

    A mesh without boundary tags is written with the triangles' own normals and areas, one patch "boundary", and
    without `seen`, which nobody knows.

    Args:
        path: File to write, ending in .vtp; its folder is made if need be.
        mesh: The mesh.
        temperature_c: Temperatures to write in place of the mesh's own, shape (n,), [degrees Celsius].

    Raises:
        MeshError: An array does not fit the mesh or is not finite.
        OutputError: The file cannot be written.
    """
    import pyvista as pv
    from vtkmodules.vtkCommonCore import vtkStringArray
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    path = check_suffix(path, ".vtp")
    content = file_content(mesh, temperature_c)
    surface = surface_of(content.points_m, content.facets)
    vectors = facet_area_vectors(content.points_m, content.facets)
    areas = np.linalg.norm(vectors, axis=1)
    arrays: dict[str, npt.NDArray] = {}
    if mesh.boundary is None:
        factor = np.ones(len(areas))
        arrays["normal"] = vectors / np.where(areas > 0.0, areas, 1.0)[:, None]
    else:
        remedy = "Give every boundary triangle a value."
        normal = check_shape("boundary.normal", mesh.boundary.normal, (len(areas), 3), remedy, MeshError)
        factor = check_shape("boundary.area_factor", mesh.boundary.area_factor, (len(areas),), remedy, MeshError)
        seen = check_shape("boundary.seen", mesh.boundary.seen, (len(areas),), remedy, MeshError)
        arrays["normal"] = check_finite("boundary.normal", normal, remedy, MeshError)
        check_finite("boundary.area_factor", factor, remedy, MeshError)
        arrays["seen"] = seen.astype(np.uint8)
    arrays["area_m2"] = areas * factor
    arrays["area_factor"] = factor
    arrays["patch"] = content.patch
    arrays["on_box"] = (mesh.facet_tags == FACET_BOX).astype(np.uint8)

    data = pv.PolyData.from_regular_faces(surface.points_m, surface.triangles)
    data.point_data["temperature_c"] = content.temperature_c[surface.nodes]
    data.point_data["observed"] = mesh.observed[surface.nodes].astype(np.uint8)
    data.point_data["node"] = surface.nodes
    if mesh.colour is not None:
        data.point_data["colour"] = colour_bytes(mesh.colour[surface.nodes])
    for name in sorted(arrays):
        data.cell_data[name] = arrays[name]
    names = vtkStringArray()  # pyvista itself takes ASCII only
    names.SetName("patch_names")
    for name in content.patch_names:
        names.InsertNextValue(name)
    data.GetFieldData().AddArray(names)
    data.set_active_scalars("temperature_c")
    write_vtk(vtkXMLPolyDataWriter(), path, data)
