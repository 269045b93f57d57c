from dataclasses import replace
from datetime import datetime, timezone

import numpy as np
import pytest
from scipy.spatial import Delaunay

from tests.support.heat_bodies import CONCRETE, STEEL
from tests.support.heat_meshes import SIDES, box_mesh, mesh_from, planes
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem, TimeSteps, effect_labels
from thermoxels_ns.fem.quantities import Varying, tabulated
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.time_loop import solve_heat
from thermoxels_ns.heat.effects import (
    AbsorbedSolar,
    Convection,
    Effect,
    FixedTemperature,
    GroundContact,
    HeatFlux,
    InternalHeat,
    Radiation,
)
from thermoxels_ns.heat.screening import nodal_heats, screen
from thermoxels_ns.heat.sun import moving_sun
from thermoxels_ns.mesh.tetrahedra import Boundary, TetMesh

EVERYTHING = 1e9
"""A tolerance that leaves out whatever can be bounded."""


def body(seed: int) -> TetMesh:
    """A carved box, its start between -10 and 40 degrees."""
    rng = np.random.default_rng(seed)
    sizes = rng.integers(2, 6, 3)
    step = float(rng.choice([0.02, 0.1]))
    hole = rng.uniform(0.3, 0.7, 3) * sizes * step
    mesh = box_mesh(
        *(planes(0.0, float(n) * step, step=step) for n in sizes),
        keep=lambda p: ~np.all(np.abs(p - hole) < 0.6 * step, axis=-1) | (p[..., 0] < step),
    )
    return replace(mesh, temperature_c=rng.uniform(-10.0, 40.0, len(mesh.points_m)))


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


@pytest.mark.parametrize("seed", range(12))
def test_bounds_hold_in_steady_states(seed) -> None:
    rng = np.random.default_rng(300 + seed)
    mesh = body(seed)
    everywhere = Convection(("*",), float(rng.uniform(2.0, 25.0)), float(rng.uniform(-10.0, 30.0)))
    surface = [
        effect for effect in (random_effect(rng, mesh) for _ in range(4)) if not isinstance(effect, InternalHeat)
    ]
    problem = HeatProblem(mesh, CONCRETE, effects=(everywhere, *surface))
    for tolerance_k in (0.1, 300.0):
        screening = screen(problem, None, tolerance_k)
        assert everywhere in screening.problem.effects, "the only exchange of some nodes"
        assert screening.bound_k <= tolerance_k
        difference_k, _, _ = differences(problem, screening.problem, None)
        assert difference_k <= screening.bound_k * (1 + 1e-6) + 1e-9, screening.left_out


@pytest.mark.parametrize("seed", range(6))
def test_bounds_hold_with_adaptive_steps(seed) -> None:
    """Up to what the steps themselves are allowed to be wrong by, in either computation."""
    rng = np.random.default_rng(500 + seed)
    mesh = body(seed)
    problem = HeatProblem(mesh, CONCRETE, effects=tuple(random_effect(rng, mesh) for _ in range(3)))
    time = AdaptiveSteps(3000.0, 0.01, outputs=2)
    screening = screen(problem, time, 5.0)
    difference_k, _, _ = differences(problem, screening.problem, time)
    assert difference_k <= screening.bound_k + 2 * 0.01, screening.left_out


def delaunay_box(seed: int, side_m: float) -> TetMesh:
    """A box of tetrahedra between random points, with as many obtuse angles as they happen to make."""
    rng, corners = np.random.default_rng(seed), np.stack(np.meshgrid(*[[0.0, side_m]] * 3)).reshape(3, -1).T
    points, axis, end = rng.uniform(0.0, side_m, (150, 3)), rng.integers(0, 3, 150), rng.random(150)
    for low, position in ((end < 0.3, 0.0), (end > 0.7, side_m)):
        points[low, axis[low]] = position
    points = np.concatenate([points, corners])
    tets = Delaunay(points).simplices
    sides = points[tets][:, 1:] - points[tets][:, :1]
    volume = np.linalg.det(sides)
    tets = np.where((volume < 0.0)[:, None], tets[:, [1, 0, 2, 3]], tets)[np.abs(volume) > 1e-6 * side_m**3]
    used, numbers = np.unique(tets, return_inverse=True)
    mesh = mesh_from(points[used], numbers.reshape(tets.shape), 0.0)
    where = mesh.points_m[mesh.facets].mean(axis=1)
    patch = np.where(where[:, 0] < 1e-9, 0, np.where(where[:, 1] < 1e-9, 1, 2))
    boundary = Boundary(
        np.zeros((len(patch), 3)), np.ones(len(patch)), np.ones(len(patch), bool), patch, ("x0", "y0", "rest")
    )
    return replace(mesh, boundary=boundary)


def test_with_obtuse_angles_only_what_does_nothing_at_all_is_left_out() -> None:
    hot, time = FixedTemperature(("x0",), 100.0), TimeSteps(5, 1.0)
    nothing, idle_air = HeatFlux(("rest",), 0.0), Convection(("rest",), 0.0, -50.0)
    radiation = Radiation(("y0", "rest"), 1e-6, 2500.0)
    problem = HeatProblem(delaunay_box(5, 0.25), STEEL, effects=(hot, nothing, idle_air, radiation))
    screening = screen(problem, time, 0.05)
    assert [entry.effect for entry in screening.left_out] == ["heat flux on rest", "convection on rest"]
    assert screening.kept[1].bound_k is not None and screening.kept[1].bound_k < 0.05
    assert "obtuse" in screening.note and "obtuse" in screening.kept[1].reason


def slab(temperature_c: float = 20.0) -> TetMesh:
    return box_mesh(planes(0.0, 0.2, step=0.02), [0.0, 0.1], [0.0, 0.1], temperature_c=temperature_c)


def test_a_steady_bound_is_flux_over_coefficient() -> None:
    """Sun of 60 W/m2 on a wall with 25 W/(m2 K): 2.4 K at most; it makes 2.4 K less what flows through the wall."""
    effects = (Convection(("x0",), 8.0, 20.0), Convection(("x1",), 25.0, 0.0), AbsorbedSolar(("x1",), 0.6, 100.0))
    problem = HeatProblem(slab(), CONCRETE, effects=effects)
    screening = screen(problem, None, 2.41)
    assert [entry.effect for entry in screening.left_out] == ["absorbed solar on x1"]
    assert screening.left_out[0].bound_k == pytest.approx(2.4, rel=1e-12)
    assert screening.left_out[0].bound_w == pytest.approx(0.6, rel=1e-12)
    assert "carries its heat away" in screening.left_out[0].reason
    difference_k, _, _ = differences(problem, screening.problem, None)
    assert 1.9 < difference_k <= 2.4
    kept = screen(problem, None, 2.39)
    assert kept.left_out == () and kept.problem is problem
    assert kept.kept[2].bound_k == pytest.approx(2.4) and "above the tolerance" in kept.kept[2].reason


def test_a_flux_for_a_short_time_knows_the_depth() -> None:
    """An insulated wall, 10 W/m2 for 10 minutes: the surface rises 2 q sqrt(t / (pi k rho c)) = 0.152 K."""
    problem = HeatProblem(slab(), CONCRETE, effects=(HeatFlux(("x0",), 10.0),))
    exact = 2.0 * 10.0 * np.sqrt(600.0 / (np.pi * 1.7 * 2200.0 * 880.0))
    screening = screen(problem, TimeSteps(10, 60.0), 0.31)
    assert exact == pytest.approx(0.1524, abs=1e-4)
    # 2 max v, and the v of one implicit step is sqrt(pi) / 2 of the exact rise at the surface.
    assert exact < screening.left_out[0].bound_k < 2.0 * 1.02 * exact
    assert "depth" in screening.left_out[0].reason


def test_a_source_in_an_insulated_body_is_exact() -> None:
    problem = HeatProblem(slab(), CONCRETE, effects=(InternalHeat(("*",), -50.0),))
    screening = screen(problem, TimeSteps(4, 3600.0), 1.0)
    assert screening.left_out[0].bound_k == pytest.approx(50.0 * 14400.0 / (2200.0 * 880.0), rel=1e-9)
    assert differences(problem, screening.problem, TimeSteps(4, 3600.0))[0] == pytest.approx(
        screening.bound_k, rel=1e-9
    )


def test_a_jump_between_kept_times_is_not_missed_by_equal_steps() -> None:
    """Equal steps ask at their ends; that is where the bound looks, also at an irradiance of one step only."""
    flash = Varying(lambda places, time_s: 1000.0 if 170.0 < time_s < 190.0 else 0.0)
    problem = HeatProblem(slab(), CONCRETE, effects=(AbsorbedSolar(("x0",), 1.0, flash),))
    time = TimeSteps(5, 60.0)
    screening = screen(problem, time, EVERYTHING)
    assert 0.0 < differences(problem, screening.problem, time)[0] <= screening.bound_k


def test_together_they_keep_within_the_tolerance() -> None:
    """Four of 0.4 times the tolerance each: two may go."""
    sources = tuple(HeatFlux((side,), 1.0) for side in ("x0", "x1", "y0", "y1"))
    air = Convection(("*",), 10.0, 20.0)
    mesh = box_mesh(*(planes(0.0, 0.2, step=0.05) for _ in range(3)))
    problem = HeatProblem(mesh, CONCRETE, effects=(air, *sources))
    alone = screen(problem, None, EVERYTHING).left_out[0].bound_k
    assert alone == pytest.approx(0.1)
    screening = screen(problem, None, 0.25)
    assert len(screening.left_out) == 2 and screening.bound_k == pytest.approx(0.2)
    assert len(screening.problem.effects) == 3


def test_the_only_exchange_of_a_steady_body_stays() -> None:
    """Air as warm as the body brings no heat, but without it there is no steady state."""
    problem = HeatProblem(slab(20.0), CONCRETE, effects=(Convection(("x0",), 5.0, 20.0),))
    assert screen(problem, None, 1.0).left_out == ()
    assert len(screen(problem, TimeSteps(3, 60.0), 1.0).left_out) == 1
    two = replace(problem, effects=(*problem.effects, Convection(("x1",), 5.0, 20.0)))
    assert len(screen(two, None, 1.0).left_out) == 1


def test_what_fixes_temperatures_stays() -> None:
    problem = HeatProblem(slab(), CONCRETE, effects=(FixedTemperature(("x0",), 20.0), HeatFlux(("x0",), 1e6)))
    screening = screen(problem, TimeSteps(3, 60.0), 1.0)
    assert [(entry.effect, entry.bound_k) for entry in screening.kept] == [("fixed temperature on x0", None)]
    # A flux onto a fixed surface changes no temperature, and all of its heat.
    assert screening.left_out[0].bound_k == 0.0 and screening.left_out[0].bound_w == pytest.approx(1e4)


def test_quantities_that_change_between_samples_are_bounded() -> None:
    """Adaptive steps ask at any time: peaks lie between the times at which the bound asks."""
    time = AdaptiveSteps(1000.0)
    step = 1000.0 / 240.0

    def wave(resolution_s: float) -> HeatProblem:
        cosine = lambda places, time_s: 100.0 + 50.0 * np.cos(2.0 * np.pi * (time_s / step - 0.5) / 8.0)  # noqa: E731
        flux = HeatFlux(("x0",), Varying(cosine, resolution_s=resolution_s))
        return HeatProblem(slab(), CONCRETE, effects=(flux,))

    heat = nodal_heats(wave(2.0 * step), time)[0]
    assert 0.01 * 150.0 < heat.heating_w.sum() < 0.01 * 150.0 * 1.25
    assert np.isinf(nodal_heats(wave(np.inf), time)[0].heating_w).any(), "nobody knows what it is in between"
    only_there = nodal_heats(wave(np.inf), TimeSteps(240, step))[0]
    assert only_there.heating_w.sum() == pytest.approx(0.01 * (100.0 + 50.0 * np.cos(np.pi / 8.0)), rel=1e-9)


@pytest.mark.parametrize("step_s", [0.1, 10.0, 3600.0])
def test_a_pulse_of_one_of_many_equal_steps_is_not_missed(step_s) -> None:
    """Also where the end of a step, as the solver adds it up, is not its number times its length."""
    for number in (1, 6, 1001, 2399, 2400):
        end_s = TimeSteps(2400, step_s).times_s[number - 1] + step_s
        pulse = Varying(lambda places, time_s, end_s=end_s: 2000.0 if time_s == end_s else 0.0)
        problem = HeatProblem(slab(), CONCRETE, effects=(HeatFlux(("x0",), pulse),))
        assert screen(problem, TimeSteps(2400, step_s), 1e-3).left_out == ()


@pytest.mark.parametrize("shift", [0.0, 0.25, 0.5, 0.9])
@pytest.mark.parametrize("hours", [10, 240, 241])
def test_no_entry_of_a_table_is_missed_between_looks(shift, hours) -> None:
    """A zigzag looked at as often as it turns may seem to stand still."""
    zigzag = tabulated(3600.0 * (np.arange(hours + 2) - shift), np.arange(hours + 2) % 2 * 2000.0)
    problem = HeatProblem(slab(), CONCRETE, effects=(HeatFlux(("x0",), zigzag),))
    heat = nodal_heats(problem, AdaptiveSteps(3600.0 * hours))[0]
    assert heat.heating_w.sum() >= 0.01 * 2000.0 * (1.0 - 1e-12)


def test_the_sun_is_not_left_out_because_every_look_at_it_is_at_midnight() -> None:
    mesh = replace(slab(), temperature_c=np.full(len(slab().points_m), 5.0))
    start = datetime(2026, 10, 1, tzinfo=timezone.utc)
    sun = AbsorbedSolar(SIDES, 0.7, moving_sun(start, 50.0, 0.0, (0.0, 1.0, 0.0)))
    problem = HeatProblem(mesh, CONCRETE, effects=(Convection(SIDES, 10.0, 5.0), sun))
    days = 240 * 86400.0
    for time in (AdaptiveSteps(days), TimeSteps(5760, 3600.0)):
        screening = screen(problem, time, 0.01)
        kept = {entry.effect.split(" on ")[0]: entry.bound_k for entry in screening.kept}
        assert kept["absorbed solar"] is not None and kept["absorbed solar"] > 10.0
    # A night is looked at often enough to know that it is dark.
    night = screen(problem, AdaptiveSteps(3 * 3600.0), 0.01)
    assert "absorbed solar" in [left.effect.split(" on ")[0] for left in night.left_out]


def test_nothing_that_matters_to_heat_flows_is_left_out_at_a_tolerance_of_zero() -> None:
    """A flux onto a fixed surface changes no temperature, but all of its heat comes in and goes out."""
    effects = FixedTemperature(("x0",), 20.0), HeatFlux(("x0",), 1e6), HeatFlux(("x1",), 0.0)
    screening = screen(HeatProblem(slab(), CONCRETE, effects=effects), None, 0.0)
    assert [entry.effect for entry in screening.left_out] == ["heat flux on x1"]
    assert "heat flows" in screening.kept[1].reason


def test_what_is_left_out_holds_nothing_any_more() -> None:
    """Convection alone would keep the flux's heat down; where both are left out, nothing does."""
    flux_w_m2, seconds = 100.0, 3600.0
    problem = HeatProblem(slab(), CONCRETE, effects=(HeatFlux(("*",), flux_w_m2), Convection(("*",), 2000.0, 20.0)))
    time = TimeSteps(4, seconds / 4)
    both = screen(problem, time, EVERYTHING)
    assert [entry.effect for entry in both.left_out] == ["heat flux on *", "convection on *"]
    alone = screen(problem, time, 0.1)
    assert [entry.effect for entry in alone.left_out] == ["heat flux on *"]
    assert alone.left_out[0].bound_k == pytest.approx(flux_w_m2 / 2000.0, rel=1e-3)
    # Nodes on edges of the slab store least beside their area: they own a corner of a cell of 2 cm.
    assert both.left_out[0].bound_k > 1.0 > 10.0 * alone.left_out[0].bound_k


@pytest.mark.parametrize("flux_w_m2", [-1000.0, 1000.0])
def test_what_a_flux_does_to_the_body_counts_for_the_exchange_beside_it(flux_w_m2) -> None:
    """Body and air begin at 20 degrees: only what the flux does makes convection bring or take heat."""
    problem = HeatProblem(slab(), CONCRETE, effects=(HeatFlux(("x0",), flux_w_m2), Convection(("x1",), 10.0, 20.0)))
    screening = screen(problem, TimeSteps(4, 3600.0), 0.0)
    assert screening.left_out == ()
    assert [entry.bound_k is not None and entry.bound_k > 0.0 for entry in screening.kept] == [True, True]
