"""Bodies from isosurface stuffing with patches and regions, whose angles between faces are obtuse here and there."""

from dataclasses import replace

import numpy as np

from tests.support.heat_bodies import CONCRETE
from tests.support.heat_meshes import Nodal, box_mesh
from tests.support.stuffed_shapes import SHAPES, tet_mesh
from thermoxels_ns.fem.solution import HeatSolution
from thermoxels_ns.fem.steady import OVERSHOOT_K
from thermoxels_ns.mesh.stuffing.isosurface import stuff
from thermoxels_ns.mesh.tetrahedra import Boundary, TetMesh

H = 0.05
"""Size of a voxel, [m]."""
STEP_S = H**2 / CONCRETE.diffusivity_m2_s
"""Time in which heat crosses a voxel, [s]."""


def dressed(mesh: TetMesh, temperature_c: Nodal = 20.0, regions: bool = False) -> TetMesh:
    """Give any mesh these patches and regions."""
    corner = mesh.points_m[mesh.facets]
    middle = mesh.points_m.mean(axis=0)
    patch = (corner.mean(axis=1)[:, 0] > middle[0]).astype(np.int64)
    boundary = Boundary(np.ones(len(patch), bool), patch, ("x0", "x1"))
    nodal = temperature_c(mesh.points_m) if callable(temperature_c) else np.full(len(mesh.points_m), temperature_c)
    mesh = replace(mesh, temperature_c=nodal, boundary=boundary)
    if regions:
        odd = np.floor(mesh.points_m[mesh.tets].mean(axis=1) / H).sum(axis=1) % 2
        mesh = replace(mesh, region=odd.astype(np.int64), region_names=("even", "odd"))
    return mesh


MOST_OVERSHOOT = 0.5
"""Share of the range by which single hot nodes may leave it beside obtuse angles."""
BLOCKS = ("regular", "carved", "shaken")
"""Names of blocks of cells: whole, with a third taken out, and with nodes moved so that angles are obtuse."""


def body(
    shape: str = "slab at 30 degrees", temperature_c: Nodal = 20.0, regions: bool = False, size: int = 6
) -> TetMesh:
    """One of the known shapes, 8 voxels wide, or one of `BLOCKS`, `size` voxels wide."""
    if shape in BLOCKS:
        keep = (lambda p: np.random.default_rng(5).random(p.shape[:3]) < 0.65) if shape == "carved" else None
        mesh = box_mesh(*[np.arange(size + 1) * H] * 3, keep=keep)
        if shape == "shaken":
            moves = np.random.default_rng(6).uniform(-0.1 * H, 0.1 * H, mesh.points_m.shape)
            mesh = replace(mesh, points_m=mesh.points_m + moves)
    else:
        mesh = tet_mesh(stuff(SHAPES[shape].level(8)), H)
    return dressed(mesh, temperature_c, regions)


def spots(points: np.ndarray) -> np.ndarray:
    """Single hot and cold nodes in an even body."""
    return np.random.default_rng(1).choice([-30.0, 20.0, 90.0], len(points))


def faults(solution: HeatSolution, low: float, high: float, shape: str = "shaken") -> list[str]:
    """What is wrong: not finite, not balanced, or out of range without a word or by too much.

    Without obtuse angles, in the first two of `BLOCKS`, no temperature leaves its range but by round-off.
    """
    temperature_c = solution.temperature_c
    most_k = (1e-8 if shape in BLOCKS[:2] else MOST_OVERSHOOT) * (high - low)
    beyond_k = max(low - float(temperature_c.min()), float(temperature_c.max()) - high)
    found = {
        "not finite": not np.isfinite(temperature_c).all(),
        f"energy {solution.energy_residual:.1e}": not solution.energy_residual < 1e-9,
        f"beyond by {beyond_k:.1e} K": not beyond_k <= most_k,
        f"silent about {beyond_k:.1e} K": beyond_k > OVERSHOOT_K and "left its range" not in solution.status,
    }
    return [f"{name}: {solution.status}" for name, wrong in found.items() if wrong]
