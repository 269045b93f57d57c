"""Do the intervals of audits hold the truth? Walls of known construction, solved by finite elements and audited.

    python tests/benchmarks/audit_truth.py --seeds 40
    python tests/benchmarks/audit_truth.py --seeds 40 --calibrate

No training is in the loop: the camera's readings are made of the surface temperatures of the solved mesh. Each seed
draws what is true from the ranges that the conditions state, solves a wall with a window and a balcony slab, and the
same wall without the slab, and makes readings: offset, drift that is smooth over the wall, noise of 0.1 K per pixel
with four pixels to a node, emissivity and reflection. Each wall is audited from outside twice, with the camera's offset
known to 1 K and with one contact temperature known to 0.2 K in its place, and once from inside without the window.

With --calibrate conductivities are estimated instead, from starts that are off by factors of two: of wall and glazing
from outside with a contact temperature, of the wall from inside. With --balance the formula of convection is drawn,
too, for the truth as for the audits, and a calm, clear night is added, whose sky cools the wall below the air.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import tyro
from measuring import print_head, print_row

from tests.support.audited_wall import (
    INSIDE,
    LENGTH_M,
    NIGHT,
    STATED,
    UP,
    Truth,
    audited_wall,
    calibrated,
    photographed,
    solve_wall,
    true_draws,
    with_contact,
)
from thermoxels_ns.audit.conditions import Conditions, Film
from thermoxels_ns.audit.draws import Interval
from thermoxels_ns.audit.run import audit


def findings(truth: Truth, plain: Truth, conditions: Conditions, seed: int) -> Iterator[tuple[str, float, Interval]]:
    """Audit a wall with a slab; yield each quantity with its truth and what was found."""
    found = audit(photographed(truth, conditions, seed), conditions, UP)
    difference = float(truth.draws["inside air"][0] - truth.draws["outside air"][0])
    yield "loss", truth.loss_w, found.whole.loss_w
    for one in found.patches:
        yield f"U of {one.name}", truth.u_w_m2k[one.name], one.u_w_m2k
    lines = [one for one in found.defects if one.kind == "line"]
    if len(lines) == 1:
        yield "psi", (truth.loss_w - plain.loss_w) / LENGTH_M / difference, lines[0].coefficient


Rows = dict[tuple[str, str], list[tuple[float, Interval]]]
"""What was found of each quantity of each kind of audit, with its truth."""


def report(rows: Rows) -> None:
    """Print how often the intervals hold the truth, how many are upper bounds, median errors and widths."""
    print_head("audit", "quantity", "found", "held", "at most", "median error", "median width")
    for (how, name), values in rows.items():
        held = np.mean([found.low <= true <= found.high for true, found in values])
        error = np.median([abs(found.value / true - 1.0) for true, found in values])
        width = np.median([(found.high - found.low) / true for true, found in values])
        bounds = sum(found.at_most for _, found in values)
        print_row(how, name, len(values), f"{held:.1%}", bounds, f"{error:.1%}", f"{width:.1%}")


@dataclass
class AuditTruth:
    seeds: int = 40
    """Walls."""
    step: float = 0.05
    """Size of the cells, [m]."""
    calibrate: bool = False
    """Estimate conductivities instead."""
    balance: bool = False
    """Draw the formula of convection."""

    def main(self) -> None:
        rows: Rows = {}
        if self.calibrate:
            for seed, side in product(range(self.seeds), ("outside", "inside")):
                for name, true, found in calibrated(side, seed, self.step):
                    rows.setdefault((side, name), []).append((true, found))
            report(rows)
            return
        within = {"window": False, "side": "inside"}
        walls = {
            "outside": (STATED, audited_wall(self.step), audited_wall(self.step, slab=False)),
            "inside": (INSIDE, audited_wall(self.step, **within), audited_wall(self.step, slab=False, **within)),
        }
        if self.balance:
            walls = {side: (replace(stated, film=Film()), *meshes) for side, (stated, *meshes) in walls.items()}
            walls["night"] = (NIGHT, *walls["outside"][1:])
        false_bridges: Counter[str] = Counter()
        for seed, (side, (stated, slab, plain_mesh)) in product(range(self.seeds), walls.items()):
            draws = true_draws(stated, seed)
            truth, plain = (solve_wall(mesh, stated, draws) for mesh in (slab, plain_mesh))
            for how in ("offset", "contact") if side == "outside" else ("offset",):
                known = [stated if how == "offset" else with_contact(stated, one, seed) for one in (truth, plain)]
                for name, true, found in findings(truth, plain, known[0], seed):
                    rows.setdefault((f"{side}, {how}", name), []).append((true, found))
                false_bridges[f"{side}, {how}"] += bool(audit(photographed(plain, stated, seed), known[1], UP).defects)
        report(rows)
        for how, count in false_bridges.items():
            print(f"{how}: bridges on {count} of {self.seeds} walls without one")


if __name__ == "__main__":
    tyro.cli(AuditTruth).main()
