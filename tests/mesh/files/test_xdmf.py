"""XDMF files as VTK (and so ParaView) reads them; FEniCSx reads them in tests/external."""

from xml.etree import ElementTree

import numpy as np
import pytest
import pyvista as pv

from thermoxels_ns.core.errors import OutputError
from thermoxels_ns.mesh.files import solvers
from thermoxels_ns.mesh.files.solvers import BODY_GRID, FACET_GRID, write_xdmf


def read_grids(path) -> dict[str, pv.UnstructuredGrid]:
    from vtkmodules.vtkIOXdmf2 import vtkXdmfReader

    reader = vtkXdmfReader()
    reader.SetFileName(str(path))
    reader.Update()
    blocks = pv.wrap(reader.GetOutputDataObject(0))
    return {name: blocks[name] for name in blocks.keys()}  # noqa: SIM118


def test_vtk_reads_body_and_boundary(tmp_path, tagged_mesh):
    write_xdmf(tmp_path / "house.xdmf", tagged_mesh)
    grids = read_grids(tmp_path / "house.xdmf")
    assert set(grids) == {BODY_GRID, FACET_GRID}
    body, boundary = grids[BODY_GRID], grids[FACET_GRID]
    assert np.array_equal(body.points, tagged_mesh.points_m)
    assert np.array_equal(body.cells_dict[pv.CellType.TETRA], tagged_mesh.tets)
    assert np.array_equal(boundary.cells_dict[pv.CellType.TRIANGLE], tagged_mesh.facets)
    assert np.array_equal(body.cell_data["region"], tagged_mesh.region + 1)
    assert np.array_equal(boundary.cell_data["patch"], tagged_mesh.boundary.patch + 1)
    assert np.array_equal(boundary.cell_data["area_factor"], tagged_mesh.boundary.area_factor)
    assert np.array_equal(boundary.cell_data["normal"], tagged_mesh.boundary.normal)
    for grid in grids.values():
        assert np.array_equal(grid.point_data["temperature_c"], tagged_mesh.temperature_c)
        assert np.array_equal(grid.point_data["temperature_k"], tagged_mesh.temperature_c + 273.15)
        assert np.array_equal(grid.point_data["observed"], tagged_mesh.observed)
        assert grid.point_data["colour"].shape == tagged_mesh.colour.shape


def test_tags_come_first_and_their_names_are_in_the_file(tmp_path, tagged_mesh):
    """FEniCSx takes the first attribute of a grid for its tags."""
    write_xdmf(tmp_path / "house.xdmf", tagged_mesh)
    grids = {grid.get("Name"): grid for grid in ElementTree.parse(tmp_path / "house.xdmf").iter("Grid")}
    assert grids[BODY_GRID].find("Attribute").get("Name") == "region"
    assert grids[FACET_GRID].find("Attribute").get("Name") == "patch"
    assert grids[BODY_GRID].find("Information").get("Value") == "1 = walls; 2 = floor slab; 3 = roof"
    names = "1 = up; 2 = down; 3 = inside; 4 = façade 1; 5 = cut by the box"
    assert grids[FACET_GRID].find("Information").get("Value") == names


def test_an_index_never_points_at_data_of_another_mesh(tmp_path, box_mesh, tagged_mesh, monkeypatch):
    """Interrupted between its two files, a new export leaves no index."""
    path = tmp_path / "mesh.xdmf"
    write_xdmf(path, box_mesh)

    def full_disk(final):
        if final.suffix == ".xdmf":
            raise OutputError("no space")
        return replace_when_done(final)

    replace_when_done = solvers.replace_when_done
    monkeypatch.setattr(solvers, "replace_when_done", full_disk)
    with pytest.raises(OutputError, match="no space"):
        write_xdmf(path, tagged_mesh)
    assert [file.name for file in tmp_path.iterdir()] == ["mesh.h5"]
