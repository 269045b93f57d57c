"""Walls, solids and spheres by hand; and heat transfer T2, T3 and T4 of NAFEMS.

The Standard NAFEMS Benchmarks, TNSB rev. 3, 1990.
"""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from tests.support.heat_bodies import CONCRETE, box_mesh, graded, nafems_t3, planes, shell_mesh
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem, TimeSteps
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.time_loop import BACKWARD_EULER, SDIRK2, Scheme, solve_heat
from thermoxels_ns.heat.effects import Convection, FixedTemperature, Radiation
from thermoxels_ns.heat.materials import Material
from thermoxels_ns.heat.results import wall_result
from thermoxels_ns.mesh.tetrahedra import TetMesh

LAYERS = {"plaster": (0.015, 0.40), "concrete": (0.20, 2.0), "insulation": (0.12, 0.035), "mortar": (0.01, 1.0)}
"""Thickness, [m], and conductivity, [W / (m K)], from inside to outside."""


@pytest.mark.parametrize("order", [1, 2])
def test_u_value_of_a_wall(order) -> None:
    """R_si 0.13 and R_se 0.04: U = 0.266946 W/(m2 K), q = 8.00839 W/m2 between 20 and -10 C."""
    ends = np.concatenate([[0.0], np.cumsum([thickness for thickness, _ in LAYERS.values()])])
    regions = {
        name: lambda p, low=low, high=high: (p[..., 0] > low) & (p[..., 0] < high)
        for name, low, high in zip(LAYERS, ends, ends[1:])
    }
    mesh = box_mesh(planes(*ends, step=0.03), [0, 0.5, 1.0], [0, 1.0], regions=regions)
    materials = {name: Material(name, k, 1000.0, 1000.0) for name, (_, k) in LAYERS.items()}
    effects = (Convection(("x0",), 1 / 0.13, 20.0), Convection(("x1",), 1 / 0.04, -10.0))
    solution = solve_steady(HeatProblem(mesh, materials, effects=effects), order=order)
    flux = solution.effects[0].heat_w[0] / 1.0
    assert flux == pytest.approx(8.00839, abs=1e-5) and flux / 30.0 == pytest.approx(0.266946, abs=1e-6)
    assert solution.effects[1].heat_w[0] == pytest.approx(-flux, rel=1e-9)
    x = mesh.points_m[:, 0]
    np.testing.assert_allclose(solution.temperature_c[x == 0.0], 18.95891, atol=1e-5)
    np.testing.assert_allclose(solution.temperature_c[x == ends[-1]], -9.67966, atol=1e-5)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize(("axis", "squashed"), [(0, 1e-4), (1, 1e-4), (1, 1e-5), (2, 1e-8)])
def test_u_value_of_a_wall_squashed_in_one_direction(axis, squashed, order) -> None:
    """U = 1 / (1 / 8 + d / k + 1 / 25), or a sentence that says that cells are too flat."""
    sides = [0.3, 0.5, 1.0]
    sides[axis] *= squashed
    mesh = wall_mesh(*sides)
    effects = (Convection(("x0",), 8.0, 20.0), Convection(("x1",), 25.0, -10.0))
    if squashed < 1e-6:
        with pytest.raises(HeatError, match=r"^mesh tets: expected"):
            HeatProblem(mesh, CONCRETE, effects=effects)
        return
    wall = HeatProblem(mesh, CONCRETE, effects=effects)
    exact = 1.0 / (1.0 / 8.0 + sides[0] / CONCRETE.conductivity_w_mk + 1.0 / 25.0)
    solution = solve_steady(wall, order=order)
    flow_w = 30.0 * exact * sides[1] * sides[2]
    assert solution.effects[0].heat_w[0] == pytest.approx(flow_w, rel=1e-6 if squashed > 1e-4 else 2e-6)
    assert solution.unbalanced_w < 1e-3 * flow_w


@pytest.mark.parametrize("coefficient", [1e6, 1e8, 1e17])
@pytest.mark.parametrize("order", [1, 2])
def test_u_value_of_a_wall_with_next_to_perfect_convection(coefficient, order) -> None:
    """U = k / d where h is next to infinite, or a sentence that asks for a given temperature."""
    effects = (Convection(("x0",), coefficient, 20.0), Convection(("x1",), coefficient, -10.0))
    wall = HeatProblem(wall_mesh(0.3, 0.5, 1.0), CONCRETE, effects=effects)
    if coefficient > 1e9:
        with pytest.raises(HeatError, match=r"^convection coefficient: expected"):
            solve_steady(wall, order=order)
        return
    solution = solve_steady(wall, order=order)
    exact = 1.0 / (2.0 / coefficient + 0.3 / CONCRETE.conductivity_w_mk)
    assert wall_result(wall, solution, ("x0",), 20.0, -10.0).u_value_w_m2k == pytest.approx(exact, rel=1e-6)
    for heat, sign in zip(solution.effects, (1.0, -1.0)):
        assert heat.heat_w[0] == pytest.approx(sign * 30.0 * exact * 0.5, rel=1e-6)


def wall_mesh(x: float, y: float, z: float, **options) -> TetMesh:
    """A wall with x0 and x1 as named sides, however thin it is."""
    mesh = box_mesh(np.linspace(0.0, 0.3, 5), np.linspace(0.0, 0.5, 3), np.linspace(0.0, 1.0, 3), **options)
    return replace(mesh, points_m=mesh.points_m * (np.array([x, y, z]) / [0.3, 0.5, 1.0]))


@pytest.mark.parametrize(
    ("depth_m", "time_s", "exact"), [(0.05, 3600.0, 0.5294616), (0.10, 3600.0, 0.2085161), (0.10, 14400.0, 0.5294616)]
)
def test_semi_infinite_solid(depth_m, time_s, exact) -> None:
    """The surface jumps from 0 to 1: T = erfc(x / (2 sqrt(a t)))."""
    assert math.erfc(depth_m / (2 * math.sqrt(CONCRETE.diffusivity_m2_s * time_s))) == pytest.approx(exact, abs=1e-7)
    far = graded(0.2, 1.2, finest=0.005, growth=1.3, coarsest=0.1)
    x = np.concatenate([planes(0, 0.2, step=0.0025), far[1:]])
    mesh = box_mesh(x, [0, 0.05], [0, 0.05], temperature_c=0.0)
    problem = HeatProblem(mesh, CONCRETE, effects=(FixedTemperature(("x0",), 1.0),))
    solution = solve_heat(problem, AdaptiveSteps(time_s, 1e-3, outputs=1))
    at = np.isclose(mesh.points_m[:, 0], depth_m)
    np.testing.assert_allclose(solution.temperature_c[-1, at], exact, atol=1e-3)
    assert solution.temperature_c.min() >= -1e-9 and solution.temperature_c.max() <= 1.0 + 1e-9
    assert solution.energy_residual < 1e-9


@pytest.mark.parametrize(
    ("biot", "fourier", "centre", "surface"),
    [
        (0.1, 1.0, 0.92239, 0.87813),
        (1.0, 1.0, 0.53386, 0.34818),
        (1.0, 0.2, 0.95064, 0.64339),
        (10, 1, 0.16382, 0.02317),
    ],
)
def test_slab_with_convection(biot, fourier, centre, surface) -> None:
    """Half of a slab at 1 in air at 0; series of Carslaw and Jaeger."""
    half = 0.1
    mesh = box_mesh(np.linspace(0, half, 41), [0, 0.01], [0, 0.01], temperature_c=1.0)
    duration = fourier * half**2 / CONCRETE.diffusivity_m2_s
    effects = (Convection(("x1",), biot * CONCRETE.conductivity_w_mk / half, 0.0),)
    problem = HeatProblem(mesh, CONCRETE, effects=effects)
    x = mesh.points_m[:, 0]
    for time in (TimeSteps(200, duration / 200), AdaptiveSteps(duration, 1e-3)):
        solution = solve_heat(problem, time, scheme=SDIRK2)
        end = solution.temperature_c[-1]
        np.testing.assert_allclose(end[x == 0.0], centre, atol=5e-4)
        np.testing.assert_allclose(end[x == half], surface, atol=5e-4)
        assert solution.energy_residual < 1e-9


def test_a_small_sphere_cools_as_a_whole() -> None:
    """r = 1 cm, h = 10, rho c = 1.936e6, one hour: exp(-3 h t / (rho c r)) = 0.00377818 (Biot number 0.02)."""
    parts = 12
    axis = np.linspace(-1.0, 1.0, parts + 1)
    cube = box_mesh(axis, axis, axis, temperature_c=1.0)
    # Each shell of the cube becomes a sphere.
    size = np.abs(cube.points_m).max(axis=1)
    length = np.linalg.norm(cube.points_m, axis=1)
    stretched = cube.points_m * np.divide(size, length, out=np.zeros_like(size), where=length > 0)[:, None]
    mesh = replace(cube, points_m=0.01 * stretched)
    copper = Material("copper-like", 200.0, 2200.0, 880.0)
    problem = HeatProblem(mesh, copper, effects=(Convection(("*",), 10.0, 0.0),))
    solution = solve_heat(problem, AdaptiveSteps(3600.0, 1e-4, outputs=2))
    assert math.exp(-3 * 10 * 3600 / (2200 * 880 * 0.01)) == pytest.approx(0.00377818, abs=1e-8)
    # Area over volume of the faceted ball, larger than 3 / r by the facets.
    area = np.linalg.norm(np.cross(*(np.diff(mesh.points_m[mesh.facets], axis=1).transpose(1, 0, 2))), axis=1).sum() / 2
    corner = mesh.points_m[mesh.tets]
    volume = np.linalg.det(corner[:, 1:] - corner[:, :1]).sum() / 6
    assert area / volume == pytest.approx(300.0, rel=0.015)
    faceted = math.exp(-10 * 3600 * area / (volume * 2200 * 880))
    np.testing.assert_allclose(solution.temperature_c[-1], faceted, atol=1e-4)
    np.testing.assert_allclose(solution.temperature_c[-1], 0.00377818, atol=5e-4)


@pytest.mark.parametrize("order", [1, 2])
def test_a_closed_spherical_shell(order) -> None:
    """455.6634 W. With flat facets the error is that of the area, of second order whatever the tetrahedra."""
    errors = []
    for parts in (4, 8):
        mesh = shell_mesh(0.5, 0.6, parts, parts // 4)
        effects = (Convection(("inside",), 7.69, 20.0), Convection(("outside",), 25.0, -10.0))
        solution = solve_steady(HeatProblem(mesh, CONCRETE, effects=effects), order=order)
        assert solution.energy_residual < 1e-9
        errors.append(float(solution.effects[0].heat_w[0]) / 455.6634 - 1.0)
    radius = np.linalg.norm(mesh.points_m, axis=1)
    inner, outer = (float(solution.temperature_c[np.abs(radius - r) < 1e-9].mean()) for r in (0.5, 0.6))
    assert [inner, outer] == pytest.approx([1.13886, -5.97105], abs=0.1)
    assert abs(errors[1]) < 3e-3, errors
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.15), f"observed order of {errors}"


@pytest.mark.parametrize(("conductivity", "exact_k"), [(55.6, 927.0076), (55.563, 926.9707)])
@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("parts", [1, 7])
def test_t2_radiation_at_the_end_of_a_rod(conductivity, exact_k, order, parts) -> None:
    """0.1 m, one end at 1000 K, the other radiates with emissivity 0.98 to 300 K: target 927.0 K at that end."""
    mesh = box_mesh(np.linspace(0, 0.1, parts + 1), [0, 0.01], [0, 0.01])
    effects = (FixedTemperature(("x0",), 1000.0 - 273.15), Radiation(("x1",), 0.98, 300.0 - 273.15, 5.67e-8))
    problem = HeatProblem(mesh, Material("rod", conductivity, 7850.0, 460.0), effects=effects)
    solution = solve_steady(problem, order=order)
    end_k = solution.temperature_c[mesh.points_m[:, 0] == 0.1] + 273.15
    np.testing.assert_allclose(end_k, exact_k, atol=1e-4)
    assert end_k[0] == pytest.approx(927.0, abs=0.05)


HALF_SECONDS = TimeSteps(64, 0.5)
T3_C = 36.60312
"""Exact temperature at x = 0.08 m after 32 s of T3, a rod with a swinging end; the printed target is 36.60."""


def t3_errors(parts: int, scheme: Scheme = BACKWARD_EULER, time: TimeSteps | AdaptiveSteps = HALF_SECONDS) -> float:
    problem = nafems_t3(parts)
    end = solve_heat(problem, time, scheme=scheme).temperature_c[-1, np.isclose(problem.mesh.points_m[:, 0], 0.08)]
    assert np.ptp(end) < 1e-9
    return float(end[0]) - T3_C


def test_t3_rod_with_a_swinging_end() -> None:
    """The error falls by four with each refinement and is within 0.1 K at 40 elements.

    The first-order error of backward Euler is a known number; a tolerance is kept beside short steps.
    """
    errors = [abs(t3_errors(parts, SDIRK2)) for parts in (10, 20, 40)]
    assert errors[2] < 0.1, errors
    assert 3.2 < errors[0] / errors[1] < 4.8 and 3.2 < errors[1] / errors[2] < 4.8, errors
    assert t3_errors(20, BACKWARD_EULER) == pytest.approx(36.18 - T3_C, abs=0.02)
    error, fine = t3_errors(40, time=AdaptiveSteps(32.0, 0.02, outputs=1)), t3_errors(40, SDIRK2, TimeSteps(320, 0.1))
    assert error == pytest.approx(fine, abs=0.02) and abs(error) < 0.1


@pytest.mark.parametrize(("order", "parts", "halved"), [(1, (10, 20, 40), 0.5), (2, (10, 20), 0.3)])
def test_t4_plate_with_convection(order, parts, halved) -> None:
    """0.6 x 1.0 m: 100 C below, insulated left, convection right and above; target 18.3 C at (0.6, 0.2)."""
    errors = []
    for n in parts:
        mesh = box_mesh(np.linspace(0, 0.6, 6 * n // 10 + 1), np.linspace(0, 1, n + 1), [0, 1 / n], temperature_c=50.0)
        effects = (FixedTemperature(("y0",), 100.0), Convection(("x1", "y1"), 750.0, 0.0))
        problem = HeatProblem(mesh, Material("plate", 52.0, 7850.0, 460.0), effects=effects)
        solution = solve_steady(problem, order=order)
        node = np.linalg.norm(mesh.points_m - [0.6, 0.2, 0.0], axis=1).argmin()
        errors.append(abs(float(solution.temperature_c[node]) - 18.25376))
        assert solution.energy_residual < 1e-9
    assert errors[-1] < 0.01 * 18.25376, errors
    # The corner (0.6, 0) is singular: the order stays below 2.
    assert all(fine < halved * coarse for coarse, fine in pairwise(errors)), errors
