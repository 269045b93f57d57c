"""Results of a solution: heat by patch, effect, region and wall, hottest and coldest spots, energy balance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from thermoxels_ns.core.arrays import BoolArray, FloatArray, IntArray
from thermoxels_ns.fem.problem import HeatProblem, effect_labels
from thermoxels_ns.fem.selection import Selection, matching_names
from thermoxels_ns.fem.solution import Solution, SolutionNodes, SteadySolution, solution_nodes
from thermoxels_ns.heat.effects import Convection, InternalHeat
from thermoxels_ns.heat.scene import HeatScene
from thermoxels_ns.mesh.quality.checks import facet_owners
from thermoxels_ns.mesh.quality.tet_shapes import signed_volumes
from thermoxels_ns.mesh.tetrahedra import TetMesh


@dataclass(frozen=True)
class Spot:
    """A node of the mesh with its temperature at one time."""

    temperature_c: float  # Temperature of the node, [degrees Celsius]
    point_m: tuple[float, float, float]  # Position of the node, [m]
    time_s: float  # Time of the temperature, [s]; 0 in a steady state
    node: int  # Number of the node in the mesh, from 0
    patches: tuple[str, ...]  # Names of the patches that the node lies on; empty inside the body


@dataclass(frozen=True)
class PatchResult:
    """The results on one patch of the surface."""

    patch: str  # Name of the patch
    area_m2: float  # Area, [m2]
    heat_w: float  # Mean heat flow into the body over all times, [W]
    heat_w_m2: float  # `heat_w` per area, [W / m2]
    last_heat_w: float  # Mean heat flow into the body during the last interval, [W]
    mean_c: float  # Mean temperature of the surface at the end, [degrees Celsius]
    coldest: Spot  # Coldest node at the end
    hottest: Spot  # Hottest node at the end


@dataclass(frozen=True)
class EffectResult:
    """The heat that one effect brings into the body."""

    effect: str  # Label of the effect
    heat_w: float  # Mean heat flow into the body over all times, [W]
    area_m2: float | None  # Area that the effect acts on, [m2]; None for a source inside
    heat_w_m2: float | None  # `heat_w` per area, [W / m2]; None without area
    last_heat_w: float  # Mean heat flow into the body during the last interval, [W]
    groups: dict[str, float]  # Mean heat flow into the body over all times by patch, or for a source by region, [W]


@dataclass(frozen=True)
class RegionResult:
    """The results in one region of the volume; heat flow and temperatures are values at the end."""

    region: str  # Name of the region
    material: str  # Name of its material
    volume_m3: float  # Volume, [m3]
    area_m2: float  # Area of the boundary triangles of the region, [m2], without its contact with other regions
    heat_w: float  # Heat flow into the body through these triangles, [W]; negative if heat is lost
    heat_w_m2: float  # `heat_w` per area, [W / m2]; 0 without area
    mean_c: float  # Mean temperature over the volume, [degrees Celsius]
    min_c: float  # Lowest temperature of a node, [degrees Celsius]
    max_c: float  # Highest temperature of a node, [degrees Celsius]


@dataclass(frozen=True)
class EnergyBalance:
    """The energy balance of a body, in `unit`: stored = into_body - out_of_body + residual."""

    unit: str  # J through time, W in a steady state
    into_body: float  # Heat that flows in, summed over intervals and over the patches or regions of all effects
    out_of_body: float  # Heat that flows out, summed in the same way, at least 0
    stored: float  # Change of the body's heat content; 0 in a steady state
    residual: float  # stored - into_body + out_of_body: stored heat without a heat flow as its cause
    relative_residual: float  # The field `energy_residual` of `HeatSolution` or `SteadySolution`, a ratio
    unbalanced_w: float
    """Unbalanced heat of all nodes (in the worst step), plus round-off, [W]; it bounds the error of each heat flow."""


@dataclass(frozen=True)
class HeatResults:
    """The results of a solution for users; heat flows are positive into the body."""

    status: str  # Sentences on how the solver converged
    times_s: tuple[float, ...]  # Times of the kept temperatures, [s]; 0 alone for a steady state
    patches: tuple[PatchResult, ...]
    effects: tuple[EffectResult, ...]
    regions: tuple[RegionResult, ...]
    balance: EnergyBalance
    overshoot_k: float  # The field `overshoot_k` of the solution, [K]
    coldest: Spot  # Coldest of all nodes and times
    hottest: Spot  # Hottest of all nodes and times


def heat_results(problem: HeatProblem, solution: Solution, nodes: SolutionNodes | None = None) -> HeatResults:
    """Return the results of a solution of `problem`; `nodes` is the result of `solution_nodes`, computed if None."""
    nodes = solution_nodes(problem, solution) if nodes is None else nodes
    times, states, selection = nodes.times_s, nodes.states_c, Selection(nodes.mesh, problem.up)
    lengths = np.diff(times) if len(times) > 1 else np.ones(1)
    return HeatResults(
        status=solution.status,
        times_s=tuple(times.tolist()),
        patches=_patches(problem, solution, selection, nodes, lengths),
        effects=_effects(problem, solution, selection, lengths),
        regions=_regions(problem, solution, selection, nodes),
        balance=_balance(solution, lengths),
        overshoot_k=solution.overshoot_k,
        coldest=_spot(selection, nodes, *divmod(int(states.argmin()), states.shape[1])),
        hottest=_spot(selection, nodes, *divmod(int(states.argmax()), states.shape[1])),
    )


def region_behind_facets(mesh: TetMesh) -> IntArray:
    """Return the region behind each boundary triangle, as an index into `mesh.region_names`, shape (f,)."""
    return mesh.region[facet_owners(mesh.tets, mesh.facets)[0]]


def _spot(selection: Selection, nodes: SolutionNodes, time: int, node: int) -> Spot:
    """Return the spot of the node number `node` at index `time` of `SolutionNodes.times_s`; -1 is the end."""
    touching = np.any(selection.mesh.facets == node, axis=1)
    patches = tuple(selection.patch_names[number] for number in np.unique(selection.facet_patch[touching]))
    x, y, z = selection.mesh.points_m[node].tolist()
    return Spot(float(nodes.states_c[time, node]), (x, y, z), float(nodes.times_s[time]), node, patches)


def _patches(
    problem: HeatProblem, solution: Solution, selection: Selection, nodes: SolutionNodes, lengths: FloatArray
) -> tuple[PatchResult, ...]:
    mesh, area, names, last_c = selection.mesh, selection.facet_area_m2, selection.patch_names, nodes.states_c[-1]
    heat = {name: np.zeros(len(lengths)) for name in names}
    for effect, part in zip(problem.effects, solution.effects):
        if not isinstance(effect, InternalHeat):
            for name, heat_w in zip(part.group_names, part.group_heat_w.T):
                heat[name] = heat[name] + heat_w
    facet_c = last_c[mesh.facets].mean(axis=1)
    results = []
    for number in np.unique(selection.facet_patch):
        chosen = selection.facet_patch == number
        on_patch, total = np.unique(mesh.facets[chosen]), float(area[chosen].sum())
        coldest, hottest = (int(on_patch[which(last_c[on_patch])]) for which in (np.argmin, np.argmax))
        heat_w = heat[names[number]]
        mean = float(np.average(heat_w, weights=lengths))
        results.append(
            PatchResult(
                patch=names[number],
                area_m2=total,
                heat_w=mean,
                heat_w_m2=mean / total,
                last_heat_w=float(heat_w[-1]),
                mean_c=float(facet_c[chosen] @ area[chosen]) / total,
                coldest=_spot(selection, nodes, -1, coldest),
                hottest=_spot(selection, nodes, -1, hottest),
            )
        )
    return tuple(results)


def _effects(
    problem: HeatProblem, solution: Solution, selection: Selection, lengths: FloatArray
) -> tuple[EffectResult, ...]:
    area, results = selection.patch_area_m2, []
    for effect, heat in zip(problem.effects, solution.effects):
        mean = float(heat.heat_w @ lengths / lengths.sum())
        groups = (heat.group_heat_w.T @ lengths / lengths.sum()).tolist()
        total = None if isinstance(effect, InternalHeat) else sum(area[name] for name in heat.group_names)
        results.append(
            EffectResult(
                effect=heat.effect,
                heat_w=mean,
                area_m2=total,
                heat_w_m2=mean / total if total else None,
                last_heat_w=float(heat.heat_w[-1]),
                groups=dict(zip(heat.group_names, groups)),
            )
        )
    return tuple(results)


def _regions(
    problem: HeatProblem, solution: Solution, selection: Selection, nodes: SolutionNodes
) -> tuple[RegionResult, ...]:
    mesh, names, last_c = selection.mesh, selection.mesh.region_names, nodes.states_c[-1]
    behind, made_of = region_behind_facets(problem.mesh), problem.materials
    heat = np.bincount(behind, solution.facet_heat_w, len(names))
    area = np.bincount(nodes.of_facets(behind), selection.facet_area_m2, len(names))
    volume = signed_volumes(mesh.points_m, mesh.tets)
    total = np.bincount(mesh.region, volume, len(names))
    content = np.bincount(mesh.region, volume * last_c[mesh.tets].mean(axis=1), len(names))
    results = []
    for number in np.unique(mesh.region):
        inside = last_c[mesh.tets[mesh.region == number]]
        results.append(
            RegionResult(
                region=names[number],
                material=made_of[names[number]].name,
                volume_m3=float(total[number]),
                area_m2=float(area[number]),
                heat_w=float(heat[number]),
                heat_w_m2=float(heat[number] / area[number]) if area[number] > 0.0 else 0.0,
                mean_c=float(content[number] / total[number]),
                min_c=float(inside.min()),
                max_c=float(inside.max()),
            )
        )
    return tuple(results)


def _balance(solution: Solution, lengths: FloatArray) -> EnergyBalance:
    steady = isinstance(solution, SteadySolution)
    # Flows are summed by patch: heat in through one patch and out through another must not cancel.
    flows = np.concatenate([np.zeros((len(lengths), 0)), *(heat.group_heat_w for heat in solution.effects)], axis=1)
    energies = flows * lengths[:, None]
    into, out = float(energies[energies > 0.0].sum()), -float(energies[energies < 0.0].sum())
    stored = 0.0 if steady else float(solution.heat_content_j[-1] - solution.heat_content_j[0])
    return EnergyBalance(
        unit="W" if steady else "J",
        into_body=into,
        out_of_body=out,
        stored=stored,
        residual=stored - into + out,
        relative_residual=solution.energy_residual,
        unbalanced_w=solution.unbalanced_w,
    )


_LEAST_DIFFERENCE_K = 1e-6  # Least difference between the temperatures of two airs for a U-value, [K]


@dataclass(frozen=True)
class WallPart:
    """A part of a wall's inner surface: one patch, or the triangles of one region."""

    name: str  # Name of the patch or region
    area_m2: float  # Area of the part, [m2]
    heat_w: float  # Heat flow into the part from the inside, [W]
    u_value_w_m2k: float  # Heat flow divided by the area and by the temperature difference of the airs, [W / (m2 K)]


@dataclass(frozen=True)
class WallResult:
    """Figures of a body that separates the air inside from the air outside, as a wall does, in a steady state."""

    inside_c: float  # Temperature of the air inside, [degrees Celsius]
    outside_c: float  # Temperature of the air outside, [degrees Celsius]
    area_m2: float  # Area of the inner surface, [m2]
    heat_w: float  # Heat flow into the inner surface, [W]
    coupling_w_k: float  # Thermal coupling coefficient L_3D, heat flow per kelvin between the airs (ISO 10211), [W / K]
    u_value_w_m2k: float
    """`coupling_w_k` per area of the inner surface, [W / (m2 K)]. For a plane wall this is the U-value (ISO 6946). With
    corners and thermal bridges the value is a mean, which depends on the surface that is measured."""
    temperature_factor: float
    """f_Rsi = (T_si,min - T_e) / (T_i - T_e) at `coldest`; it is 1 at the temperature of the air inside. The factor
    depends on the resistance of the inner surface. For the risk of mould ISO 13788 asks for 0.25 m2 K/W, a coefficient
    of 4 W/(m2 K); ISO 6946 uses 0.10 to 0.17 m2 K/W for the loss of heat."""
    coldest: Spot  # Coldest node of the inner surface; the hottest if it is warmer outside
    patches: tuple[WallPart, ...]  # Parts of the inner surface by patch
    regions: tuple[WallPart, ...]  # Parts of the inner surface by region


def wall_of_scene(
    scene: HeatScene, problem: HeatProblem, solution: Solution, nodes: SolutionNodes, *, doubtful: bool
) -> WallResult | str:
    """Return the `wall_result` of a body in a steady state between two airs, or a sentence on why there is no result.

    The sentence is empty through time, without two airs, or if both airs have the same temperature. There is no result
    if `doubtful` is True: the airs then probably act on surfaces that the user did not mean.
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
    if not matching_facets(problem.selection, inside.patches).any():
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
    """Return the heat flow, U-value and coldest spot of a body between airs of two different temperatures.

    The figures describe a wall only if the two airs are the only effects, because heat from sunlight or to a cold sky
    would be counted as heat through the wall. `inside` are names or patterns of the patches that face the air inside;
    their area must be above 0. `nodes` is `solution_nodes(problem, solution)`, computed if None.
    """
    difference_k = inside_c - outside_c
    selection, mesh = problem.selection, problem.mesh
    inner = matching_facets(selection, inside)

    def parts(numbers: IntArray, names: tuple[str, ...]) -> tuple[WallPart, ...]:
        number, count = np.where(inner, numbers, len(names)), len(names) + 1
        heat, area = (np.bincount(number, one, count) for one in (solution.facet_heat_w, selection.facet_area_m2))
        return tuple(
            WallPart(names[n], float(area[n]), float(heat[n]), float(heat[n] / area[n] / difference_k))
            for n in np.unique(number[inner]).tolist()
        )

    patches = parts(selection.facet_patch, selection.patch_names)
    area, heat = sum(part.area_m2 for part in patches), sum(part.heat_w for part in patches)
    shown = solution_nodes(problem, solution) if nodes is None else nodes
    every_c, inner_nodes = shown.states_c[-1], np.unique(shown.mesh.facets[shown.of_facets(inner)])
    # At the rim of a hole both airs touch the same node, which does not count as a spot of the inner surface.
    outer = np.zeros(len(mesh.facets), dtype=bool)
    for effect in problem.effects:
        if isinstance(effect, Convection) and effect.air_c != inside_c:
            outer[selection.facets(effect.patches)] = True
    away = np.setdiff1d(inner_nodes, shown.mesh.facets[shown.of_facets(outer & ~inner)])
    inner_nodes = away if len(away) else inner_nodes
    # The worst spot is the coldest node if it is colder outside, else the hottest node.
    worst = int(inner_nodes[np.argmin(np.sign(difference_k) * every_c[inner_nodes])])
    spot = _spot(Selection(shown.mesh, problem.up), shown, -1, worst)
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


def matching_facets(selection: Selection, patterns: Sequence[str]) -> BoolArray:
    """Return True for each boundary triangle whose patch matches a name or pattern, shape (f,)."""
    matching = [name for pattern in patterns for name in matching_names(selection.patch_names, pattern)]
    return np.isin(selection.patch_names, matching)[selection.facet_patch]
