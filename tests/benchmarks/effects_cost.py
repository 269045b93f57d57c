"""What each effect costs: time for a scene with all effects and with each one removed.

Run it on an otherwise idle machine:

    OMP_NUM_THREADS=1 python tests/benchmarks/effects_cost.py

A room of concrete with the scene of configs/scene-all-effects.yaml takes equal steps, so that all rows take the same
number of them. Times are medians; all problems take turns in one process, and compiled kernels are loaded before the
first. The last line compares conduction alone with plain conjugate gradients on the same matrices.
"""

import statistics
from dataclasses import dataclass, replace
from operator import truediv

import numpy as np
import tyro
from measuring import print_head, print_row, take_turns
from scipy import sparse

from tests.support.scene_bodies import tagged_body
from thermoxels_ns.fem.implicit_equation import LinearSolver
from thermoxels_ns.fem.p1_kernels import lumped_mass, stiffness_matrix
from thermoxels_ns.fem.problem import HeatProblem, TimeSteps, effect_labels
from thermoxels_ns.fem.time_loop import solve_heat
from thermoxels_ns.heat.scene import load_heat_scene
from thermoxels_ns.mesh.tetrahedra import TetMesh

TOLERANCE = 1e-12


@dataclass
class EffectsCost:
    voxels: int = 28
    """Voxels along a side of the room; its walls are an eighth as thick."""
    steps: int = 24
    """Time steps."""
    step_seconds: float = 600.0
    """Length of a step, [s]."""
    repeats: int = 5
    """Runs per median."""

    def main(self) -> None:
        mesh, steps = room(self.voxels), TimeSteps(self.steps, self.step_seconds)
        scene = load_heat_scene("all-effects")
        whole = scene.problem(mesh)
        problems = {"all effects": whole}
        for number, label in enumerate(effect_labels(whole)):
            rest = whole.effects[:number] + whole.effects[number + 1 :]
            problems[f"without {label}"] = replace(whole, effects=rest)
        calm = tuple(effect for effect in whole.effects if effect.kind != "radiation")
        problems["without any radiation"] = replace(whole, effects=calm)
        problems["conduction only"] = replace(whole, effects=())
        print(f"{len(mesh.tets):,} tetrahedra, {self.steps} steps of {self.step_seconds:g} s, {self.repeats} runs\n")
        seconds, solutions = take_turns(
            {name: lambda p=problem: solve_heat(p, steps) for name, problem in problems.items()}, self.repeats
        )
        print_head("", "s", "of all", "Newton steps")
        for name, solution in solutions.items():
            median = statistics.median(seconds[name])
            share = median / statistics.median(seconds["all effects"])
            print_row(name, f"{median:.2f}", f"{share:.2f}", solution.newton_iterations.sum())
        self.conduction_only(problems["conduction only"], steps)

    def conduction_only(self, problem: HeatProblem, steps: TimeSteps) -> None:
        """Conduction alone, through the effects layer and by hand."""
        seconds, states = take_turns(
            {
                "through effects": lambda: solve_heat(problem, steps, relative_tolerance=TOLERANCE).temperature_c,
                "plain conjugate gradients": lambda: plainly(problem, steps),
            },
            5 * self.repeats,
        )
        ours, plain = seconds.values()
        ratio = statistics.median(map(truediv, ours, plain))
        difference = np.abs(states["through effects"] - states["plain conjugate gradients"]).max()
        print(f"\nconduction only: {ratio:.3f} of plain conjugate gradients, largest difference {difference:.1e} K")


def plainly(problem: HeatProblem, steps: TimeSteps) -> np.ndarray:
    """Backward Euler with the assembled matrices, conjugate gradients and nothing else."""
    points, tets = problem.mesh.points_m, problem.mesh.tets
    stiffness = stiffness_matrix(points, tets, problem.conductivity_w_mk)
    mass = lumped_mass(points, tets, problem.heat_capacity_j_m3k)
    system = sparse.csr_matrix(stiffness + sparse.diags(mass / steps.step_seconds, format="csr"))
    solver = LinearSolver(system, relative_tolerance=TOLERANCE)
    states = [problem.start_c]
    for _ in range(steps.steps):
        states.append(states[-1] + solver.solve(-(stiffness @ states[-1])).x)
    return np.array(states)


def room(voxels: int) -> TetMesh:
    """A closed room of 4 m whose side at x = 0 is cut by the box around the scene."""
    thick = max(voxels // 8, 1)
    hollow = slice(thick, -thick)
    cells = np.ones((voxels,) * 3, dtype=bool)
    cells[hollow, hollow, hollow] = False
    mesh = tagged_body(cells, 4.0 / voxels, np.pad(cells, 1, constant_values=True), cut_below_x=1e-6)
    points = mesh.points_m
    return replace(mesh, temperature_c=15.0 + 2.0 * points[:, 2] + np.sin(3.0 * points[:, 0]))


if __name__ == "__main__":
    tyro.cli(EffectsCost).main()
