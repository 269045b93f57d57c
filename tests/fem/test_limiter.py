import numpy as np
import pytest

from tests.support.obtuse_bodies import AT_THE_BOUNDS, CONCRETE, body
from thermoxels_ns.fem.limiter import PositiveOffDiagonals, holds_maximum_principle
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.fem.system import HeatSystem


def obtuse() -> HeatSystem:
    return HeatSystem(HeatProblem(body(AT_THE_BOUNDS), CONCRETE))


def test_without_all_of_them_the_maximum_principle_holds() -> None:
    system = obtuse()
    left_out = PositiveOffDiagonals(system)
    assert not holds_maximum_principle(system.stiffness) and left_out.count == 0
    limited = left_out.leave_out(np.ones(system.num_nodes, dtype=bool))
    assert limited is not None and holds_maximum_principle(limited.stiffness)
    assert left_out.count > 100 and left_out.leave_out(np.ones(system.num_nodes, dtype=bool)) is None


@pytest.mark.parametrize("share", [0.02, 0.2, 1.0])
def test_heat_is_conserved_and_flows_both_ways_alike(share) -> None:
    """The matrix stays symmetric, rows sum to 0, and it only gains: no piece comes apart."""
    system = obtuse()
    outside = np.random.default_rng(0).random(system.num_nodes) < share
    limited = PositiveOffDiagonals(system).leave_out(outside)
    assert limited is not None
    matrix = limited.stiffness.toarray()
    size = np.abs(matrix).max()
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-14 * size)
    np.testing.assert_allclose(matrix.sum(axis=1), 0.0, atol=1e-13 * size)
    assert np.linalg.eigvalsh(matrix - system.stiffness.toarray()).min() > -1e-12 * size
