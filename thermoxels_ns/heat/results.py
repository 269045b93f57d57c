"""Answers people use: where heat is lost and how much, where it is hottest and coldest, and whether it adds up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.checks import check_shape
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.fem.selection import Selection
from thermoxels_ns.fem.solution import EffectHeat, SteadySolution
from thermoxels_ns.fem.solution_nodes import Solution, SolutionNodes, solution_nodes
from thermoxels_ns.fem.surface_heat import heat_by_part, heat_through_parts
from thermoxels_ns.heat.effects import Effect, InternalHeat
from thermoxels_ns.heat.materials import materials_by_region
from thermoxels_ns.mesh.tetrahedra import TetMesh

Vector = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Spot:
    """A node and its temperature."""

    temperature_c: float
    """Its temperature, [degrees Celsius]."""
    point_m: tuple[float, float, float]
    """Where it is, [m]."""
    time_s: float
    """When, [s]; 0 in a steady state."""
    node: int
    """Its number in the mesh, from 0."""
    patches: tuple[str, ...]
    """Patches that it lies on; none inside the body."""


@dataclass(frozen=True)
class PatchAnswer:
    """A part of the surface."""

    patch: str
    """Its name."""
    area_m2: float
    """Its true area, [m2]."""
    heat_w: float
    """Mean heat flow into the body through it over all times, [W]; negative where heat is lost."""
    heat_w_m2: float
    """The same per true area, [W / m2]."""
    last_heat_w: float
    """Mean heat flow into the body during the last interval, [W]."""
    mean_c: float
    """Mean temperature of its area at the end, [degrees Celsius]."""
    coldest: Spot
    """Where it is coldest at the end."""
    hottest: Spot
    """Where it is hottest at the end."""


@dataclass(frozen=True)
class EffectAnswer:
    """Something that acts on the body."""

    effect: str
    """What it is and where it acts."""
    heat_w: float
    """Mean heat flow into the body over all times, [W]; negative where heat is lost."""
    area_m2: float | None
    """True area it acts on, [m2]; None for a source inside."""
    heat_w_m2: float | None
    """Heat flow per true area, [W / m2]; None for a source inside."""
    last_heat_w: float
    """Mean heat flow into the body during the last interval, [W]."""
    groups: dict[str, float]
    """Mean heat flow over all times by patch, of a source by region, [W]."""


@dataclass(frozen=True)
class RegionAnswer:
    """A part of the volume, such as all that is made of one material."""

    region: str
    """Its name."""
    material: str
    """What it is made of."""
    volume_m3: float
    """Its volume, [m3]."""
    area_m2: float
    """True area of its own surface, [m2]; where it touches other regions does not count."""
    heat_w: float
    """Heat flow into the body through its own surface at the end, [W]; negative where heat is lost."""
    heat_w_m2: float
    """The same per true area, [W / m2]; 0 without a surface."""
    mean_c: float
    """Mean temperature of its volume at the end, [degrees Celsius]."""
    min_c: float
    """Lowest temperature at the end, [degrees Celsius]."""
    max_c: float
    """Highest temperature at the end, [degrees Celsius]."""


@dataclass(frozen=True)
class EnergyBalance:
    """Stored = in - out."""

    unit: str
    """J through time, W in a steady state."""
    into_body: float
    """All that effects brought."""
    out_of_body: float
    """All that effects took."""
    stored: float
    """Change of the body's heat content; 0 in a steady state."""
    residual: float
    """Stored - in + out: what nothing accounts for."""
    relative_residual: float
    """The solver's own measure of it: its largest size relative to the heat content or to all heat exchanged."""


@dataclass(frozen=True)
class Answers:
    """All of it. Heat flows are positive into the body."""

    status: str
    """The outcome of the computation as a sentence."""
    times_s: tuple[float, ...]
    """Times of the kept temperatures, [s]; 0 alone for a steady state."""
    patches: tuple[PatchAnswer, ...]
    """Parts of the surface that have some area."""
    effects: tuple[EffectAnswer, ...]
    """What acts, in the order of the problem."""
    regions: tuple[RegionAnswer, ...]
    """Parts of the volume that have some."""
    balance: EnergyBalance
    """Whether it adds up."""
    coldest: Spot
    """The coldest node of all times."""
    hottest: Spot
    """The hottest node of all times."""

    def as_mapping(self) -> dict[str, Any]:
        """Return names and values, nested, as json has them."""
        return plain_values(self)


def plain_values(value: Any) -> Any:
    """Turn nested dataclasses into mappings.

    >>> plain_values((EnergyBalance("W", 2.0, 2.0, 0.0, 0.0, 0.0),))[0]["unit"]
    'W'
    """
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain_values(getattr(value, field.name)) for field in fields(value)}
    return [plain_values(entry) for entry in value] if isinstance(value, tuple) else value


def heat_answers(
    problem: HeatProblem,
    solution: Solution,
    *,
    facet_region: npt.NDArray[np.int64] | None = None,
    end_s: float | None = None,
    nodes: SolutionNodes | None = None,
) -> Answers:
    """Work out the answers from a solution.

    Temperatures are those of all its unknowns, heat flows those that its own tetrahedra, linear or quadratic, bring.

    Args:
        problem: What was solved.
        solution: Its outcome.
        facet_region: Region of the tetrahedron behind each boundary triangle, shape (f,); needed only if the body has
            several regions.
        end_s: Time at which effects that change are taken for the flows of regions, [s]; None: the last one.
        nodes: What `solution_nodes` gives, if it is there already.

    Raises:
        HeatError: The body has several regions and `facet_region` is missing or does not fit.
    """
    nodes = solution_nodes(problem, solution) if nodes is None else nodes
    times, states, selection = nodes.times_s, nodes.states_c, Selection(nodes.mesh, problem.up)
    end_s = float(times[-1]) if end_s is None else end_s
    facet_region = _checked_regions(problem.mesh, facet_region)
    names = problem.mesh.region_names
    by_region = heat_by_part(problem, end_state_c(solution), end_s, facet_region, names)
    lengths = np.diff(times) if len(times) > 1 else np.ones(1)
    spots = _Spots(selection, times, states)
    surface = [heat for effect, heat in zip(problem.effects, solution.effects) if not isinstance(effect, InternalHeat)]
    return Answers(
        status=solution.status,
        times_s=tuple(times.tolist()),
        patches=_patches(selection, surface, lengths, states[-1], spots),
        effects=_effects(selection, problem.effects, solution.effects, lengths),
        regions=_regions(
            problem, selection, states[-1], heat_through_parts(by_region, names)[0], nodes.of_facets(facet_region)
        ),
        balance=_balance(solution, lengths),
        coldest=spots.extreme(np.argmin),
        hottest=spots.extreme(np.argmax),
    )


def end_state_c(solution: Solution) -> Vector:
    """Give the last temperatures of all unknowns of a solution, those of edges last, [degrees Celsius]."""
    if isinstance(solution, SteadySolution):
        return np.concatenate([solution.temperature_c, solution.edge_temperature_c])
    return solution.temperature_c[-1]


class _Spots:
    """Finds nodes and says where they are."""

    def __init__(self, selection: Selection, times_s: Vector, states_c: Vector) -> None:
        self._selection, self._times, self._states = selection, times_s, states_c

    def extreme(self, which: Any) -> Spot:
        """Find the first of the coldest or hottest of all nodes and times."""
        time, node = np.unravel_index(int(which(self._states)), self._states.shape)
        return self.at(int(time), int(node))

    def on(self, nodes: npt.NDArray[np.int64], which: Any) -> Spot:
        """Find the coldest or hottest of some nodes at the end."""
        return self.at(len(self._times) - 1, int(nodes[which(self._states[-1][nodes])]))

    def at(self, time: int, node: int) -> Spot:
        """Describe a node at a time."""
        return describe_spot(self._selection, node, float(self._states[time, node]), float(self._times[time]))


def describe_spot(selection: Selection, node: int, temperature_c: float, time_s: float) -> Spot:
    """Say where a node is."""
    touching = np.any(selection.mesh.facets == node, axis=1)
    patches = tuple(selection.patch_names[number] for number in np.unique(selection.facet_patch[touching]))
    x, y, z = selection.mesh.points_m[node].tolist()
    return Spot(temperature_c, (x, y, z), time_s, node, patches)


def _patches(
    selection: Selection, surface: Sequence[EffectHeat], lengths: Vector, last_c: Vector, spots: _Spots
) -> tuple[PatchAnswer, ...]:
    mesh, area = selection.mesh, selection.facet_area_m2
    heat = np.zeros((len(lengths), len(selection.patch_names)))
    heat += heat_through_parts(surface, selection.patch_names)
    facet_c = last_c[mesh.facets].mean(axis=1)
    answers = []
    for number in np.unique(selection.facet_patch):
        chosen = selection.facet_patch == number
        nodes, total = np.unique(mesh.facets[chosen]), float(area[chosen].sum())
        mean = float(heat[:, number] @ lengths / lengths.sum())
        answers.append(
            PatchAnswer(
                patch=selection.patch_names[number],
                area_m2=total,
                heat_w=mean,
                heat_w_m2=mean / total,
                last_heat_w=float(heat[-1, number]),
                mean_c=float(facet_c[chosen] @ area[chosen]) / total,
                coldest=spots.on(nodes, np.argmin),
                hottest=spots.on(nodes, np.argmax),
            )
        )
    return tuple(answers)


def _effects(
    selection: Selection, effects: Sequence[Effect], heats: Sequence[EffectHeat], lengths: Vector
) -> tuple[EffectAnswer, ...]:
    by_patch = np.bincount(selection.facet_patch, selection.facet_area_m2, len(selection.patch_names))
    area = dict(zip(selection.patch_names, by_patch.tolist()))
    answers = []
    for effect, heat in zip(effects, heats):
        mean = float(heat.heat_w @ lengths / lengths.sum())
        groups = (heat.group_heat_w.T @ lengths / lengths.sum()).tolist()
        total = None if isinstance(effect, InternalHeat) else sum(area[name] for name in heat.group_names)
        answers.append(
            EffectAnswer(
                effect=heat.effect,
                heat_w=mean,
                area_m2=total,
                heat_w_m2=mean / total if total else None,
                last_heat_w=float(heat.heat_w[-1]),
                groups=dict(zip(heat.group_names, groups)),
            )
        )
    return tuple(answers)


def _regions(
    problem: HeatProblem, selection: Selection, last_c: Vector, heat: Vector, facet_region: npt.NDArray[np.int64]
) -> tuple[RegionAnswer, ...]:
    mesh, names = selection.mesh, selection.mesh.region_names
    area = np.bincount(facet_region, selection.facet_area_m2, len(names))
    corner = mesh.points_m[mesh.tets]
    sides = corner[:, 1:] - corner[:, :1]
    volume = np.einsum("ti,ti->t", sides[:, 0], np.cross(sides[:, 1], sides[:, 2])) / 6.0
    total = np.bincount(mesh.region, volume, len(names))
    content = np.bincount(mesh.region, volume * last_c[mesh.tets].mean(axis=1), len(names))
    made_of = materials_by_region(problem)
    answers = []
    for number in np.unique(mesh.region):
        inside = last_c[mesh.tets[mesh.region == number]]
        answers.append(
            RegionAnswer(
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
    return tuple(answers)


def _balance(solution: Solution, lengths: Vector) -> EnergyBalance:
    steady = isinstance(solution, SteadySolution)
    # By patch: what comes in through one and leaves through another must not cancel in the sum of an effect.
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
    )


def _checked_regions(mesh: TetMesh, facet_region: npt.NDArray[np.int64] | None) -> npt.NDArray[np.int64]:
    """Region behind each boundary triangle, which is clear if there is only one."""
    used = np.unique(mesh.region)
    if facet_region is None and len(used) == 1:
        return np.full(len(mesh.facets), used[0])
    remedy = "Give the region of the tetrahedron behind each boundary triangle."
    if facet_region is None:
        got = f"none for {len(used)} regions"
        raise HeatError("facet_region", expected="one number per triangle", got=got, remedy=remedy)
    return check_shape("facet_region", np.asarray(facet_region), (len(mesh.facets),), remedy, HeatError)
