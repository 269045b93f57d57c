"""Build the page of an audit with its pictures, and pack its surface for the 3-D view, which plotly.js draws."""

from __future__ import annotations

import base64
import gzip
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from html import escape
from typing import Any, TypeAlias

import numpy as np

from thermoxels_ns.audit.compare import Comparison
from thermoxels_ns.audit.conditions import Survey
from thermoxels_ns.audit.draws import CONFIDENCE
from thermoxels_ns.audit.envelope import Envelope
from thermoxels_ns.audit.run import F_RSI_M2K_W, Audit, Defect, asked_of_survey
from thermoxels_ns.audit.surface import WHY_NOT
from thermoxels_ns.core.arrays import BoolArray, FloatArray, IntArray
from thermoxels_ns.core.version import __version__
from thermoxels_ns.mesh.boundary.planes import FlatElement, plane_axes
from thermoxels_ns.reports.numbers import interval_text
from thermoxels_ns.reports.page import Picture, Report, build_page, gradient, image_file

AuditPictures: TypeAlias = dict[str, list[bytes]]
"""PNG files by quantity, a list with one file for each view: "temperature" with the numbers of defects, "u_value" (heat
flow if no outside temperature is stated), "misfit" (measured minus computed temperature; empty without calibration)."""

MOST_DEFECTS = 12  # Number of defects that get a section of their own
MOST_TRIANGLES = 100_000  # Most triangles of the 3-D view, see `thinned`

_COARSER = 4.0  # Nodes at which no triangle counts are merged in cells this many times as large as the others'
_BEFORE_SURFACE_M = 0.4  # Distance of the marks of bridges from the surface, [m]; if nearer, half of them are hidden
_ALL_AROUND = 0.35  # If the mean horizontal normal is shorter than this, the building was seen from all around


def audit_page(
    audit: Audit,
    pictures: AuditPictures | None,
    photographs: Mapping[int, tuple[Picture, ...]],
    mesh_name: str,
    command: str,
    files: Sequence[str],
    report: Report,
    compared: Comparison | None = None,
    paper: bool = False,
) -> str:
    """Return the html text of an audit's page; it has a 3-D view unless `pictures` is None or `paper` is True.

    `pictures` are those of `draw_audit`; None: the page has no drawings. `photographs` are pictures of defects by place
    in `audit.defects`, `command` is the command that made the audit, `files` are names of files beside the page, and
    `compared` is the comparison with an earlier survey, if any.
    """
    numbered, asked = list(enumerate(audit.defects, start=1)), audit.conditions.calibrate
    counted = [(number, one) for number, one in numbered if not one.not_counted]
    start = {} if asked is None else asked.stated()
    unknown = set() if asked is None else {one.name() for one in asked.unknown}
    view = None
    if pictures is not None and not paper:
        view = {"plotly": plotly_script(), "data": view_data(audit, _views(audit)[0])}
    return build_page(
        "audit.html.j2",
        audit=audit,
        counted=counted,
        doubted=[(number, one) for number, one in numbered if one.not_counted],
        worst=max(counted, key=lambda item: item[1].extra_w.value, default=None),
        start=start,
        known={name: value for name, value in start.items() if name not in unknown},
        pictures=pictures,
        report=report,
        gradient=gradient(),
        compared=compared,
        photographs=photographs,
        confidence=100.0 * CONFIDENCE,
        f_rsi_m2k_w=F_RSI_M2K_W,
        most_defects=MOST_DEFECTS,
        mesh_name=mesh_name,
        command=command,
        files=files,
        view=view,
    )


def agreement_page(title: str, survey: Survey) -> str:
    """Return the html text of what a client signs before a survey: purpose, conditions and limits."""
    about = {"title": title, "survey": survey, "asked": asked_of_survey(survey)}
    return build_page("agreement.html.j2", **about, version=__version__, confidence=100.0 * CONFIDENCE)


def gbxml(envelope: Envelope, title: str) -> str:
    """Return a building of one space as gbXML 6.01; intervals of U-values are in descriptions of constructions."""

    def rectangle(one: FlatElement) -> tuple[list[float], float, float]:
        """Return the corner, the width and the height, [m], of the rectangle around an element in its plane."""
        low, high = np.array(one.flat().bounds).reshape(2, 2)
        corner = plane_axes(one.normal) @ low + (one.outline_m[0] @ one.normal) * one.normal
        return corner.tolist(), *(high - low).tolist()

    about = {"envelope": envelope, "title": title, "confidence": 100.0 * CONFIDENCE}
    return build_page("envelope.gbxml.j2", **about, rectangle=rectangle)


def draw_audit(audit: Audit) -> AuditPictures:
    """Return all pictures of the triangles of `drawn_triangles`, seen from one or two sides; grey: does not count."""
    from thermoxels_ns.reports.mesh_pictures import image_of_surface

    surface, mesh, known = audit.surface, audit.surface.mesh, audit.conditions.outside_known

    def ends(values: FloatArray, cut: float) -> list[float]:
        return np.nanquantile(values, (cut, 1.0 - cut)).tolist()

    temperature_c, flow = audit.triangle_surface_c, audit.triangle_u if known else audit.triangle_flow_w_m2
    name, unit = ("U-value", "W/(m² K)") if known else ("Heat flow", "W/m²")
    title = "Surface temperature, corrected for emissivity and reflection"
    kinds: dict[str, tuple[FloatArray, dict[str, Any]]] = {
        "temperature": (temperature_c, {"clim": ends(temperature_c, 0.005), "title": title}),
        "u_value": (flow, {"clim": ends(flow, 0.02), "colour_map": "viridis", "bar_title": f"{name} [{unit}]"}),
    }
    kinds["u_value"][1]["title"] = f"{name} by the stated values"
    if audit.calibration is not None:
        off_k = audit.calibration.difference_k
        most = float(np.nanquantile(np.abs(off_k), 0.98)) or 1.0
        look = {"clim": (-most, most), "colour_map": "coolwarm", "bar_title": "difference [K]"}
        kinds["misfit"] = off_k, look | {"title": "Measured minus computed"}
    pictures: AuditPictures = {"temperature": [], "u_value": [], "misfit": []}
    for direction in _views(audit):
        chosen = (surface.selection.facet_normal @ direction < 0.0) & drawn_triangles(audit)
        view = {"up": surface.selection.up, "view_direction": direction.tolist()}
        for kind, (values, look) in kinds.items():
            shown = values[chosen]
            painted = [("does not count", "lightgrey", np.isnan(shown))]
            labels = [(str(n), one.centre_m) for n, one, normal in numbered_defects(audit) if normal @ direction < 0.0]
            labels = labels if kind == "temperature" else []
            image = image_of_surface(
                mesh.points_m, mesh.facets[chosen], shown, painted=painted, labels=labels, **look, **view
            )
            pictures[kind].append(image_file(image, "PNG"))
    return pictures


def _views(audit: Audit) -> list[FloatArray]:
    """Return viewing directions, (3,) each: one towards the seen side, or two from corners if all sides were seen."""
    surface, up = audit.surface, np.array(audit.surface.selection.up)
    area = surface.area_m2 * surface.counted
    mean = area @ surface.selection.facet_normal / area.sum()
    level = mean - (mean @ up) * up
    if np.linalg.norm(level) > _ALL_AROUND:
        front = level / np.linalg.norm(level)
        return [-(front + 0.35 * np.cross(up, front) + 0.25 * up)]
    side = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    side /= np.linalg.norm(side)
    corner = side + 0.7 * np.cross(up, side)
    if audit.conditions.side == "inside":  # floor and walls, then ceiling and walls
        return [-(corner + 0.5 * up), corner + 0.5 * up]
    return [-(corner + 0.5 * up), corner - 0.5 * up]


@cache
def plotly_script() -> str:
    """Return plotly.js as `packed` text of 2 MB; plotly's wheel holds no smaller script that draws in 3-D."""
    from plotly.offline import get_plotlyjs

    return packed(get_plotlyjs())


def packed(text: str) -> str:
    """Return a text compressed with gzip and encoded in base64; equal texts give equal results."""
    return base64.b64encode(gzip.compress(text.encode(), mtime=0)).decode()


def view_data(audit: Audit, toward: FloatArray) -> str:
    """Return the json text of the 3-D view, `packed`; `toward`, (3,), is the direction in which it looks at first."""
    from plotly.colors import get_colorscale

    surface, known = audit.surface, audit.conditions.outside_known
    mesh, selection = surface.mesh, surface.selection
    some = np.flatnonzero(drawn_triangles(audit))
    points, facets, which = thinned(mesh.points_m, mesh.facets[some], surface.counted[some], MOST_TRIANGLES)
    which = some[which]
    counted = surface.counted[which]
    shown = which[counted]
    values = {
        ("Surface temperature", "°C", "Inferno", 0.005): audit.triangle_surface_c,
        **({("U-value", "W/(m² K)", "Viridis", 0.02): audit.triangle_u} if known else {}),
        ("Heat flow", "W/m²", "Viridis", 0.02): audit.triangle_flow_w_m2,
    }
    quantities = []
    for (name, unit, scale, cut), every in values.items():
        low, high = np.nanquantile(every[surface.counted], (cut, 1.0 - cut)).tolist()
        told = {"name": name, "unit": unit, "scale": get_colorscale(scale), "low": low, "high": max(high, low + 1e-3)}
        rounded = every[shown].round(2).tolist()
        quantities.append({**told, "values": [value if math.isfinite(value) else None for value in rounded]})
    marks = []  # of the bridges that count: number, text and place, [mm], a little before the surface
    for number, one, normal in numbered_defects(audit):
        at = 1e3 * (np.array(one.centre_m) + _BEFORE_SURFACE_M * normal)
        text = f"{number}: {escape(one.patch)}<br>{interval_text(one.extra_w, 'W')} extra<br>click for more"
        marks.append({"number": number, "at": at.round().tolist(), "text": text})
    return packed(
        json.dumps(
            {
                "points": (1e3 * points).round().astype(int).T.tolist(),  # [mm]: whole numbers are short
                "counted": facets[counted].T.tolist(),
                "others": facets[~counted].T.tolist(),
                "patch": selection.facet_patch[shown].tolist(),
                "patches": [escape(name) for name in selection.patch_names],
                "quantities": quantities,
                "bridges": marks,
                "up": list(selection.up),
                "eye": (-1.9 * toward / np.linalg.norm(toward)).tolist(),
                "inside": audit.conditions.side == "inside",
            },
            separators=(",", ":"),
        )
    )


def drawn_triangles(audit: Audit) -> BoolArray:
    """Return True for the boundary triangles that pictures show, (f,): from inside, none that are cut or unseen."""
    if audit.conditions.side == "outside":
        return np.ones(len(audit.surface.why_not), dtype=bool)
    kinds = [number for number, name in enumerate(WHY_NOT) if name in ("cut", "unseen")]
    return ~np.isin(audit.surface.why_not, kinds)


def numbered_defects(audit: Audit) -> Iterator[tuple[int, Defect, FloatArray]]:
    """Yield the number (from 1), the defect and its mean outward unit normal, (3,), for each defect that counts."""
    for number, (one, found) in enumerate(zip(audit.defects, audit.found), start=1):
        if not one.not_counted:
            normal = audit.surface.area_m2[found.core] @ audit.surface.selection.facet_normal[found.core]
            yield number, one, normal / (float(np.linalg.norm(normal)) or 1.0)


def thinned(
    points_m: FloatArray, facets: IntArray, counted: BoolArray, most: int
) -> tuple[FloatArray, IntArray, IntArray]:
    """Return points, (m, 3), triangles, (g, 3), g at most `most`, and the place of each in `facets`, (g,).

    If there are more `facets`, (f, 3), points in one cell of a grid are replaced by their mean, and triangles with two
    equal corners are deleted. Cells are as small as possible, and smaller by `_COARSER` at triangles that count.
    """
    used, corners = np.unique(facets, return_inverse=True)
    points, corners, which = points_m[used], corners.reshape(facets.shape), np.arange(len(facets))
    inner = np.zeros(len(points), dtype=bool)
    inner[corners[counted]] = True
    cell = float(np.linalg.norm(points[corners[:, 0]] - points[corners[:, 1]], axis=1).mean()) if len(facets) else 1.0
    means, triangles = points, corners
    while len(which) > most:
        cell *= 1.4
        place = np.floor(points / np.where(inner, cell / _COARSER, cell)[:, None])
        _, of_point = np.unique(np.column_stack([place, inner]), axis=0, return_inverse=True)
        of_point = of_point.ravel()
        count = np.bincount(of_point)
        means = np.stack([np.bincount(of_point, axis) / count for axis in points.T], axis=1)
        triangles = of_point[corners]
        which = np.flatnonzero((triangles != np.roll(triangles, 1, axis=1)).all(axis=1))
        triangles = triangles[which]
    return means, triangles, which
