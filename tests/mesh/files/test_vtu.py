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
    write_vtu(path, box_mesh)
    grid = pv.read(path)
    assert isinstance(grid, pv.UnstructuredGrid)
    assert grid.points.dtype == np.float64
    assert np.array_equal(grid.points, box_mesh.points_m)
    assert np.array_equal(grid.cells_dict[pv.CellType.TETRA], box_mesh.tets)
    assert np.array_equal(grid.point_data["temperature_c"], box_mesh.temperature_c)
    assert np.array_equal(grid.point_data["temperature_k"], box_mesh.temperature_c + 273.15)
    assert grid.point_data["observed"].dtype == np.uint8
    assert np.array_equal(grid.point_data["observed"], box_mesh.observed)
    assert 0 < grid.point_data["observed"].sum() < grid.n_points
    assert np.array_equal(grid.cell_data["region"], box_mesh.region)
    assert grid.volume == pytest.approx(3.0)
    assert [p.name for p in path.parent.iterdir()] == ["mesh.vtu"]


def test_temperature_of_a_later_step_replaces_the_meshs_own(tmp_path, box_mesh):
    later = box_mesh.temperature_c + 1.0
    write_vtu(tmp_path / "step.vtu", box_mesh, temperature_c=later)
    grid = pv.read(tmp_path / "step.vtu")
    assert np.array_equal(grid.point_data["temperature_c"], later)
    assert np.array_equal(grid.point_data["temperature_k"], later + 273.15)


def test_summary_keeps_order_and_converts_numpy(tmp_path):
    path = tmp_path / "summary.json"
    write_summary(
        path,
        {
            "volume_m3": np.float32(0.5),
            "counts": {"tets": np.int64(6), "whole": np.bool_(True)},
            "bounds_m": np.array([[0.0, 1.0], [2.0, 3.0]]),
            "source": Path("run/config.yml"),
            "sizes": (3, 2),
            "unknown": None,
            "unit": "°C",
        },
    )
    text = path.read_text(encoding="utf-8")
    read = json.loads(text)
    assert list(read) == ["volume_m3", "counts", "bounds_m", "source", "sizes", "unknown", "unit"]
    assert read["counts"] == {"tets": 6, "whole": True}
    assert read["bounds_m"] == [[0.0, 1.0], [2.0, 3.0]]
    assert read["source"] == "run/config.yml"
    assert '\n  "volume_m3": 0.5' in text
    assert "°C" in text


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
