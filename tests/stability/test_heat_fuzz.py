from dataclasses import replace

import numpy as np
import pytest

from tests.support.heat_meshes import box_mesh
from tests.support.obtuse_bodies import AT_THE_BOUNDS, H, body, dressed
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem, TimeSteps
from thermoxels_ns.fem.quantities import Varying
from thermoxels_ns.fem.solution import HeatSolution, SteadySolution
from thermoxels_ns.fem.steady import OVERSHOOT_K, solve_steady
from thermoxels_ns.fem.time_loop import solve_heat
from thermoxels_ns.heat.effects import Convection, Effect, FixedTemperature, HeatFlux, InternalHeat, Radiation
from thermoxels_ns.heat.materials import Material
from thermoxels_ns.mesh.tetrahedra import TetMesh

SEEDS = range(72)
PER_TEST = 12
SWING_C = 20.0, 10.0
"""Middle and size of an air temperature that swings."""
REASONS = (
    "steady heat problem: expected convection",
    "heat capacity: expected at least 1 J",
    "convection coefficient: expected at most 1e+10 times",
    "below absolute zero",
    "fixed temperature: expected one temperature at each node",
)

Time = TimeSteps | AdaptiveSteps | None


def drawn_mesh(rng: np.random.Generator) -> TetMesh:
    """A block, two blocks, a torn block or a conforming body, of voxels from 1 mm to 1 m."""
    kind = str(rng.choice(["block", "two", "torn", "sphere", "torus", "slab at 30 degrees", AT_THE_BOUNDS]))
    if kind in ("block", "two", "torn"):
        axis = H * np.arange(6.0)
        torn = rng.random((5, 5, 5)) < 0.3

        def keep(centre):
            cell = np.floor(centre / H).astype(int)
            if kind == "two":
                return cell[..., 0] != 2
            return ~torn[cell[..., 0], cell[..., 1], cell[..., 2]] if kind == "torn" else np.ones(cell.shape[:-1], bool)

        mesh = dressed(box_mesh(axis, axis, axis, keep=keep), regions=True)
    else:
        mesh = body(kind, regions=True)
    nodes, size = len(mesh.points_m), float(rng.choice([0.02, 1.0, 20.0]))
    starts = (np.full(nodes, 20.0), rng.choice([-30.0, 20.0, 90.0], nodes), np.linspace(20.0, 70.0, nodes))
    return replace(mesh, points_m=size * mesh.points_m, temperature_c=starts[rng.integers(3)])


def drawn_effect(rng: np.random.Generator, duration_s: float) -> Effect:
    where = ("*",) if rng.random() < 0.4 else (str(rng.choice(["x0", "x1"])),)
    given_c, strength = float(rng.uniform(-40.0, 80.0)), float(rng.uniform(-1.0, 1.0) * 10.0 ** rng.uniform(0.0, 3.0))
    middle, size = SWING_C
    period_s = duration_s / 20.0
    swing = Varying(lambda _, time_s: middle + size * np.sin(time_s / period_s), resolution_s=period_s)
    choices = (
        lambda: Convection(where, float(10.0 ** rng.uniform(-6.0, 5.0)), given_c),
        lambda: Convection(where, 10.0, swing),
        lambda: FixedTemperature(("x0",), given_c),
        lambda: Radiation(where, float(rng.uniform(0.05, 1.0)), float(rng.choice([-270.15, -40.0, 20.0, 726.85]))),
        lambda: HeatFlux(where, strength),
        lambda: InternalHeat(("*",), strength),
    )
    return choices[rng.integers(len(choices))]()


def drawn(seed: int) -> tuple[HeatProblem, Time]:
    rng = np.random.default_rng(seed)
    mesh = drawn_mesh(rng)
    conductivity = float(rng.choice([0.04, 1.7, 200.0]))
    capacity = float(rng.choice([880.0, 880.0, 1.0, 1e-9]))
    even = Material("even", conductivity, 2200.0, capacity)
    odd = Material("odd", conductivity * float(rng.choice([1.0, 1e-6, 1e3, 1e6])), 2200.0, 880.0)
    voxel_m = float(np.ptp(mesh.points_m[:, 0])) / 5.0
    step_s = float(10.0 ** rng.uniform(-3.0, 6.0)) * voxel_m**2 / (conductivity / (2200.0 * 880.0))
    times: tuple[Time, ...] = (
        TimeSteps(int(rng.integers(1, 4)), step_s),
        AdaptiveSteps(min(step_s, 100.0 * voxel_m**2 / (conductivity / 2e6)), 0.5, outputs=2),
        None,
    )
    time = times[rng.choice(3, p=[0.5, 0.2, 0.3])]
    duration_s = 1e6 if time is None else time.duration_s
    effects = tuple(drawn_effect(rng, duration_s) for _ in range(rng.integers(1, 4)))
    used = {mesh.region_names[number] for number in np.unique(mesh.region)}
    materials = {name: material for name, material in (("even", even), ("odd", odd)) if name in used}
    return HeatProblem(mesh, materials, effects=effects), time


def allowed_c(problem: HeatProblem, steady: bool) -> tuple[float, float]:
    """What no temperature may leave."""
    ends = [] if steady else [float(problem.start_c.min()), float(problem.start_c.max())]
    for effect in problem.effects:
        if isinstance(effect, HeatFlux | InternalHeat):
            given = effect.flux_w_m2 if isinstance(effect, HeatFlux) else effect.source_w_m3
            ends.append(float(np.copysign(np.inf, given)))
        elif isinstance(effect, Radiation):
            ends.append(effect.surroundings_c)
        elif isinstance(effect, FixedTemperature):
            ends.append(effect.temperature_c)
        elif isinstance(effect, Convection):
            swings = isinstance(effect.air_c, Varying)
            ends += [SWING_C[0] - SWING_C[1], SWING_C[0] + SWING_C[1]] if swings else [effect.air_c]
    return min(ends), max(ends)


def faults(problem: HeatProblem, time: Time, solution: HeatSolution | SteadySolution) -> list[str]:
    temperature_c, (low, high) = solution.temperature_c, allowed_c(problem, time is None)
    beyond_k = max(low - float(temperature_c.min()), float(temperature_c.max()) - high)
    found = {
        "not finite": not np.isfinite(temperature_c).all(),
        f"energy {solution.energy_residual:.1e}": not solution.energy_residual < 1e-9,
        f"silent about {beyond_k:.1e} K": beyond_k > OVERSHOOT_K and "the range of the" not in solution.status,
    }
    return [fault for fault, wrong in found.items() if wrong]


@pytest.mark.parametrize("first", range(SEEDS.start, SEEDS.stop, PER_TEST))
def test_what_is_drawn_is_solved_or_refused_with_a_reason(first) -> None:
    wrong, solved = [], 0
    for seed in range(first, first + PER_TEST):
        problem, time = drawn(seed)
        what = f"seed {seed}, {[effect.label for effect in problem.effects]}, {time}"
        try:
            solution = solve_steady(problem) if time is None else solve_heat(problem, time)
        except HeatError as refusal:
            if not any(reason in str(refusal) for reason in REASONS):
                wrong.append(f"{what}: {refusal}")
            continue
        solved += 1
        wrong += [f"{what}: {fault}; {solution.status}" for fault in faults(problem, time, solution)]
    assert wrong == []
    assert solved >= PER_TEST // 3
