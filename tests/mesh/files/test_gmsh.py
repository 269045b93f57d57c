"""Gmsh files as meshio reads them; Gmsh itself reads them in tests/external."""

import dataclasses

import meshio
import numpy as np
import pytest

from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.files.solvers import TEMPERATURE_VIEW, write_msh


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
    ours = {2: (tagged_mesh.facets, tagged_mesh.boundary.patch), 3: (tagged_mesh.tets, tagged_mesh.region)}
    assert [block.dim for block in read.cells] == [2, 2, 2, 2, 3, 3]
    for block, tags in zip(read.cells, read.cell_data["gmsh:physical"]):
        cells, index = ours[block.dim]
        assert len(set(tags)) == 1
        expected = tagged_mesh.points_m[cells[index == tags[0] - 1]]
        assert np.array_equal(read.points[block.data], expected)


def test_temperatures_are_at_their_nodes(tmp_path, tagged_mesh):
    shown = tagged_mesh.temperature_c[::-1].copy()
    write_msh(tmp_path / "house.msh", dataclasses.replace(tagged_mesh, temperature_c=shown))
    read = meshio.read(tmp_path / "house.msh")
    assert len(read.points) == len(tagged_mesh.points_m)
    # The nodes come sorted by where they lie.
    at = {tuple(point): number for number, point in enumerate(tagged_mesh.points_m)}
    number = [at[tuple(point)] for point in read.points]
    assert sorted(number) == list(range(len(at)))
    assert np.array_equal(read.point_data[TEMPERATURE_VIEW].ravel(), shown[number])


def test_a_name_that_gmsh_would_cut_is_refused(tmp_path, tagged_mesh):
    names = ("walls", "floor", "é" * 64)
    with pytest.raises(MeshError, match=r"at most 127 bytes.*got 128 bytes"):
        write_msh(tmp_path / "house.msh", dataclasses.replace(tagged_mesh, region_names=names))
    assert not list(tmp_path.iterdir())


def test_triangles_carry_true_areas_and_normals(tmp_path, tagged_mesh):
    """Tag of the element, number of its nodes, then the values at each of them."""
    write_msh(tmp_path / "house.msh", tagged_mesh)
    data, count = (tmp_path / "house.msh").read_bytes(), len(tagged_mesh.facets)
    views = {"area_factor": tagged_mesh.boundary.area_factor[:, None], "normal": tagged_mesh.boundary.normal}
    for name, values in views.items():
        width = values.shape[1]
        head = f'$ElementNodeData\n1\n"{name}"\n1\n0.0\n3\n0\n{width}\n{count}\n'.encode()
        row = np.dtype([("tag", "<i4"), ("nodes", "<i4"), ("value", "<f8", (3, width))])
        table = np.frombuffer(data, row, count, data.index(head) + len(head))
        assert np.array_equal(table["tag"], len(tagged_mesh.tets) + 1 + np.arange(count))
        assert np.all(table["nodes"] == 3)
        assert np.array_equal(table["value"], np.repeat(values[:, None], 3, axis=1))
