"""The command ``thermoxels audit``: find heat loss, U-values and thermal bridges from measured temperatures."""

from __future__ import annotations

# Only light imports at the top, so that --help answers at once.
import time as clock
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tyro
from threadpoolctl import threadpool_limits

from thermoxels_ns.commands.installed_commands import command_of
from thermoxels_ns.core.checks import check_direction, check_positive, remove_file, result_folder
from thermoxels_ns.core.errors import AuditError

if TYPE_CHECKING:
    from thermoxels_ns.audit.run import Audit as Found
    from thermoxels_ns.reports.page import Picture

ANSWERS, PAGE, SURFACE = "answers.json", "audit.html", "surface.vtp"
"""Files that an audit writes."""

Say = Callable[[str], None]


@dataclass
class Audit:
    """Compute heat loss, U-values and thermal bridges, as intervals, from temperatures that thermal images measured.

    Writes audit.html (open it first, or print it), answers.json, and surface.vtp for ParaView. A yaml file states the
    conditions on site: ``thermoxels audit --write-conditions conditions.yaml`` writes an example that explains them."""

    mesh: tyro.conf.Positional[Path | None] = None
    """The mesh.vtu of an export with a known scale; its mesh-boundary.vtp must lie in the same folder."""
    conditions: Path | None = None
    """Conditions of the survey, a yaml file: air inside and outside, wind, sky, emissivities, camera, each with +-."""
    output_dir: Path = Path("audit")
    """Folder for the results; made if it does not exist. Results of an earlier audit in the folder are replaced."""
    write_conditions: Path | None = None
    """Write an example of conditions that explains every key to this file, and do nothing else."""
    up: tuple[float, float, float] | None = None
    """Direction that points up in the coordinates of the mesh. Default: the direction in the summary.json beside the
    mesh, or else z."""
    scene: Path | None = None
    """Folder of the photographs that the mesh was made from, the --data of the training: the page then shows each
    defect in the photograph and the thermal image in which the defect is largest."""
    pictures: bool = True
    """Draw pictures for the page."""

    def main(self) -> None:
        """Run the audit; raises `ThermoxelsError` if the mesh, the conditions or an option cannot be used."""
        from rich.console import Console

        console = Console(highlight=False)
        # With more BLAS threads, the last bits of results would depend on the number of threads.
        with threadpool_limits(1, "blas"):
            run_audit(self, lambda line: console.print(line, markup=False, soft_wrap=True))


def run_audit(options: Audit, say: Say = lambda _: None) -> Found | None:
    """Audit a mesh, write all files, return the result; with `options.write_conditions`, only write an example."""
    from thermoxels_ns.audit.conditions import load_conditions, write_example
    from thermoxels_ns.audit.run import audit
    from thermoxels_ns.commands.audit_photographs import photographs_of_defects
    from thermoxels_ns.mesh.files.vtu import read_export_summary, read_mesh
    from thermoxels_ns.reports.numbers import interval_text

    if options.write_conditions is not None:
        write_example(options.write_conditions)
        say(f"Written to {options.write_conditions}: put in what you measured, and pass it with --conditions.")
        return None
    if options.mesh is None or options.conditions is None:
        missing = "mesh" if options.mesh is None else "conditions"
        remedy = "Pass the mesh.vtu of an export, and --conditions; --write-conditions writes an example of these."
        raise AuditError(missing, expected="a file", got="none", remedy=remedy)
    begin = clock.perf_counter()
    others = ("summary.json", "quality.json", "series.csv")
    folder = result_folder(options.output_dir, (ANSWERS, PAGE, SURFACE), (SURFACE, ANSWERS), others)
    conditions = load_conditions(options.conditions)
    mesh = read_mesh(options.mesh)
    export = read_export_summary(options.mesh, say)
    up = export.get("up") if options.up is None else options.up
    direction = check_direction("up", up or (0.0, 0.0, 1.0), "Pass --up 0 0 1.", AuditError)
    x, y, z = (direction / float(np.linalg.norm(direction))).tolist()
    say(f"Mesh: {len(mesh.tets):,} tetrahedra, {len(mesh.facets):,} boundary triangles.")
    found = audit(mesh, conditions, (x, y, z))
    for words in (*found.check.forbidden, *found.check.doubts):
        say(f"Warning: {words}")
    if found.check.missing:
        say(f"Missing for a report after EN 13187: {', '.join(found.check.missing)}.")
    whole = found.whole
    say(f"Heat loss: {interval_text(whole.loss_w, 'W')}; U-value: {interval_text(whole.u_w_m2k, 'W/(m2 K)')}.")
    say(f"{sum(not one.not_counted for one in found.defects)} thermal bridges or defects.")
    calibration = found.calibration
    if calibration is not None:
        told = [f"{name} {interval_text(one, calibration.units[name])}" for name, one in calibration.found.items()]
        say(f"Calibration: {'; '.join(told) or f'refused. {calibration.refused}'}")
    photographs = {}
    if options.scene is not None:
        scale = (export.get("scale") or {}).get("metres_per_unit", 1.0)
        scale = check_positive("summary.json: metres_per_unit", scale, "Export the mesh again.", AuditError)
        photographs = photographs_of_defects(options.scene, scale, found)
        say(f"Photographs show {sum(not found.defects[number].not_counted for number in photographs)} of them.")
    _write(folder, options, found, photographs)
    say(f"Written to {folder}: {PAGE}, {ANSWERS}, {SURFACE} ({clock.perf_counter() - begin:.1f} s)")
    return found


def answers_of(options: Audit, found: Found) -> dict[str, Any]:
    """Return the content of answers.json; numbers and ends of intervals that are NaN or infinite become null."""
    from pydantic_core import to_jsonable_python

    calibration = found.calibration
    same = ("conditions", "whole", "patches", "storeys", "defects", "limits", "f_rsi", "year", "not_counted_m2")
    named = ("found", "units", "refused", "moved_most_by", "misfit_k")
    told = {
        "mesh": options.mesh,
        **{name: getattr(found, name) for name in same},
        "calibration": None if calibration is None else {name: getattr(calibration, name) for name in named},
        "forbidden": found.check.forbidden,
        "doubts": found.check.doubts,
        "missing_for_en_13187": found.check.missing,
        "loss_moved_by_w": found.budget,
    }
    return to_jsonable_python(told, inf_nan_mode="null")


def _write(folder: Path, options: Audit, found: Found, photographs: Mapping[int, tuple[Picture, ...]]) -> None:
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    from thermoxels_ns.mesh.files.vtu import summary_text, write_summary, write_vtk
    from thermoxels_ns.reports.audit_page import audit_page, draw_audit
    from thermoxels_ns.reports.page import write_page

    answers = answers_of(options, found)
    summary_text(answers)  # raises if json cannot hold the answers
    remove_file(folder / ANSWERS)
    write_vtk(vtkXMLPolyDataWriter(), folder / SURFACE, found.to_pyvista())
    pictures = draw_audit(found) if options.pictures else None
    assert options.mesh is not None
    command, files = command_of("audit", options), (PAGE, ANSWERS, SURFACE)
    write_page(folder / PAGE, audit_page(found, pictures, photographs, options.mesh.name, command, files))
    write_summary(folder / ANSWERS, answers)
