"""Steady states stay in the range of what surrounds the body, also where obtuse angles would let them leave it."""

from dataclasses import replace

import numpy as np
import pytest

from tests.support.heat_meshes import SIDES, box_mesh
from tests.support.obtuse_bodies import AT_THE_BOUNDS, CONCRETE, body
from thermoxels_ns.fem import steady
from thermoxels_ns.fem.implicit_equation import ImplicitEquation
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.fem.quantities import Varying
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.system import HeatSystem
from thermoxels_ns.heat.effects import Convection, Effect, FixedTemperature, HeatFlux, InternalHeat, Radiation

LOW, HIGH = -30.0, 90.0
SAID = "positive off-diagonals were left out"
STRONG = Convection(("x1",), 1e5, LOW)


def spots(places, _) -> np.ndarray:
    """Hot spots that the mesh does not resolve."""
    return np.where(np.sin(places.points_m @ np.array([93.0, 171.0, 249.0])) > 0.6, HIGH, LOW)


HOT_SPOTS = Varying(spots, in_time=False)


def problem(shape: str, contrast: float, *effects: Effect) -> HeatProblem:
    other = replace(CONCRETE, conductivity_w_mk=contrast * CONCRETE.conductivity_w_mk)
    return HeatProblem(body(shape, regions=True), {"even": CONCRETE, "odd": other}, effects=effects)


def plain(given: HeatProblem) -> np.ndarray:
    """The state without any keeping, [degrees Celsius]."""
    system = HeatSystem(given)
    found = ImplicitEquation(system, 0.0, np.inf, relative_tolerance=1e-12).solve(system.start_k, 0.0)
    return found.relative_k + system.reference_c


@pytest.mark.parametrize("shape", ["sphere", "torus", "slab at 30 degrees", "cylinder", AT_THE_BOUNDS])
@pytest.mark.parametrize("contrast", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize(
    "effects",
    [
        (FixedTemperature(("*",), HOT_SPOTS),),
        (FixedTemperature(("x0",), HIGH), STRONG),
        (FixedTemperature(("x0",), HOT_SPOTS), Radiation(("x1",), 0.9, LOW)),
        (Convection(("x0",), 1e5, HOT_SPOTS), STRONG),
        (Radiation(("*",), 0.9, HOT_SPOTS),),
    ],
    ids=["spots given", "jump", "spots and radiation", "spots of air", "radiating spots"],
)
def test_no_steady_temperature_leaves_its_range(shape, contrast, effects) -> None:
    solution = solve_steady(problem(shape, contrast, *effects))
    assert solution.temperature_c.min() >= LOW - 1e-6 and solution.temperature_c.max() <= HIGH + 1e-6, solution.status
    assert solution.converged and solution.energy_residual < 1e-9


@pytest.mark.parametrize(
    ("shape", "contrast", "effects", "least_k"),
    [
        ("torus", 1e-6, (FixedTemperature(("*",), HOT_SPOTS),), 1.0),
        ("torus", 1e-6, (FixedTemperature(("x0",), HIGH), STRONG), 1.0),
        ("torus", 1e6, (FixedTemperature(("*",), HOT_SPOTS),), 0.1),
        ("cylinder", 1e6, (FixedTemperature(("x0",), HOT_SPOTS), Radiation(("x1",), 0.9, LOW)), 1e-3),
    ],
)
def test_these_would_have_left_it_and_say_so(shape, contrast, effects, least_k) -> None:
    """Or the test above would show nothing. What is left out is heat between two nodes: the balance stays closed."""
    given = problem(shape, contrast, *effects)
    beyond = plain(given)
    assert max(LOW - beyond.min(), beyond.max() - HIGH) > least_k
    solution = solve_steady(given)
    assert SAID in solution.status and "out of the range" not in solution.status
    assert solution.energy_residual < 1e-9


def test_a_source_opens_its_own_side_only() -> None:
    effects = (FixedTemperature(("x0",), HIGH), STRONG, InternalHeat(("odd",), 1e3))
    given = problem("torus", 1e-6, *effects)
    assert plain(given).min() < LOW - 0.1
    solution = solve_steady(given)
    assert solution.temperature_c.min() >= LOW - 1e-6 and solution.temperature_c.max() > HIGH + 0.1
    assert SAID in solution.status


@pytest.mark.parametrize(
    "effects",
    [
        (Convection(("x0",), 8.0, 20.0), Convection(("x1",), 25.0, -10.0)),
        (FixedTemperature(("x0",), 20.0), Radiation(("x1",), 0.9, -30.0)),
        (Convection(("*",), 8.0, 20.0), HeatFlux(("x1",), -100.0)),
    ],
)
@pytest.mark.parametrize("shape", ["sphere", "slab at 30 degrees"])
def test_where_nothing_overshoots_the_first_answer_is_the_last(monkeypatch, shape, effects) -> None:
    """The same bits, from one solution."""
    given, made = problem(shape, 1.0, *effects), []

    class Counted(ImplicitEquation):
        def __init__(self, *args, **kwargs) -> None:
            made.append(self)
            super().__init__(*args, **kwargs)

    before = plain(given)
    monkeypatch.setattr(steady, "ImplicitEquation", Counted)
    solution = solve_steady(given)
    np.testing.assert_array_equal(solution.temperature_c, before)
    assert len(made) == 1 and "range" not in solution.status


def test_meshes_without_obtuse_angles_need_none() -> None:
    """Rounding leaves entries a little above 0 there: they do not count as positive, nor is the solver's error."""
    axis = np.linspace(0.0, 0.7, 8)
    mesh = box_mesh(axis, axis, axis)
    for tolerance in (1e-6, 1e-8, 1e-12):
        for effects in ((FixedTemperature(SIDES, HOT_SPOTS),), (FixedTemperature(("x0",), HIGH), STRONG)):
            solution = solve_steady(HeatProblem(mesh, CONCRETE, effects=effects), relative_tolerance=tolerance)
            assert "range" not in solution.status
            assert solution.temperature_c.min() >= LOW - 2e-4 and solution.temperature_c.max() <= HIGH + 2e-4


@pytest.mark.parametrize(
    ("options", "because"),
    [({"order": 2}, "quadratic tetrahedra"), ({"lumped_boundary": False}, "convection that is not lumped")],
)
def test_what_is_not_kept_in_range_says_by_how_much_it_left(options, because) -> None:
    solution = solve_steady(problem("torus", 1.0, FixedTemperature(("x0",), HIGH), STRONG), **options)
    everywhere = np.concatenate([solution.temperature_c, solution.edge_temperature_c])
    beyond = np.maximum(LOW - everywhere, everywhere - HIGH)
    assert beyond.max() > 1.0
    count = np.count_nonzero(beyond > 1.2e-7)
    said = f"The temperature of {count} of {len(everywhere)} nodes is up to {beyond.max():.2g} K out of the range"
    assert said in solution.status and because in solution.status
    mild = solve_steady(problem("torus", 1.0, Convection(("*",), 8.0, 20.0), HeatFlux(("x0",), 10.0)), **options)
    assert "range" not in mild.status
