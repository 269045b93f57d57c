"""A heat run: solution of a scene on a mesh, with probes, warnings and results."""

from __future__ import annotations

import time as clock
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.spatial import KDTree

from thermoxels_ns.core.arrays import BoolArray, FloatArray
from thermoxels_ns.core.checks import check_array
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.core.tables import HasTables, lines_of
from thermoxels_ns.core.units import kelvin_to_celsius
from thermoxels_ns.fem.linear_tets import lumped_mass
from thermoxels_ns.fem.problem import HeatProblem, Varying
from thermoxels_ns.fem.selection import Selection, matching_names
from thermoxels_ns.fem.solution import Solution, SolutionNodes, SteadySolution, solution_nodes
from thermoxels_ns.fem.system import Engine
from thermoxels_ns.fem.tolerance import ToleratedSolution
from thermoxels_ns.heat.effects import Convection
from thermoxels_ns.heat.results import (
    HeatResults,
    WallResult,
    heat_results,
    matching_facets,
    region_behind_facets,
    wall_of_scene,
)
from thermoxels_ns.heat.scene import HeatScene
from thermoxels_ns.heat.scene_fields import INSIDE, OUTSIDE
from thermoxels_ns.heat.sky import Vector as Direction
from thermoxels_ns.heat.solving import Goals, LeftOut, Say, solve_problem
from thermoxels_ns.mesh.files.vtu import blocks_of
from thermoxels_ns.mesh.quality.checks import count_tets_in_other_bodies, count_twin_nodes
from thermoxels_ns.mesh.tetrahedra import TetMesh

if TYPE_CHECKING:
    import pyvista as pv

_OUTSIDE = 1e-9
"""Largest distance of a point outside a tetrahedron, as a share of its height, at which it counts as on the face."""


def place_probes(mesh: TetMesh, points_m: npt.ArrayLike) -> sparse.csr_matrix:
    """Return the matrix (p, n) that interpolates nodal values at the points (p, 3), [m].

    A row holds the barycentric coordinates of a point in its tetrahedron; they are at least 0 and sum to 1. Raises
    `HeatError` if a point lies outside the body.

    >>> corner, none = np.vstack([np.zeros(3), np.eye(3)]), np.zeros((0, 3), np.int64)
    >>> tets, seen = np.array([[0, 1, 2, 3]]), np.ones(4, bool)
    >>> mesh = TetMesh(corner, tets, np.array([0.0, 8.0, 0.0, 0.0]), seen, none, none[:, 0], np.array([0]))
    >>> (place_probes(mesh, [[0.25, 0.25, 0.25]]) @ mesh.temperature_c).tolist()
    [2.0]
    """
    remedy = "Give three coordinates in metres for each probe."
    points = check_array("probes", np.asarray(points_m, dtype=np.float64), (None, 3), remedy, HeatError)
    corner = mesh.points_m[mesh.tets]
    low, high = corner.min(axis=1), corner.max(axis=1)
    slack = _OUTSIDE * float(np.max(high - low))
    nodes, weights = np.zeros((len(points), 4), np.int64), np.zeros((len(points), 4))
    for number, point in enumerate(points):
        near = np.flatnonzero(np.all((low <= point + slack) & (high >= point - slack), axis=1))
        sides, reach = corner[near, 1:] - corner[near, :1], point - corner[near, 0]
        others = np.linalg.solve(np.swapaxes(sides, 1, 2), reach[..., None])[..., 0]
        shares = np.concatenate([1.0 - others.sum(axis=1, keepdims=True), others], axis=1)  # barycentric coordinates
        # A point on a face or node lies in several tetrahedra: take the one it lies deepest in, the first of equals.
        best = int(np.argmax(shares.min(axis=1))) if len(near) else -1
        if best < 0 or shares[best].min() < -_OUTSIDE:
            distance = np.linalg.norm(mesh.points_m - point, axis=1)
            node = np.round(mesh.points_m[np.argmin(distance)], 6).tolist()
            got = f"{np.round(point, 6).tolist()}, which is outside"
            remedy = f"Move it; the nearest node is {node}, {distance.min():.3g} m away."
            raise HeatError(f"probe {number + 1}", expected="a point inside the body", got=got, remedy=remedy)
        inside = np.clip(shares[best], 0.0, 1.0)
        nodes[number], weights[number] = mesh.tets[near[best]], inside / inside.sum()
    ends = np.arange(0, 4 * len(points) + 1, 4)
    return sparse.csr_matrix((weights.ravel(), nodes.ravel(), ends), shape=(len(points), len(mesh.points_m)))


@dataclass(frozen=True)
class HeatRun(HasTables):
    """The outcome of `run_scene`: the problems, the solution, its results, the warnings, and tables of them."""

    scene: HeatScene  # The scene that was run
    problem: HeatProblem  # The problem with all effects of the scene, on the given mesh
    solved: HeatProblem  # The problem that was solved: without `left_out`, and perhaps refined to meet a tolerance
    nodes: SolutionNodes  # All temperatures of the solution, on a mesh with a node for each unknown
    left_out: tuple[LeftOut, ...]  # Effects that were left out because they bring too little heat
    accuracy: ToleratedSolution | None  # Solution with estimated errors; None if no tolerance was given
    warnings: tuple[str, ...]  # Sentences on suspicious facts about the scene on this mesh
    unfit: tuple[str, ...]  # Entries of `warnings` that make heat losses and U-values worthless, such as no rooms
    layers: tuple[Layer, ...]  # Layers that `with_layers` added for `behind_m2k_w`
    solution: Solution  # Temperatures and heat flows
    results: HeatResults  # Heat by patch, effect and region, the heat balance, and the coldest and hottest spot
    wall: WallResult | None
    """U-value and f_Rsi of the body between two airs in a steady state; None if there is no such result."""
    no_wall: str  # Sentence on why a steady state between airs of two temperatures gave no `wall`; else empty
    mean_c: FloatArray  # Mean temperature of the volume at each time, shape (s,), [degrees Celsius]
    probes_m: FloatArray  # Points at which temperatures are recorded, shape (p, 3), [m]
    probes_c: FloatArray  # Temperatures at `probes_m`, shape (s, p), [degrees Celsius]
    seconds: Mapping[str, float]  # Time to solve, "solve", and to work out the results, "answers", [s]

    def __repr__(self) -> str:
        states, last_s = self.nodes.states_c, self.nodes.times_s[-1]
        wall = "" if self.wall is None else f", U {self.wall.u_value_w_m2k:.3g} W/(m2 K)"
        what = f"{'steady' if self.scene.steady else f'{last_s:g} s'}, {len(self.solved.mesh.tets):,} tetrahedra"
        return f"HeatRun({what}, {states[-1].min():.4g} to {states[-1].max():.4g} °C at the end{wall})"

    def tables(self) -> dict[str, list[dict[str, Any]]]:
        """Return the tables "patches", "effects" and "regions" of `HeatResults`, and "times".

        "times" has a line for each kept time: the least, mean and largest temperature, temperatures at probes, and the
        mean heat flow into the body by each effect since the previous time (None at the start)."""
        states, effects = self.nodes.states_c, self.solution.effects
        times = list[dict[str, Any]]()
        for number, time_s in enumerate(self.nodes.times_s.tolist()):
            line = {"time_s": time_s, "min_c": float(states[number].min()), "mean_c": float(self.mean_c[number])}
            line |= {"max_c": float(states[number].max())}
            line |= {f"probe {n + 1} [C]": value for n, value in enumerate(self.probes_c[number].tolist())}
            interval = number if len(states) == 1 else number - 1
            line |= {f"{heat.effect} [W]": float(heat.heat_w[interval]) if interval >= 0 else None for heat in effects}
            times.append(line)
        of_results = {name: lines_of(getattr(self.results, name)) for name in ("patches", "effects", "regions")}
        return {**of_results, "times": times}

    def to_pyvista(self) -> pv.MultiBlock:
        """Return the blocks of `blocks_of` for the mesh that was solved, with the temperatures at the end."""
        end = replace(self.nodes.mesh, temperature_c=self.nodes.states_c[-1])
        return blocks_of(end, {"up": self.problem.up})


def run_scene(
    scene: HeatScene,
    mesh: TetMesh,
    goals: Goals,
    *,
    up: Direction | None = None,
    probes_m: npt.ArrayLike = (),
    export: Mapping[str, Any] | None = None,
    behind_m2k_w: Mapping[str, float] | None = None,
    say: Say = lambda _: None,
    engine: Engine | None = None,
) -> HeatRun:
    """Return the solution of a scene on a mesh, with results and warnings.

    `goals` are the allowed errors and memory. The direction `up` is used if the scene has none; None: z. Temperatures
    are recorded at `probes_m`, shape (p, 3), [m]. `export`, the summary of the export that wrote the mesh, adds
    warnings. `behind_m2k_w` is the argument of `with_layers`; None: no layers. `say` is called with lines of progress.
    An `engine` finds the temperatures in place of our own solver.
    Raises `HeatError` if the scene does not fit the mesh, a probe lies outside it, or the solver fails.
    """
    start, scene = clock.perf_counter(), scene.on(mesh)
    scene, layers = (scene, ()) if behind_m2k_w is None else with_layers(scene, mesh, behind_m2k_w, up)
    problem = scene.problem(mesh, up=up)
    points_m = np.array(probes_m, dtype=np.float64).reshape(-1, 3)
    place_probes(mesh, points_m)  # raises before anything slow
    about_patches = patch_warnings(scene, mesh, problem.up)
    inner, harmless = ((), ()) if about_patches else inner_surface_warnings(scene, mesh, problem.up)
    about_scene = air_warnings(scene)
    over = [one.patch for one in layers if one.body_m2k_w > 1.05 * one.asked_m2k_w]
    if over:
        what = f"The body alone resists more than the audit found: {', '.join(over)}. There the heat loss is too low"
        about_scene += (f"{what}; give the scene a material that conducts more, or export thinner walls.",)
    unfit = (*about_patches, *inner)
    warnings = (*unfit, *harmless, *about_scene, *body_warnings(mesh), *shell_warnings(scene, export or {}))
    for warning in warnings:
        say(f"Warning: {warning}")
    found = solve_problem(problem, scene.time, goals, say, engine)
    solution, solved = found.solution, found.problem
    done = clock.perf_counter()
    seconds = {"solve": done - start}
    say(f"Heat: {solution.status} ({seconds['solve']:.1f} s)")
    closed = f"Energy balance closed to {solution.energy_residual:.1e}"
    say(f"{closed}; what is unbalanced changes no heat flow by more than {solution.unbalanced_w:.1e} W.")
    if found.accuracy is None:
        say(f"Error of the mesh: {mesh_error_in_words(solution)}.")
    elif not found.accuracy.met:
        say("Warning: the tolerance was not met.")

    nodes = solution_nodes(solved, solution)
    wall = wall_of_scene(scene, solved, solution, nodes, doubtful=bool(about_patches))
    probes = place_probes(nodes.mesh, points_m)
    results = heat_results(solved, solution, nodes)
    node_m3 = lumped_mass(nodes.mesh.points_m, nodes.mesh.tets, np.ones(len(nodes.mesh.tets)))  # tetrahedra, shared out
    return HeatRun(
        scene=scene,
        problem=problem,
        solved=solved,
        nodes=nodes,
        left_out=found.left_out,
        accuracy=found.accuracy,
        warnings=warnings,
        unfit=unfit,
        layers=layers,
        solution=solution,
        results=results,
        wall=None if isinstance(wall, str) else wall,
        no_wall=wall if isinstance(wall, str) else "",
        mean_c=nodes.states_c @ (node_m3 / node_m3.sum()),
        probes_m=points_m,
        probes_c=np.stack([probes @ state_c for state_c in nodes.states_c]),
        seconds={**seconds, "answers": clock.perf_counter() - done},
    )


def mesh_error_in_words(solution: Solution) -> str:
    """Return a phrase on the estimated mesh error of a solution without tolerance, or on the lack of an estimate."""
    error = solution.error if isinstance(solution, SteadySolution) else None
    if error is None:
        return "not estimated; --flow-tolerance 0.01 or --tolerance 0.05 estimates it"
    return f"estimated {error.describe()}, usually right to a factor of three"


_KELVIN_OF_AIR = (173.15, 373.15)  # Range of numbers that are likely air temperatures in kelvin, but not in Celsius
_COS_45 = float(np.sqrt(0.5))
_LEAST_OF_A_ROOM = 0.1  # Least share of walls and floor in a room's inner surface; in a cube they are five sixths of it
_LEAST_FLOOR = 0.5  # Least ratio of a room's floor area to its ceiling area
_MOST_SHARED = 0.02  # Largest share of the inner surface's nodes that may lie on the outer one, as rims of holes do
_THICKNESS_OFF = 0.2  # Largest relative difference from the asked thickness of walls without a warning
_INWARDS = -0.2
"""Value of `_outwards` below which a surface faces inwards, as in a room. Typical values: 0.8 to 1 for a body seen from
around, 0 for a plane, -0.8 to -1 for a room seen from within."""


def patch_warnings(scene: HeatScene, mesh: TetMesh, up: Direction) -> tuple[str, ...]:
    """Return warnings if the default patches of the scene's two airs do not suit the mesh.

    By default, surfaces that no camera saw are inside. This is wrong for a filled body, of which only the underside is
    unseen, and for a room photographed from within. Airs for which the scene names patches are not checked.
    """
    selection = Selection(mesh, up)
    inside_air = scene.inside_air if scene.inside_air and scene.inside_air.patches[:1] == INSIDE else None
    outside_air = scene.outside_air if scene.outside_air and scene.outside_air.patches[:1] == OUTSIDE else None
    if (inside_air or outside_air) and _outwards(selection, matching_facets(selection, OUTSIDE)) < _INWARDS:
        return (
            "The surface that photographs see faces inwards, as that of a room photographed from within. The scene's "
            "outside air (and sun and sky) acts on surfaces that were seen, its inside air on those that were not. If "
            "the seen surface is that of the room, give inside_air and outside_air their patches in the scene: "
            'patches: ["exterior-*"] to the inside air, patches: ["interior-*"] to the outside air.',
        )
    if inside_air is None:
        return ()
    inside = matching_facets(selection, inside_air.patches)
    area, whole = selection.facet_area_m2[inside], float(selection.facet_area_m2[inside].sum())
    level = selection.facet_normal[inside] @ np.array(selection.up)
    if float(area[level > -_COS_45].sum()) > _LEAST_OF_A_ROOM * whole:  # walls and floors of rooms
        return ()
    return (
        f"The scene names air inside, but the body has no rooms: of the {whole:.4g} m² that no photograph saw, next "
        "to nothing is walls or floor of a room. The air acts on what is left, such as the underside, and U-values "
        "and heat losses are those of that. Export again with --interior hollow --wall-thickness 0.3, or "
        "name the inner surface with --patches.",
    )


def inner_surface_warnings(scene: HeatScene, mesh: TetMesh, up: Direction) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return two tuples of warnings: on faults that make heat losses worthless, and on harmless faults.

    A missing floor and nodes that inner and outer surface share are faults; few shared nodes (rims) are harmless.
    """
    if scene.inside_air is None or scene.outside_air is None:
        return (), ()
    selection = Selection(mesh, up)
    inside, outside = (matching_facets(selection, air.patches) for air in (scene.inside_air, scene.outside_air))
    inner = np.unique(mesh.facets[inside])
    shared = np.intersect1d(inner, mesh.facets[outside & ~inside])
    warnings, harmless = [], []
    if len(shared):
        x, y, z = mesh.points_m[shared[0]]
        (warnings if len(shared) > _MOST_SHARED * len(inner) else harmless).append(
            f"{len(shared)} of the {len(inner)} nodes of the inner surface lie on the outer one as well, one at "
            f"({x:.4g}, {y:.4g}, {z:.4g}) m: rims of holes, or walls that end. There both airs touch the body; "
            "temperature factors leave these nodes out, heat losses do not."
        )
    area, level = selection.facet_area_m2, selection.facet_normal @ np.array(selection.up)
    # A floor may be adiabatic, or touch a cellar: all that faces up and is not outside is one.
    floor = float(area[(level > _COS_45) & ~outside].sum())
    ceiling = float(area[inside & (level < -_COS_45)].sum())
    if floor < _LEAST_FLOOR * ceiling:
        warnings.append(
            f"The inner surface has a ceiling of {ceiling:.3g} m² and a floor of {floor:.3g} m²: most of the floor is "
            "missing, and so is the heat that it loses."
        )
    return tuple(warnings), tuple(harmless)


@dataclass(frozen=True)
class Layer:
    """A thermal layer on the outside of a patch that raises the resistance of the wall to what an audit found."""

    patch: str
    asked_m2k_w: float  # Wanted resistance from the air inside to the outer surface, [m2 K / W]
    body_m2k_w: float  # Resistance of the inner film and the body without the layer, [m2 K / W]
    layer_m2k_w: float  # Resistance of the layer, at least 0, [m2 K / W]


def with_layers(
    scene: HeatScene, mesh: TetMesh, behind_m2k_w: Mapping[str, float], up: Direction | None = None
) -> tuple[HeatScene, tuple[Layer, ...]]:
    """Return a scene with a thermal layer on the outside of patches, so that walls have given resistances, and layers.

    `behind_m2k_w` is the wanted resistance from the air inside to the outer surface by patch, [m2 K / W]. The layer has
    what the inner film and the body lack. The body's resistance is its thickness, the distance across the wall from an
    outer to the nearest inner triangle, divided by its conductivity. `up` is used if the scene has none; None: z.
    Raises `HeatError` if the body has no rooms or lacks the patches, or if effects other than the two airs act: the
    layer is part of the outer film, so it cannot lie below sunlight or sky.
    """
    top = np.array(scene.up or up or (0.0, 0.0, 1.0), dtype=np.float64)
    x, y, z = (top / np.linalg.norm(top)).tolist()
    inside, outside, selection = scene.inside_air, scene.outside_air, Selection(mesh, (x, y, z))
    more = [key for key in ("sky", "ground", "sun", "radiation", "absorbed_solar", "heat_flux") if getattr(scene, key)]
    if inside is None or outside is None or more:
        got, remedy = ", ".join(more) or "no two airs", "Pass --scene winter-night, or a scene like it."
        raise HeatError("--from-audit", expected="a scene of the airs inside and outside alone", got=got, remedy=remedy)
    names, patch = selection.patch_names, selection.facet_patch
    inner, outer = (np.flatnonzero(matching_facets(selection, air.patches)) for air in (inside, outside))
    both = [names[n] for n in np.unique(patch[outer]) if names[n] in behind_m2k_w]
    if not len(inner) or not both:
        expected, got = f"rooms, and outer patches out of {', '.join(behind_m2k_w)}", ", ".join(names)
        remedy = "Export with --interior hollow --wall-thickness 0.3 and the --patches of the audit."
        raise HeatError("--from-audit", expected=expected, got=got, remedy=remedy)
    places, here, area = selection.facet_places(inner), selection.facet_places(outer), selection.facet_area_m2[outer]
    _, nearest = KDTree(places.points_m).query(here.points_m)
    thickness_m = np.abs(np.einsum("fi,fi->f", here.points_m - places.points_m[nearest], here.normals))
    film = inside.convection().coefficient_w_m2k
    film = np.broadcast_to(film.function(places, 0.0) if isinstance(film, Varying) else film, len(inner))
    made_of = scene.material(mesh)
    conductivity = np.array([made_of[n].conductivity_w_mk if n in made_of else np.nan for n in mesh.region_names])
    conducts = 1.0 / (1.0 / film[nearest] + thickness_m / conductivity[region_behind_facets(mesh)[outer]])
    air, layers, effects = outside.convection(), [], []
    assert isinstance(air.coefficient_w_m2k, float), "outside, films are numbers"
    for name in both:
        on = patch[outer] == names.index(name)
        asked, own = behind_m2k_w[name], 1.0 / float(np.average(conducts[on], weights=area[on]))
        layers.append(Layer(name, asked, own, max(asked - own, 0.0)))
        through = 1.0 / (1.0 / max(air.coefficient_w_m2k, 1e-9) + layers[-1].layer_m2k_w)
        effects.append(replace(air, patches=(name,), coefficient_w_m2k=through))
    every = {name for pattern in outside.patches for name in matching_names(names, pattern)}
    rest = tuple(sorted(every - {*behind_m2k_w}))
    outside = replace(outside, patches=rest or effects[-1].patches)
    if not rest:  # the last patch keeps the open air, by which the page names the temperature outside
        own = {"coefficient": None, "wind_m_s": None, "emissivity": None}
        outside = replace(outside, **own, coefficient_w_m2k=effects.pop().coefficient_w_m2k)
    return replace(scene, outside_air=outside, convection=(*scene.convection, *effects)), tuple(layers)


def air_warnings(scene: HeatScene) -> tuple[str, ...]:
    """Return warnings on air temperatures probably given in kelvin, and on series that leave times uncovered."""
    hours, warnings = scene.time.duration_s / 3600.0 if scene.time else 0.0, list[str]()
    airs = [("inside_air", scene.inside_air), ("outside_air", scene.outside_air)]
    airs += [(f"convection entry {number}", entry) for number, entry in enumerate(scene.convection, start=1)]
    for name, air in airs:
        if air is not None and isinstance(air.air_c, float) and _KELVIN_OF_AIR[0] <= air.air_c <= _KELVIN_OF_AIR[1]:
            warnings.append(
                f"The air of {name} has {air.air_c:g} degrees Celsius. If that is meant in kelvin, give air_c: "
                f"{kelvin_to_celsius(air.air_c):g}."
            )
        if air is None or isinstance(air, Convection) or air.air_series is None:
            continue
        begin, end = air.series()[0][[0, -1]].tolist()
        if begin > 0.0 or end < hours * (1.0 - 1e-9):
            warnings.append(
                f"The air_series of {name} is from {begin:g} to {end:g} hours, but the body is followed from 0 to "
                f"{hours:g} hours: before and after the series its first and last temperature are held. Give a longer "
                "series, or a shorter time."
            )
    return tuple(warnings)


def body_warnings(mesh: TetMesh) -> tuple[str, ...]:
    """Return a warning if bodies overlap, or else if two nodes are at one place, between which no heat flows."""
    twins, inside, warnings = count_twin_nodes(mesh.points_m), count_tets_in_other_bodies(mesh), []
    if inside:
        warnings.append(
            f"Bodies of the mesh overlap: at least {inside} tetrahedra lie in another body. Heat flows of both count, "
            "and no heat crosses from one to the other. Remove one of them."
        )
    elif twins:
        warnings.append(
            f"{twins} nodes of the mesh lie at the place of another one: parts that touch there without sharing nodes "
            "exchange no heat. Merge the nodes where they should."
        )
    return tuple(warnings)


def shell_warnings(scene: HeatScene, export: Mapping[str, Any]) -> tuple[str, ...]:
    """Return a warning if the mesh is a shell of unknown or unwanted thickness by `export`, its export summary."""
    options, mesh = export.get("options"), export.get("mesh")
    if scene.inside_air is None or not isinstance(options, dict) or not isinstance(mesh, dict):
        return ()
    asked_m = options.get("wall_thickness")
    if options.get("interior") != "hollow" and asked_m is None:
        return ()
    try:
        thickness_m = 2.0 * float(mesh["volume"]) / float(mesh["area"])
        if asked_m is not None:
            if abs(thickness_m / float(asked_m) - 1.0) <= _THICKNESS_OFF:
                return ()
            return (
                f"Walls were to be {float(asked_m):.2g} m thick (--wall-thickness); volume and surface of the mesh say "
                f"{thickness_m:.2g} m on average. What is thinner than that or solid, such as slabs, is in this mean.",
            )
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return ()
    return (
        f"The mesh is a shell (--interior hollow), {thickness_m:.2g} m thick on average. Photographs do not show how "
        "thick walls are, nor what no camera saw, such as floors: heat losses and U-values are those of this shell, "
        "with its holes and loose parts. Where you know the walls, export with --wall-thickness.",
    )


def _outwards(selection: Selection, chosen: BoolArray) -> float:
    """Return the mean cosine between normals and directions away from a surface's middle; 0 for an empty surface. The
    surface is the triangles `chosen` (f,); the mean is weighted by area."""
    area = selection.facet_area_m2[chosen]
    if not float(area.sum()) > 0.0:
        return 0.0
    centroid = selection.mesh.points_m[selection.mesh.facets[chosen]].mean(axis=1)
    away = centroid - area @ centroid / area.sum()
    length = np.linalg.norm(away, axis=1)
    cosine = np.einsum("fi,fi->f", away, selection.facet_normal[chosen]) / np.maximum(length, np.finfo(float).tiny)
    return float(area @ cosine / area.sum())
