"""More on ISO 10211: the bar through insulation, case 1 turned in space, case 2 seen in a mirror.

Case 4 and its figures, 0.540 W and 0.805 C, are as validation reports of other programs give them; they ask for 1 % of
the flow and 0.005 C.
"""

from dataclasses import replace

import numpy as np
import pytest

from tests.support.heat_meshes import box_mesh, graded, planes
from tests.verification.test_iso_10211 import CASE_1, CASE_2, at, conductor
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.fem.quantities import Varying
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.heat.effects import Convection, FixedTemperature


@pytest.mark.parametrize("finest", [0.0125, 0.00625])
def test_case_4_an_iron_bar_through_insulation(finest) -> None:
    """1 m x 1 m of insulation, 0.2 m thick; the bar, 0.1 m x 0.05 m x 0.6 m, ends at its cold face. A quarter of it."""
    grading = {"finest": finest, "growth": 1.3, "coarsest": 0.1}
    x, y, z = (graded(*knots, **grading) for knots in ((0, 0.05, 0.5), (0, 0.025, 0.5), (0, 0.2, 0.6)))

    def insulation(p):
        return p[..., 2] < 0.2

    def bar(p):
        return (p[..., 0] < 0.05) & (p[..., 1] < 0.025)

    def cut(c):
        return (np.minimum(c[:, 0], c[:, 1]) < 1e-9) | (np.maximum(c[:, 0], c[:, 1]) > 0.5 - 1e-9)

    mesh = box_mesh(
        x,
        y,
        z,
        regions={"insulation": insulation, "bar": bar},
        patches={
            "warm": lambda c, n: ~cut(c) & (c[:, 2] > 0.2 - 1e-9),
            "cold": lambda c, n: ~cut(c) & (c[:, 2] < 1e-9),
        },
        keep=lambda p: insulation(p) | bar(p),
    )
    materials = {"insulation": conductor("insulation", 0.1), "bar": conductor("iron", 50.0)}
    effects = (Convection(("warm",), 10.0, 1.0), Convection(("cold",), 10.0, 0.0))
    solution = solve_steady(HeatProblem(mesh, materials, effects=effects), order=2)
    assert 4.0 * float(solution.effects[0].heat_w[0]) == pytest.approx(0.540, rel=0.01)
    assert solution.energy_residual < 1e-9
    cold = np.abs(mesh.points_m[:, 2]) < 1e-9
    assert solution.temperature_c[cold].max() == pytest.approx(0.805, abs=0.005)


@pytest.mark.parametrize("seed", range(3))
def test_case_1_turned_in_space(seed) -> None:
    """Its directions, its place and the numbers of its nodes are any."""
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    away = rng.uniform(-50.0, 50.0, 3)

    def sides(places, _):
        x, _, z = ((places.points_m - away) @ turn).T
        return np.where(z > 1.0 - 1e-9, np.where(x < 1e-9, 10.0, 20.0), 0.0)

    straight = box_mesh(np.linspace(0, 0.5, 25), [0, 1 / 48], np.linspace(0, 1, 49), temperature_c=5.0)
    boundary, number = straight.boundary, rng.permutation(len(straight.points_m))
    assert boundary is not None
    points = np.empty_like(straight.points_m)
    points[number] = straight.points_m @ turn.T + away
    mesh = replace(
        straight,
        points_m=points,
        tets=number[straight.tets],
        facets=number[straight.facets],
        boundary=replace(boundary, normal=boundary.normal @ turn.T),
    )
    fixed = FixedTemperature(("x0", "z0", "z1"), Varying(sides, in_time=False))
    solution = solve_steady(HeatProblem(mesh, conductor("any", 1.0), effects=(fixed,)))
    straight_solution = replace(solution, temperature_c=solution.temperature_c[number])
    for row, line in enumerate(CASE_1.splitlines(), start=1):
        for column, listed in enumerate(line.split(), start=1):
            computed = at(straight, straight_solution, column / 8, 0.0, 1 - row / 8)
            assert computed == pytest.approx(float(listed), abs=0.1), f"row {row}, column {column}"


def test_case_2_in_a_mirror() -> None:
    """Left and right, and inside and outside of the axes change places; so do the diagonals of all cells."""
    x = 0.5 - 1e-3 * np.unique(
        np.concatenate(
            [planes(0, 1.5, 15, step=3), planes(15, 60, step=5), graded(60, 500, finest=8, growth=1.3, coarsest=60)]
        )
    )
    z = -1e-3 * planes(0, 1.5, 35, 36.5, 41.5, 47.5, step=4)

    def place(p):
        return 0.5 - p[..., 0], -p[..., 2]

    def aluminium(p):
        left, up = place(p)
        corner = (left < 0.015) & (up > 0.035) & (up < 0.0365)
        return (up < 0.0015) | ((left < 0.0015) & (up < 0.0365)) | corner

    regions = {
        "insulation": lambda p: place(p)[1] < 0.0415,
        "concrete": lambda p: place(p)[1] > 0.0415,
        "wood": lambda p: (place(p)[0] < 0.015) & (place(p)[1] > 0.0365) & (place(p)[1] < 0.0415),
        "aluminium": aluminium,
    }
    depth = 0.01
    mesh = box_mesh(x[::-1], [0, depth], z[::-1], regions=regions)
    conductivities = {"insulation": 0.029, "concrete": 1.15, "wood": 0.12, "aluminium": 230.0}
    effects = (Convection(("z0",), 1 / 0.06, 0.0), Convection(("z1",), 1 / 0.11, 20.0))
    problem = HeatProblem(mesh, {name: conductor(name, k) for name, k in conductivities.items()}, effects=effects)
    solution = solve_steady(problem)
    assert solution.effects[1].heat_w[0] / depth == pytest.approx(9.5, abs=0.1)
    for name, (px, pz, listed) in CASE_2.items():
        assert at(mesh, solution, 0.5 - 1e-3 * px, 0.0, -1e-3 * pz) == pytest.approx(listed, abs=0.1), name
