"""Memory that a heat computation takes at its peak."""

from __future__ import annotations

from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.problem import HeatProblem

DEFAULT_MEMORY_BYTES = 4 * 2**30  # Most memory that a solution may need, [bytes]

_VECTORS = 15  # Vectors of the nodes that are alive at the peak, besides the temperatures that are kept
_FRAGMENTS = 1.15  # What the allocator and what lives shortly add, by measurement
_BYTES_PER_FACET = 400.0  # What an effect needs per boundary triangle
_BYTES_PER_TET_OF_ORDER_2, _BYTES_PER_UNKNOWN_OF_ORDER_2 = 850.0, 680.0
"""Element matrices that are being added up; matrices and vectors."""


def peak_bytes(
    problem: HeatProblem, *, order: int = 1, refinements: int = 0, times: int = 1, adaptive: bool = False
) -> float:
    """Estimate the most memory that a computation takes besides the problem itself, [bytes].

    The arrays that are alive together are counted, with a coupling along every edge: lattices, which have none along
    edges between right angles, take about half. Interpreter and libraries, which need about 150 MB, come on top, and so
    does multigrid, which takes over where conjugate gradients are slow and needs about as much as the matrices.

    Every refinement makes eight tetrahedra of each; `times` are those whose temperatures are kept, 1 for a steady
    state; of `adaptive` time steps, matrices of two lengths are kept.
    """
    if order not in (1, 2):
        raise HeatError("order", expected="1 or 2", got=repr(order), remedy="Use 1 or 2.")
    if times < 1:
        raise HeatError("times", expected="at least 1", got=repr(times), remedy="Count the start as one.")
    mesh, finer = problem.mesh, 8.0**refinements
    nodes = float(len(mesh.points_m))
    # Euler's formula, nodes - edges + faces - tetrahedra = 1; each tetrahedron has four halves of a face.
    edges = nodes + len(mesh.tets) + len(mesh.facets) // 2
    states = 8.0 * times * nodes
    if order == 2:
        matrices = _BYTES_PER_TET_OF_ORDER_2 * len(mesh.tets) + _BYTES_PER_UNKNOWN_OF_ORDER_2 * (nodes + edges)
        return finer * (matrices + states)
    matrix, half = 24.0 * edges + 16.0 * nodes, 16.0 * edges
    radiates = any(effect.kind == "radiation" for effect in problem.effects)
    # K, the matrix of a step and its scaled entries; what radiation adds; a second length and estimates again.
    matrices = 2.0 * matrix + half + radiates * 1.3 * matrix + 2.0 * adaptive * (matrix + half)
    surfaces = _BYTES_PER_FACET * len(mesh.facets) * sum(hasattr(effect, "patches") for effect in problem.effects)
    return finer * (_FRAGMENTS * (matrices + 8.0 * _VECTORS * nodes) + states) + 4.0**refinements * surfaces


def describe_bytes(amount: float) -> str:
    """Say it in a unit that suits it.

    >>> describe_bytes(3 * 2**30), describe_bytes(266000.0)
    ('3 GiB', '0.25 MiB')
    """
    return f"{amount / 2**30:.2g} GiB" if amount >= 2**30 else f"{amount / 2**20:.{3 if amount >= 1e8 else 2}g} MiB"


def check_memory(needed: float, allowed: float, remedy: str) -> None:
    """Raise `HeatError` for what needs more bytes than are allowed."""
    if needed > allowed:
        expected, got = f"at most {describe_bytes(allowed)}", f"about {describe_bytes(needed)}"
        raise HeatError("memory of the heat problem", expected=expected, got=got, remedy=remedy)
