"""How much memory a solution needs, said and refused before it is taken."""

from __future__ import annotations

from thermoxels_ns.errors import HeatError, explain

DEFAULT_MEMORY_BYTES = 4 * 2**30
"""Most memory that a solution may need, [bytes]."""

_BYTES_PER_TET = {1: 250, 2: 3000}
"""Memory of a solution by order, measured on lattices and doubled, because meshes without right angles have twice as
many entries in their matrices."""
_CHILDREN = 8
"""Tetrahedra, and about as many times more nodes, that halving all edges makes of one."""


def needed_bytes(num_tets: int, num_nodes: int, *, order: int = 1, refinements: int = 0, times: int = 1) -> float:
    """Estimate the most memory that a solution takes, [bytes].

    Args:
        num_tets: Tetrahedra of the given mesh.
        num_nodes: Its nodes.
        order: 1 for linear tetrahedra, 2 for quadratic ones.
        refinements: How often the size of the given mesh is halved first.
        times: Number of times whose temperatures are kept.

    >>> needed_bytes(1000, 200, times=10)
    266000.0
    """
    finer = float(_CHILDREN**refinements)
    return _BYTES_PER_TET[order] * num_tets * finer + 8.0 * times * num_nodes * finer


def describe_bytes(amount: float) -> str:
    """Say it in a unit that suits it.

    >>> describe_bytes(3 * 2**30), describe_bytes(266000.0)
    ('3 GiB', '0.25 MiB')
    """
    return f"{amount / 2**30:.2g} GiB" if amount >= 2**30 else f"{amount / 2**20:.{3 if amount >= 1e8 else 2}g} MiB"


def check_memory(needed: float, allowed: float, remedy: str) -> None:
    """Refuse what does not fit.

    Args:
        needed: What it takes, [bytes].
        allowed: What it may take, [bytes].
        remedy: What to do about it.

    Raises:
        HeatError: It is too much.
    """
    if needed > allowed:
        expected, got = f"at most {describe_bytes(allowed)}", f"about {describe_bytes(needed)}"
        raise HeatError(explain("memory of the heat problem", expected=expected, got=got, remedy=remedy))
