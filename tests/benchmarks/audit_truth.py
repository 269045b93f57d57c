"""Do the intervals of audits hold the truth? Walls of known construction, solved by finite elements and audited.

    python tests/benchmarks/audit_truth.py --seeds 40
    python tests/benchmarks/audit_truth.py --seeds 40 --calibrate

No training is in the loop yet: the camera's readings are made of the surface temperatures of the solved mesh. Each
seed draws what is true (airs, wind, clouds, dew point, ground, emissivity, film factor, offset of the camera) from the
ranges that the conditions state, solves a wall with a window and a balcony slab, and the same wall without the slab,
and makes readings: offset, drift that is smooth over the wall, noise of 0.1 K per pixel with four pixels to a node,
emissivity and reflection. Each wall is audited from outside twice, with the camera's offset known to 1 K and with one
contact temperature known to 0.2 K in its place, and once from inside, with the offset known to 0.5 K (without the
window). Printed: how often the 90 % intervals hold the truth by kind of quantity, median errors, how often the balcony
is found, and how often a bridge is found where there is none.

With --calibrate conductivities are estimated instead, from starts that are off by factors of two: of wall and glazing
from outside with a contact temperature, of the wall from inside.
"""

import argparse
from collections.abc import Iterator

import measuring  # noqa: F401 - makes tests.support importable
import numpy as np

from tests.support.audited_wall import (
    INSIDE,
    LENGTH_M,
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
from thermoxels_ns.audit.conditions import Conditions
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


def calibrate(seeds: int, step: float) -> None:
    """Print how often the intervals of calibrated conductivities hold the true ones."""
    rows: dict[tuple[str, str], list[tuple[float, Interval]]] = {}
    for seed in range(seeds):
        for side in ("outside", "inside"):
            for name, true, found in calibrated(side, seed, step):
                rows.setdefault((side, name), []).append((true, found))
    print(f"{'seen from':10} {'property':24} {'held':>9} {'median error':>13} {'median width':>13}")
    for (side, name), values in rows.items():
        held = sum(found.low <= true <= found.high for true, found in values)
        error = np.median([abs(found.value / true - 1.0) for true, found in values])
        width = np.median([(found.high - found.low) / true for true, found in values])
        print(f"{side:10} {name:24} {held:3} of {len(values):2} {error:13.1%} {width:13.1%}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--step", type=float, default=0.05)
    parser.add_argument("--calibrate", action="store_true")
    arguments = parser.parse_args()
    step = arguments.step
    if arguments.calibrate:
        calibrate(arguments.seeds, step)
        return
    walls = {
        "outside": (STATED, audited_wall(step), audited_wall(step, slab=False)),
        "inside": (
            INSIDE,
            audited_wall(step, window=False, side="inside"),
            audited_wall(step, slab=False, window=False, side="inside"),
        ),
    }
    rows: dict[tuple[str, str], list[tuple[float, Interval]]] = {}
    false_bridges: dict[str, int] = {}
    for seed in range(arguments.seeds):
        for side, (stated, slab, plain_mesh) in walls.items():
            draws = true_draws(stated, seed)
            truth, plain = (solve_wall(mesh, stated, draws) for mesh in (slab, plain_mesh))
            for how in ("offset", "contact") if side == "outside" else ("offset",):
                known = [stated if how == "offset" else with_contact(stated, one, seed) for one in (truth, plain)]
                for name, true, found in findings(truth, plain, known[0], seed):
                    rows.setdefault((f"{side}, {how}", name), []).append((true, found))
                more = bool(audit(photographed(plain, stated, seed), known[1], UP).defects)
                false_bridges[f"{side}, {how}"] = false_bridges.get(f"{side}, {how}", 0) + more
    print(f"{'camera known by':17} {'quantity':12} {'found':>6} {'held':>6} {'at most':>8} {'median error':>13}")
    for (how, name), values in rows.items():
        held = sum(found.low <= true <= found.high for true, found in values)
        bounds = sum(found.at_most for _, found in values)
        error = np.median([abs(found.value / true - 1.0) for true, found in values])
        print(f"{how:17} {name:12} {len(values):6} {held / len(values):6.1%} {bounds:8} {error:13.1%}")
    for how, count in false_bridges.items():
        print(f"{how}: bridges on {count} of {arguments.seeds} walls without one")


if __name__ == "__main__":
    main()
