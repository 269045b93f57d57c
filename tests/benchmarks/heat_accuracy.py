"""What accuracy of the heat solver costs, and whether the tolerance driver finds the cheap way to it.

Run it on an otherwise idle machine:

    OMP_NUM_THREADS=1 python tests/benchmarks/heat_accuracy.py

Steady: case 3 of ISO 10211 and a spherical shell, with linear and quadratic tetrahedra on a given mesh and on the same
with its size halved once and twice. Errors are those of the nodes of the given mesh, against quadratic tetrahedra on
the finest mesh. In time: the rod of NAFEMS T3, three schemes by step size on three meshes, against a fine mesh with
short steps. Then the driver gets each problem with several tolerances: its estimate is compared with the true error,
and its time with that of the cheapest setting by hand whose true error is within the tolerance, which nobody knows
beforehand.

Prints all rows, and writes them to a csv file and the errors against the seconds to a picture.
"""

from __future__ import annotations

import csv
import gc
import sys
import time
import types
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro

if "tests" not in sys.modules:  # Another distribution may have installed a package of this name.
    sys.modules["tests"] = types.ModuleType("tests")
    sys.modules["tests"].__path__ = [str(Path(__file__).parents[1])]

from tests.building_corner import building_corner
from tests.heat_meshes import box_mesh, planes
from tests.shell_mesh import shell_mesh
from thermoxels_ns.checks import replace_when_done
from thermoxels_ns.fem.effects import Convection, FixedTemperature
from thermoxels_ns.fem.error_budget import ErrorSize, Tolerance, difference_between
from thermoxels_ns.fem.materials import Material
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem, TimeSteps
from thermoxels_ns.fem.quantities import Varying
from thermoxels_ns.fem.refine_mesh import refine_mesh
from thermoxels_ns.fem.schemes import BACKWARD_EULER, CRANK_NICOLSON, SDIRK2
from thermoxels_ns.fem.solution import HeatSolution, SteadySolution
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.stepping import solve_heat
from thermoxels_ns.fem.tolerance import solve_to_tolerance

DURATION_S = 32.0
OUTPUTS = 10


@dataclass(frozen=True)
class Row:
    """One solution."""

    problem: str
    method: str
    setting: str
    unknowns: int
    seconds: float
    error_k: float
    """True error of the temperature, [K]."""
    error_flow: float
    """True error of the heat flow as a share of it."""
    tolerance_k: float = float("nan")
    """What the driver was asked for."""
    estimate_over_true: float = float("nan")
    """The driver's estimate over the true error."""
    seconds_over_best: float = float("nan")
    """The driver's time over that of the best setting by hand."""


@dataclass
class HeatAccuracy:
    """Error against seconds."""

    output: Path = Path("outputs/heat-accuracy.csv")
    """Where the rows go."""
    picture: Path = Path("docs/heat-accuracy.png")
    """Where the picture goes."""
    repeats: int = 3
    """Runs of which the fastest counts."""

    def main(self) -> None:
        """Measure, print and write."""
        rows: list[Row] = []
        for name, problem, finest, tolerances in (
            ("ISO 10211 case 3", building_corner(lambda *k: planes(*k, step=0.1)), 2, (0.5, 0.25, 0.15, 0.05)),
            ("spherical shell", shell(), 3, (0.1, 0.02, 0.005, 0.001)),
        ):
            rows += self.steady(name, problem, finest, tolerances)
        rows += self.in_time()
        self.write(rows)
        self.draw(rows)

    def steady(self, name: str, given: HeatProblem, finest: int, tolerances: tuple[float, ...]) -> list[Row]:
        """Rows of a steady problem; `finest` is how often the mesh is refined for the reference."""
        problems = [given]
        for _ in range(finest):
            problems.append(replace(problems[-1], mesh=refine_mesh(problems[-1].mesh), initial_temperature_c=None))
        exact = solve_steady(problems[-1], order=2, relative_tolerance=1e-9)
        settings = [(1, 0), (1, 1), (1, 2), (2, 0), (2, 1)] + ([(2, 2)] if finest > 2 else [])
        rows = []
        for order, refinements in settings:
            run = _refined_solution(given, order, refinements)
            seconds, solution = self.fastest(run)
            unknowns = len(solution.temperature_c) + len(solution.edge_temperature_c)
            setting = f"mesh size / {2**refinements}"
            rows.append(_row(name, f"P{order}", setting, unknowns, seconds, _error(given, solution, exact)))
            print(rows[-1], flush=True)
        for tolerance_k in tolerances:
            rows.append(self.drive(name, given, tolerance_k, None, rows, lambda s: _error(given, s, exact)))
        return rows

    def in_time(self) -> list[Row]:
        """Rows of NAFEMS T3."""
        name, given = "NAFEMS T3", rod(10)
        fine = solve_heat(rod(320), AdaptiveSteps(DURATION_S, 1e-3, outputs=OUTPUTS))
        fine_x = rod(320).mesh.points_m[:, 0]
        ascending = np.argsort(fine_x)
        x = given.mesh.points_m[:, 0]
        line = np.array([np.interp(x, fine_x[ascending], state[ascending]) for state in fine.temperature_c])
        flows = {heat.effect: float(heat.heat_w.mean()) for heat in fine.effects}

        def error(solution: HeatSolution | SteadySolution) -> ErrorSize:
            largest_k = float(np.abs(solution.temperature_c[..., : len(x)] - line).max())
            through = 0.5 * sum(abs(flow) for flow in flows.values())
            missed = max(abs(float(heat.heat_w.mean()) - flows[heat.effect]) for heat in solution.effects)
            return ErrorSize(largest_k, missed / through)

        rows = []
        for refinements in range(3):
            for scheme in (BACKWARD_EULER, CRANK_NICOLSON, SDIRK2):
                for steps in (10, 20, 40, 80, 160):
                    run = _refined_march(given, refinements, scheme, steps)
                    seconds, solution = self.fastest(run)
                    setting = f"mesh size / {2**refinements}, step {DURATION_S / steps:g} s"
                    unknowns = solution.temperature_c.shape[1]
                    rows.append(_row(name, scheme.name, setting, unknowns, seconds, error(solution)))
                    print(rows[-1], flush=True)
        for tolerance_k in (2.0, 0.5, 0.15):
            rows.append(self.drive(name, given, tolerance_k, DURATION_S, rows, error))
        return rows

    def drive(
        self,
        name: str,
        given: HeatProblem,
        tolerance_k: float,
        duration_s: float | None,
        by_hand: list[Row],
        error: Callable[[Any], ErrorSize],
    ) -> Row:
        """Row of the driver."""

        def run() -> Any:
            return solve_to_tolerance(
                given, Tolerance(tolerance_k), duration_s=duration_s, outputs=OUTPUTS, log=lambda line: None
            )

        seconds, found = self.fastest(run)
        true = error(found.solution)
        good = [row.seconds for row in by_hand if row.method != "driver" and row.error_k <= tolerance_k]
        level = found.settings
        setting = f"P{level.order}, mesh size / {2**level.refinements}"
        if level.step_tolerance_k is not None:
            setting += f", steps to {level.step_tolerance_k:.2g} K"
        row = Row(
            name,
            "driver",
            setting,
            level.num_nodes,
            seconds,
            true.temperature_k,
            true.heat_flow,
            tolerance_k,
            level.error.temperature_k / true.temperature_k,
            seconds / min(good) if good else float("nan"),
        )
        print(row, flush=True)
        return row

    def fastest(self, run: Callable[[], Any]) -> tuple[float, Any]:
        """Processor seconds of the fastest of some runs and the result of the last; long ones run once."""
        best, result = np.inf, None
        for _ in range(self.repeats):
            result = None
            gc.collect()
            begin = time.process_time()
            result = run()
            best = min(best, time.process_time() - begin)
            if best > 5.0:
                break
        return best, result

    def write(self, rows: list[Row]) -> None:
        """Write the csv file."""
        self.output.parent.mkdir(parents=True, exist_ok=True)
        with replace_when_done(self.output) as path, path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, [field.name for field in fields(Row)])
            writer.writeheader()
            for row in rows:
                writer.writerow({k: f"{v:.4g}" if isinstance(v, float) else v for k, v in asdict(row).items()})

    def draw(self, rows: list[Row]) -> None:
        """Draw errors against seconds, one panel per problem."""
        import matplotlib

        matplotlib.use("Agg")
        from matplotlib import pyplot

        problems = list(dict.fromkeys(row.problem for row in rows))
        figure, panels = pyplot.subplots(1, len(problems), figsize=(4.6 * len(problems), 4.2), layout="constrained")
        for panel, problem in zip(panels, problems):
            mine = [row for row in rows if row.problem == problem]
            for method in dict.fromkeys(row.method for row in mine):
                dots = sorted((row.seconds, row.error_k) for row in mine if row.method == method)
                line = "" if method == "driver" or problem == "NAFEMS T3" else "-"
                marker, size = ("*", 13) if method == "driver" else ("o", 5)
                panel.plot(*zip(*dots), marker + line, markersize=size, label=method)
            panel.set(
                xscale="log",
                yscale="log",
                title=problem,
                xlabel="processor seconds",
                ylabel="largest error of a node [K]",
            )
            panel.grid(True, which="both", alpha=0.25)
            panel.legend(loc="lower left")
        self.picture.parent.mkdir(parents=True, exist_ok=True)
        with replace_when_done(self.picture) as path:
            figure.savefig(path, dpi=110)


def shell() -> HeatProblem:
    """An eighth of the shell of tests/verification/test_walls.py; the body is what lies between the facets."""
    effects = (Convection(("inside",), 7.69, 20.0), Convection(("outside",), 25.0, -10.0))
    mesh = shell_mesh(0.5, 0.6, 12, 2, eighth=True)
    return HeatProblem(mesh, Material("concrete", 1.7, 2200.0, 880.0), effects=effects)


def rod(parts: int) -> HeatProblem:
    """The rod of NAFEMS T3."""
    mesh = box_mesh(np.linspace(0, 0.1, parts + 1), [0, 0.01], [0, 0.01], temperature_c=0.0)
    swing = Varying(lambda places, time_s: 100.0 * np.sin(np.pi * time_s / 40.0))
    effects = (FixedTemperature(("x0",), 0.0), FixedTemperature(("x1",), swing))
    return HeatProblem(mesh, Material("steel", 35.0, 7200.0, 440.5), effects=effects)


def _refined_problem(given: HeatProblem, refinements: int) -> HeatProblem:
    problem = replace(given)
    for _ in range(refinements):
        problem = replace(problem, mesh=refine_mesh(problem.mesh), initial_temperature_c=None)
    return problem


def _refined_solution(given: HeatProblem, order: int, refinements: int) -> Callable[[], SteadySolution]:
    return lambda: solve_steady(_refined_problem(given, refinements), order=order, relative_tolerance=1e-8)


def _refined_march(given: HeatProblem, refinements: int, scheme: Any, steps: int) -> Callable[[], HeatSolution]:
    def run() -> HeatSolution:
        solution = solve_heat(_refined_problem(given, refinements), TimeSteps(steps, DURATION_S / steps), scheme=scheme)
        every = steps // OUTPUTS
        return replace(solution, temperature_c=solution.temperature_c[::every])

    return run


def _error(given: HeatProblem, solution: SteadySolution, exact: SteadySolution) -> ErrorSize:
    return difference_between(solution, exact, len(given.mesh.points_m))


def _row(name: str, method: str, setting: str, unknowns: int, seconds: float, error: ErrorSize) -> Row:
    return Row(name, method, setting, unknowns, seconds, error.temperature_k, error.heat_flow)


if __name__ == "__main__":
    tyro.cli(HeatAccuracy).main()
