"""What each effect costs: time for a scene with all effects and with each one removed.

Run it on an otherwise idle machine:

    OMP_NUM_THREADS=1 python tests/benchmarks/effects_cost.py

A room of concrete with the scene of configs/scene-all-effects.yaml takes equal steps, so that all rows take the same
number of them. Times are medians; all problems take turns in one process, and compiled kernels are loaded before the
first.
"""

import statistics
from dataclasses import dataclass, replace

import numpy as np
import tyro
from measuring import print_head, print_row, take_turns

from tests.support.heat_bodies import tagged_body
from thermoxels_ns.fem.problem import TimeSteps, effect_labels
from thermoxels_ns.fem.time_loop import solve_heat
from thermoxels_ns.heat.scene import load_heat_scene
from thermoxels_ns.mesh.tetrahedra import TetMesh


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
