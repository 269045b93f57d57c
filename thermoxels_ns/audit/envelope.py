"""The envelope of an audited building for energy programs, with U-values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from thermoxels_ns.audit.draws import Interval, draw, interval_of
from thermoxels_ns.audit.exchange import Parts, with_references
from thermoxels_ns.audit.run import Audit
from thermoxels_ns.mesh.boundary.planes import Building


@dataclass(frozen=True)
class Envelope:
    """A building's elements with what the audit measured on them."""

    building: Building
    u: Mapping[str, Interval | None]
    """U-value of each element and opening by name, the mean over the area that counts, [W/(m2 K)]; None if nothing
    counts, or if the air outside is not known."""
    share: Mapping[str, float]  # Share of the triangles' area that counts, 0 to 1

    def figures(self) -> dict[str, dict[str, Any]]:
        """Return the figures of each element and opening by name, for json."""
        return {
            one.name: {
                **{name: round(getattr(one, name), 3) for name in ("net_area_m2", "azimuth_deg", "tilt_deg")},
                "u_w_m2k": None if (u := self.u[one.name]) is None else vars(u),
                "measured_share": round(self.share[one.name], 3),
            }
            for one in self.building.every()
        }


def envelope_of(found: Audit, building: Building) -> Envelope:
    """Return the envelope of the building that `find_building` found on the audited mesh."""
    conditions, surface = found.conditions, found.surface
    draws = with_references(surface, conditions, draw(conditions))
    which = {one.name: one.facets[surface.counted[one.facets]] for one in building.every()}
    area_m2 = {one.name: max(float(surface.area_m2[one.facets].sum()), 1e-12) for one in building.every()}
    u = dict[str, Interval | None].fromkeys(which)
    seen = [name for name, part in which.items() if len(part) and conditions.outside_known]
    parts = Parts(conditions, surface, draws, [which[n] for n in seen])
    off_by = conditions.camera.repeatability.off_by
    for n, (name, flow_w) in enumerate(zip(seen, parts.in_draws(draws)[1])):
        flow_w = flow_w + parts.slope_w_k[n] * draws.local(off_by, n)
        u[name] = interval_of(flow_w / parts.area_m2[n] / draws.difference_k)
    return Envelope(building, u, {name: float(surface.area_m2[which[name]].sum()) / area_m2[name] for name in which})
