"""What is left out does not matter: bounds hold on random problems, and are sharp where the answer is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.heat_meshes import SIDES, box_mesh, planes
from thermoxels_ns.errors import HeatError
from thermoxels_ns.fem import nodal_heat
from thermoxels_ns.fem.effects import (
    AbsorbedSolar,
    Convection,
    Effect,
    FixedTemperature,
    GroundContact,
    HeatFlux,
    InternalHeat,
    Radiation,
)
from thermoxels_ns.fem.materials import Material
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem, TimeSteps
from thermoxels_ns.fem.quantities import Varying
from thermoxels_ns.fem.screening import screen
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.stepping import solve_heat
from thermoxels_ns.fem.system import effect_labels
from thermoxels_ns.mesh.tetrahedra import TetMesh

CONCRETE = Material("concrete", 1.7, 2200.0, 880.0)
STEEL = Material("steel", 50.0, 7800.0, 450.0)
EVERYTHING = 1e9
"""A tolerance that leaves out whatever can be bounded."""


def body(seed: int, *, shaken: float = 0.0) -> TetMesh:
    """A carved box, its start between -10 and 40 degrees; shaken nodes make obtuse angles."""
    rng = np.random.default_rng(seed)
    sizes = rng.integers(2, 6, 3)
    step = float(rng.choice([0.02, 0.1]))
    hole = rng.uniform(0.3, 0.7, 3) * sizes * step
    mesh = box_mesh(
        *(planes(0.0, float(n) * step, step=step) for n in sizes),
        keep=lambda p: ~np.all(np.abs(p - hole) < 0.6 * step, axis=-1) | (p[..., 0] < step),
    )
    inner = np.all((mesh.points_m > 0) & (mesh.points_m < sizes * step), axis=1)
    points = mesh.points_m + shaken * step * rng.uniform(-1, 1, mesh.points_m.shape) * inner[:, None]
    return replace(mesh, points_m=points, temperature_c=rng.uniform(-10.0, 40.0, len(points)))


def random_effect(rng: np.random.Generator, mesh: TetMesh) -> Effect:
    """Any effect but a fixed temperature, from feeble to strong."""
    where, strength = (str(rng.choice(SIDES)),), float(10.0 ** rng.uniform(-5.0, 0.5))
    air_c = float(rng.uniform(-20.0, 40.0))
    slow = Varying(lambda places, time_s: air_c + 5.0 * np.sin(time_s / 500.0 + places.points_m[:, 1]))
    return [
        Convection(where, 20.0 * strength, slow if rng.random() < 0.3 else air_c),
        Radiation(where, min(strength, 1.0), air_c),
        AbsorbedSolar(where, 0.6, 500.0 * strength),
        HeatFlux(where, float(rng.normal()) * 100.0 * strength),
        GroundContact(where, 1.0 / strength, air_c),
        InternalHeat(("*",), float(rng.normal()) * 1000.0 * strength),
    ][rng.integers(6)]


def differences(problem: HeatProblem, without: HeatProblem, time) -> tuple[float, float, float]:
    """Largest difference of any temperature, of any kept effect's mean heat, and the largest mean heat left out."""
    if time is None:
        with_all, left = solve_steady(problem), solve_steady(without)
        duration, lengths = 1.0, np.ones(1)
    else:
        with_all, left = solve_heat(problem, time), solve_heat(without, time)
        duration, lengths = with_all.times_s[-1], np.diff(with_all.times_s)
    mean = {h.effect: float(h.heat_w @ lengths) / duration for h in with_all.effects}
    kept = {h.effect: float(h.heat_w @ lengths) / duration for h in left.effects}
    change = max((abs(mean[name] - heat) for name, heat in kept.items()), default=0.0)
    gone = max((abs(heat) for name, heat in mean.items() if name not in kept), default=0.0)
    return float(np.abs(with_all.temperature_c - left.temperature_c).max()), change, gone


@pytest.mark.parametrize("seed", range(24))
def test_screening_never_changes_an_answer_by_more_than_its_bound(seed) -> None:
    rng = np.random.default_rng(100 + seed)
    mesh = body(seed)
    effects = [random_effect(rng, mesh) for _ in range(rng.integers(1, 6))]
    if rng.random() < 0.3:
        effects.append(FixedTemperature((str(rng.choice(SIDES)),), float(rng.uniform(-10.0, 40.0))))
    material = STEEL if rng.random() < 0.3 else CONCRETE
    time = TimeSteps(int(rng.integers(1, 6)), float(10.0 ** rng.uniform(0.0, 5.0)))
    labelled = {
        label: effect
        for effect, label in zip(effects, effect_labels(HeatProblem(mesh, material, effects=tuple(effects))))
    }
    problem = HeatProblem(mesh, material, effects=tuple(labelled.values()))
    for tolerance_k in (0.01, 1.0, EVERYTHING):
        screening = screen(problem, time, tolerance_k)
        assert len(screening.kept) + len(screening.left_out) == len(effects)
        assert screening.bound_k <= tolerance_k
        if not screening.left_out or len({effect.label for effect in effects}) < len(effects):
            continue
        difference_k, change_w, gone_w = differences(problem, screening.problem, time)
        most_w = sum(entry.bound_w for entry in screening.left_out)
        assert difference_k <= screening.bound_k * (1 + 1e-9) + 1e-9, screening.left_out
        assert change_w <= most_w * (1 + 1e-9) + 1e-9 and gone_w <= most_w * (1 + 1e-9) + 1e-9
