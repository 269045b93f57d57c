import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from tests.support.heat_bodies import CONCRETE
from tests.support.heat_meshes import box_mesh
from tests.support.stuffed_shapes import SHAPES, tet_mesh
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem import memory
from thermoxels_ns.fem.memory import check_memory, peak_bytes
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem, TimeSteps
from thermoxels_ns.fem.selection import Selection
from thermoxels_ns.fem.space import Space
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.time_loop import solve_heat
from thermoxels_ns.heat.effects import Convection, Radiation
from thermoxels_ns.mesh.stuffing.isosurface import stuff

MIXED = (Convection(("*",), 8.0, 10.0), Radiation(("*",), 0.9, 0.0))


@pytest.fixture(scope="module", params=["lattice", "stuffed"])
def mesh(request):
    if request.param == "lattice":
        mesh = box_mesh(*[np.linspace(0.0, 1.0, 15)] * 3)
    else:
        mesh = tet_mesh(stuff(SHAPES["sphere"].level(20)), 0.05)
    return replace(mesh, temperature_c=20.0 + 5.0 * np.sin(9.0 * mesh.points_m[:, 0]))


def peak(run) -> int:
    """Most memory that numpy had while something ran the second time, when kernels and modules are loaded."""
    run()
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        run()
        return tracemalloc.get_traced_memory()[1] - before
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("effects", "solve", "said"),
    [
        ((), lambda p: solve_heat(p, TimeSteps(1, 5.0)), {"times": 2}),
        ((), lambda p: solve_heat(p, TimeSteps(59, 5.0)), {"times": 60}),
        (MIXED, lambda p: solve_heat(p, TimeSteps(1, 5.0)), {"times": 2}),
        (MIXED, lambda p: solve_heat(p, TimeSteps(59, 5.0)), {"times": 60}),
        (MIXED[:1], lambda p: solve_heat(p, AdaptiveSteps(600.0, 0.5, outputs=9)), dict(times=10, adaptive=True)),
        (MIXED[:1], lambda p: solve_steady(p, order=1), {"order": 1}),
        (MIXED[:1], lambda p: solve_steady(p, order=2), {"order": 2}),
    ],
)
def test_it_takes_what_was_said(mesh, concrete, effects, solve, said) -> None:
    """Or half of it where angles are right, as on a lattice: nothing couples along their edges then."""
    problem = HeatProblem(mesh, concrete, effects=effects)
    assert 1 / 1.5 < peak_bytes(problem, **said) / peak(lambda: solve(problem)) < 2.0


def test_what_does_not_fit_is_refused() -> None:
    check_memory(10.0, 10.0, "")
    with pytest.raises(
        HeatError, match=r"memory of the heat problem: expected at most 1 GiB, got about 2 GiB\. Wait\."
    ):
        check_memory(2.0**31, 2.0**30, "Wait.")


def test_edges_are_counted_from_nodes_tetrahedra_and_facets(monkeypatch) -> None:
    """The unknowns of quadratic tetrahedra, in a body of one piece without holes."""
    monkeypatch.setattr(memory, "_BYTES_PER_TET_OF_ORDER_2", 0.0)
    monkeypatch.setattr(memory, "_BYTES_PER_UNKNOWN_OF_ORDER_2", 1.0)
    box = box_mesh(*[np.linspace(0.0, 1.0, 5)] * 3)
    unknowns = Space(Selection(box), order=2, lumped=False).num_nodes
    assert peak_bytes(HeatProblem(box, CONCRETE), order=2) - 8.0 * len(box.points_m) == unknowns + 1
