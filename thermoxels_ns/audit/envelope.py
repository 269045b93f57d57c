"""The envelope of an audited building: the U-values of its flat elements, and its export as HBJSON."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from thermoxels_ns.audit.draws import Interval, draw, interval_of
from thermoxels_ns.audit.exchange import Parts, with_references
from thermoxels_ns.audit.run import Audit
from thermoxels_ns.mesh.boundary.planes import Building, FlatElement

SHGC = 0.6
"""Share of the sun's heat that windows are assumed to let in: HBJSON demands a number that no thermal image tells."""
_LEAST_R_M2K_W, _MOST_WINDOW_U = 0.001, 12.0  # Limits of HBJSON for a layer and for a window
_R_M2K_W = {"roof": 0.14, "wall": 0.17, "door": 0.17, "floor": 0.21}
"""Sum of both surface resistances of ISO 6946, [m2 K / W]; energy programs add them to the layers themselves."""


@dataclass(frozen=True)
class Envelope:
    """A building's elements with what the audit measured on them."""

    building: Building
    u: Mapping[str, Interval | None]
    """Mean U-value, [W/(m2 K)], of the triangles that count on each element and opening, by name; None if no triangle
    counts, or if the air temperature outside is not known."""
    share: Mapping[str, float]  # By the same names, share of the triangles' area that counts, 0 to 1

    def figures(self) -> dict[str, dict[str, Any]]:
        """Return area, [m2], azimuth and tilt, [degrees], U-value and `share` of each element and opening by name."""
        return {
            one.name: {
                **{name: round(getattr(one, name), 3) for name in ("net_area_m2", "azimuth_deg", "tilt_deg")},
                "u_w_m2k": None if (u := self.u[one.name]) is None else vars(u),
                "measured_share": round(self.share[one.name], 3),
            }
            for one in self.building.every()
        }


def envelope_of(found: Audit, building: Building) -> Envelope:
    """Return U-values of the elements of `building`, which `find_building` must have found on the mesh of `found`."""
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


def hbjson(envelope: Envelope, title: str) -> dict[str, Any]:
    """Return a model of one room by honeybee-schema 2.3 (HBJSON); x points east, y north and z up.

    A U-value becomes a construction of one layer without mass, with the resistance 1 / U less the surface resistances
    of ISO 6946; windows keep U. Elements without a U-value get a program's default. `user_data`: `Envelope.figures`.
    """
    building, figures = envelope.building, envelope.figures()
    materials, constructions = list[dict[str, Any]](), list[dict[str, Any]]()
    for one in building.every():
        value = 0.0 if (u := envelope.u[one.name]) is None else u.value
        if value > 0.0:
            layer: dict[str, Any] = {"identifier": f"{one.name}-layer", "type": "EnergyMaterialNoMass"}
            if one.kind == "window":
                layer |= {"type": "EnergyWindowMaterialSimpleGlazSys", "u_factor": min(value, _MOST_WINDOW_U)}
                layer |= {"shgc": SHGC, "user_data": {"shgc": "assumed"}}
            else:
                layer["r_value"] = max(1.0 / value - _R_M2K_W[one.kind], _LEAST_R_M2K_W)
            materials.append(layer)
            kind = f"{'Window' if one.kind == 'window' else 'Opaque'}ConstructionAbridged"
            construction = {"type": kind, "identifier": one.name, "materials": [layer["identifier"]]}
            constructions.append(construction)
    given = {one["identifier"] for one in constructions}

    def part(one: FlatElement, kind: str, boundary: str, **more: Any) -> dict[str, Any]:
        energy = {
            "type": f"{kind}EnergyPropertiesAbridged",
            **({"construction": one.name} if one.name in given else {}),
        }
        return {
            "type": kind,
            "identifier": one.name,
            "geometry": {"type": "Face3D", "boundary": np.round(one.outline_m, 5).tolist()},
            "boundary_condition": {"type": boundary},
            "properties": {"type": f"{kind}PropertiesAbridged", "energy": energy},
            "user_data": figures[one.name],
            **more,
        }

    faces = []
    for one in building.elements:
        windows = [part(hole, "Aperture", "Outdoors") for hole in one.openings if hole.kind == "window"]
        doors = [part(hole, "Door", "Outdoors") for hole in one.openings if hole.kind == "door"]
        kind = "RoofCeiling" if one.kind == "roof" else one.kind.capitalize()
        touches = {"air": "Outdoors", "ground": "Ground", "cover": "Adiabatic"}[one.behind]
        faces.append(part(one, "Face", touches, face_type=kind, apertures=windows, doors=doors))
    inside = {"type": "RoomPropertiesAbridged", "energy": {"type": "RoomEnergyPropertiesAbridged"}}
    energy = {"type": "ModelEnergyProperties", "constructions": constructions, "materials": materials}
    named = {"display_name": title} if title else {}
    return {
        **{"type": "Model", "identifier": "envelope", **named, "version": "2.3.0", "units": "Meters"},
        **{"tolerance": 0.01, "angle_tolerance": 1.0},
        "rooms": [{"type": "Room", "identifier": "building", "faces": faces, "properties": inside}],
        "properties": {"type": "ModelProperties", "energy": energy},
    }
