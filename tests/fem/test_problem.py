"""What a heat problem and its parts refuse, each naming the field that is wrong."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.support.heat_bodies import CONCRETE, box_mesh
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.problem import AdaptiveSteps, Effect, HeatProblem, TimeSteps
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.system import HeatSystem
from thermoxels_ns.fem.time_loop import solve_heat
from thermoxels_ns.heat.effects import Convection, GroundContact, HeatFlux, InternalHeat, Radiation
from thermoxels_ns.heat.solving import Goals

REGIONS = {"inner": lambda p: p[..., 0] < 0.25, "outer": lambda p: p[..., 0] > 0.25}
BOX = box_mesh(np.linspace(0, 0.5, 5), [0, 0.2], [0, 0.2], regions=REGIONS)
EMPTY = replace(CONCRETE, density_kg_m3=1.0, specific_heat_j_kgk=1e-12)
NAN, INF = float("nan"), float("inf")
Refused = list[tuple[str, Callable[[], Any]]]


def body(**changes: Any) -> HeatProblem:
    return HeatProblem(replace(BOX, **changes), {"inner": CONCRETE, "outer": CONCRETE})


def tagged(**changes: Any) -> HeatSystem:
    return HeatSystem(body(boundary=replace(BOX.boundary, **changes)))


def acting(*effects: Effect) -> Any:
    return solve_steady(replace(body(), effects=effects))


def moved(values: np.ndarray, place: Any, value: float) -> np.ndarray:
    changed = values.copy()
    changed[place] = value
    return changed


STEPS: Refused = [
    ("tolerance_k", lambda: Goals(tolerance_k=0.0)),
    ("flow_tolerance", lambda: Goals(flow_tolerance=1.5)),
    ("leave_out_below", lambda: Goals(flow_tolerance=0.05, leave_out_below=0.01)),
    ("memory_gb", lambda: Goals(memory_gb=-1.0)),
    ("step_seconds", lambda: TimeSteps(10, 1e308)),
    *(("steps", lambda n=n: TimeSteps(n, 60.0)) for n in (0, -1, 2.5, True, "10")),
    *(("step_seconds", lambda s=s: TimeSteps(10, s)) for s in (0.0, -60.0, NAN, INF)),
    ("duration_s", lambda: AdaptiveSteps(0.0)),
    ("tolerance_k", lambda: AdaptiveSteps(60.0, -1.0)),
    *(("outputs", lambda n=n: AdaptiveSteps(60.0, outputs=n)) for n in (0, 1.5)),
    *(
        ("heat capacity", lambda t=t: solve_heat(HeatProblem(BOX, EMPTY), t))
        for t in (TimeSteps(3, 1.0), AdaptiveSteps(9.0))
    ),
]
MESHES: Refused = [
    ("mesh points_m", lambda: body(points_m=moved(BOX.points_m, (3, 1), NAN))),
    ("mesh tets", lambda: body(tets=np.concatenate([BOX.tets[:1, [1, 0, 2, 3]], BOX.tets[1:]]))),
    ("mesh tets", lambda: body(points_m=BOX.points_m * [1.0, 1.0, 0.0])),
    ("mesh tets", lambda: body(tets=moved(BOX.tets, (0, 0), len(BOX.points_m)))),
    ("mesh tets", lambda: body(tets=BOX.tets[:0])),
    (
        "mesh points",
        lambda: body(
            points_m=np.vstack([BOX.points_m, [[9, 9, 9]]]),
            temperature_c=np.append(BOX.temperature_c, 0),
            observed=np.append(BOX.observed, True),
        ),
    ),
    *(("mesh temperature_c", lambda t=t: body(temperature_c=moved(BOX.temperature_c, 5, t))) for t in (NAN, -274.0)),
    ("mesh temperature_c", lambda: body(temperature_c=BOX.temperature_c[:-1])),
    ("mesh boundary.patch", lambda: tagged(patch=np.full(len(BOX.facets), 7))),
    ("mesh boundary.patch", lambda: tagged(patch=np.zeros(3, np.int64))),
]
PROBLEMS: Refused = [
    *(("up", lambda u=u: HeatProblem(BOX, CONCRETE, up=u)) for u in ((0.0, 0.0, 0.0), (1.0, 2.0))),
    ("materials", lambda: HeatProblem(BOX, {"inner": CONCRETE})),
    *(
        (name, lambda n=name, v=value: replace(CONCRETE, **{n: v}))
        for name in ("conductivity_w_mk", "density_kg_m3", "specific_heat_j_kgk")
        for value in (0.0, NAN, "1.7")
    ),
    *(("steady heat problem", lambda e=e: acting(*e)) for e in ((), (HeatFlux(("*",), 1.0),))),
    ("steady heat problem", lambda: acting(Convection(("*",), 0.0, 20.0))),
]
EFFECTS: Refused = [
    ("patches", lambda: Convection("x0", 5.0, 20.0)),  # type: ignore[arg-type]
    ("coefficient_w_m2k", lambda: Convection(("*",), -1.0, 20.0)),
    *(("flux_w_m2", lambda f=f: HeatFlux(("*",), f)) for f in (True, np.ones(3), lambda places, time_s: 1.0)),
    ("emissivity", lambda: Radiation(("*",), 1.01, 20.0)),
    *(("surroundings_c", lambda t=t: Radiation(("*",), 0.9, t)) for t in (1e6, 1e300)),
    ("air_c", lambda: Convection(("*",), 5.0, 1e6)),
    ("resistance_m2k_w", lambda: GroundContact(("*",), 0.0, 10.0)),
    *(("patches", lambda p=p: acting(HeatFlux(p, 1.0))) for p in (("roof",), ("x0", "X?"))),
    ("regions", lambda: acting(InternalHeat(("oven",), 1.0))),
]


@pytest.mark.parametrize(("name", "make"), [*STEPS, *MESHES, *PROBLEMS, *EFFECTS])
def test_what_cannot_be_is_refused_by_its_name(name, make) -> None:
    with pytest.raises(HeatError, match=f"^{name}: expected"):
        make()
