import dataclasses
import re
import shutil

import numpy as np
import pytest
import pyvista as pv

from tests.support.unreadable import forbid
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.files.formats import write_mesh
from thermoxels_ns.mesh.files.vtu import body_grid, boundary_surface, read_mesh, write_vtk
from thermoxels_ns.mesh.tetrahedra import FACET_BOX, Boundary, facet_areas, facet_normals


def test_tags_come_back_under_their_names(tmp_path, tagged_mesh):
    write_vtk(tmp_path / "house-boundary.vtp", boundary_surface(tagged_mesh))
    read = pv.read(tmp_path / "house-boundary.vtp")
    tags, node = tagged_mesh.boundary, read.point_data["node"]
    assert np.array_equal(node[read.regular_faces], tagged_mesh.facets)
    assert np.array_equal(read.point_data["temperature_c"], tagged_mesh.temperature_c[node])
    assert np.array_equal(read.cell_data["seen"], tags.seen)
    assert np.array_equal(read.cell_data["patch"], tags.patch + 1)
    assert read.cell_data["area_m2"] == pytest.approx(facet_areas(tagged_mesh.points_m, tagged_mesh.facets), rel=1e-14)
    assert read.cell_data["normal"] == pytest.approx(facet_normals(tagged_mesh.points_m, tagged_mesh.facets))
    assert np.array_equal(read.cell_data["on_box"], tagged_mesh.facet_tags == FACET_BOX)
    assert list(read.field_data["patch_names"]) == list(tags.patch_names)


def assert_same(read, written) -> None:
    for field in dataclasses.fields(written):
        ours, theirs = getattr(written, field.name), getattr(read, field.name)
        if isinstance(ours, np.ndarray) and field.name != "colour":
            assert theirs.dtype == ours.dtype, field.name
            assert np.array_equal(ours, theirs), field.name
        elif isinstance(ours, Boundary):
            assert_same(theirs, ours)
        elif field.name != "colour":
            assert ours == theirs, field.name


@pytest.mark.parametrize("name", ["mesh.vtu", "my house.vtu"])
def test_a_tagged_mesh_comes_back_bit_for_bit(tmp_path, tagged_mesh, name) -> None:
    count = np.random.default_rng(2).integers(0, 9, (len(tagged_mesh.facets), 2))
    tags = dataclasses.replace(tagged_mesh.boundary, photographs=count)
    counted = dataclasses.replace(tagged_mesh, boundary=tags, region_names=("a<b>", "floor & slab", "roof"))
    write_mesh(tmp_path / name, counted)
    read = read_mesh(tmp_path / name)
    assert_same(read, counted)
    assert read.colour.dtype == np.float32 and np.abs(read.colour - tagged_mesh.colour).max() <= 0.5 / 255 + 1e-7
    again, grid = tmp_path / "again.vtu", body_grid(read)
    write_mesh(again, read)
    write_vtk(again, grid)
    assert "region:a<b>" in grid.field_data  # what is written stays as it was
    assert np.array_equal(read_mesh(again).colour, read.colour)


def test_missing_files_are_named(tmp_path, box_mesh) -> None:
    with pytest.raises(MeshError, match=r"box\.vtu: expected a file at"):
        read_mesh(tmp_path / "box.vtu")
    write_mesh(tmp_path / "box.vtu", box_mesh)
    (tmp_path / "box-boundary.vtp").unlink()
    with pytest.raises(MeshError, match=r"box-boundary\.vtp: expected a file at"):
        read_mesh(tmp_path / "box.vtu")
    with pytest.raises(MeshError, match=r"^mesh file: .* got box\.msh"):
        read_mesh(tmp_path / "box.msh")


@pytest.mark.parametrize("name", ["box.vtu", "box-boundary.vtp"])
@pytest.mark.parametrize("damage", ["cut short", "text", "empty", "other kind", "forbidden"])
def test_damaged_files_are_refused_and_those_that_may_not_be_read(
    tmp_path, box_mesh, monkeypatch, name, damage, capfd
) -> None:
    write_mesh(tmp_path / "box.vtu", box_mesh)
    file, other = tmp_path / name, tmp_path / ("box-boundary.vtp" if name == "box.vtu" else "box.vtu")
    content = file.read_bytes()
    if damage == "other kind":
        shutil.copy(other, file)
    elif damage == "forbidden":
        forbid(monkeypatch, name)
    else:
        file.write_bytes({"cut short": content[: len(content) // 2], "text": b"not a mesh", "empty": b""}[damage])
    said = ".* got Permission denied" if damage == "forbidden" else "expected a VTK file"
    with pytest.raises(MeshError, match=f"{name}: {said}"):
        read_mesh(tmp_path / "box.vtu")
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("array", range(6))
@pytest.mark.parametrize("what", [b"<?xml ver", b"////////"], ids=["text", "number"])
def test_a_size_that_no_memory_holds_is_a_damaged_file(tmp_path, box_mesh, array, what) -> None:
    """VTK would end the process."""
    write_mesh(tmp_path / "box.vtu", box_mesh)
    file = tmp_path / "box.vtu"
    content = bytearray(file.read_bytes())
    begin = content.index(b"_", content.index(b"<AppendedData")) + 1
    offset = [int(found) for found in re.findall(rb'offset="(\d+)', bytes(content))][array]
    content[begin + offset : begin + offset + len(what)] = what
    file.write_bytes(bytes(content))
    with pytest.raises(MeshError, match=r"box\.vtu: expected a VTK file"):
        read_mesh(file)


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        ("a node moved", None),
        ("no number", "finite positions of nodes, got 1"),
        ("no temperatures", r"box\.vtu: .* temperature_c"),
        ("boundary of another mesh", None),
        ("region without a number", None),
    ],
)
def test_files_that_say_something_else_are_refused(tmp_path, box_mesh, damage, said) -> None:
    file, other = tmp_path / "box.vtu", tmp_path / "other.vtu"
    write_mesh(file, box_mesh)
    if damage == "boundary of another mesh":
        write_mesh(other, dataclasses.replace(box_mesh, points_m=box_mesh.points_m + 1e-3))
        shutil.copy(tmp_path / "other-boundary.vtp", tmp_path / "box-boundary.vtp")
    elif damage == "region without a number":
        file.write_bytes(file.read_bytes().replace(b'NumberOfTuples="1"', b'NumberOfTuples="0"'))
    else:
        edited = pv.read(file)
        if damage == "no temperatures":
            del edited.point_data["temperature_c"]
        else:
            edited.points[3, 1] += np.nan if damage == "no number" else 1.0
        edited.save(file)
    with pytest.raises(MeshError, match=said):
        read_mesh(file)


@pytest.mark.parametrize(
    ("names", "chosen", "said"),
    [
        (("tets", "region"), [0, *range(144)], r"mesh\.vtu: expected every tetrahedron once"),
        *((("facets", "facet_tags"), slice(n, None), rf"mesh-boundary\.vtp: .* got {n} missing") for n in (1, 7)),
    ],
)
def test_a_tetrahedron_listed_again_and_missing_triangles_are_refused(tmp_path, box_mesh, names, chosen, said) -> None:
    """Where triangles of the boundary are missing no heat would flow."""
    changes = {name: getattr(box_mesh, name)[chosen] for name in names}
    write_mesh(tmp_path / "mesh.vtu", dataclasses.replace(box_mesh, boundary=None, **changes))
    with pytest.raises(MeshError, match=said):
        read_mesh(tmp_path / "mesh.vtu")
