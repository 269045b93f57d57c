"""The tagged boundary as a file of its own."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import pyvista as pv

from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.files.vtu import write_boundary_vtp
from thermoxels_ns.mesh.quality.checks import facet_areas, facet_normals
from thermoxels_ns.mesh.tetrahedra import FACET_BOX


def names_in(data: pv.DataSet) -> list[str]:
    array = data.GetFieldData().GetAbstractArray("patch_names")
    return [array.GetValue(number) for number in range(array.GetNumberOfValues())]


def test_tags_come_back(tmp_path, tagged_mesh):
    write_boundary_vtp(tmp_path / "house-boundary.vtp", tagged_mesh)
    read = pv.read(tmp_path / "house-boundary.vtp")
    tags, node = tagged_mesh.boundary, read.point_data["node"]
    assert np.array_equal(node, np.unique(tagged_mesh.facets))
    assert np.array_equal(read.points, tagged_mesh.points_m[node])
    assert np.array_equal(node[read.regular_faces], tagged_mesh.facets)
    assert np.array_equal(read.point_data["temperature_c"], tagged_mesh.temperature_c[node])
    assert np.array_equal(read.cell_data["normal"], tags.normal)
    assert np.array_equal(read.cell_data["area_factor"], tags.area_factor)
    true_area = facet_areas(tagged_mesh.points_m, tagged_mesh.facets) * tags.area_factor
    assert read.cell_data["area_m2"] == pytest.approx(true_area, rel=1e-14)
    assert np.array_equal(read.cell_data["seen"], tags.seen)
    assert np.array_equal(read.cell_data["patch"], tags.patch)
    assert np.array_equal(read.cell_data["on_box"], tagged_mesh.facet_tags == FACET_BOX)
    assert 0 < read.cell_data["on_box"].sum() < read.n_cells
    assert names_in(read) == list(tags.patch_names)


def test_what_nobody_tagged_is_not_made_up(tmp_path, box_mesh):
    write_boundary_vtp(tmp_path / "box.vtp", box_mesh)
    read = pv.read(tmp_path / "box.vtp")
    assert "seen" not in read.cell_data
    assert "colour" not in read.point_data
    assert names_in(read) == ["boundary"]
    assert read.cell_data["normal"] == pytest.approx(facet_normals(box_mesh.points_m, box_mesh.facets))
    # A box of 1.5 x 2 x 1 m.
    assert read.cell_data["area_m2"].sum() == pytest.approx(13.0)


@pytest.mark.parametrize("field", ["normal", "area_factor", "seen"])
def test_tags_of_another_mesh_are_refused(tmp_path, tagged_mesh, field):
    tags = dataclasses.replace(tagged_mesh.boundary, **{field: getattr(tagged_mesh.boundary, field)[1:]})
    with pytest.raises(MeshError, match=f"boundary.{field}: expected shape"):
        write_boundary_vtp(tmp_path / "house.vtp", dataclasses.replace(tagged_mesh, boundary=tags))
    assert not list(tmp_path.iterdir())
