import json
from pathlib import Path

import numpy as np
import pytest
import pyvista as pv

from thermoxels_ns.mesh.files.vtu import write_boundary_vtp, write_summary, write_vtu
from thermoxels_ns.mesh.quality.checks import facet_areas, facet_normals
from thermoxels_ns.mesh.tetrahedra import FACET_BOX


def test_mesh_round_trips_through_pyvista(tmp_path, box_mesh):
    path = tmp_path / "new" / "mesh.vtu"
    temperature_c = box_mesh.temperature_c + 1.0  # of a later step
    write_vtu(path, box_mesh, temperature_c=temperature_c)
    grid = pv.read(path)
    assert isinstance(grid, pv.UnstructuredGrid)
    assert grid.points.dtype == np.float64
    assert np.array_equal(grid.points, box_mesh.points_m)
    assert np.array_equal(grid.cells_dict[pv.CellType.TETRA], box_mesh.tets)
    assert np.array_equal(grid.point_data["temperature_c"], temperature_c)
    assert np.array_equal(grid.point_data["temperature_k"], temperature_c + 273.15)
    assert grid.point_data["observed"].dtype == np.uint8
    assert np.array_equal(grid.point_data["observed"], box_mesh.observed)
    assert 0 < grid.point_data["observed"].sum() < grid.n_points
    assert np.array_equal(grid.cell_data["region"], box_mesh.region)
    assert grid.volume == pytest.approx(3.0)
    assert [p.name for p in path.parent.iterdir()] == ["mesh.vtu"]


def names_in(data: pv.DataSet) -> list[str]:
    array = data.GetFieldData().GetAbstractArray("patch_names")
    return [array.GetValue(number) for number in range(array.GetNumberOfValues())]


def test_what_nobody_tagged_is_not_made_up(tmp_path, box_mesh):
    write_boundary_vtp(tmp_path / "box.vtp", box_mesh)
    read = pv.read(tmp_path / "box.vtp")
    assert "seen" not in read.cell_data
    assert "colour" not in read.point_data
    assert names_in(read) == ["boundary"]
    assert read.cell_data["normal"] == pytest.approx(facet_normals(box_mesh.points_m, box_mesh.facets))
    # A box of 1.5 x 2 x 1 m.
    assert read.cell_data["area_m2"].sum() == pytest.approx(13.0)


def test_tags_come_back_under_their_names(tmp_path, tagged_mesh):
    write_boundary_vtp(tmp_path / "house-boundary.vtp", tagged_mesh)
    read = pv.read(tmp_path / "house-boundary.vtp")
    tags, node = tagged_mesh.boundary, read.point_data["node"]
    assert np.array_equal(node[read.regular_faces], tagged_mesh.facets)
    assert np.array_equal(read.point_data["temperature_c"], tagged_mesh.temperature_c[node])
    for name in ("normal", "area_factor", "seen", "patch"):
        assert np.array_equal(read.cell_data[name], getattr(tags, name)), name
    true_area = facet_areas(tagged_mesh.points_m, tagged_mesh.facets) * tags.area_factor
    assert read.cell_data["area_m2"] == pytest.approx(true_area, rel=1e-14)
    assert np.array_equal(read.cell_data["on_box"], tagged_mesh.facet_tags == FACET_BOX)
    assert names_in(read) == list(tags.patch_names)


def test_summary_keeps_order_and_converts_numpy(tmp_path):
    figures = {"volume": np.float32(0.5), "counts": {"tets": np.int64(6)}, "bounds": np.eye(2), "run": Path("a/b")}
    write_summary(tmp_path / "summary.json", {**figures, "unit": "°C"})
    text = (tmp_path / "summary.json").read_text(encoding="utf-8")
    read = json.loads(text)
    assert list(read) == [*figures, "unit"] and "°C" in text and '\n  "volume": 0.5' in text
    assert (read["counts"], read["bounds"], read["run"]) == ({"tets": 6}, [[1.0, 0.0], [0.0, 1.0]], "a/b")
