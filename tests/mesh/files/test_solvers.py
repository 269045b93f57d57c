"""Files for solvers; CalculiX, Gmsh and FEniCSx read them in tests/external."""

import dataclasses
from pathlib import Path
from xml.etree import ElementTree

import meshio
import numpy as np
import pytest
import pyvista as pv

from thermoxels_ns.core.errors import MeshError, OutputError
from thermoxels_ns.mesh.files import formats
from thermoxels_ns.mesh.files.formats import BODY_GRID, FACET_GRID, TEMPERATURE_VIEW, write_inp, write_msh, write_xdmf

# Nodes of the faces S1 to S4 of a linear tetrahedron, as the manuals of Abaqus and CalculiX list them.
FACE_NODES = {1: (1, 2, 3), 2: (1, 4, 2), 3: (2, 4, 3), 4: (3, 4, 1)}


def sections(path: Path) -> dict[str, list[list[str]]]:
    """Fields of the data lines under each keyword line."""
    found: dict[str, list[list[str]]] = {}
    lines: list[list[str]] = []
    for line in path.read_text(encoding="ascii").splitlines():
        if line.startswith("*"):
            lines = found.setdefault(line, [])
        else:
            lines.append([field.strip() for field in line.split(",")])
    return found


@pytest.fixture
def written(tmp_path, tagged_mesh) -> dict[str, list[list[str]]]:
    write_inp(tmp_path / "house.inp", tagged_mesh)
    return sections(tmp_path / "house.inp")


def test_nodes_and_elements_keep_their_numbers(written, tagged_mesh):
    nodes = np.array(written["*NODE, NSET=NALL"], dtype=float)
    assert np.array_equal(nodes[:, 0], np.arange(1, len(tagged_mesh.points_m) + 1))
    assert np.abs(nodes[:, 1:] - tagged_mesh.points_m).max() < 1e-11
    for number, name in enumerate(("WALLS", "FLOOR_SLAB")):
        rows = np.array(written[f"*ELEMENT, TYPE=DC3D4, ELSET=REGION-{name}"], dtype=int)
        assert np.array_equal(rows[:, 0] - 1, np.flatnonzero(tagged_mesh.region == number))
        assert np.array_equal(rows[:, 1:] - 1, tagged_mesh.tets[rows[:, 0] - 1])
    assert written["*ELSET, ELSET=EALL"] == [["REGION-WALLS"], ["REGION-FLOOR_SLAB"]]


def test_surfaces_are_the_faces_with_the_nodes_of_the_patch(written, tagged_mesh):
    surfaces = [lines for keyword, lines in written.items() if keyword.startswith("*SURFACE")]
    assert {face for lines in surfaces for _, face in lines} == {"S1", "S2", "S3", "S4"}
    for number, name in enumerate(("UP", "DOWN", "INSIDE", "FA_ADE_1")):
        facets = tagged_mesh.facets[tagged_mesh.boundary.patch == number]
        faces = [
            [tagged_mesh.tets[int(element) - 1][node - 1] for node in FACE_NODES[int(face.removeprefix("S"))]]
            for element, face in written[f"*SURFACE, NAME=PATCH-{name}, TYPE=ELEMENT"]
        ]
        assert np.array_equal(np.sort(faces, axis=1), np.sort(facets, axis=1))
        nodes = [int(field) for line in written[f"*NSET, NSET=PATCH-{name}"] for field in line]
        assert nodes == (np.unique(facets) + 1).tolist()


def test_empty_parts_are_left_out(written):
    """An empty set stops a solver."""
    text = "\n".join(written)
    assert "ROOF" not in text and "CUT_BY_THE_BOX" not in text
    for keyword, lines in written.items():
        if keyword.split(",")[0] in ("*NSET", "*ELSET", "*SURFACE", "*ELEMENT"):
            assert lines, keyword


def test_materials_temperatures_and_times(written, tagged_mesh):
    assert "*PHYSICAL CONSTANTS, ABSOLUTE ZERO=-273.15, STEFAN BOLTZMANN=5.670374419E-08" in written
    for keyword, value in (("*DENSITY", 2200.0), ("*CONDUCTIVITY", 1.7), ("*SPECIFIC HEAT", 880.0)):
        assert [float(line[0]) for line in written[keyword]] == [value, value], "one per region"
    for name in ("WALLS", "FLOOR_SLAB"):
        assert f"*MATERIAL, NAME=MATERIAL-{name}" in written
        assert f"*SOLID SECTION, ELSET=REGION-{name}, MATERIAL=MATERIAL-{name}" in written
    start = np.array(written["*INITIAL CONDITIONS, TYPE=TEMPERATURE"], dtype=float)
    assert np.array_equal(start[:, 0], np.arange(1, len(start) + 1))
    assert np.abs(start[:, 1] - tagged_mesh.temperature_c).max() < 1e-10
    assert "*STEP, INC=10" in written
    assert [float(field) for field in written["*HEAT TRANSFER"][0]] == [60.0, 600.0, 60.0, 60.0]
    assert written["*NODE PRINT, NSET=NALL"] == written["*NODE FILE"] == [["NT"]]
    assert list(written)[-1] == "*END STEP"


@pytest.mark.parametrize("names", [("wall a", "wall-a", "roof"), ("a", "A", "b")])
def test_names_that_become_one_are_refused(tmp_path, tagged_mesh, names):
    with pytest.raises(MeshError, match="region_names: expected"):
        write_inp(tmp_path / "house.inp", dataclasses.replace(tagged_mesh, region_names=names))
    assert not list(tmp_path.iterdir())


def test_groups_carry_names_numbers_and_elements(tmp_path, tagged_mesh):
    write_msh(tmp_path / "house.msh", tagged_mesh)
    read = meshio.read(tmp_path / "house.msh")
    assert {name: tuple(entry) for name, entry in read.field_data.items()} == {
        "up": (1, 2),
        "down": (2, 2),
        "inside": (3, 2),
        "façade 1": (4, 2),
        "walls": (1, 3),
        "floor slab": (2, 3),
    }
    assert np.array_equal(read.points, tagged_mesh.points_m)
    ours = ((tagged_mesh.facets, tagged_mesh.boundary.patch), (tagged_mesh.tets, tagged_mesh.region))
    for block, tags, (cells, index) in zip(read.cells, read.cell_data["gmsh:physical"], ours, strict=True):
        assert np.array_equal(block.data, cells) and np.array_equal(tags, index + 1)
    assert np.array_equal(read.point_data[TEMPERATURE_VIEW].ravel(), tagged_mesh.temperature_c)


def read_grids(path) -> dict[str, pv.UnstructuredGrid]:
    from vtkmodules.vtkIOXdmf2 import vtkXdmfReader

    reader = vtkXdmfReader()
    reader.SetFileName(str(path))
    reader.Update()
    blocks = pv.wrap(reader.GetOutputDataObject(0))
    return {name: blocks[name] for name in blocks.keys()}  # noqa: SIM118


def test_vtk_reads_body_and_boundary_and_tags_come_first_with_their_names(tmp_path, tagged_mesh):
    write_xdmf(tmp_path / "house.xdmf", tagged_mesh)
    grids = read_grids(tmp_path / "house.xdmf")
    assert set(grids) == {BODY_GRID, FACET_GRID}
    body, boundary = grids[BODY_GRID], grids[FACET_GRID]
    assert np.array_equal(body.points, tagged_mesh.points_m)
    assert np.array_equal(body.cells_dict[pv.CellType.TETRA], tagged_mesh.tets)
    assert np.array_equal(boundary.cells_dict[pv.CellType.TRIANGLE], tagged_mesh.facets)
    assert np.array_equal(body.cell_data["region"], tagged_mesh.region + 1)
    assert np.array_equal(boundary.cell_data["patch"], tagged_mesh.boundary.patch + 1)
    for grid in grids.values():
        assert np.array_equal(grid.point_data["temperature_c"], tagged_mesh.temperature_c)
        assert np.array_equal(grid.point_data["observed"], tagged_mesh.observed)
        assert grid.point_data["colour"].shape == tagged_mesh.colour.shape
    # FEniCSx takes the first attribute of a grid for its tags.
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

    replace_when_done = formats.replace_when_done
    monkeypatch.setattr(formats, "replace_when_done", full_disk)
    with pytest.raises(OutputError, match="no space"):
        write_xdmf(path, tagged_mesh)
    assert [file.name for file in tmp_path.iterdir()] == ["mesh.h5"]
