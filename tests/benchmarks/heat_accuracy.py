"""What accuracy of the heat solver costs, and whether the tolerance driver finds the cheap way to it.

Run it on an otherwise idle machine:

    OMP_NUM_THREADS=1 python tests/benchmarks/heat_accuracy.py

Steady: case 3 of ISO 10211 and a spherical shell, with linear and quadratic tetrahedra on a given mesh and on the same
with its size halved once and twice. Errors are those of the nodes of the given mesh, against quadratic tetrahedra on
the finest mesh. In time: the rod of NAFEMS T3, two schemes by step size on three meshes, against a fine mesh with
short steps. Then the driver gets each problem with several tolerances: its estimate is compared with the true error,
and its time with that of the cheapest setting by hand whose true error is within the tolerance, which nobody knows
beforehand.

Times are processor times. All settings of a problem, by hand and the driver's, take turns in one process. The ratio of
the driver to a setting by hand is the median of the ratios within the rounds, and the best setting is the one with the
largest such ratio: no lucky run makes a setting the best. All rows are printed and written to a csv file, and the
errors against the seconds are drawn.
"""

import statistics
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from operator import truediv
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from measuring import append_row, logarithmic_panels, save, take_turns

from tests.support.heat_bodies import CONCRETE, building_corner, finer, nafems_t3, planes, shell_mesh
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem, TimeSteps
from thermoxels_ns.fem.solution import ErrorSize, HeatSolution, SteadySolution
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.time_loop import BACKWARD_EULER, SDIRK2, solve_heat
from thermoxels_ns.fem.tolerance import Goals, difference_between, solve_to_tolerance
from thermoxels_ns.heat.effects import Convection

DURATION_S = 32.0
OUTPUTS = 10
Setting = tuple[str, str]
"""Method and how it is set."""


@dataclass(frozen=True)
class Row:
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
    output: Path = Path("outputs/heat-accuracy.csv")
    """Where the rows go."""
    picture: Path = Path("docs/heat-accuracy.png")
    """Where the picture goes."""
    repeats: int = 7
    """Rounds of which the median counts."""

    def main(self) -> None:
        rows: list[Row] = []
        for name, problem, finest, tolerances in (
            ("ISO 10211 case 3", building_corner(lambda *k: planes(*k, step=0.1)), 2, (0.5, 0.25, 0.15, 0.05)),
            ("spherical shell", shell(), 3, (0.1, 0.02, 0.005, 0.001)),
        ):
            rows += self.steady(name, problem, finest, tolerances)
        rows += self.in_time()
        self.output.unlink(missing_ok=True)
        for row in rows:
            append_row(self.output, {k: f"{v:.4g}" if isinstance(v, float) else v for k, v in asdict(row).items()})
        self.draw(rows)

    def steady(self, name: str, given: HeatProblem, finest: int, tolerances: tuple[float, ...]) -> list[Row]:
        exact = solve_steady(finer(given, finest), order=2, relative_tolerance=1e-9)
        settings = [(1, 0), (1, 1), (1, 2), (2, 0), (2, 1)] + ([(2, 2)] if finest > 2 else [])

        def solved(order: int, refinements: int) -> SteadySolution:
            return solve_steady(finer(given, refinements), order=order, relative_tolerance=1e-8)

        by_hand = {
            (f"P{order}", f"mesh size / {2**refinements}"): partial(solved, order, refinements)
            for order, refinements in settings
        }
        nodes = len(given.mesh.points_m)
        return self.compare(name, given, by_hand, tolerances, None, lambda s: difference_between(s, exact, nodes))

    def in_time(self) -> list[Row]:
        name, given = "NAFEMS T3", nafems_t3(10)
        fine = solve_heat(nafems_t3(320), AdaptiveSteps(DURATION_S, 1e-3, outputs=OUTPUTS))
        fine_x = nafems_t3(320).mesh.points_m[:, 0]
        ascending = np.argsort(fine_x)
        x = given.mesh.points_m[:, 0]
        line = np.array([np.interp(x, fine_x[ascending], state[ascending]) for state in fine.temperature_c])
        flows = {heat.effect: float(heat.heat_w.mean()) for heat in fine.effects}

        def error(solution: HeatSolution | SteadySolution) -> ErrorSize:
            largest_k = float(np.abs(solution.temperature_c[..., : len(x)] - line).max())
            through = 0.5 * sum(abs(flow) for flow in flows.values())
            missed = max(abs(float(heat.heat_w.mean()) - flows[heat.effect]) for heat in solution.effects)
            return ErrorSize(largest_k, missed / through)

        def march(refinements: int, scheme: Any, steps: int) -> HeatSolution:
            times = TimeSteps(steps, DURATION_S / steps)
            solution = solve_heat(finer(given, refinements), times, scheme=scheme)
            return replace(solution, temperature_c=solution.temperature_c[:: steps // OUTPUTS])

        by_hand = {
            (scheme.name, f"mesh size / {2**refinements}, step {DURATION_S / steps:g} s"): partial(
                march, refinements, scheme, steps
            )
            for refinements in range(3)
            for scheme in (BACKWARD_EULER, SDIRK2)
            for steps in (10, 20, 40, 80, 160)
        }
        return self.compare(name, given, by_hand, (2.0, 0.5, 0.15), DURATION_S, error)

    def compare(
        self,
        name: str,
        given: HeatProblem,
        by_hand: Mapping[Setting, Callable[[], Any]],
        tolerances: tuple[float, ...],
        duration_s: float | None,
        error: Callable[[Any], ErrorSize],
    ) -> list[Row]:
        """Rows of all settings by hand and of the driver with each tolerance, which take turns."""
        time = None if duration_s is None else AdaptiveSteps(duration_s, outputs=OUTPUTS)
        options: dict[str, Any] = {"time": time, "log": lambda line: None}
        driven = {("driver", f"{k}"): partial(solve_to_tolerance, given, Goals(k), **options) for k in tolerances}
        seconds, results = take_turns({**by_hand, **driven}, self.repeats)
        rows, errors = [], {}
        for one in by_hand:
            errors[one] = true = error(results[one])
            unknowns = results[one].temperature_c.shape[-1]
            if isinstance(results[one], SteadySolution):
                unknowns += len(results[one].edge_temperature_c)
            cost = unknowns, statistics.median(seconds[one]), true.temperature_k, true.heat_flow
            rows.append(Row(name, *one, *cost))
            print(rows[-1], flush=True)
        for tolerance_k, one in zip(tolerances, driven):
            good = [seconds[other] for other in by_hand if errors[other].temperature_k <= tolerance_k]
            ratios = [statistics.median(map(truediv, seconds[one], theirs)) for theirs in good]
            true, level = error(results[one].solution), results[one].settings
            setting = f"P{level.order}, mesh size / {2**level.refinements}"
            if level.step_tolerance_k is not None:
                setting += f", steps to {level.step_tolerance_k:.2g} K"
            over_true = level.error.temperature_k / true.temperature_k
            cost = level.num_nodes, statistics.median(seconds[one]), true.temperature_k, true.heat_flow
            over_best = max(ratios, default=float("nan"))
            rows.append(Row(name, "driver", setting, *cost, tolerance_k, over_true, over_best))
            print(rows[-1], flush=True)
        return rows

    def draw(self, rows: list[Row]) -> None:
        problems = list(dict.fromkeys(row.problem for row in rows))
        figure, panels = logarithmic_panels(1, len(problems), figsize=(4.6 * len(problems), 4.2))
        for panel, problem in zip(panels[0], problems):
            mine = [row for row in rows if row.problem == problem]
            for method in dict.fromkeys(row.method for row in mine):
                dots = sorted((row.seconds, row.error_k) for row in mine if row.method == method)
                line = "" if method == "driver" or problem == "NAFEMS T3" else "-"
                marker, size, colour = ("*", 13, "black") if method == "driver" else ("o", 5, None)
                panel.plot(*zip(*dots), marker + line, markersize=size, color=colour, label=method)
            panel.set(title=problem, xlabel="processor seconds", ylabel="largest error of a node [K]")
            panel.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=4, columnspacing=0.8, handletextpad=0.3)
        save(figure, self.picture)


def shell() -> HeatProblem:
    """An eighth of the shell of tests/verification/test_walls.py; the body is what lies between the facets."""
    effects = (Convection(("inside",), 7.69, 20.0), Convection(("outside",), 25.0, -10.0))
    mesh = shell_mesh(0.5, 0.6, 12, 2, eighth=True)
    return HeatProblem(mesh, CONCRETE, effects=effects)


if __name__ == "__main__":
    tyro.cli(HeatAccuracy).main()
