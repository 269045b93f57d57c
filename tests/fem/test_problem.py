from dataclasses import replace

import numpy as np
import pytest

from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.problem import HeatProblem, TimeSteps


@pytest.mark.parametrize("field", ["conductivity_w_mk", "density_kg_m3", "specific_heat_j_kgk"])
@pytest.mark.parametrize("bad", [0.0, float("nan"), "1.7"])
def test_material_refuses_impossible_values(concrete, field, bad) -> None:
    with pytest.raises(HeatError, match=field):
        replace(concrete, **{field: bad})


@pytest.mark.parametrize(
    ("steps", "seconds", "message"),
    [
        *((steps, 60.0, "steps: expected a whole number") for steps in (0, -1, 2.5, True, "10")),
        *((10, seconds, "step_seconds") for seconds in (0.0, -60.0, float("nan"), float("inf"))),
    ],
)
def test_steps_must_be_whole_and_positive(steps, seconds, message) -> None:
    with pytest.raises(HeatError, match=message):
        TimeSteps(steps, seconds)


def broken(mesh, what: str):
    points, tets, temperature = mesh.points_m.copy(), mesh.tets.copy(), mesh.temperature_c.copy()
    if what == "nan point":
        points[3, 1] = np.nan
    elif what == "inverted":
        tets[0, [0, 1]] = tets[0, [1, 0]]
    elif what == "flat":
        points = points * np.array([1.0, 1.0, 0.0])
    elif what == "unused":
        points, temperature = np.vstack([points, [[9.0, 9.0, 9.0]]]), np.append(temperature, 0.0)
    elif what == "out of range":
        tets[0, 0] = len(points)
    elif what == "empty":
        tets = tets[:0]
    elif what == "nan temperature":
        temperature[5] = np.nan
    elif what == "too cold":
        temperature[5] = -274.0
    elif what == "too few temperatures":
        temperature = temperature[:-1]
    return replace(mesh, points_m=points, tets=tets, temperature_c=temperature)


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("nan point", "mesh points: expected finite numbers only"),
        ("inverted", "1 of .* flat or inverted"),
        ("flat", "flat or inverted"),
        ("unused", "1 of .* in none"),
        ("out of range", "mesh tets"),
        ("empty", "at least one tetrahedron"),
        ("nan temperature", "mesh temperature_c: expected finite"),
        ("too cold", "absolute zero"),
        ("too few temperatures", "mesh temperature_c: expected shape"),
    ],
)
def test_unusable_meshes_are_refused(random_body, concrete, what, message) -> None:
    HeatProblem(random_body, concrete)
    with pytest.raises(HeatError, match=message):
        HeatProblem(broken(random_body, what), concrete)
