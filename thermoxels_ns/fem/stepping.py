"""Backward Euler in time."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from thermoxels_ns.errors import HeatError, explain
from thermoxels_ns.fem.assembly import HeatMatrices, assemble
from thermoxels_ns.fem.linear_solver import ConjugateGradients, LinearSolution
from thermoxels_ns.fem.problem import HeatProblem, TimeSteps
from thermoxels_ns.fem.solution import HeatSolution
from thermoxels_ns.units import celsius_to_kelvin

INSULATED_BOUNDARY = (
    "Convection: not modelled, the boundary is insulated.",
    "Thermal radiation: not modelled, the boundary is insulated.",
    "Solar gain and internal sources: not modelled.",
)
"""What pure conduction leaves out."""

MAX_STATE_BYTES = 4 * 2**30
"""Most memory that the temperatures of all times may take, [bytes]; every time is also a file of an export."""

_ROUND_OFF = 8.0 * np.finfo(np.float64).eps


class BackwardEuler:
    """One step length, many steps: the matrix and its preconditioner are made once.

    (M / dt + K) d = -K T_n, T_n+1 = T_n + d. Solving for the change d keeps round-off relative to the change, and
    T is held relative to a reference for the same reason.
    """

    def __init__(self, matrices: HeatMatrices, step_seconds: float, *, relative_tolerance: float = 1e-12) -> None:
        """Assemble M / dt + K and set up its solver.

        Args:
            matrices: Stiffness and mass.
            step_seconds: Length of every step, [s].
            relative_tolerance: Of the linear solver.
        """
        self._matrices = matrices
        self._absolute_stiffness_w_k = abs(matrices.stiffness_w_k)
        matrix = (matrices.mass_j_k / step_seconds + matrices.stiffness_w_k).tocsr()
        self._solver = ConjugateGradients(matrix, relative_tolerance=relative_tolerance)
        self._num_pieces, self._piece = _pieces(matrices.stiffness_w_k)
        self._piece_mass = self._piece_sums(matrices.nodal_mass_j_k)

    def advance(
        self, relative_temperature_k: npt.NDArray[np.float64]
    ) -> tuple[npt.NDArray[np.float64], LinearSolution]:
        """Take one step from nodal temperatures relative to any reference, shape (n,), [K].

        Conduction moves heat within a connected piece and never out of it, because the rows of K sum to 0. The
        equations therefore fix each piece's mean change at 0 exactly, and it is set so instead of being left to
        the linear solver's tolerance. What round-off puts into the right-hand side's own sum is taken out for the
        same reason: over a long step, that is where M / dt + K is all but singular. A right-hand side that is
        nothing but the round-off of K T is 0: the body is level.
        """
        net_heat_w = -(self._matrices.stiffness_w_k @ relative_temperature_k)
        round_off_w = _ROUND_OFF * (self._absolute_stiffness_w_k @ np.abs(relative_temperature_k))
        if np.all(np.abs(net_heat_w) <= round_off_w):
            level = LinearSolution(np.zeros_like(net_heat_w), 0, 0.0, True, "The temperature is level: nothing flows.")
            return relative_temperature_k.copy(), level
        mass = self._matrices.nodal_mass_j_k
        # Weighted by mass, this shifts the solution by a constant in each piece, which the mean change takes out again.
        net_heat_w -= mass * (self._piece_sums(net_heat_w) / self._piece_mass)[self._piece]
        solution = self._solver.solve(net_heat_w)
        mean_change = self._piece_sums(mass * solution.x) / self._piece_mass
        change = solution.x - mean_change[self._piece]
        return relative_temperature_k + change, solution

    def _piece_sums(self, nodal: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        return np.bincount(self._piece, weights=nodal, minlength=self._num_pieces).astype(np.float64, copy=False)


def _pieces(stiffness: sparse.csr_matrix) -> tuple[int, npt.NDArray[np.int32]]:
    """Number the connected pieces of a body and give each node its piece."""
    count, piece = connected_components(stiffness, directed=False)
    return int(count), piece


def solve_heat(
    problem: HeatProblem,
    time: TimeSteps,
    *,
    lumped: bool = True,
    relative_tolerance: float = 1e-12,
    allow_unconverged: bool = False,
) -> HeatSolution:
    """Follow the temperatures of an insulated body through time.

    Args:
        problem: Body, material and initial temperatures.
        time: The steps.
        lumped: Lump the mass matrix, which keeps temperatures within their initial range at any step length.
        relative_tolerance: Of the linear solver in each step.
        allow_unconverged: Return what was computed, with `converged` False and the reason in `status`, instead
            of raising when a step cannot be solved.

    Returns:
        Temperatures at the start and after every step, and the heat balance.

    Raises:
        HeatError: If the temperatures of all times do not fit into memory, or a step's linear solver does not converge.
    """
    states = _room_for_states(time.steps + 1, len(problem.mesh.points_m))
    matrices = assemble(problem.mesh, problem.material, lumped=lumped)
    stepper = BackwardEuler(matrices, time.step_seconds, relative_tolerance=relative_tolerance)
    start_c = problem.start_c
    # The middle of the range, not the mean: exact for a uniform temperature.
    reference_c = 0.5 * (float(start_c.min()) + float(start_c.max()))
    states[0] = start_c - reference_c
    iterations = np.zeros(time.steps, dtype=np.int64)
    done, failure = 0, ""
    for step in range(time.steps):
        states[step + 1], linear = stepper.advance(states[step])
        iterations[step] = linear.iterations
        if not linear.converged:
            failure = f"Step {step + 1} of {time.steps} failed. {linear.status}"
            break
        done = step + 1
    if failure and not allow_unconverged:
        raise HeatError(f"{failure} Use shorter steps (--step-seconds) or check the mesh's quality.")
    states, iterations = states[: done + 1], iterations[:done]
    return _account(
        matrices.nodal_mass_j_k,
        states,
        reference_c,
        time.times_s[: done + 1],
        iterations,
        failure or f"All {time.steps} steps converged, in {int(iterations.max())} iterations at most.",
        not failure,
    )


def _room_for_states(num_times: int, num_nodes: int) -> npt.NDArray[np.float64]:
    """Array for the temperatures of all times, or an error that says how much memory they need."""
    needed = num_times * num_nodes * 8
    try:
        if needed <= MAX_STATE_BYTES:
            return np.empty((num_times, num_nodes))
        got = "more than"
    except MemoryError:
        got = "less memory free than"
    raise HeatError(
        explain(
            "steps",
            expected=f"temperatures of all times that fit into memory, at most {MAX_STATE_BYTES} bytes",
            got=f"{got} that: {num_times} times x {num_nodes} nodes x 8 bytes = {needed} bytes",
            remedy=f"Pass fewer and longer steps (--steps up to {max(MAX_STATE_BYTES // (8 * num_nodes) - 1, 1)}, "
            "--step-seconds), or a coarser mesh.",
        )
    )


def _account(
    nodal_mass_j_k: npt.NDArray[np.float64],
    states_k: npt.NDArray[np.float64],
    reference_c: float,
    times_s: npt.NDArray[np.float64],
    iterations: npt.NDArray[np.int64],
    status: str,
    converged: bool,
) -> HeatSolution:
    """Balance the heat and convert to degrees Celsius, in place because the states may be large."""
    total_mass = float(nodal_mass_j_k.sum())
    relative_content = states_k @ nodal_mass_j_k
    content = relative_content + total_mass * celsius_to_kelvin(reference_c)
    # The boundary is insulated and there are no sources: any change of the content is unaccounted for.
    unexplained = float(np.max(np.abs(relative_content - relative_content[0])))
    mean = relative_content[0] / total_mass
    spread = float(nodal_mass_j_k @ np.abs(states_k[0] - mean))
    states_k += reference_c
    return HeatSolution(
        times_s=times_s,
        temperature_c=states_k,
        heat_w=np.diff(relative_content) / np.diff(times_s),
        heat_content_j=content,
        energy_residual=_share(unexplained, float(content[0])),
        energy_residual_of_spread=_share(unexplained, spread),
        status=status,
        converged=converged,
        iterations=iterations,
        skipped_effects=INSULATED_BOUNDARY,
    )


def _share(part: float, whole: float) -> float:
    """Part of a whole; nothing of nothing is 0, something of nothing is infinite."""
    if part == 0.0:
        return 0.0
    return part / whole if whole > 0.0 else float("inf")
