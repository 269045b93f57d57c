"""Thermal coupling, U-value and surface temperature factor of a wall between two airs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

import numpy as np
import numpy.typing as npt

from thermoxels_ns.fem.problem import HeatProblem, effect_labels
from thermoxels_ns.fem.selection import Selection
from thermoxels_ns.fem.solution import Solution, SolutionNodes, SteadySolution, solution_nodes
from thermoxels_ns.fem.surface_heat import heat_by_part, heat_through_parts
from thermoxels_ns.heat.effects import Convection
from thermoxels_ns.heat.results import Spot, describe_spot, end_state_c, region_behind_facets
from thermoxels_ns.heat.scene import HeatScene

_LEAST_DIFFERENCE_K = 1e-6


@dataclass(frozen=True)
class WallPart:
    """A part of the inner surface."""

    name: str
    """Name of the patch or region."""
    area_m2: float
    """Its true area, [m2]."""
    heat_w: float
    """Heat flow into it from the inside, [W]."""
    u_value_w_m2k: float
    """Heat flow per area and difference of the airs, [W / (m2 K)]."""


@dataclass(frozen=True)
class WallResult:
    """A body as a wall between an inside and an outside."""

    inside_c: float
    """Temperature of the air inside, [degrees Celsius]."""
    outside_c: float
    """Temperature of the air outside, [degrees Celsius]."""
    area_m2: float
    """True area of the inner surface, [m2]."""
    heat_w: float
    """Heat flow into the inner surface, [W]."""
    coupling_w_k: float
    """Thermal coupling coefficient, heat flow per difference of the airs (ISO 10211: L_3D), [W / K]."""
    u_value_w_m2k: float
    """The same per area of the inner surface, [W / (m2 K)]. For a plane wall this is its U-value (ISO 6946); at corners
    and thermal bridges it is a mean that depends on which surface is measured."""
    temperature_factor: float
    """f_Rsi = (T_si,min - T_e) / (T_i - T_e) at the coldest spot of the inner surface: 1 is as warm as the air inside.
    It depends on the resistance of the inner surface; for the risk of mould ISO 13788 asks for 0.25 m2 K/W, a
    coefficient of 4 W/(m2 K), where ISO 6946 takes 0.10 to 0.17 for the loss of heat."""
    coldest: Spot
    """The coldest spot of the inner surface."""
    patches: tuple[WallPart, ...]
    """The inner surface by patch."""
    regions: tuple[WallPart, ...]
    """The inner surface by region of the body behind it."""


def wall_of_scene(
    scene: HeatScene, problem: HeatProblem, solution: Solution, nodes: SolutionNodes, *, doubtful: bool
) -> WallResult | str:
    """See a body as a wall, if its steady state between two airs of different temperature is asked for.

    Args:
        scene: The scene.
        problem: What was solved.
        solution: Its outcome.
        nodes: What `solution_nodes` gives.
        doubtful: Whether the surfaces that the scene's airs act on are probably not those that were meant.

    Returns:
        The wall; or why there is none although there are two airs, a sentence; "" without two airs.
    """
    inside, outside = scene.inside_air, scene.outside_air
    if not isinstance(solution, SteadySolution) or inside is None or outside is None:
        return ""
    if abs(inside.air_c - outside.air_c) < _LEAST_DIFFERENCE_K:
        return ""
    if doubtful:
        return "There is no U-value, because it is doubtful which surface faces the air inside."
    for label, effect in zip(effect_labels(problem), problem.effects):
        if not (isinstance(effect, Convection) and effect.air_c in (inside.air_c, outside.air_c)):
            return f"There is no U-value, because its heat would count in it: {label}. Ask for the two airs alone."
    if not _faces_inside(problem, inside.patches).any():
        return "There is no U-value, because no surface of the body faces the air inside."
    return wall_result(problem, solution, inside.patches, inside.air_c, outside.air_c, nodes)


def wall_result(
    problem: HeatProblem,
    solution: SteadySolution,
    inside: Sequence[str],
    inside_c: float,
    outside_c: float,
    nodes: SolutionNodes | None = None,
) -> WallResult:
    """Work out what a body between two airs lets through.

    What it says is that of a wall only if nothing but the two airs acts: sunlight or a cold sky count as heat through
    it.

    Args:
        problem: What was solved.
        solution: Its steady state.
        inside: Names or patterns of the patches that face the inside, some of which have area.
        inside_c: Temperature of the air inside, [degrees Celsius].
        outside_c: Temperature of the air outside, [degrees Celsius], another one.
        nodes: What `solution_nodes` gives, if it is there already.
    """
    difference_k = inside_c - outside_c
    selection, mesh = Selection(problem.mesh, problem.up), problem.mesh
    every_c = end_state_c(solution)
    inner = _faces_inside(problem, inside)

    def parts(numbers: npt.NDArray[np.int64], names: tuple[str, ...]) -> tuple[WallPart, ...]:
        number = np.where(inner, numbers, len(names))
        listed = (*names, "\0rest")
        flows = heat_by_part(problem, every_c, 0.0, number, listed)
        heat = heat_through_parts(flows, listed)[0]
        area = np.bincount(number, selection.facet_area_m2, len(listed))
        return tuple(
            WallPart(names[n], float(area[n]), float(heat[n]), float(heat[n] / area[n] / difference_k))
            for n in np.unique(number[inner]).tolist()
        )

    patches = parts(selection.facet_patch, selection.patch_names)
    area, heat = sum(part.area_m2 for part in patches), sum(part.heat_w for part in patches)
    shown = solution_nodes(problem, solution) if nodes is None else nodes
    inner_nodes = np.unique(shown.mesh.facets[shown.of_facets(inner)])
    # The worst spot: the coldest if it is colder outside, else the hottest.
    worst = int(inner_nodes[np.argmin(np.sign(difference_k) * every_c[inner_nodes])])
    spot = describe_spot(Selection(shown.mesh, problem.up), worst, float(every_c[worst]), 0.0)
    return WallResult(
        inside_c=inside_c,
        outside_c=outside_c,
        area_m2=area,
        heat_w=heat,
        coupling_w_k=heat / difference_k,
        u_value_w_m2k=heat / area / difference_k,
        temperature_factor=(spot.temperature_c - outside_c) / difference_k,
        coldest=spot,
        patches=patches,
        regions=parts(region_behind_facets(mesh), mesh.region_names),
    )


def _faces_inside(problem: HeatProblem, inside: Sequence[str]) -> npt.NDArray[np.bool_]:
    """Mark the boundary triangles of patches whose names match one of some names or patterns, shape (f,)."""
    selection = Selection(problem.mesh, problem.up)
    matching = [any(fnmatchcase(name, pattern) for pattern in inside) for name in selection.patch_names]
    return np.array(matching, dtype=bool)[selection.facet_patch]
