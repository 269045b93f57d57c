import json
import pickle
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import pyvista as pv

import thermoxels_ns
from tests.support.docs_code import DOCS
from tests.support.heat_bodies import room
from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.fem.problem import TimeSteps
from thermoxels_ns.heat.scene import load_heat_scene
from thermoxels_ns.mesh.files.formats import write_mesh
from thermoxels_ns.mesh.files.vtu import any_mesh

CONDITIONS = {
    "side": "outside",
    "inside": {"air": "20 +- 0.5 C"},
    "outside": {"air": "0 +- 0.5 C"},
    "surroundings": {"reflected": "0 C"},
    "film": {"model": "iso-6946-combined", "factor": "1"},
    "camera": {"offset": "0 +- 0.5 K", "repeatability": "0 K"},
    "surfaces": [{"emissivity": "1"}],
}


@pytest.fixture
def grid() -> pv.UnstructuredGrid:
    """A house of 3 m with walls of 1 m, as pyvista makes it; half of it is brick, one tetrahedron is turned over."""
    house = pv.ImageData(dimensions=(4, 4, 4)).to_tetrahedra()
    house = house.extract_cells(np.abs(house.cell_centers().points - 1.5).max(axis=1) > 0.5)
    house.clear_data()
    house.cell_data["region"] = np.where(house.cell_centers().points[:, 0] < 1.5, "brick", "wall")
    house.point_data["temperature_c"] = 10.0 + house.points[:, 2]
    house.cell_connectivity[:2] = house.cell_connectivity[[1, 0]]
    return house


def test_importing_is_light_and_the_names_are_there() -> None:
    code = (
        "import sys, thermoxels_ns as t; print(sorted({'numpy', 'torch', 'pyvista', 'nerfstudio'} & set(sys.modules)));"
        "import thermoxels_ns.audit.run; print(callable(t.audit), set(t.__all__) <= set(dir(t)), t.solve.__name__)"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert said.splitlines() == ["[]", "True True solve"]
    with pytest.raises(AttributeError):
        _ = thermoxels_ns.sovle


def test_a_grid_of_tetrahedra_becomes_a_tagged_mesh(grid) -> None:
    blocks = thermoxels_ns.to_pyvista(grid)
    mesh, _ = any_mesh(blocks)
    assert mesh.region_names == ("brick", "wall") and np.all(np.bincount(mesh.region) > 0)
    area = blocks["boundary"]["area_m2"]
    of_patches = dict(zip(mesh.boundary.patch_names, np.bincount(mesh.boundary.patch, area)))
    sides = {"exterior-up": 9.0, "exterior-side": 36.0, "exterior-down": 9.0}
    assert of_patches == pytest.approx({**sides, "interior-up": 1.0, "interior-side": 4.0, "interior-down": 1.0})
    assert blocks["body"].volume == pytest.approx(26.0)
    blocks["boundary"].cell_data["patch"] = np.where(
        blocks["boundary"].cell_centers().points[:, 2] < 0.1, "ground", "air"
    )
    again, _ = any_mesh(pickle.loads(pickle.dumps(blocks)))
    assert again.boundary.patch_names == ("air", "ground") and np.bincount(again.boundary.patch, area)[1] == 9.0
    turned, _ = any_mesh(grid, up=(0.0, 0.0, -1.0))
    assert np.array_equal(
        turned.boundary.patch[mesh.boundary.patch == 0], [2] * np.count_nonzero(mesh.boundary.patch == 0)
    )


def test_heat_and_audit_without_files_are_those_with_files(grid, tmp_path) -> None:
    """And what is lost by the house is what the audit finds in the temperatures of its surface."""
    blocks = thermoxels_ns.to_pyvista(grid)
    write_mesh(tmp_path / "mesh.vtu", any_mesh(blocks)[0])
    (tmp_path / "summary.json").write_text(json.dumps({"up": [0, 0, 1]}))
    heat, from_file = (thermoxels_ns.solve(mesh, "winter-night") for mesh in (blocks, str(tmp_path / "mesh.vtu")))
    assert np.array_equal(heat.nodes.states_c, from_file.nodes.states_c)
    lost_w = -sum(line["heat_w"] for line in heat.tables()["patches"] if line["patch"].startswith("exterior"))
    found = thermoxels_ns.audit(heat.to_pyvista(), CONDITIONS)
    loss = found.whole.loss_w
    assert loss.low < loss.value < loss.high and loss.value == pytest.approx(lost_w, rel=1e-9)
    assert found.tables()["patches"][-1]["u_w_m2k"] == found.whole.u_w_m2k.value
    assert found.tables()["patches"][-1]["u_w_m2k_low"] == found.whole.u_w_m2k.low
    again = pickle.loads(pickle.dumps((heat, found)))
    assert repr(again) == repr((heat, found)) and len(repr(again)) < 300
    assert np.array_equal(again[1].triangle_u, found.triangle_u, equal_nan=True)


def test_a_run_with_everything_that_changes_in_time_can_be_pickled() -> None:
    scene = replace(load_heat_scene("all-effects"), time=TimeSteps(2, 3600.0))
    heat = thermoxels_ns.solve(room(), scene, leave_out_below=0.0)
    again = pickle.loads(pickle.dumps(heat))
    assert len(again.solved.effects) == len(heat.problem.effects) > 8
    assert np.array_equal(thermoxels_ns.solve(again.problem.mesh, again.scene, leave_out_below=0.0).mean_c, heat.mean_c)
    assert [line["time_s"] for line in again.tables()["times"]] == [0.0, 3600.0, 7200.0]


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda grid: grid.point_data.clear(), "temperature_c"),
        (lambda grid: grid.cast_to_poly_points(), "PolyData"),
        (lambda grid: pv.ImageData(dimensions=(3, 3, 3)).cast_to_unstructured_grid(), "tetrahedra"),
        (lambda grid: pv.MultiBlock({"body": grid}), "boundary"),
        (lambda grid: grid.point_data.update({"temperature_c": np.full(grid.n_points, np.nan)}), "temperature_c"),
        (lambda grid: "no/such/mesh.vtu", "mesh.vtu"),
    ],
)
def test_what_is_no_mesh_is_refused(grid, change, named) -> None:
    with pytest.raises(ThermoxelsError, match=named):
        thermoxels_ns.solve(grid if (made := change(grid)) is None else made, "winter-night")


def test_a_frame_needs_pandas_and_says_so(grid, monkeypatch) -> None:
    heat = thermoxels_ns.solve(grid, "winter-night", memory_gb=None)
    with pytest.raises(ThermoxelsError, match="patches"):
        heat.to_frame("patch")
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ThermoxelsError, match="pip install pandas"):
        heat.to_frame()


def test_the_notebook_runs() -> None:
    """In a kernel; pictures come without a display and without a server."""
    import nbformat
    from nbclient import NotebookClient

    notebook = nbformat.read(DOCS / "notebook.ipynb", as_version=4)
    NotebookClient(notebook, timeout=600, kernel_name="python3").execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 2
    said = "".join(output.get("text", "") for output in outputs)
    numbers = [float(word) for word in said[said.index("The house loses") :].split() if word.isdigit()]
    assert numbers[1] < numbers[0] < numbers[2]
