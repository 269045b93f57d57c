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
from thermoxels_ns.audit.run import F_RSI_M2K_W, Audit, asked_of_survey
from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.version import __version__
from thermoxels_ns.mesh.boundary.planes import FlatElement, plane_axes
from thermoxels_ns.reports.audit_view import drawn_triangles, numbered_defects, plotly_script, view_data
from thermoxels_ns.reports.charts import gradient
from thermoxels_ns.reports.page import Picture, Report, build_page, image_file

AuditPictures: TypeAlias = dict[str, list[bytes]]
"""PNG files by name, one for each view: "temperature" with the numbers of defects, "u_value" (heat flow if no outside
temperature is stated), "misfit" (measured minus computed temperature)."""

MOST_DEFECTS = 12  # Number of defects that get a section of their own
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
    """Return the html text of an audit's page; `command` made the audit, `files` lie beside the page.

    It has a 3-D view if it has pictures and is not meant for `paper`.

    `photographs` are pictures of defects by place in `audit.defects`; without `pictures` the page has no drawings.
    `compared` is what changed since an earlier survey.
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
        photographs=defaultdict(tuple, photographs),
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
        """Return the corner, [m], the width and the height of the rectangle around an element."""
        low, high = np.array(one.flat().bounds).reshape(2, 2)
        corner = plane_axes(one.normal) @ low + (one.outline_m[0] @ one.normal) * one.normal
        return corner.tolist(), *(high - low).tolist()

    about = {"envelope": envelope, "title": title, "confidence": 100.0 * CONFIDENCE}
    return build_page("envelope.gbxml.j2", **about, rectangle=rectangle)


def draw_audit(audit: Audit) -> AuditPictures:
    """Draw all pictures: triangles from one or two sides, grey where they have no value.

    In a view from inside, cut and unseen triangles are left out.
    """
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
