"""Surface temperatures measured by contact, from which the common error of a camera's readings follows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from thermoxels_ns.audit.conditions import Conditions
from thermoxels_ns.audit.draws import Draws, contact_name, emissivity_name
from thermoxels_ns.audit.exchange import radiant_k4
from thermoxels_ns.audit.heat_flow import reading_k
from thermoxels_ns.audit.surface import AuditedSurface
from thermoxels_ns.core.arrays import IntArray
from thermoxels_ns.core.errors import AuditError
from thermoxels_ns.core.units import celsius_to_kelvin

_AROUND_M, _FARTHEST_M = 0.15, 0.5
"""Readings within the first distance of a reference are averaged; none within the second is an error, [m]."""
_OF_A_REFERENCE = 2 * 10**6  # Numbers of errors of their own


def with_references(surface: AuditedSurface, conditions: Conditions, draws: Draws) -> Draws:
    """Replace the offset of the camera by what contact temperatures say of it, in every draw.

    It is what must be added to the readings near a reference so that they give the temperature measured there. Errors
    of emissivity and reflection then largely cancel elsewhere. Of several references the mean holds.

    Raises:
        AuditError: No triangle that counts is near a reference.
    """
    if not conditions.references:
        return draws
    up, offsets = surface.selection.up, []
    set_k = celsius_to_kelvin(draws.values.get("reflected temperature set in the camera", np.zeros(draws.count)))
    for number in range(len(conditions.references)):
        near = _near(surface, conditions, number)
        area = surface.area_m2[near]
        normal = area @ surface.selection.facet_normal[near]
        normal = (normal / np.linalg.norm(normal))[None]
        emissivity = draws[emissivity_name(conditions, int(surface.surface_entry[near[0]]))]
        contact_k = celsius_to_kelvin(draws[contact_name(number)])
        around_k4 = radiant_k4(conditions, draws, normal, up)[0]
        needed_k = reading_k(contact_k, emissivity, around_k4, draws["emissivity set in the camera"], set_k)
        read_k = celsius_to_kelvin(float(np.average(surface.reading_c[near], weights=area)))
        own = draws.local(conditions.camera.repeatability.off_by, _OF_A_REFERENCE + number)
        offsets.append(needed_k - read_k + own)
    return replace(draws, values={**draws.values, "camera offset": np.mean(offsets, axis=0)})


def reference_doubts(conditions: Conditions, draws: Draws) -> tuple[str, ...]:
    """Say if references ask for an offset that is stated to be impossible."""
    stated, found = conditions.camera.offset, draws["camera offset"]
    if not conditions.references or (stated.low <= found.max() and found.min() <= stated.high):
        return ()
    return (
        f"The contact temperatures ask for {found[0]:+.1f} K on all readings; stated are {stated.low:+g} to "
        f"{stated.high:+g} K. One of the two is wrong; the contact temperatures were used.",
    )


def _near(surface: AuditedSurface, conditions: Conditions, number: int) -> IntArray:
    """Triangles that count around a reference, of the patch of the nearest one."""
    at = np.array(conditions.references[number].at)
    counted = np.flatnonzero(surface.counted)
    distance = np.linalg.norm(surface.centroid_m[counted] - at, axis=1)
    nearest = int(np.argmin(distance))
    if distance[nearest] > _FARTHEST_M:
        point = ", ".join(f"{part:.2f}" for part in surface.centroid_m[counted[nearest]])
        expected = f"a point within {_FARTHEST_M:g} m of surface with readings"
        got = f"{conditions.references[number].at}, {distance[nearest]:.2f} m from the nearest, ({point})"
        remedy = "Read the place off the mesh in ParaView, in metres."
        raise AuditError(f"references entry {number + 1}: at", expected=expected, got=got, remedy=remedy)
    patch = surface.selection.facet_patch[counted]
    near = (distance <= _AROUND_M) & (patch == patch[nearest])
    near[nearest] = True
    return counted[near]
