from dataclasses import replace

import numpy as np
import pytest

from tests.support.heat_bodies import CONCRETE
from tests.support.heat_meshes import box_mesh
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.fem.tolerance import Tolerance, ToleratedSolution, solve_to_tolerance
from thermoxels_ns.heat.effects import Convection, Effect
from thermoxels_ns.heat.materials import Material

EMPTY = Material("next to nothing", 1.0, 1e-3, 1e-3)
HOUR_S = 3600.0


def followed(tolerance_k: float, material: Material, *effects: Effect) -> ToleratedSolution:
    mesh = box_mesh(np.linspace(0.0, 0.2, 5), [0.0, 0.1], [0.0, 0.1])
    assert mesh.boundary is not None
    tags = replace(mesh.boundary, patch_names=(*mesh.boundary.patch_names, "without triangles"))
    problem = HeatProblem(replace(mesh, boundary=tags), material, effects=effects)
    return solve_to_tolerance(problem, Tolerance(tolerance_k), duration_s=HOUR_S, log=lambda _: None)


@pytest.mark.parametrize("tolerance_k", [5.0, 0.1], ids=["given mesh", "finer mesh"])
def test_an_effect_that_acts_nowhere_brings_nothing(tolerance_k) -> None:
    air, nowhere = Convection(("x0",), 50.0, 0.0), Convection(("without triangles",), 20.0, 0.0)
    found = followed(tolerance_k, CONCRETE, air, nowhere)
    assert (found.settings.refinements > 0) is (tolerance_k < 1.0)
    assert found.met and not found.solution.effects[1].heat_w.any()
    alone = followed(tolerance_k, CONCRETE, air)
    np.testing.assert_array_equal(found.solution.temperature_c, alone.solution.temperature_c)
