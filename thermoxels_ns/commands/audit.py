"""The command ``thermoxels audit``: find heat loss, U-values and thermal bridges from measured temperatures."""

from __future__ import annotations

# Only light imports at the top, so that --help answers at once.
import math
import time as clock
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import tyro
from threadpoolctl import threadpool_limits

from thermoxels_ns.commands.installed_commands import command_of
from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.checks import (
    check_direction,
    check_positive,
    is_number,
    remove_file,
    result_folder,
    writable_folder,
)
from thermoxels_ns.core.errors import AuditError
from thermoxels_ns.core.json_values import plain_values, write_json
from thermoxels_ns.data.layouts import LayoutName

if TYPE_CHECKING:
    from thermoxels_ns.audit.compare import Comparison
    from thermoxels_ns.audit.envelope import Envelope
    from thermoxels_ns.audit.run import Audit as Found
    from thermoxels_ns.mesh.boundary.patches import Vector
    from thermoxels_ns.mesh.tetrahedra import TetMesh
    from thermoxels_ns.reports.page import Picture

ANSWERS, PAGE, DOCUMENT, SURFACE = "answers.json", "audit.html", "audit.pdf", "surface.vtp"
"""Files that an audit writes."""
ENVELOPES = {"hbjson": "envelope.hbjson", "gbxml": "envelope-gbxml.xml"}
"""File names of the formats of `Audit.envelope`."""
_PATCHES = {"wall": "tan", "roof": "indianred", "window": "deepskyblue", "door": "saddlebrown", "ground": "yellowgreen"}
"""Colours of proposed patches by the first word of their names."""

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
    layout: LayoutName | None = None
    """Layout of the folder of --scene, if the training had --layout."""
    thermal_bounds: tuple[float, float] | None = None
    """Degrees Celsius of black and of white in the thermal images of --scene, if the training had --thermal-bounds."""
    least_bridge_w: float = 0.0
    """Bridges and defects that lose less than this extra are listed as seen, but not counted, [W]. What lies within the
    error of the reconstruction is never counted."""
    pictures: bool = True
    """Draw pictures and the 3-D view for the page."""
    pdf: bool = False
    """Print the page into audit.pdf as well: a document to sign. It takes some seconds, and needs WeasyPrint (pip
    install weasyprint)."""
    write_agreement: Path | None = None
    """Write what a client signs before the survey (purpose, conditions, limits) to this .pdf or .html file, and do
    nothing else. What the section survey of --conditions says is filled in; the rest are lines to fill in by hand."""
    compare: Path | None = None
    """The answers.json of an earlier audit of the same building, with its surface.vtp beside it: what changed since,
    with intervals. The two meshes may have different coordinates, both in metres."""
    compare_difference: float | None = None
    """Inside minus outside air at which --compare compares heat losses, [K]. Default: that of the later survey."""
    write_patches: Path | None = None
    """Propose patches: find walls, roofs, windows, doors and the ground on the mesh, write them to this yaml file with
    a picture of their names beside it, and do nothing else. Needs no conditions."""
    patches: Path | None = None
    """A yaml file of patches that replace those of the mesh, such as --write-patches wrote; what --patches of ns-export
    thermoxels-mesh reads."""
    envelope: tuple[Literal["hbjson", "gbxml"], ...] = ()
    """Write the building as flat elements with U-values for energy programs: hbjson (Ladybug Tools), gbxml or both."""
    north: tuple[float, float, float] = (0.0, 1.0, 0.0)
    """Direction that points north in the coordinates of the mesh, for names of walls and for --envelope."""

    def main(self) -> None:
        """Run the audit; raises `ThermoxelsError` if the mesh, the conditions or an option cannot be used."""
        # With more BLAS threads, the last bits of results would depend on the number of threads.
        with threadpool_limits(1, "blas"):
            run_audit(self, partial(print, flush=True))


def run_audit(options: Audit, say: Say = lambda _: None) -> Found | None:
    """Audit a mesh, write all files and return the result; None if an option asked for another file instead.

    `say` receives lines of progress. For errors see `Audit.main`.
    """
    from thermoxels_ns.audit.compare import compare
    from thermoxels_ns.audit.conditions import EXAMPLE, load_conditions
    from thermoxels_ns.audit.envelope import envelope_of
    from thermoxels_ns.audit.run import audit
    from thermoxels_ns.commands.audit_photographs import photographs_of_defects
    from thermoxels_ns.core.yaml_records import write_example
    from thermoxels_ns.data.scene_file import read_scene_file
    from thermoxels_ns.mesh.boundary.planes import find_building
    from thermoxels_ns.reports.numbers import interval_text, plain_names
    from thermoxels_ns.reports.page import why_no_pdf

    if options.write_conditions is not None:
        write_example(options.write_conditions, EXAMPLE, AuditError)
        say(f"Written to {options.write_conditions}: put in what you measured, and pass it with --conditions.")
        return None
    if options.write_agreement is not None:
        write_agreement(options.write_agreement, options.conditions)
        say(f"Written to {options.write_agreement}.")
        return None
    if options.mesh is not None and options.write_patches is not None:
        mesh, up, _ = _read(options.mesh, options, say)
        propose_patches(options.write_patches, mesh, up, options.north, say)
        return None
    if options.mesh is None or options.conditions is None:
        missing = "mesh" if options.mesh is None else "conditions"
        remedy = "Pass the mesh.vtu of an export, and --conditions; --write-conditions writes an example of these."
        raise AuditError(missing, expected="a file", got="none", remedy=remedy)
    if options.compare is not None and options.compare.resolve().parent == options.output_dir.resolve():
        remedy = "Pass another --output-dir."
        raise AuditError("output folder", expected="another one than that of --compare", got="the same", remedy=remedy)
    begin, least_w = clock.perf_counter(), options.least_bridge_w
    if not 0.0 <= least_w < math.inf:
        remedy = "Pass --least-bridge-w 0 to count all."
        raise AuditError("--least-bridge-w", expected="a number of watts, at least 0", got=least_w, remedy=remedy)
    folder = result_folder(options.output_dir, (ANSWERS, PAGE, DOCUMENT, SURFACE, *ENVELOPES.values()), SURFACE)
    lacking = why_no_pdf() if options.pdf else ""
    if lacking:
        say(f"Without audit.pdf: {lacking}")
    conditions = load_conditions(options.conditions)
    if options.envelope and conditions.side != "outside":
        remedy = "Leave --envelope out; rooms are not written."
        raise AuditError("envelope", expected="a survey from outside", got="one from inside", remedy=remedy)
    earlier = None if options.compare is None else read_earlier(options.compare, options.compare_difference)
    scene = None  # is read before anything slow
    if options.scene is not None:
        scene = read_scene_file(options.scene, "skip", options.layout, options.thermal_bounds)
    mesh, up, export = _read(options.mesh, options, say)
    building = find_building(mesh, up, options.north) if options.envelope else None  # raises before anything slow
    found = audit(mesh, conditions, up, least_w)
    envelope = None if building is None else envelope_of(found, building)
    compared = None if earlier is None else compare(earlier(), found, options.compare_difference)
    for words in (*found.check.forbidden, *found.check.doubts, *found.impossible):
        say(f"Warning: {plain_names(words)}")
    if found.check.missing:
        say(f"Missing for a report after EN 13187: {', '.join(found.check.missing)}.")
    whole = found.whole
    say(f"Heat loss: {interval_text(whole.loss_w, 'W')}; U-value: {interval_text(whole.u_w_m2k, 'W/(m2 K)')}.")
    say(f"{sum(not one.not_counted for one in found.defects)} thermal bridges or defects.")
    photographs = {}
    if scene is not None:
        scale = (export.get("scale") or {}).get("metres_per_unit", 1.0)
        scale = check_positive("summary.json: metres_per_unit", scale, "Export the mesh again.", AuditError)
        photographs = photographs_of_defects(scene, scale, found)
        say(f"Photographs show {sum(not found.defects[number].not_counted for number in photographs)} of them.")
    if compared is not None:
        sure = [one.name for one in (*compared.elements, *compared.bridges) if one.significant]
        say(f"Significant changes since the earlier survey: {', '.join(sure) or 'none'}.")
    names = _write(folder, options, found, photographs, envelope, compared)
    say(f"Written to {folder}: {', '.join(names)} ({clock.perf_counter() - begin:.1f} s)")
    return found


def write_agreement(path: Path, conditions: Path | None) -> None:
    """Write what a client signs before a survey to a .pdf or .html file, filled in from a file of conditions, if any.

    Raises `AuditError` if `path` exists or ends otherwise, WeasyPrint is missing, or the conditions are wrong.
    """
    from thermoxels_ns.audit.conditions import Survey
    from thermoxels_ns.core.yaml_records import as_record, raising, read_yaml
    from thermoxels_ns.reports.audit_page import agreement_page
    from thermoxels_ns.reports.page import write_page, write_pdf

    if path.suffix not in (".pdf", ".html") or path.exists():
        got = "a file that is there" if path.exists() else path.name
        remedy = "Choose another name, such as agreement.pdf."
        raise AuditError("--write-agreement", expected="a new .pdf or .html file", got=got, remedy=remedy)
    title, survey = "", Survey()
    with raising(AuditError):
        if conditions is not None:
            stated = read_yaml(conditions)  # before the survey, the rest of it is not known
            survey = as_record(f"{conditions.name}: survey", stated.get("survey") or {}, Survey)
            title = str(stated.get("title") or "")
        writable_folder(path.parent)
        (write_page if path.suffix == ".html" else write_pdf)(path, agreement_page(title, survey))


def propose_patches(path: Path, mesh: TetMesh, up: Vector, north: Vector, say: Say) -> None:
    """Find the flat elements of a building, write them as patch rules to `path`, and draw them in a PNG file beside it.

    `up` and `north` are directions in the coordinates of the mesh. Raises `AuditError` if one of the files exists or
    `path` itself ends with .png, `MeshError` if no planes of the mesh enclose a body.
    """
    from thermoxels_ns.mesh.boundary.patches import with_patches, write_patch_rules
    from thermoxels_ns.mesh.boundary.planes import find_building, proposed_rules
    from thermoxels_ns.reports.mesh_pictures import image_of_surface, write_picture

    picture = path.with_suffix(".png")
    for one in (path, picture):
        if one.exists() or path == picture:
            remedy = "Choose another name with --write-patches, such as patches.yaml."
            got = f"{one}, which is there" if one.exists() else f"{one}, the name of the picture"
            raise AuditError("write_patches", expected="a name of a yaml file that is free", got=got, remedy=remedy)
    building = find_building(mesh, up, north)
    rules = proposed_rules(building)
    tagged, _ = with_patches(mesh, rules, up)
    patch, names = tagged.boundary.patch, tagged.boundary.patch_names
    areas = ", ".join(f"{one.name} {one.net_area_m2:.1f}" for one in building.every() if len(one.facets))
    say(f"Found, [m2]: {areas}. {100 * building.left_out:.0f} % of the volume stands out from walls or is not flat.")
    writable_folder(path.parent)
    at, views = tagged.points_m[tagged.facets].mean(axis=1), []
    normals = {one.name: one.normal for one in building.every()}
    kinds = np.array([name.split("-")[0] for name in names])[patch]
    painted = [(kind, colour, kinds == kind) for kind, colour in _PATCHES.items()]
    painted.append(("no patch", "lightgrey", ~np.isin(kinds, [*_PATCHES])))
    for title, towards in (("south and east", (-0.7, 0.9, -0.55)), ("north and west", (0.7, -0.9, -0.55))):
        direction, labels = building.axes @ towards, list[tuple[str, FloatArray]]()
        for number in np.unique(patch).tolist():
            on, normal = at[patch == number], normals.get(names[number])
            if normal is not None and normal @ towards < 0.0:
                labels.append((names[number], on.mean(axis=0)))
            elif names[number] == "ground":  # its middle may be under the house
                labels.append(("ground", on[np.argsort(on @ direction)[len(on) // 50]]))
        look = {"up": up, "view_direction": direction, "painted": painted, "labels": labels}
        shape = mesh.points_m, mesh.facets, mesh.temperature_c
        views.append(image_of_surface(*shape, title=f"Proposed patches, from {title}", **look))
    write_patch_rules(path, rules, "Proposed by thermoxels audit; see the picture beside, correct and rename.")
    write_picture(picture, np.concatenate(views, axis=1))
    say(f"Written to {path} and {picture}: look at the picture, correct the file, and pass it with --patches.")


def _read(path: Path, options: Audit, say: Say) -> tuple[TetMesh, Vector, dict[str, Any]]:
    """Return the mesh `path` with the patches of `Audit.patches`, the unit vector up, and the export's summary.json."""
    from thermoxels_ns.mesh.boundary.patches import load_patch_rules, with_patches
    from thermoxels_ns.mesh.files.vtu import read_export_summary, read_mesh

    rules = None if options.patches is None else load_patch_rules(options.patches)
    mesh, export = read_mesh(path), read_export_summary(path, say)
    up = export.get("up") if options.up is None else options.up
    x, y, z = check_direction("up", up or (0.0, 0.0, 1.0), "Pass --up 0 0 1.", AuditError).tolist()
    say(f"Mesh: {len(mesh.tets):,} tetrahedra, {len(mesh.facets):,} boundary triangles.")
    if rules is not None:
        mesh, idle = with_patches(mesh, rules, (x, y, z))
        say(f"Rules that no triangle follows: {', '.join(idle)}." if idle else f"Patches of {options.patches}.")
    return mesh, (x, y, z), export


def read_earlier(path: Path, difference_k: float | None) -> Callable[[], Found]:
    """Read an earlier audit from its answers.json and the surface.vtp beside it; return a function that audits again.

    Raises `AuditError` or `MeshError` if a file is missing or damaged, or `difference_k` is not above 0 (None: unused).
    """
    from thermoxels_ns.audit.compare import earlier_conditions
    from thermoxels_ns.audit.run import audit
    from thermoxels_ns.core.json_values import read_json_object
    from thermoxels_ns.mesh.files.vtu import read_surface

    if difference_k is not None:
        check_positive("--compare-difference", difference_k, "Pass --compare-difference 20.", AuditError)
    again = "Pass the answers.json that thermoxels audit wrote, with its surface.vtp beside it."
    content = read_json_object(path, again, AuditError)
    missing = [key for key, kind in (("conditions", dict), ("up", list)) if not isinstance(content.get(key), kind)]
    if missing or not all(map(is_number, content["up"])):
        got, remedy = f"one without {' and '.join(missing) or 'up'}", f"{again} Audit again first."
        raise AuditError(str(path), expected="the answers.json of an audit", got=got, remedy=remedy)
    conditions, mesh = earlier_conditions(path.name, content["conditions"]), read_surface(path.with_name(SURFACE))
    x, y, z = check_direction(f"{path}: up", content["up"], again, AuditError).tolist()
    least_w = content.get("least_bridge_w")
    return lambda: audit(mesh, conditions, (x, y, z), least_w if is_number(least_w) else 0.0)


def answers_of(
    options: Audit, found: Found, envelope: Envelope | None = None, compared: Comparison | None = None
) -> dict[str, Any]:
    """Return the content of answers.json; numbers and ends of intervals that are NaN or infinite become null."""
    from pydantic_core import to_jsonable_python

    calibration = found.calibration
    same = ("conditions", "whole", "patches", "defects", "limits", "f_rsi", "energy", "not_counted_m2")
    named = ("found", "units", "refused", "moved_most_by", "misfit_k", "history_h", "doubt")
    told = {
        "mesh": options.mesh,
        "up": found.surface.selection.up,
        "least_bridge_w": options.least_bridge_w,
        **{name: getattr(found, name) for name in same},
        "calibration": None if calibration is None else {name: getattr(calibration, name) for name in named},
        "forbidden": found.check.forbidden,
        "doubts": found.check.doubts,
        "impossible": found.impossible,
        "missing_for_en_13187": found.check.missing,
        "asked_of_survey": found.check.asked,
        "loss_narrower_by_w": found.budget,
        **{name: getattr(found, name) for name in ("draws", "remembered")},
        **({} if envelope is None else {"envelope": envelope.figures()}),
        **({} if compared is None else {"compared": compared}),
    }
    return to_jsonable_python(told, inf_nan_mode="null")


def _write(
    folder: Path,
    options: Audit,
    found: Found,
    photographs: Mapping[int, tuple[Picture, ...]],
    envelope: Envelope | None,
    compared: Comparison | None,
) -> tuple[str, ...]:
    """Write all files of an audit, answers.json last, and return their names; raises `AuditError` for bad answers."""
    from thermoxels_ns.audit.envelope import hbjson
    from thermoxels_ns.mesh.files.vtu import write_vtk
    from thermoxels_ns.reports.audit_page import audit_page, draw_audit, gbxml
    from thermoxels_ns.reports.page import identify, why_no_pdf, write_page, write_pdf

    assert options.mesh is not None and options.conditions is not None
    inputs = (options.mesh, options.mesh.with_name(f"{options.mesh.stem}-boundary.vtp"), options.conditions)
    weather, energy = found.conditions.weather, found.conditions.energy
    series = weather and weather.file, energy and energy.climate
    earlier = options.compare and options.compare.with_name(SURFACE)
    more = [options.patches, options.compare, earlier, *(Path(one) for one in series if one)]
    north = options.north if options.envelope else None
    choices = options.up, options.least_bridge_w, north, *filter(None, [options.compare_difference])
    report = identify((*inputs, *filter(None, more)), *choices)
    answers = answers_of(options, found, envelope, compared) | {"report": asdict(report)}
    plain_values(answers, "answers", AuditError)  # raises if json cannot hold the answers
    remove_file(folder / ANSWERS)
    write_vtk(folder / SURFACE, found.to_pyvista())
    title = found.conditions.title
    for kind, name in ENVELOPES.items():
        if envelope is None or kind not in options.envelope:
            remove_file(folder / name)
        elif kind == "hbjson":
            write_json(folder / name, hbjson(envelope, title))
        else:
            write_page(folder / name, gbxml(envelope, title))
    pictures = draw_audit(found) if options.pictures else None
    command, document = command_of("audit", options), options.pdf and not why_no_pdf()
    files = (PAGE, DOCUMENT, ANSWERS, SURFACE) if document else (PAGE, ANSWERS, SURFACE)
    files += tuple(ENVELOPES[one] for one in options.envelope)
    about = (found, pictures, photographs, options.mesh.name, command, files, report, compared)
    write_page(folder / PAGE, audit_page(*about))
    remove_file(folder / DOCUMENT)
    if document:
        write_pdf(folder / DOCUMENT, audit_page(*about, paper=True))
    write_json(folder / ANSWERS, answers)
    return files
