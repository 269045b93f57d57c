"""Nodes whose temperature is given, and the heat that keeps it so."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy import sparse

from thermoxels_ns.core.errors import HeatError, explain
from thermoxels_ns.fem.forms import FixedForm

Vector = npt.NDArray[np.float64]

_SAME_TEMPERATURE_K = 1e-9
"""Two effects may fix the same node if their temperatures differ by no more than this, [K]."""
_KEPT_TIMES = 4
"""Times whose temperatures are kept, because what begins a step has ended the one before."""


class FixedNodes:
    """All nodes that any effect fixes."""

    def __init__(self, forms: Sequence[FixedForm], num_nodes: int) -> None:
        """Merge the nodes of the forms.

        Args:
            forms: One per effect that fixes temperatures.
            num_nodes: Number of nodes of the body.
        """
        self._forms = tuple(forms)
        self.nodes: npt.NDArray[np.int64] = np.unique(
            np.concatenate([np.zeros(0, np.int64), *(f.nodes for f in forms)])
        )
        """Their numbers, ascending, shape (d,)."""
        self.groups: tuple[tuple[str, str], ...] = tuple(
            (form.effect, patch) for form in forms for patch in form.groups
        )
        """Effect and patch of each row of `shares`."""
        self._num_nodes = num_nodes
        self._kept: dict[float, Vector] = {}

    @cached_property
    def shares(self) -> sparse.csr_matrix:
        """Share of each node's heat that belongs to each group, by the area around the node, shape (g, d)."""
        rows, columns, areas, before = [], [], [], 0
        for form in self._forms:
            width = form.owners.shape[1]
            rows.append(np.repeat(before + form.group, width))
            columns.append(np.searchsorted(self.nodes, form.owners.ravel()))
            areas.append(np.repeat(form.area_m2, width))
            before += len(form.groups)
        if not rows:
            return sparse.csr_matrix((0, 0))
        column, area = np.concatenate(columns), np.concatenate(areas)
        share = area / np.bincount(column, area, len(self.nodes))[column]
        return sparse.csr_matrix((share, (np.concatenate(rows), column)), (before, len(self.nodes)))

    @cached_property
    def free(self) -> npt.NDArray[np.int64]:
        """Nodes that are not fixed, ascending."""
        free = np.ones(self._num_nodes, dtype=bool)
        free[self.nodes] = False
        return np.flatnonzero(free)

    def temperature_k(self, time_s: float) -> Vector:
        """Temperatures of `nodes`, relative to the reference, shape (d,), [K].

        Raises:
            HeatError: Two effects fix different temperatures at one node.
        """
        known = self._kept.get(time_s)
        if known is None:
            known = np.full(len(self.nodes), np.nan)
            for number, form in enumerate(self._forms):
                place, wanted = self._places[number], form.temperature_k(time_s)
                clash = np.abs(known[place] - wanted) > _SAME_TEMPERATURE_K
                if clash.any():
                    raise HeatError(self._explain_clash(number, form.nodes[clash], wanted[clash], time_s))
                known[place] = wanted
            known.setflags(write=False)
            while len(self._kept) >= _KEPT_TIMES:
                del self._kept[next(iter(self._kept))]
            self._kept[time_s] = known
        return known

    @cached_property
    def _places(self) -> list[npt.NDArray[np.int64]]:
        """Where the nodes of each form stand in `nodes`."""
        return [np.searchsorted(self.nodes, form.nodes) for form in self._forms]

    def _explain_clash(self, number: int, nodes: npt.NDArray[np.int64], wanted: Vector, time_s: float) -> str:
        form = self._forms[number]
        others = [other for other in self._forms if other is not form and np.isin(other.nodes, nodes).any()]
        other = others[0]
        place = np.flatnonzero(np.isin(other.nodes, nodes))
        node = int(other.nodes[place[0]])
        first = other.temperature_k(time_s)[place[0]] + other.reference_c
        second = wanted[np.flatnonzero(nodes == node)[0]] + form.reference_c
        return explain(
            "fixed temperature",
            expected="one temperature at each node",
            got=f"{first:g} C from {other.effect} and {second:g} C from {form.effect} at node {node} "
            f"and {len(nodes) - 1} more",
            remedy="Let one effect fix all patches that meet, with a Varying that says what holds where they do.",
        )
