"""Do the intervals of audits hold the truth? Walls of known construction, solved by finite elements and audited.

    python tests/benchmarks/audit_truth.py --seeds 40
    python tests/benchmarks/audit_truth.py --seeds 40 --calibrate
    python tests/benchmarks/audit_truth.py --seeds 40 --trained draft --output RUNS

Without --trained the camera's readings are made of the surface temperatures of the solved mesh. Each seed
draws what is true from the ranges that the conditions state, solves a wall with a window and a balcony slab, and the
same wall without the slab, and makes readings: offset, drift that is smooth over the wall, noise of 0.1 K per pixel
with four pixels to a node, emissivity and reflection. Each wall is audited from outside twice, with the camera's offset
known to 1 K and with one contact temperature known to 0.2 K in its place, and once from inside without the window.

With --trained the whole way is in the loop: a house with a room, a window in each of two walls, a door and a balcony
slab is solved under what each seed draws, photographed by a camera that errs as stated (noise 0.1 K, drift 0.5 K,
exposure 0.2 stops, poses 0.1 degrees), trained, exported and audited by the commands that a user types, and beside it
the solved mesh itself ("no training"), so that what reconstruction adds shows; with `--trained no` only that, which
takes seconds for a house. Each audit's figures are rows of ``audit_truth.csv`` in the output folder, written as they
come; seeds that are there are not run again. `--first-seed` lets several processes share the seeds of a folder.

With --calibrate conductivities are estimated instead, from starts that are off by factors of two: of wall and glazing
from outside with a contact temperature, of the wall from inside. With --calibrate --history-h 48 the wall (of a time
constant of 12 h) is photographed after a warm day, and its conductivity is found with that many hours of the air before
the survey, and as if heat flow were steady. With --balance the formula of convection is drawn,
too, for the truth as for the audits, and a calm, clear night is added, whose sky cools the wall below the air.
"""

import shutil
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, astuple, dataclass, replace
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import numpy as np
import tyro
from measuring import append_row, print_head, print_row, read_rows, run_of, run_quietly, trained

from tests.support.audited_house import CONTACT_M, ELEMENTS, SLAB, SLAB_LENGTH_M, house_mesh, house_scene, patches_yaml
from tests.support.audited_wall import (
    CONDUCTIVITY,
    INSIDE,
    LENGTH_M,
    NIGHT,
    STATED,
    UP,
    Truth,
    audited_wall,
    calibrated,
    calibrated_after,
    photographed,
    solve_wall,
    true_draws,
    with_contact,
)
from thermoxels_ns.audit.conditions import Conditions, Film
from thermoxels_ns.audit.draws import Interval
from thermoxels_ns.audit.run import audit
from thermoxels_ns.mesh.tetrahedra import TetMesh


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


def house_findings(
    mesh: TetMesh, truth: Truth, plain: Truth, conditions: Conditions
) -> Iterator[tuple[str, float, Interval]]:
    """Audit a house; yield each quantity with its truth and what was found, and the number of bridges beside the slab.

    Areas and the number of bridges have no interval: both of its ends are what was found.
    """
    others = tuple(name for name in mesh.boundary.patch_names if name not in ELEMENTS)
    found = audit(mesh, replace(conditions, leave_out=others), UP)
    difference = float(truth.draws["inside air"][0] - truth.draws["outside air"][0])
    true_w = {name: truth.u_w_m2k[name] * truth.area_m2[name] * difference for name in ELEMENTS}
    yield "loss", sum(true_w.values()), found.whole.loss_w
    for one in found.patches:
        yield f"U of {one.name}", truth.u_w_m2k[one.name], one.u_w_m2k
        yield f"area of {one.name}", truth.area_m2[one.name], Interval(*3 * (one.area_m2,))
    lines = []
    for one in (one for one in found.defects if not one.not_counted):
        near = np.maximum(np.subtract(SLAB[0], one.centre_m), np.subtract(one.centre_m, SLAB[1])).max() < 0.4
        lines += [one] if near and one.kind == "line" else []
    true_psi = sum(truth.flow_w[name] - plain.flow_w[name] for name in ELEMENTS) / SLAB_LENGTH_M / difference
    if lines:
        yield "psi", true_psi, max(lines, key=lambda one: one.extra_w.value).coefficient
    beside = sum(not one.not_counted for one in found.defects) - len(lines)
    yield "other bridges", 0.0, Interval(*3 * (float(beside),))


def trained_mesh(truth: Truth, stated: Conditions, folder: Path, quality: str, seed: int) -> TetMesh:
    """Photograph a solved house, train and export; the folder keeps logs, and the mesh."""
    from thermoxels_ns.mesh.files.vtu import read_mesh
    from thermoxels_ns.synthetic.imperfections import Imperfections
    from thermoxels_ns.synthetic.scene_folder import TRUTH, write_scene

    flaws = Imperfections(exposure_stops=0.2, noise_k=0.1, drift_k=0.5, pose_error_deg=0.1)
    write_scene(house_scene(truth, stated), folder / "scene", seed=seed, imperfections=flaws, progress=False)
    (folder / "scene" / TRUTH).unlink()  # no command knows a scene of this name
    (folder / "patches.yaml").write_text(patches_yaml(), encoding="utf-8")
    trained(folder / "scene", folder, ["--quality", quality])
    command = ["ns-export", "thermoxels-mesh", "--load-config", str(run_of(folder) / "config.yml")]
    command += ["--output-dir", str(folder / "export"), "--metres-per-unit", "1"]
    run_quietly([*command, "--patches", str(folder / "patches.yaml")], folder / "export.log")
    mesh = read_mesh(folder / "export" / "mesh.vtu")
    for name in ("outputs", "scene"):
        shutil.rmtree(folder / name)
    return mesh


def run_trained(output: Path, quality: str, seeds: range) -> None:
    """Train and audit the houses that the output folder does not have yet, and print what all say."""
    path = output / "audit_truth.csv"
    done = {(row["quality"], row["seed"]) for row in read_rows(path)}
    for seed in seeds:
        if (quality, str(seed)) in done:
            continue
        draws = true_draws(STATED, seed)
        truth, plain = (solve_wall(house_mesh(slab=slab), STATED, draws) for slab in (True, False))
        folder = output / f"{quality} {seed}"
        shutil.rmtree(folder, ignore_errors=True)
        meshes = {"no training": photographed(truth, STATED, seed)}
        if quality != "no":
            meshes["trained"] = trained_mesh(truth, STATED, folder, quality, seed)
        contact = with_contact(STATED, truth, seed, CONTACT_M)
        rows = [
            {"quality": quality, "seed": seed, "audit": f"{how}, {known}", "quantity": name, "true": true}
            | asdict(found)
            for how, mesh in meshes.items()
            for known, conditions in (("offset", STATED), ("contact", contact))
            for name, true, found in house_findings(mesh, truth, plain, conditions)
        ]
        for row in rows:
            append_row(path, row)
        print(f"seed {seed}: done", flush=True)
    found_of: Rows = {}
    for row in read_rows(path):
        if row["quality"] == quality:
            found = Interval(*(float(row[name]) for name in ("value", "low", "high")))
            found_of.setdefault((row["audit"], row["quantity"]), []).append((float(row["true"]), found))
    report(found_of)


Rows = dict[tuple[str, str], list[tuple[float, Interval]]]
"""What was found of each quantity of each kind of audit, with its truth."""


def report(rows: Rows) -> None:
    """Print how often the intervals hold the truth, how many are upper bounds, median errors and widths."""
    print_head("audit", "quantity", "found", "held", "at most", "median bias", "error", "width")
    for (how, name), values in rows.items():
        held = np.mean([found.low <= true <= found.high for true, found in values])
        scale = [true or 1.0 for true, _ in values]
        off = [(found.value - true) / size for (true, found), size in zip(values, scale)]
        width = np.median([(found.high - found.low) / size for (_, found), size in zip(values, scale)])
        bounds = sum(found.at_most for _, found in values)
        figures = f"{held:.1%}", bounds, f"{np.median(off):+.1%}", f"{np.median(np.abs(off)):.1%}", f"{width:.1%}"
        print_row(how, name, len(values), *figures)


@dataclass
class AuditTruth:
    seeds: int = 40
    """Walls."""
    step: float = 0.05
    """Size of the cells, [m]."""
    calibrate: bool = False
    """Estimate conductivities instead."""
    history_h: float = 0.0
    """Of --calibrate: photograph after a warm day, of which the weather file knows so many hours; 0: steady, [h]."""
    balance: bool = False
    """Draw the formula of convection."""
    trained: Literal["no", "draft", "standard"] | None = None
    """Audit solved houses: photographed, trained and exported in this quality, or as they were solved."""
    first_seed: int = 0
    """Of --trained."""
    output: Path = Path("audit-truth")
    """Folder for the rows and logs of --trained."""

    def main(self) -> None:
        rows: Rows = {}
        refused: Counter[str] = Counter()
        if self.trained:
            return run_trained(self.output, self.trained, range(self.first_seed, self.first_seed + self.seeds))
        if self.calibrate and self.history_h > 0.0:
            with TemporaryDirectory() as folder:
                for seed, side, steady in product(range(self.seeds), ("outside", "inside"), (False, True)):
                    how = f"{side}, {'as if steady' if steady else f'{self.history_h:g} h of air'}"
                    found, calibration = calibrated_after(side, seed, Path(folder), self.history_h, steady)
                    print(seed, how, *astuple(found)[:3], calibration.refused[:60], sep="; ", file=sys.stderr)
                    if calibration.refused:
                        refused[how] += 1
                    else:
                        rows.setdefault((how, "conductivity of wall"), []).append((CONDUCTIVITY["wall"], found))
            report(rows)
            for how, count in refused.items():
                print(f"{how}: {count} of {self.seeds} refused")
            return
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
