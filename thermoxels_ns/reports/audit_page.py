"""Build the page of an audit and draw its pictures: the surface from one or two sides."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np

from thermoxels_ns.audit.compare import Comparison
from thermoxels_ns.audit.conditions import Survey
from thermoxels_ns.audit.draws import CONFIDENCE
from thermoxels_ns.audit.envelope import Envelope
from thermoxels_ns.audit.run import F_RSI_M2K_W, MODERATE_SHARE, SEVERE_SHARE, Audit, asked_of_survey
from thermoxels_ns.core.arrays import BoolArray, FloatArray
from thermoxels_ns.core.version import __version__
from thermoxels_ns.mesh.boundary.planes import FlatElement, plane_axes
from thermoxels_ns.reports.audit_view import drawn_triangles, plotly_script, view_data
from thermoxels_ns.reports.charts import gradient
from thermoxels_ns.reports.page import Picture, Report, build_page, image_file

AuditPictures: TypeAlias = dict[str, list[bytes]]
"""PNG files by name, one for each view: "temperature" with the numbers of defects, "u_value" (heat flow if no outside
temperature is stated), "misfit" (measured minus computed temperature)."""

MOST_DEFECTS = 12  # Number of defects that get a section of their own
MOST_PAGE_BYTES = 15_000_000  # A page that would be larger has no 3-D view
_ALL_AROUND = 0.35  # If the mean horizontal normal is shorter than this, the building was seen from all around


def audit_page(
    audit: Audit,
    pictures: AuditPictures | None,
    photographs: Mapping[int, tuple[Picture, ...]],
    mesh_name: str,
    command: str,
    files: Sequence[str],
    *,
    report: Report,
    range_c: tuple[float, float] | None,
    most_u: Mapping[str, float],
    impossible: Sequence[str],
    paper: bool = False,
    compared: Comparison | None = None,
) -> str:
    """Return the html text of an audit's page; `command` made the audit, `files` lie beside the page.

    It has a 3-D view if it has pictures, is not meant for `paper` and does not exceed `MOST_PAGE_BYTES`.

    `photographs` are pictures of defects by place in `audit.defects`, whose colours span `range_c`; without `pictures`
    the page has no drawings. `most_u` is the U-value by name of an element from which on a value is marked impossible,
    `impossible` are sentences on such values; `compared` is what changed since an earlier survey.
    """
    numbered, asked = list(enumerate(audit.defects, start=1)), audit.conditions.calibrate
    counted = [(number, one) for number, one in numbered if not one.not_counted]
    start = {} if asked is None else asked.stated()
    unknown = set() if asked is None else {one.name() for one in asked.unknown}
    shown = dict[str, Any](
        audit=audit,
        counted=counted,
        doubted=[(number, one) for number, one in numbered if one.not_counted],
        worst=max(counted, key=lambda item: item[1].extra_w.value, default=None),
        start=start,
        known={name: value for name, value in start.items() if name not in unknown},
        pictures=pictures,
        report=report,
        gradient=gradient(),
        range_c=range_c,
        most_u=most_u,
        impossible=impossible,
        compared=compared,
        photographs=defaultdict(tuple, photographs),
        confidence=100.0 * CONFIDENCE,
        severe_share=SEVERE_SHARE,
        moderate_share=MODERATE_SHARE,
        f_rsi_m2k_w=F_RSI_M2K_W,
        most_defects=MOST_DEFECTS,
        mesh_name=mesh_name,
        command=command,
        files=files,
        view=None,
        view_left_out="",
    )
    view = None
    if pictures is not None and not paper:
        view = {"plotly": plotly_script(), "data": view_data(audit, _views(audit)[0])}
    page = build_page("audit.html.j2", **shown | {"view": view})
    if view is not None and len(page) > MOST_PAGE_BYTES:
        size, most = f"{len(page) / 1e6:.0f}", f"{MOST_PAGE_BYTES / 1e6:.0f}"
        why = f"A 3-D view is left out: with it, this page would have {size} MB, of {most} at most."
        page = build_page("audit.html.j2", **shown | {"view_left_out": why})
    return page


def agreement_page(title: str, survey: Survey) -> str:
    """Return the html text of what a client signs before a survey: purpose, conditions and limits."""
    about = {"title": title, "survey": survey, "asked": asked_of_survey(survey)}
    return build_page("agreement.html.j2", **about, version=__version__, confidence=100.0 * CONFIDENCE)


def gbxml(envelope: Envelope, title: str) -> str:
    """Return a building of one space as gbXML 6.01; intervals of U-values are in descriptions of constructions."""

    def rectangle(one: FlatElement) -> tuple[list[float], float, float]:
        """Return the corner, [m], the width and the height of the rectangle around an element."""
        low, high = np.array(one.flat().bounds).reshape(2, 2)
        corner = plane_axes(one.normal) @ low + (one.outline_m[0] @ one.normal) * one.normal
        return corner.tolist(), *(high - low).tolist()

    about = {"envelope": envelope, "title": title, "confidence": 100.0 * CONFIDENCE}
    return build_page("envelope.gbxml.j2", **about, rectangle=rectangle)


def draw_audit(audit: Audit) -> AuditPictures:
    """Draw all pictures; pictures of temperatures share one range of colours, triangles that do not count are grey."""
    surface, calibration, up = audit.surface, audit.calibration, audit.surface.selection.up
    shown = np.unique(surface.mesh.facets[surface.counted])
    known = audit.conditions.outside_known
    values, name, unit = audit.triangle_u[:, 0], "U-value", "W/(m² K)"
    if not known:
        values, name, unit = audit.triangle_flow_w_m2, "Heat flow", "W/m²"
    surface_c, u = _at_nodes(audit, audit.triangle_surface_c), _at_nodes(audit, values)
    temperatures: dict[str, Any] = {"up": up, "clim": np.quantile(surface_c[shown], (0.005, 0.995)).tolist()}
    flows: dict[str, Any] = {"up": up, "clim": np.quantile(u[shown], (0.02, 0.98)).tolist(), "colour_map": "viridis"}
    flows |= {"bar_title": f"{name} [{unit}]", "title": f"{name} by the stated values"}
    pictures: AuditPictures = {"temperature": [], "u_value": [], "misfit": []}
    for direction in _views(audit):
        view = {"view_direction": direction.tolist()}
        facing = surface.selection.facet_normal @ direction < 0.0
        labels = _labels(audit, direction)
        title = "Surface temperature, corrected for emissivity and reflection"
        drawn = _picture(audit, facing, surface_c, title=title, labels=labels, **temperatures, **view)
        pictures["temperature"].append(drawn)
        pictures["u_value"].append(_picture(audit, facing, u, **flows, **view))
        if calibration is not None:
            off_k = _at_nodes(audit, calibration.difference_k)
            most = float(np.quantile(np.abs(off_k[shown]), 0.98)) or 1.0
            look: dict[str, Any] = {"up": up, "clim": (-most, most), "colour_map": "coolwarm"}
            look |= {"bar_title": "difference [K]", "title": "Measured minus computed"}
            pictures["misfit"].append(_picture(audit, facing, off_k, **look, **view))
    return pictures


def _at_nodes(audit: Audit, values: FloatArray) -> FloatArray:
    """Return for each node the mean, by area, of `values` of its triangles that count, shape (n,); 0 without any."""
    surface = audit.surface
    facets, area = surface.mesh.facets[surface.counted], surface.area_m2[surface.counted]
    weight, count = np.repeat(area, 3), len(surface.mesh.points_m)
    known = np.nan_to_num(values[surface.counted])  # NaN where a calibration leaves out patches
    total = np.bincount(facets.ravel(), weight * np.repeat(known, 3), count)
    share = np.bincount(facets.ravel(), weight, count)
    return total / np.where(share > 0.0, share, 1.0)


def _labels(audit: Audit, direction: FloatArray) -> list[tuple[str, tuple[float, float, float]]]:
    """Return number and centre, [m], of the defects that count and face a camera that looks along `direction`."""
    surface, labels = audit.surface, []
    for number, (one, found) in enumerate(zip(audit.defects, audit.found), start=1):
        normal = surface.area_m2[found.core] @ surface.selection.facet_normal[found.core]
        if not one.not_counted and normal @ direction < 0.0:
            labels.append((str(number), one.centre_m))
    return labels


def _views(audit: Audit) -> list[FloatArray]:
    """Return directions to look in: one towards the seen side, or two from corners if all sides were seen."""
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


def _picture(audit: Audit, chosen: BoolArray, values: FloatArray, **look: Any) -> bytes:
    """Draw chosen triangles, grey if they do not count; without cut and unseen triangles in a view from inside."""
    from thermoxels_ns.reports.mesh_pictures import image_of_surface

    mesh = audit.surface.mesh
    chosen = chosen & drawn_triangles(audit)
    painted = [("does not count", "lightgrey", ~audit.surface.counted[chosen])]
    return image_file(image_of_surface(mesh.points_m, mesh.facets[chosen], values, painted=painted, **look), "PNG")
