"""Problems of heat flow that several tests pose, and the same on finer meshes."""

from dataclasses import replace

import numpy as np

from tests.support.heat_meshes import box_mesh
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.fem.quantities import Varying
from thermoxels_ns.fem.refine_mesh import refine_mesh
from thermoxels_ns.heat.effects import FixedTemperature
from thermoxels_ns.heat.materials import Material


def finer(problem: HeatProblem, times: int = 1) -> HeatProblem:
    for _ in range(times):
        problem = replace(problem, mesh=refine_mesh(problem.mesh), initial_temperature_c=None)
    return problem


def nafems_t3(parts: int = 10) -> HeatProblem:
    """The rod of NAFEMS T3, at 0 C: one end is kept there, the other at 100 sin(pi t / 40)."""
    mesh = box_mesh(np.linspace(0, 0.1, parts + 1), [0, 0.01], [0, 0.01], temperature_c=0.0)
    swing = Varying(lambda places, time_s: 100.0 * np.sin(np.pi * time_s / 40.0))
    effects = (FixedTemperature(("x0",), 0.0), FixedTemperature(("x1",), swing))
    return HeatProblem(mesh, Material("steel", 35.0, 7200.0, 440.5), effects=effects)
