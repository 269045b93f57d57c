"""What transient conduction costs beside a straightforward scikit-fem script: time and peak memory.

Run it on an otherwise idle machine:

    OMP_NUM_THREADS=1 python tests/benchmarks/heat_speed.py

An insulated concrete cube of 1 m, cut into N^3 voxels of six tetrahedra, is followed through ten steps of backward
Euler. Both sides get the nodes and tetrahedra and return the temperatures of all times; both use one core and conjugate
gradients to a relative residual of 1e-12, the script with the diagonal as preconditioner. It measures it against
M T / dt and starts from the last temperature; we measure against the heat that flows, K T, which is the stricter test.
Ours includes all checks of the input, and everything else that `solve_heat` does.

Times are medians, the two sides taking turns in one process; compiled kernels are loaded before the first. Memory is
that of a process for each side alone: its peak less what it needs after its imports.
"""

import math
import statistics
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from measuring import in_own_process, peak_memory_bytes, print_head, print_row, take_turns
from scipy import sparse
from scipy.sparse.linalg import cg

TOLERANCE = 1e-12
SIDE_M = 1.0


@dataclass
class HeatSpeed:
    voxels: tuple[int, ...] = (20, 40, 64)
    """Voxels along a side, N; the mesh has 6 N^3 tetrahedra."""
    ours_alone: tuple[int, ...] = (88,)
    """Further N on which only our side is measured, to see how its cost grows."""
    steps: int = 10
    """Time steps."""
    step_seconds: float = 60.0
    """Length of a step, [s]."""
    repeats: int = 5
    """Runs per median."""

    def main(self) -> None:
        print(f"\nLumped mass, {self.steps} steps of {self.step_seconds:g} s, medians of {self.repeats}\n")
        print_head(
            *("tetrahedra", "scikit-fem", "ours", "ours / scikit-fem", "per million tetrahedra"),
            *("memory of scikit-fem", "ours", "ours / scikit-fem", "largest difference"),
        )
        for voxels in (*self.voxels, *self.ours_alone):
            print_row(*self.row(voxels, alone=voxels in self.ours_alone))

    def row(self, voxels: int, *, alone: bool) -> list[str]:
        points, tets = cube(voxels)
        start = temperatures(points)
        sides = {"ours": lambda: self.ours(points, tets, start)}
        if not alone:
            sides["scikit-fem"] = lambda: self.scikit_fem(points, tets, start)
        seconds, last = take_turns(sides, self.repeats, time.perf_counter)
        with tempfile.TemporaryDirectory() as folder:
            np.save(Path(folder) / "points.npy", points)
            np.save(Path(folder) / "tets.npy", tets)
            memory = {side: in_own_process(peak_memory_mb, side, Path(folder), self) for side in sides}
        ours, ours_mb = statistics.median(seconds["ours"]), memory["ours"]
        theirs = statistics.median(seconds["scikit-fem"]) if not alone else math.nan
        theirs_mb = memory.get("scikit-fem", math.nan)
        difference = np.abs(last["ours"] - last["scikit-fem"]).max() if not alone else math.nan
        return [
            *(f"{len(tets):,}", f"{theirs:.2f} s", f"{ours:.2f} s", f"{ours / theirs:.2f}"),
            *(f"{1e6 * ours / len(tets):.2f} s", f"{theirs_mb:.0f} MB", f"{ours_mb:.0f} MB"),
            *(f"{ours_mb / theirs_mb:.2f}", f"{difference:.0e} K"),
        ]

    def ours(self, points: np.ndarray, tets: np.ndarray, start: np.ndarray) -> np.ndarray:
        from thermoxels_ns.fem.problem import HeatProblem, TimeSteps
        from thermoxels_ns.fem.time_loop import solve_heat
        from thermoxels_ns.heat.materials import Material
        from thermoxels_ns.mesh.tetrahedra import TetMesh

        none, seen, region = np.zeros((0, 3), np.int64), np.ones(len(points), bool), np.zeros(len(tets), np.int64)
        mesh = TetMesh(points, tets, start, seen, none, none[:, 0], region)
        problem = HeatProblem(mesh, Material("concrete", 1.7, 2200.0, 880.0))
        time_steps = TimeSteps(self.steps, self.step_seconds)
        return solve_heat(problem, time_steps, relative_tolerance=TOLERANCE).temperature_c

    def scikit_fem(self, points: np.ndarray, tets: np.ndarray, start: np.ndarray) -> np.ndarray:
        from skfem import Basis, BilinearForm, ElementTetP1, MeshTet
        from skfem.helpers import dot

        @BilinearForm
        def conduction(u: Any, v: Any, _: Any) -> Any:
            return 1.7 * dot(u.grad, v.grad)

        @BilinearForm
        def storage(u: Any, v: Any, _: Any) -> Any:
            return 2200.0 * 880.0 * u * v

        space = MeshTet(np.ascontiguousarray(points.T), np.ascontiguousarray(tets.T))
        basis = Basis(space, ElementTetP1())
        stiffness, mass = conduction.assemble(basis), storage.assemble(basis)
        mass = sparse.diags(np.asarray(mass.sum(axis=1)).ravel(), format="csr")
        matrix = (mass / self.step_seconds + stiffness).tocsr()
        jacobi = sparse.diags(1.0 / matrix.diagonal())
        states = [start]
        for _ in range(self.steps):
            heat = mass @ states[-1] / self.step_seconds
            state, failed = cg(matrix, heat, x0=states[-1], rtol=TOLERANCE, atol=0.0, M=jacobi)
            if failed:
                raise RuntimeError("scikit-fem script: conjugate gradients did not converge")
            states.append(state)
        return np.array(states)


def peak_memory_mb(side: str, folder: Path, options: HeatSpeed) -> float:
    """Run one side on the mesh in a folder; what the imports and the kernels need does not count, [MB]."""
    run = options.ours if side == "ours" else options.scikit_fem
    points, tets = cube(1)
    run(points, tets, temperatures(points))
    before = peak_memory_bytes()
    points, tets = np.load(folder / "points.npy"), np.load(folder / "tets.npy")
    run(points, tets, temperatures(points))
    return (peak_memory_bytes() - before) / 2**20


def cube(voxels: int) -> tuple[np.ndarray, np.ndarray]:
    from thermoxels_ns.mesh.voxel_tets import kuhn_tets

    corners, tets = kuhn_tets(np.ones((voxels, voxels, voxels), bool))
    return corners * (SIDE_M / voxels), tets


def temperatures(points: np.ndarray) -> np.ndarray:
    """A gradient and a warm spot, [degrees Celsius]: no mode of the cube, which one iteration would solve."""
    spot = np.exp(-np.square(points - 0.4).sum(axis=1) / 0.05)
    return 20.0 + 5.0 * points[:, 0] + 10.0 * spot


if __name__ == "__main__":
    tyro.cli(HeatSpeed).main()
