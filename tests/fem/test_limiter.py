from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

from tests.support.heat_meshes import box_mesh
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


def test_only_those_of_the_given_nodes_are_left_out() -> None:
    system = obtuse()
    outside = np.zeros(system.num_nodes, dtype=bool)
    outside[7] = True
    limited = PositiveOffDiagonals(system).leave_out(outside)
    assert limited is not None
    changed = np.abs((limited.stiffness - system.stiffness).toarray()) > 1e-12
    row = changed[7].copy()
    row[7] = False
    assert row.any() and not changed[np.ix_(~row & ~outside, ~row & ~outside)].any()
    assert limited.stiffness[7].toarray().ravel()[row].max() <= 1e-12


def test_all_go_after_some_attempts() -> None:
    system = obtuse()
    left_out, attempts = PositiveOffDiagonals(system), 0
    for node in range(system.num_nodes):
        outside = np.arange(system.num_nodes) == node
        limited = left_out.leave_out(outside)
        attempts += limited is not None
        if limited is not None and holds_maximum_principle(limited.stiffness):
            break
    assert attempts == 9


@pytest.mark.parametrize(("share", "wrong"), [(1e-15, 0), (1e-12, 1)])
def test_what_rounding_leaves_of_nothing_is_no_coupling(share, wrong) -> None:
    axis = np.linspace(0.0, 0.4, 3)
    system = HeatSystem(HeatProblem(box_mesh(axis, axis, axis), CONCRETE))
    last, size = system.num_nodes - 1, share * float(system.stiffness.diagonal().min())
    entries = sparse.csr_matrix(([size, size], ([0, last], [last, 0])), shape=system.stiffness.shape)
    left_out = PositiveOffDiagonals(system.with_stiffness(sparse.csr_matrix(system.stiffness + entries)))
    left_out.leave_out(np.ones(system.num_nodes, dtype=bool))
    assert left_out.count == wrong
