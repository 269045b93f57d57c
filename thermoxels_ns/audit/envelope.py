"""The envelope of an audited building for energy programs, with U-values, as HBJSON and as gbXML."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from thermoxels_ns.audit.draws import CONFIDENCE, Interval
from thermoxels_ns.audit.run import Audit
from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.mesh.boundary.planes import Building, FlatElement, plane_axes

SHGC = 0.6
"""Share of the sun's heat that windows are assumed to let in: HBJSON demands a number that no thermal image tells."""
_LEAST_R_M2K_W, _MOST_WINDOW_U = 0.001, 12.0  # Limits of HBJSON for a layer and for a window
_R_M2K_W = {"roof": 0.14, "wall": 0.17, "door": 0.17, "floor": 0.21}
"""Surface resistances of ISO 6946, both sides, [m2 K / W]: programs add such to those of layers."""


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
    area, known = found.surface.area_m2, np.isfinite(found.triangle_u).all(axis=1)
    u, share = dict[str, Interval | None](), dict[str, float]()
    for one in building.every():
        which = one.facets[known[one.facets]]
        share[one.name] = float(area[which].sum() / max(area[one.facets].sum(), 1e-12))
        mean = np.average(found.triangle_u[which], axis=0, weights=area[which]) if len(which) else None
        u[one.name] = None if mean is None else Interval(*mean.tolist())
    return Envelope(building, u, share)


def hbjson(envelope: Envelope, title: str) -> dict[str, Any]:
    """Return a model of one room by honeybee-schema 2.3 (HBJSON); x points east, y north and z up.

    U-values become constructions of one layer without mass, less the surface resistances of ISO 6946. What was not
    measured has none, so programs take their default. Figures and intervals are in `user_data`.
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


def gbxml(envelope: Envelope, title: str) -> bytes:
    """Return a building of one space as gbXML 6.01; intervals of U-values are in descriptions of constructions."""
    building = envelope.building
    units = {"temperatureUnit": "C", "lengthUnit": "Meters", "areaUnit": "SquareMeters", "volumeUnit": "CubicMeters"}
    units |= {"useSIUnitsForResults": "true", "version": "6.01", "xmlns": "http://www.gbxml.org/schema"}
    root = ElementTree.Element("gbXML", units)

    def add(
        parent: ElementTree.Element, tag: str, text: str | float | None = None, **given: str
    ) -> ElementTree.Element:
        made = ElementTree.SubElement(parent, tag, given)
        made.text = text if text is None or isinstance(text, str) else f"{text:.4f}"
        return made

    def point(parent: ElementTree.Element, at_m: FloatArray) -> None:
        made = add(parent, "CartesianPoint")
        for value in at_m.tolist():
            add(made, "Coordinate", value)

    def shape(parent: ElementTree.Element, one: FlatElement) -> None:
        axes = plane_axes(one.normal)
        low, high = np.array(one.flat().bounds).reshape(2, 2)
        rectangle = add(parent, "RectangularGeometry")
        add(rectangle, "Azimuth", one.azimuth_deg)
        point(rectangle, axes @ low + (one.outline_m[0] @ one.normal) * one.normal)
        for tag, value in {"Tilt": one.tilt_deg, "Height": high[1] - low[1], "Width": high[0] - low[0]}.items():
            add(rectangle, tag, float(value))
        loop = add(add(parent, "PlanarGeometry"), "PolyLoop")
        for corner in one.outline_m:
            point(loop, corner)

    campus = add(root, "Campus", id="campus")
    add(add(campus, "Location"), "ZipcodeOrPostalCode", "unknown")
    house = add(campus, "Building", id="building", buildingType="Unknown")
    add(house, "Name", title or "audited building")
    floor_m2 = sum(one.net_area_m2 for one in building.elements if one.kind == "floor")
    add(house, "Area", floor_m2)
    space = add(house, "Space", id="space")
    add(space, "Area", floor_m2)
    add(space, "Volume", building.volume_m3)
    kinds = {"roof": "Roof", "wall": "ExteriorWall", "floor": "RaisedFloor"}
    for one in building.elements:
        kind = {"air": kinds.get(one.kind, ""), "ground": "SlabOnGrade", "cover": "InteriorWall"}[one.behind]
        surface = add(campus, "Surface", id=one.name, surfaceType=kind, constructionIdRef=f"{one.name}-construction")
        add(surface, "AdjacentSpaceId", spaceIdRef="space")
        shape(surface, one)
        for hole in one.openings:
            window = hole.kind == "window"
            made = {"windowTypeIdRef" if window else "constructionIdRef": f"{hole.name}-construction"}
            kind = "OperableWindow" if window else "NonSlidingDoor"
            shape(add(surface, "Opening", id=hole.name, openingType=kind, **made), hole)
    for one in building.every():
        made = add(root, "WindowType" if one.kind == "window" else "Construction", id=f"{one.name}-construction")
        add(made, "Name", one.name)
        interval = envelope.u[one.name]
        if interval is None:
            add(made, "Description", "U-value not measured")
        else:
            ends = f"{interval.low:.2f} to {interval.high:.2f} W/(m2 K), {100 * CONFIDENCE:.0f} %"
            add(made, "Description", f"U-value measured by thermography: {ends}")
            if interval.value > 0.0:
                add(made, "U-value", float(interval.value), unit="WPerSquareMeterK")
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)
