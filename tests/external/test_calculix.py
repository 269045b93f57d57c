import re
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from tests.support.heat_bodies import CONCRETE, HeatMatrices, assemble, backward_euler
from thermoxels_ns.fem.problem import HeatProblem, TimeSteps
from thermoxels_ns.mesh.files.formats import write_inp
from thermoxels_ns.mesh.tetrahedra import facet_areas

pytestmark = pytest.mark.external


def printed_temperatures(path: Path) -> npt.NDArray[np.float64]:
    """Temperatures that CalculiX prints after each step, shape (steps, n); nodes come in the order of their numbers."""
    blocks = path.read_text().split("temperatures for set NALL and time")[1:]
    tables = [np.array([line.split() for line in block.splitlines()[1:] if line.strip()], float) for block in blocks]
    assert all(np.array_equal(table[:, 0], np.arange(1, len(table) + 1)) for table in tables)
    return np.array([table[:, 1] for table in tables])


def capacities(problem: HeatProblem) -> dict[str, HeatMatrices]:
    """The ways to integrate the heat capacity of a linear tetrahedron of volume V.

    "lumped" is V / 4 for each node, "consistent" V / 20 for each pair and once more for a node with itself. At one
    point, the centre, all shape functions are 1 / 4: V / 16 for each pair, which is 5 / 4 consistent - 1 / 4 lumped.
    """
    lumped, consistent = (assemble(problem.mesh, problem.material, lumped=entry) for entry in (True, False))
    one_point = lumped[0], 1.25 * consistent[1] - 0.25 * lumped[1]
    return {"lumped": lumped, "consistent": consistent, "one point": one_point}


def run_calculix(folder: Path, problem: HeatProblem, time: TimeSteps, ccx: str, run_in) -> npt.NDArray[np.float64]:
    write_inp(folder / "house.inp", problem.mesh, steps=time.steps, step_seconds=time.step_seconds)
    said = run_in(folder, [ccx, "house"])
    assert "Job finished" in said
    assert "*WARNING" not in said and "*ERROR" not in said, said
    return printed_temperatures(folder / "house.dat")


@pytest.mark.parametrize("time", [TimeSteps(10, 3600.0), TimeSteps(7, 1000.1 / 3.0)])  # also of an awkward length
def test_all_steps_agree_with_ours(tmp_path, heat_problem, time, program, run_in):
    """CalculiX takes backward Euler and integrates the capacity of its linear tetrahedra at one point."""
    theirs = run_calculix(tmp_path, heat_problem, time, program("ccx", "calculix-ccx"), run_in)
    start = heat_problem.start_c
    assert theirs.shape == (time.steps, len(start))
    difference = {
        name: float(np.abs(backward_euler(matrices, start, time) - theirs).max() / np.ptp(start))
        for name, matrices in capacities(heat_problem).items()
    }
    assert difference["one point"] < 1e-5, f"differences relative to the span of temperatures: {difference}"
    # The test sees which is which.
    assert min(difference["lumped"], difference["consistent"]) > 1e-3, difference


def test_surfaces_and_sets_are_the_patches(tmp_path, heat_problem, program, run_in):
    """A heat flux on a surface brings what its area asks for; a node set holds its nodes at a temperature."""
    mesh, seconds, flux_w_m2, held_c = heat_problem.mesh, 1e4, 50.0, -40.0
    write_inp(tmp_path / "plain.inp", mesh, steps=1, step_seconds=seconds)
    plain, ccx = (tmp_path / "plain.inp").read_text(), program("ccx", "calculix-ccx")
    surfaces = re.findall(r"\*SURFACE, NAME=([^,]+),", plain)
    used = np.unique(mesh.boundary.patch)
    assert len(surfaces) == len(used) > 1
    nodal_mass = assemble(mesh, CONCRETE)[1].diagonal()
    areas = facet_areas(mesh.points_m, mesh.facets)
    for name, patch in zip(surfaces, used):
        facets = mesh.boundary.patch == patch
        load = f"*DFLUX\n{name}, S, {flux_w_m2}\n*NODE PRINT"
        (tmp_path / "flux.inp").write_text(plain.replace("*NODE PRINT", load))
        run_in(tmp_path, [ccx, "flux"])
        gained_j = nodal_mass @ (printed_temperatures(tmp_path / "flux.dat")[-1] - mesh.temperature_c)
        assert gained_j == pytest.approx(flux_w_m2 * seconds * areas[facets].sum(), rel=1e-3), name

        hold = f"*BOUNDARY\n{name}, 11, 11, {held_c}\n*NODE PRINT"
        (tmp_path / "held.inp").write_text(plain.replace("*NODE PRINT", hold))
        run_in(tmp_path, [ccx, "held"])
        held = np.flatnonzero(printed_temperatures(tmp_path / "held.dat")[-1] == held_c)
        assert np.array_equal(held, np.unique(mesh.facets[facets])), name
