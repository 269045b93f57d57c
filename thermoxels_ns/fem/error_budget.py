"""What error a user allows, and how much of it a solution makes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from thermoxels_ns.core.checks import check_positive
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.core.units import ZERO_CELSIUS_K
from thermoxels_ns.fem.solution import HeatSolution, SteadySolution

_EQUAL = 1e-9
"""Temperatures that differ by less than this share of the absolute temperature are equal."""

Flows = Mapping[str, float]
"""Mean heat flow into the body of each effect, [W]."""


@dataclass(frozen=True)
class Tolerance:
    """Errors that a user allows; what is None does not matter."""

    temperature_k: float | None = 0.05
    """Largest error of the temperature at any node of the mesh, [K]. The default is half of what building physics asks
    of a temperature (ISO 10211: 0.1 K)."""
    heat_flow: float | None = None
    """Largest error of the mean heat flow that any effect brings, as a share of all heat that flows through the body;
    0.01 is what building physics asks for (ISO 10211)."""

    def __post_init__(self) -> None:
        if self.temperature_k is None and self.heat_flow is None:
            remedy = "Give a tolerance in kelvin, or one for heat flows such as 0.01."
            raise HeatError("tolerance", expected="temperature_k or heat_flow", got="neither", remedy=remedy)
        for name, remedy in (("temperature_k", "Give it in kelvin."), ("heat_flow", "Give a share, such as 0.01.")):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, check_positive(name, value, remedy, HeatError))

    def excess(self, error: ErrorSize) -> float:
        """Error over what is allowed, whichever is worse; at most 1 is good."""
        shares = [0.0]
        if self.temperature_k is not None:
            shares.append(error.temperature_k / self.temperature_k)
        if self.heat_flow is not None:
            shares.append(error.heat_flow / self.heat_flow)
        return max(shares)

    def describe(self) -> str:
        """Say it in words."""
        parts = [] if self.temperature_k is None else [f"{self.temperature_k:g} K"]
        parts += [] if self.heat_flow is None else [f"{100.0 * self.heat_flow:g} % of the heat flow"]
        return " and ".join(parts)


@dataclass(frozen=True)
class ErrorSize:
    """Errors of a solution."""

    temperature_k: float
    """Largest error of the temperature at the nodes of the given mesh, [K]."""
    heat_flow: float
    """Largest error of the mean heat flow of an effect, as a share of all heat that flows through the body."""

    def describe(self) -> str:
        """Say it in words."""
        return f"{self.temperature_k:.2g} K and {100.0 * self.heat_flow:.2g} % of the heat flow"


def mean_flows_w(solution: SteadySolution | HeatSolution) -> dict[str, float]:
    """Give the mean heat flow into the body of each effect over all times, [W].

    Not of each patch: how much of the heat of a fixed node between two patches belongs to either is a convention.
    """
    lengths = np.diff(solution.times_s) if isinstance(solution, HeatSolution) else np.ones(1)
    return {heat.effect: float(lengths @ heat.heat_w / lengths.sum()) for heat in solution.effects}


def flow_error(difference: Flows, solution: SteadySolution | HeatSolution) -> float:
    """Largest error of a solution's mean heat flows as a share of what flows through the body.

    Where all temperatures are equal nothing flows but round-off, which has no share of it.

    Args:
        difference: What the flows err by, by effect, [W].
        solution: The solution.
    """
    level_k = float(np.abs(solution.temperature_c).max()) + ZERO_CELSIUS_K
    if float(np.ptp(solution.temperature_c)) <= _EQUAL * level_k:
        return 0.0
    return share_of_flow(difference, mean_flows_w(solution))


def share_of_flow(difference: Flows, flows: Flows) -> float:
    """Largest difference between heat flows as a share of what flows through the body, half the sum of their sizes.

    >>> share_of_flow({"a": 1.0, "b": -2.0}, {"a": 99.0, "b": -101.0})
    0.02
    """
    through = 0.5 * sum(abs(flow) for flow in flows.values())
    largest = max((abs(part) for part in difference.values()), default=0.0)
    if largest == 0.0:
        return 0.0
    return largest / through if through > 0.0 else math.inf


def difference_between(
    coarse: SteadySolution | HeatSolution, fine: SteadySolution | HeatSolution, num_nodes: int
) -> ErrorSize:
    """Compare two solutions of one problem at the same times.

    Args:
        coarse: One of them.
        fine: The other.
        num_nodes: Number of nodes of the mesh that both have in common; they come first in both.
    """
    change_k = fine.temperature_c[..., :num_nodes] - coarse.temperature_c[..., :num_nodes]
    before = mean_flows_w(coarse)
    change_w = {group: flow - before[group] for group, flow in mean_flows_w(fine).items()}
    return ErrorSize(float(np.max(np.abs(change_k))), flow_error(change_w, fine))
