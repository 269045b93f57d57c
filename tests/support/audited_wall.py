"""A wall with a window and a balcony slab of known construction, solved by finite elements, as a camera sees it."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from tests.support.heat_bodies import box_mesh, planes
from thermoxels_ns.audit.calibration import Calibration
from thermoxels_ns.audit.conditions import (
    BALANCE,
    Calibrate,
    Camera,
    Conditions,
    Film,
    InsideAir,
    OutsideAir,
    Reference,
    Side,
    SkyModel,
    Surface,
    Surroundings,
    Unknown,
    Weather,
)
from thermoxels_ns.audit.draws import FORMULA, Draws, Interval, draw, emissivity_name
from thermoxels_ns.audit.exchange import radiant_k4
from thermoxels_ns.audit.heat_flow import FILMS
from thermoxels_ns.audit.run import audit
from thermoxels_ns.core.measured import Measured
from thermoxels_ns.core.units import celsius_to_kelvin, kelvin_to_celsius
from thermoxels_ns.fem.problem import HeatProblem, TimeSteps, Varying, tabulated
from thermoxels_ns.fem.selection import Places
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.time_loop import SDIRK2, solve_heat
from thermoxels_ns.heat.effects import AbsorbedSolar, Convection, Radiation
from thermoxels_ns.heat.materials import Material
from thermoxels_ns.heat.results import heat_results
from thermoxels_ns.heat.scene_fields import INSIDE_RESISTANCE_M2K_W
from thermoxels_ns.mesh.tetrahedra import FACET_BOX, TetMesh, facet_normals

UP = (0.0, 0.0, 1.0)
WALL_M, LENGTH_M, HEIGHT_M = 0.3, 4.0, 3.0
SLAB_M = (1.4, 1.6)  # From where to where the balcony slab goes, [m] above the floor
SLAB_DEPTH_M = 0.6
WINDOW_M = ((2.2, 3.4), (0.3, 1.1))
CONDUCTIVITY = {"wall": 0.30, "glazing": 0.36, "slab": 2.3, "door": 0.9}  # [W/(m K)]
R_INSIDE = INSIDE_RESISTANCE_M2K_W["horizontal"]

STATED = Conditions(
    side="outside",
    inside=InsideAir(Measured(20.0, 0.5)),
    outside=OutsideAir(Measured(0.0, 0.5), wind=Measured(1.0, 0.4)),
    surroundings=Surroundings(sky=SkyModel(Measured(0.7, 0.15), Measured(-4.0, 1.0)), ground=Measured(-0.5, 1.0)),
    film=Film("iso-6946", Measured(1.0, 0.2)),
    camera=Camera(offset=Measured(0.0, 1.0), repeatability=Measured(0.0, 0.2)),
    surfaces=(Surface(Measured(0.93, 0.02)),),
)

SURE = replace(
    STATED,
    inside=InsideAir(Measured(20.0)),
    outside=OutsideAir(Measured(0.0), wind=Measured(1.0)),
    surroundings=Surroundings(sky=SkyModel(Measured(0.7), Measured(-4.0)), ground=Measured(-0.5)),
    film=Film("iso-6946"),
    camera=Camera(Measured(0.0), Measured(0.0)),
    surfaces=(Surface(Measured(0.93)),),
)
"""The same without a range."""

INSIDE = replace(
    STATED,
    side="inside",
    surroundings=Surroundings(reflected=Measured(19.6, 0.3)),
    camera=Camera(offset=Measured(0.0, 0.5), repeatability=Measured(0.0, 0.2)),
)

NIGHT = replace(
    STATED,
    outside=OutsideAir(Measured(0.0, 0.5), wind=Measured(0.5, 0.4)),
    surroundings=Surroundings(sky=SkyModel(Measured(0.05, 0.05), Measured(-10.0, 1.0)), ground=Measured(-3.0, 1.0)),
    film=Film(),
    camera=Camera(offset=Measured(0.0, 0.3), repeatability=Measured(0.0, 0.1)),
)
"""A calm and clear night, whose sky cools a wall below the air."""


def audited_wall(step: float = 0.1, slab: bool = True, window: bool = True, side: Side = "outside") -> TetMesh:
    """The mesh: outside at y = 0, the room at y = 0.3 m, the slab reaches out to y = -0.6 m; all else is cut.

    `side` is what was photographed: facade and window, or the room.
    """
    low, high = SLAB_M
    (left, right), (bottom, top) = WINDOW_M
    x = planes(0.0, left, right, LENGTH_M, step=step)
    z = planes(0.0, bottom, top, low, high, HEIGHT_M, step=step)
    y = np.concatenate([planes(-SLAB_DEPTH_M, 0.0, step=step)[:-1], planes(0.0, WALL_M, step=0.05)])
    if not slab:
        y = y[y > -1e-9]

    def in_slab(p: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
        return (p[..., 2] > low) & (p[..., 2] < high)

    def in_window(p: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
        across = (p[..., 0] > left) & (p[..., 0] < right)
        return across & (p[..., 2] > bottom) & (p[..., 2] < top)

    regions = {"wall": lambda p: np.ones(p.shape[:-1], dtype=bool)}
    if window:
        regions["glazing"] = lambda p: in_window(p) & (p[..., 1] > 0.0)
    if slab:
        regions["slab"] = in_slab

    def outer(c: npt.NDArray[np.float64], n: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
        ends = (np.abs(n[:, 0]) > 0.5) & ((c[:, 0] < 1e-9) | (c[:, 0] > LENGTH_M - 1e-9))
        ends |= (np.abs(n[:, 2]) > 0.5) & ((c[:, 2] < 1e-9) | (c[:, 2] > HEIGHT_M - 1e-9))
        return ~ends & (c[:, 1] < WALL_M - 1e-9)

    patches = {
        "cut": lambda c, n: np.ones(len(c), dtype=bool),
        "room": lambda c, n: c[:, 1] > WALL_M - 1e-9,
        "facade": outer,
    }
    if window:
        patches["window"] = lambda c, n: outer(c, n) & in_window(c) & (np.abs(c[:, 1]) < 1e-9)
    mesh = box_mesh(x, y, z, regions=regions, patches=patches, keep=lambda p: (p[..., 1] > 0.0) | in_slab(p))
    names, patch = mesh.boundary.patch_names, mesh.boundary.patch
    tags = np.where(patch == names.index("cut"), FACET_BOX, 0)
    shown = ("room",) if side == "inside" else ("facade", "window")
    seen = np.isin(patch, [names.index(name) for name in shown if name in names])
    return replace(mesh, facet_tags=tags, boundary=replace(mesh.boundary, seen=seen))


@dataclass(frozen=True)
class Truth:
    """What is so: the state of the wall, and what audits are to find."""

    mesh: TetMesh  # With true temperatures
    loss_w: float  # Through what was photographed
    u_w_m2k: dict[str, float]  # By patch
    area_m2: dict[str, float]
    flow_w: dict[str, float]  # From inside to outside
    draws: Draws  # The true value of each quantity, one draw


def true_draws(conditions: Conditions, seed: int | None) -> Draws:
    """True values of what the conditions state, drawn from their ranges; None: as stated."""
    if seed is None:
        return draw(conditions, 1).first(0)
    return Draws({name: values[1:] for name, values in draw(conditions, 1, 1000 + seed).values.items()})


def radiant_c(conditions: Conditions, draws: Draws, normals: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Temperature of what surfaces of these normals exchange radiation with, (n,)."""
    return kelvin_to_celsius(radiant_k4(conditions, draws, normals @ np.array(UP))[:, 0] ** 0.25)


def solve_wall(mesh: TetMesh, conditions: Conditions, draws: Draws) -> Truth:
    """Let heat flow through the wall under the true conditions, by iso-6946 on the side that was photographed.

    For the model `BALANCE`, convection is by the formula that was drawn, at the mean temperature of each patch.
    """
    value = {name: float(values[0]) for name, values in draws.values.items()}
    used = (mesh.boundary.patch_names[number] for number in np.unique(mesh.boundary.patch))
    patches = tuple(name for name in used if name not in ("room", "cut"))

    def around_c(places, _):
        return radiant_c(conditions, draws, places.normals)

    inside = conditions.side == "inside"
    seen = ("room",) if inside else patches
    balance = conditions.film.model == BALANCE
    formulas = list(FILMS[conditions.side].values()) if balance else []
    names, airs = mesh.boundary.patch_names, (value["inside air"], value["outside air"])
    air, other_air = airs if inside else airs[::-1]
    materials = {name: Material(name, k, 1000.0, 1000.0) for name, k in CONDUCTIVITY.items()}
    warmer_k = {one: -1.0 if inside else 1.0 for one in seen}
    for _ in range(5 if balance else 1):
        coefficient = {one: value["film factor"] * (2.5 if inside else 4.0 + 4.0 * value["wind"]) for one in seen}
        if balance:
            drawn = formulas[int(value[FORMULA])].w_m2k
            coefficient = {one: np.ravel(drawn(value["wind"], warmer_k[one], np.zeros(1))).item() for one in seen}
        effects = (
            Convection(patches if inside else ("room",), 25.0 if inside else 1.0 / R_INSIDE, other_air),
            *[Convection((one,), coefficient[one], air) for one in seen],
            Radiation(seen, value[emissivity_name(conditions, 0)], Varying(around_c, in_time=False)),
        )
        problem = HeatProblem(mesh, {n: materials[n] for n in mesh.region_names}, effects=effects, up=UP)
        solution = solve_steady(problem)
        for one in seen:
            facets = mesh.facets[mesh.boundary.patch == names.index(one)]
            warmer_k[one] = float(solution.temperature_c[facets].mean()) - air
    results = heat_results(problem, solution)
    outwards = 1.0 if inside else -1.0
    flow = {one.patch: outwards * one.heat_w for one in results.patches if one.patch in seen}
    area = {one.patch: one.area_m2 for one in results.patches}
    difference = value["inside air"] - value["outside air"]
    u = {name: flow[name] / area[name] / difference for name in seen}
    return Truth(replace(mesh, temperature_c=solution.temperature_c), sum(flow.values()), u, area, flow, draws)


def photographed(truth: Truth, conditions: Conditions, seed: int | None = None) -> TetMesh:
    """The mesh with what a camera says of each node: offset, drift over the wall, noise, emissivity, reflection."""
    mesh, draws = truth.mesh, truth.draws
    nodes = np.unique(mesh.facets[mesh.boundary.seen])
    normal = np.zeros((len(mesh.points_m), 3))
    np.add.at(
        normal, mesh.facets[mesh.boundary.seen], facet_normals(mesh.points_m, mesh.facets)[mesh.boundary.seen][:, None]
    )
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = normal / np.where(length > 0.0, length, 1.0)
    emissivity = float(draws[emissivity_name(conditions, 0)][0])
    around_k4 = radiant_k4(conditions, draws, normal @ np.array(UP))[:, 0]
    arrives = emissivity * celsius_to_kelvin(mesh.temperature_c) ** 4 + (1.0 - emissivity) * around_k4
    reading = kelvin_to_celsius(arrives**0.25) - float(draws["camera offset"][0])
    if seed is not None:
        generator = np.random.default_rng((seed, 7))
        # What is left of drift between images: smooth over the wall, within what the conditions state.
        size = conditions.camera.repeatability.off_by
        waves = generator.uniform(-1.0, 1.0, (3, 3)) @ mesh.points_m.T * 2.0 + generator.uniform(0, 6, (3, 1))
        reading = reading + size * 0.5 * np.sin(waves).mean(axis=0)
        reading = reading + generator.normal(0.0, 0.1, len(reading)) / np.sqrt(4.0)
    observed = np.zeros(len(mesh.points_m), dtype=bool)
    observed[nodes] = True
    return replace(mesh, temperature_c=np.where(observed, reading, -50.0), observed=observed)


CONTACT_M, CONTACT_OFF_K = (1.0, 0.0, 2.5), 0.2


def with_contact(
    conditions: Conditions, truth: Truth, seed: int, at: tuple[float, float, float] = CONTACT_M
) -> Conditions:
    """The conditions with a contact temperature that is as wrong as it may be."""
    points = truth.mesh.points_m
    nearest = int(np.argmin(np.linalg.norm(points - np.array(at), axis=1)))
    off = np.random.default_rng((seed, 11)).uniform(-CONTACT_OFF_K, CONTACT_OFF_K)
    measured = Measured(float(truth.mesh.temperature_c[nearest]) + off, CONTACT_OFF_K)
    return replace(conditions, references=(Reference(at, measured),))


def calibrated(side: Side, seed: int, step: float = 0.1) -> Iterator[tuple[str, float, Interval]]:
    """Calibrate a wall, seen from outside with a window in it; yield each property, its truth and what was found."""
    outside = side == "outside"
    stated = STATED if outside else INSIDE
    truth = solve_wall(audited_wall(step, slab=False, window=outside, side=side), stated, true_draws(stated, seed))
    conditions = with_contact(stated, truth, seed) if outside else stated
    names = [name for name in CONDUCTIVITY if name in truth.mesh.region_names]
    start = {name: Measured(factor * CONDUCTIVITY[name]) for name, factor in zip(names, (2.0, 0.5))}
    unknown = tuple(Unknown("conductivity", name) for name in names)
    asked = Calibrate(start, unknown, behind=("room",) if outside else ("facade",))
    found = audit(photographed(truth, conditions, seed), replace(conditions, calibrate=asked), UP).calibration
    assert found is not None and not found.refused, found
    for name in names:
        yield f"conductivity of {name}", CONDUCTIVITY[name], found.found[f"conductivity of {name}"]


CAPACITY_KJ_M3K = 980.0  # The slowest mode of the wall, with films of 12.5 and 7.7 W/(m2 K), decays within 12 h
_BEFORE_H = 120.0  # How long before the survey the true weather begins


@cache
def after_a_warm_day(
    side: Side, seed: int, folder: Path, history_h: float = 48.0, step: float = 1.0
) -> tuple[Truth, Conditions]:
    """A wall that is followed through 120 h of weather of its own; the conditions know the last `history_h` of it.

    The air outside has a daily wave of 4 to 8 K, a trend and weather of its own; the sun shines on the wall by day, the
    room is 2 K colder at night. The survey is at five in the morning. The truth is solved on cells of 12.5 mm.
    """
    stated = STATED if side == "outside" else INSIDE
    draws, own = true_draws(stated, seed), np.random.default_rng((seed, 13))
    value = {name: float(values[0]) for name, values in draws.values.items()}
    hours = np.arange(-_BEFORE_H, 1.0)
    clock = (hours + 5.0) % 24.0
    outside = own.uniform(4.0, 8.0) * np.cos(2.0 * np.pi * (clock - 15.0) / 24.0) + own.uniform(-0.05, 0.05) * hours
    outside += np.convolve(own.normal(0.0, 1.0, len(hours) + 11), np.ones(12) / 6.0, "valid")
    outside -= outside[-1]
    room = np.where((clock >= 6.0) & (clock < 22.0), 2.0, 0.0)
    sun = (
        own.uniform(0.0, 300.0) * np.maximum(np.sin(np.pi * (clock - 8.0) / 9.0), 0.0) * (clock > 8.0) * (clock < 17.0)
    )
    absorptance, capacity = own.uniform(0.4, 0.8), CAPACITY_KJ_M3K * own.uniform(0.9, 1.1)

    def changes(values: npt.NDArray[np.float64], time_s: float) -> float:
        return float(np.interp(time_s / 3600.0 - _BEFORE_H, hours, values))

    def around_c(places: Places, time_s: float) -> npt.NDArray[np.float64]:
        if side == "inside":
            return np.full(len(places), value["reflected temperature"] + changes(room, time_s))
        moved = {name: draws[name] + changes(outside, time_s) for name in ("outside air", "dew point")}
        return radiant_c(stated, Draws({**draws.values, **moved}), places.normals)

    def air(name: str, values: npt.NDArray[np.float64]) -> Varying:
        return tabulated(3600.0 * (hours + _BEFORE_H), value[name] + values)

    near, far = ("x1", "x0") if side == "inside" else ("x0", "x1")
    film = value["film factor"] * (2.5 if side == "inside" else 4.0 + 4.0 * value["wind"])
    airs = {"x0": air("outside air", outside), "x1": air("inside air", room)}
    effects = (
        Convection((near,), film, airs[near]),
        Convection((far,), 25.0 if side == "inside" else 1.0 / R_INSIDE, airs[far]),
        Radiation((near,), value[emissivity_name(stated, 0)], Varying(around_c)),
        AbsorbedSolar(("x0",), absorptance, tabulated(3600.0 * (hours + _BEFORE_H), sun)),
    )
    column = box_mesh(planes(0.0, WALL_M, step=0.0125), [0.0, 1.0], [0.0, 1.0])
    material = Material("wall", CONDUCTIVITY["wall"], 1000.0, capacity)
    problem = HeatProblem(column, material, np.full(len(column.points_m), 10.0), effects, UP)
    start_c = solve_steady(problem).temperature_c
    problem = replace(problem, initial_temperature_c=start_c)
    end_c = solve_heat(problem, TimeSteps(160, 2700.0), scheme=SDIRK2).temperature_c[-1]
    depth, first = np.unique(column.points_m[:, 0], return_index=True)
    mesh = audited_wall(step, slab=False, window=False, side=side)
    mesh = replace(mesh, temperature_c=np.interp(mesh.points_m[:, 1], depth, end_c[first]))
    table = np.stack([hours, stated.outside.air.value + outside, stated.inside.air.value + room, sun], axis=1)
    file = folder / f"{side}-{seed}.csv"
    np.savetxt(file, table[hours >= -history_h], "%.6g", ",", header="hours,outside_c,inside_c,sun_w_m2", comments="")
    conditions = replace(stated, weather=Weather(str(file), absorptance=Measured(0.6, 0.2)))
    return Truth(mesh, 0.0, {}, {}, {}, draws), conditions


def calibrated_after(
    side: Side, seed: int, folder: Path, history_h: float = 48.0, steady: bool = False
) -> tuple[Interval, Calibration]:
    """Calibrate the conductivity of a wall `after_a_warm_day`, with its history or as if heat flow were steady.

    The interval is NaN where the calibration refuses to answer.
    """
    truth, conditions = after_a_warm_day(side, seed, folder, history_h)
    conditions = with_contact(conditions, truth, seed) if side == "outside" else conditions
    capacity = {} if steady else {"wall": Measured(CAPACITY_KJ_M3K, 0.1 * CAPACITY_KJ_M3K)}
    asked = Calibrate(
        {"wall": Measured(2.0 * CONDUCTIVITY["wall"])},
        (Unknown("conductivity", "wall"),),
        behind=("room",) if side == "outside" else ("facade",),
        heat_capacity=capacity,
    )
    found = audit(photographed(truth, conditions, seed), replace(conditions, calibrate=asked), UP).calibration
    return found.found.get("conductivity of wall", Interval(np.nan, np.nan, np.nan)), found
