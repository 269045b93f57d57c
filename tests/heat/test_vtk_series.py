import numpy as np
import pytest
import pyvista

from thermoxels_ns.core.errors import OutputError
from thermoxels_ns.fem.problem import HeatProblem, TimeSteps
from thermoxels_ns.fem.time_loop import solve_heat
from thermoxels_ns.heat.vtk_series import remove_heat_series, write_heat_series


@pytest.fixture
def solution(random_body, concrete):
    return solve_heat(HeatProblem(random_body, concrete), TimeSteps(3, 20.0))


def test_series_reads_back(tmp_path, random_body, solution) -> None:
    paths = write_heat_series(tmp_path / "heat.pvd", random_body, solution)
    assert [path.relative_to(tmp_path).as_posix() for path in paths] == [
        "heat.pvd",
        *(f"heat/step-{number:04d}.vtu" for number in range(4)),
    ]
    reader = pyvista.PVDReader(tmp_path / "heat.pvd")
    assert reader.time_values == [0.0, 20.0, 40.0, 60.0]
    for number, time_s in enumerate(solution.times_s):
        reader.set_active_time_value(time_s)
        grid = reader.read()[0]
        np.testing.assert_array_equal(grid.point_data["temperature_c"], solution.temperature_c[number])
        np.testing.assert_allclose(grid.point_data["temperature_k"], solution.temperature_c[number] + 273.15)
        np.testing.assert_array_equal(grid.points, random_body.points_m)
        assert grid.n_cells == len(random_body.tets)


def test_a_shorter_series_leaves_no_old_steps(tmp_path, random_body, concrete, solution) -> None:
    write_heat_series(tmp_path / "heat.pvd", random_body, solution)
    short = solve_heat(HeatProblem(random_body, concrete), TimeSteps(1, 20.0))
    write_heat_series(tmp_path / "heat.pvd", random_body, short)
    assert sorted(path.name for path in (tmp_path / "heat").iterdir()) == ["step-0000.vtu", "step-0001.vtu"]


def test_remove_takes_only_the_series(tmp_path, random_body, solution) -> None:
    write_heat_series(tmp_path / "heat.pvd", random_body, solution)
    note = tmp_path / "heat" / "note.txt"
    note.write_text("mine")
    remove_heat_series(tmp_path / "heat.pvd")
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["note.txt"]
    note.unlink()
    remove_heat_series(tmp_path / "heat.pvd")
    assert list(tmp_path.iterdir()) == []


def test_what_is_in_the_way_is_an_output_error(tmp_path, random_body, solution) -> None:
    (tmp_path / "heat.pvd").mkdir()
    with pytest.raises(OutputError, match=r"heat\.pvd: expected a file that can be removed"):
        remove_heat_series(tmp_path / "heat.pvd")
    with pytest.raises(OutputError, match=r"heat\.pvd: expected a file that can be written"):
        write_heat_series(tmp_path / "heat.pvd", random_body, solution)
