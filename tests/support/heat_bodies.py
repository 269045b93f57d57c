from dataclasses import replace

import numpy as np
import pytest

from tests.support.heat_meshes import Nodal, box_mesh, mesh_from
from thermoxels_ns.fem.linear_tets import refine_mesh
from thermoxels_ns.fem.problem import HeatProblem, Varying
from thermoxels_ns.heat.effects import FixedTemperature
from thermoxels_ns.heat.materials import Material
from thermoxels_ns.mesh.tetrahedra import TetMesh
from thermoxels_ns.mesh.voxel_tets import kuhn_tets

CONCRETE = Material("concrete", 1.7, 2200.0, 880.0)
STEEL = Material("steel", 50.0, 7800.0, 450.0)


def make_body(cells: np.ndarray, voxel_m: float, temperature_c: Nodal = 20.0) -> TetMesh:
    corners, tets = kuhn_tets(cells)
    return mesh_from(corners * voxel_m, tets, temperature_c)


@pytest.fixture
def concrete() -> Material:
    return CONCRETE


@pytest.fixture
def random_body() -> TetMesh:
    """A 6 x 5 x 4 block with a tunnel, a cavity and a bite out of its corner."""
    cells, rng = np.ones((6, 5, 4), dtype=bool), np.random.default_rng(7)
    cells[:, 2, 1] = False
    cells[3, 3, 2] = False
    cells[4:, :2, 2:] = False
    return make_body(cells, 0.05, lambda points: rng.uniform(-15.0, 45.0, len(points)))


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
