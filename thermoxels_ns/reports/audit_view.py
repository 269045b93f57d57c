"""Pack the surface of an audit for the 3-D view of its page, which plotly.js draws in the reader's browser."""

from __future__ import annotations

import base64
import gzip
import json
import math
from collections.abc import Iterator
from functools import cache
from html import escape

import numpy as np

from thermoxels_ns.audit.run import Audit, Defect
from thermoxels_ns.audit.surface import WHY_NOT
from thermoxels_ns.core.arrays import BoolArray, FloatArray, IntArray
from thermoxels_ns.reports.numbers import interval_text

MOST_TRIANGLES = 100_000
"""Most triangles of a view; on more, nodes are put together, first where nothing counts."""

_COARSER = 4.0  # Nodes at which nothing counts are put together in cells this many times as large
_BEFORE_SURFACE_M = 0.4  # Distance of the marks of bridges from the surface, [m]; nearer, it hides half of them


@cache
def plotly_script() -> str:
    """Return plotly.js as `packed` text: 2 MB of 4.8 (its wheel holds no smaller one that draws in 3-D)."""
    from plotly.offline import get_plotlyjs

    return packed(get_plotlyjs())


def packed(text: str) -> str:
    """Return a text compressed with gzip and written in base64; equal texts give equal ones."""
    return base64.b64encode(gzip.compress(text.encode(), mtime=0)).decode()


def view_data(audit: Audit, toward: FloatArray) -> str:
    """Return what the view shows, `packed`: triangles with values and patches, marks of bridges, where to look from.

    `toward` is the direction, (3,), in which the view looks at first.
    """
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
    return packed(
        json.dumps(
            {
                "points": (1e3 * points).round().astype(int).T.tolist(),  # [mm]: whole numbers are short
                "counted": facets[counted].T.tolist(),
                "others": facets[~counted].T.tolist(),
                "patch": selection.facet_patch[shown].tolist(),
                "patches": [escape(name) for name in selection.patch_names],
                "quantities": quantities,
                "bridges": _marks(audit),
                "up": list(selection.up),
                "eye": (-1.9 * toward / np.linalg.norm(toward)).tolist(),
                "inside": audit.conditions.side == "inside",
            },
            separators=(",", ":"),
        )
    )


def drawn_triangles(audit: Audit) -> BoolArray:
    """Return which boundary triangles pictures show, (f,): in a view from inside, none that are cut or unseen."""
    if audit.conditions.side == "outside":
        return np.ones(len(audit.surface.why_not), dtype=bool)
    kinds = [number for number, name in enumerate(WHY_NOT) if name in ("cut", "unseen")]
    return ~np.isin(audit.surface.why_not, kinds)


def numbered_defects(audit: Audit) -> Iterator[tuple[int, Defect, FloatArray]]:
    """Yield number, defect and mean outward unit normal, (3,), of each defect that counts."""
    for number, (one, found) in enumerate(zip(audit.defects, audit.found), start=1):
        if not one.not_counted:
            normal = audit.surface.area_m2[found.core] @ audit.surface.selection.facet_normal[found.core]
            yield number, one, normal / (float(np.linalg.norm(normal)) or 1.0)


def _marks(audit: Audit) -> list[dict[str, object]]:
    """Return number, text and place, [mm], of the bridges that count, a little before the surface."""
    marks = []
    for number, one, normal in numbered_defects(audit):
        at = 1e3 * (np.array(one.centre_m) + _BEFORE_SURFACE_M * normal)
        text = f"{number}: {escape(one.patch)}<br>{interval_text(one.extra_w, 'W')} extra<br>click for more"
        marks.append({"number": number, "at": at.round().tolist(), "text": text})
    return marks


def thinned(
    points_m: FloatArray, facets: IntArray, counted: BoolArray, most: int
) -> tuple[FloatArray, IntArray, IntArray]:
    """Return points, (m, 3), and at most `most` of the triangles `facets`, (f, 3), with their places in `facets`, (g,).

    If there are more, points that share a cell of a grid become their mean; triangles left without area go. The grid is
    as coarse as it must be, and finer by `_COARSER` at triangles that count, whose values are theirs, not means.
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
