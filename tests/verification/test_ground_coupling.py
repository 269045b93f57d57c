"""Steady heat flow from a floor into the ground: cases of IEA BESTEST (NREL/TP-550-43388, Neymark and Judkoff 2008).

A slab of 12 m x 12 m lies on soil, with a wall strip of 0.24 m around it. The room is at 30 C, the outside at 10 C, the
ground at depth E at 10 C; the soil ends at the distance F beyond the strip, where it is adiabatic. Nothing radiates.
Case GC10a has an exact solution (Delsante, Stokes and Walsh 1983). The others were solved with TRNSYS, FLUENT and
MATLAB, whose answers are 0.7 to 4.3 % apart.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pytest

from tests.support.heat_bodies import box_mesh
from thermoxels_ns.fem.problem import HeatProblem, Varying
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.tolerance import Goals, solve_to_tolerance
from thermoxels_ns.heat.effects import Convection, FixedTemperature
from thermoxels_ns.heat.materials import Material
from thermoxels_ns.mesh.tetrahedra import TetMesh

SOIL = Material("soil", 1.9, 1490.0, 1800.0)
INSIDE_C, OUTSIDE_C = 30.0, 10.0
FLOOR_M, STRIP_M = 6.0, 6.24  # Distances from the centre to where the floor and the strip end
EXACT_GC10A_W = 2432.597
INFINITE_M = 60.0  # What stands for infinite depth and distance in GC10a: ten times the half side of the floor


@dataclass(frozen=True)
class Case:
    """What tells a case from the others."""

    depth_m: float  # E
    distance_m: float  # F
    inside_w_m2k: float | None = None  # Surface coefficient; None: the surface has the temperature of the air
    outside_w_m2k: float | None = None
    linear_strip: bool = False  # Whether the temperature under the wall is given, linear from inside to outside
    ends: str = "as specified"  # Or "cold" or "adiabatic" where the soil ends, at its sides and below


GC10A = Case(INFINITE_M, INFINITE_M, linear_strip=True)
TRNSYS_FLUENT_MATLAB_W = {
    "GC30a": (Case(30.0, 20.0), (2642.0, 2585.0, 2695.0)),
    "GC65b": (Case(15.0, 15.0, 7.95, 11.95), (1994.0, 1991.0, 2004.0)),
}


def away(length_m: float, finest_m: float, share: float) -> npt.NDArray[np.float64]:
    """Distances from an edge at which the heat flux is singular, 0 to the length, (n,).

    Cells are a share of their distance from it; coarser where little energy is: within 0.1 m and beyond 8 m.
    """
    distances = [0.0]
    while distances[-1] < length_m * (1.0 - 1e-9):
        far = distances[-1]
        distances.append(far + max(finest_m, share * far, share * np.cbrt(0.1 * far**2), share * far**2 / 8.0))
    return np.array(distances) * (length_m / distances[-1])


def ground(case: Case, finest_m: float, share: float) -> TetMesh:
    """An eighth of the soil, 0 <= y <= x: four quarters are alike, and so are the two halves of each."""
    half = away(0.5 * (STRIP_M - FLOOR_M), finest_m, share)
    floor, beyond = FLOOR_M - away(FLOOR_M, finest_m, share)[::-1], STRIP_M + away(case.distance_m, finest_m, share)
    across = np.concatenate([floor[:-1], FLOOR_M + half[:-1], STRIP_M - half[::-1][:-1], beyond])
    return box_mesh(
        across,
        across,
        -away(case.depth_m, finest_m, share)[::-1],
        temperature_c=OUTSIDE_C,
        patches={
            "outside": lambda centroid, normal: normal[:, 2] > 0.5,
            "strip": lambda centroid, normal: (normal[:, 2] > 0.5) & (centroid[:, 0] < STRIP_M),
            "floor": lambda centroid, normal: (normal[:, 2] > 0.5) & (centroid[:, 0] < FLOOR_M),
        },
        keep=lambda centre: centre[..., 0] > centre[..., 1] - 1e-9,
        keep_tets=lambda centroid: centroid[:, 0] > centroid[:, 1],
    )


def surface(patch: str, coefficient_w_m2k: float | None, air_c: float) -> Convection | FixedTemperature:
    if coefficient_w_m2k is None:
        return FixedTemperature((patch,), air_c)
    return Convection((patch,), coefficient_w_m2k, air_c)


def problem_of(case: Case, finest_m: float = 0.002, share: float = 0.2) -> HeatProblem:
    effects = [surface("floor", case.inside_w_m2k, INSIDE_C), surface("outside", case.outside_w_m2k, OUTSIDE_C)]
    if case.ends != "adiabatic":
        effects.append(FixedTemperature(("z0",) if case.ends == "as specified" else ("z0", "x1"), OUTSIDE_C))
    if case.linear_strip:

        def across(places, time_s):
            return np.interp(places.points_m[:, 0], [FLOOR_M, STRIP_M], [INSIDE_C, OUTSIDE_C])

        effects.append(FixedTemperature(("strip",), Varying(across, in_time=False)))
    return HeatProblem(ground(case, finest_m, share), SOIL, effects=tuple(effects))


def floor_heat_w(case: Case, finest_m: float = 0.002, share: float = 0.2) -> float:
    solution = solve_steady(problem_of(case, finest_m, share))
    assert solution.energy_residual < 1e-9
    return 8.0 * float(solution.effects[0].heat_w[0])


def test_gc10a_is_far_from_where_the_soil_ends() -> None:
    """Insulating all ends or keeping them cold, which lie on either side of infinite, changes next to nothing."""
    adiabatic, cold = (
        floor_heat_w(Case(INFINITE_M, INFINITE_M, linear_strip=True, ends=ends), finest_m=0.02, share=0.5)
        for ends in ("adiabatic", "cold")
    )
    assert 0.0 < cold - adiabatic < 0.001 * EXACT_GC10A_W


def test_gc10a_is_met_and_errors_fall_as_cells_shrink() -> None:
    """Halved cells have a quarter of the error where a solution is smooth, and half of it at worst beside its edges."""
    errors = [
        floor_heat_w(GC10A, finest, share) / EXACT_GC10A_W - 1.0 for finest, share in ((0.016, 0.6), (0.008, 0.3))
    ]
    assert 0.0 < errors[1] < 0.5 * errors[0], errors
    assert floor_heat_w(GC10A) == pytest.approx(EXACT_GC10A_W, rel=0.01)


@pytest.mark.parametrize("name", TRNSYS_FLUENT_MATLAB_W)
def test_between_three_programs(name) -> None:
    """Within the span of their answers, widened by 0.5 %."""
    case, answers_w = TRNSYS_FLUENT_MATLAB_W[name]
    assert 0.995 * min(answers_w) < floor_heat_w(case) < 1.005 * max(answers_w)


def test_a_tolerance_of_heat_flows_is_met_on_flat_cells() -> None:
    """Cells are up to 1000 times as long as high; multigrid without regard for that stalls on them.

    With 0.01 it was not met, for want of a solution: the estimate holds what is left of the singular edge.
    """
    found = solve_to_tolerance(problem_of(GC10A, share=2.5), Goals(None, 0.03), log=lambda _: None)
    error = abs(8.0 * float(found.solution.effects[0].heat_w[0]) / EXACT_GC10A_W - 1.0)
    assert "converged in" in found.solution.status
    assert found.met and found.settings.order == 2 and error < found.settings.error.heat_flow
