"""Compute the heat exchange of groups of triangles in every draw; correct readings by contact temperatures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy import sparse

from thermoxels_ns.audit.conditions import Conditions
from thermoxels_ns.audit.draws import FORMULA, Draws, emissivity_name
from thermoxels_ns.audit.heat_flow import (
    FILMS,
    fourth_power,
    net_radiation_w_m2,
    reading_k,
    sky_emissivity,
    surface_temperature_k,
    view_shares,
)
from thermoxels_ns.audit.surface import AuditedSurface, Readings
from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.core.errors import AuditError
from thermoxels_ns.core.units import ZERO_CELSIUS_K, celsius_to_kelvin
from thermoxels_ns.heat.scene_fields import OUTSIDE_RESISTANCE_M2K_W

CHUNK = 400_000  # Values, groups times draws, of one array that are in memory at the same time
HALF_STEP_K = 0.05  # Half the step of difference quotients with respect to readings, [K]
_AROUND_M, _FARTHEST_M = 0.15, 0.5
"""Readings within the first distance of a reference are averaged; no reading within the second is an error, [m]."""
_OF_A_REFERENCE = 2 * 10**6  # First argument `number` of `Draws.local` for references


class Exchange(NamedTuple):
    """Temperature and heat flow of n pieces of surface in k draws; draw 0 is made of the stated values."""

    surface_c: FloatArray  # Surface temperature, corrected, shape (n, k), [degrees Celsius]
    flow_w_m2: FloatArray  # Heat flow from inside to outside, shape (n, k), [W/m2]


def exchange(conditions: Conditions, readings: Readings, draws: Draws, warmer_k: float = 0.0) -> Exchange:
    """Return the surface temperature and the heat flow of each piece of surface in each draw.

    Readings plus `warmer_k` [K] are corrected for emissivity and reflection; the film model gives the heat flow.
    """
    emissivity = np.stack([draws[emissivity_name(conditions, n)] for n in range(len(conditions.surfaces))])
    emissivity = emissivity[readings.surface_entry]
    around_k4 = radiant_k4(conditions, draws, readings.upward)
    reading_k = celsius_to_kelvin(readings.reading_c + warmer_k)[:, None] + draws["camera offset"]
    surface_k = surface_temperature_k(reading_k, emissivity, around_k4, *_camera_settings(draws))
    flow = film_flow_w_m2(conditions, draws, surface_k, around_k4, emissivity, readings.upward)
    return Exchange(surface_k - ZERO_CELSIUS_K, flow)


def triangle_exchange(conditions: Conditions, surface: AuditedSurface, draws: Draws) -> Exchange:
    """Return the exchange of each boundary triangle for the stated values, (f,) each; NaN: does not count.

    Within a group of alike triangles, temperature and heat flow are linear in the reading.
    """
    groups, of = surface.alike
    low, mean, high = _around(conditions, groups, draws)
    off_k = (surface.reading_c - groups.reading_c[of]) / (2.0 * HALF_STEP_K)
    found = (one[of, 0] + off_k * (above - below)[of, 0] for below, one, above in zip(low, mean, high))
    return Exchange(*(np.where(surface.counted, values, np.nan) for values in found))


def _around(conditions: Conditions, groups: Readings, draws: Draws) -> list[Exchange]:
    """Return the exchange for the stated values with readings minus `HALF_STEP_K`, as they are, and plus this step."""
    return [exchange(conditions, groups, draws.first(0), step) for step in (-HALF_STEP_K, 0.0, HALF_STEP_K)]


class Parts:
    """The heat exchange of p parts of the surface in every draw; a part is a set of triangles.

    A draw is computed for groups of alike triangles. The difference between the triangles of a part and the means of
    their groups is computed from the stated values alone, and is the same in every draw.
    """

    def __init__(
        self, conditions: Conditions, surface: AuditedSurface, draws: Draws, which: Sequence[IntArray]
    ) -> None:
        """Take the triangles of each part; the caller must leave out triangles that do not count."""
        self.conditions, (self.groups, of_triangle) = conditions, surface.alike
        row = np.repeat(np.arange(len(which)), [len(one) for one in which])
        every = np.concatenate([np.zeros(0, np.int64), *which])
        area, shape = surface.area_m2[every], (len(which), len(self.groups.reading_c))
        self._rows = sparse.coo_array((area, (row, of_triangle[every])), shape=shape).tocsc()
        low, mean, high = _around(conditions, self.groups, draws)
        self.area_m2: FloatArray = np.asarray(self._rows.sum(axis=1), np.float64)  # Shape (p,), [m2]
        self.slope_w_k = (self._rows @ (high.flow_w_m2 - low.flow_w_m2))[:, 0] / (2.0 * HALF_STEP_K)
        """Derivative of the stated flow of a part with respect to a shift of all its readings, shape (p,), [W/K]."""
        self._off = [
            np.bincount(row, area * own[every], len(which))[:, None] - self._rows @ of_group
            for own, of_group in zip(triangle_exchange(conditions, surface, draws), mean)
        ]

    def in_draws(self, draws: Draws, first: int | None = None) -> tuple[FloatArray, FloatArray]:
        """Return mean surface temperature, [C], and heat flow from inside to outside, [W], of parts, (p, k) each.

        `first` is the number of parts to compute, from the first on; None: all.
        """
        rows = self._rows[:first]
        surface_c, flow_w = (np.repeat(off[:first], draws.count, axis=1) for off in self._off)
        groups, step = self.groups, max(1, CHUNK // draws.count)
        for start in range(0, len(groups.reading_c), step):
            part = slice(start, start + step)
            some = Readings(groups.reading_c[part], groups.upward[part], groups.surface_entry[part])
            found = exchange(self.conditions, some, draws)
            surface_c += rows[:, part] @ found.surface_c
            flow_w += rows[:, part] @ found.flow_w_m2
        area = self.area_m2[:first, None]
        return surface_c / np.where(area > 0.0, area, 1.0), flow_w


def _camera_settings(draws: Draws) -> tuple[FloatArray, FloatArray]:
    """Return emissivity and reflected temperature, [K], set in the camera, (k,) each; 0 C if none was stated."""
    reflected_c = draws.values.get("reflected temperature set in the camera", np.zeros(draws.count))
    return draws["emissivity set in the camera"], celsius_to_kelvin(reflected_c)


def radiant_k4(conditions: Conditions, draws: Draws, upward: FloatArray) -> FloatArray:
    """Return the fourth power of the radiant temperature that surfaces see, (g, k), [K^4]; `upward`: `view_shares`."""
    if conditions.surroundings.sky is None:
        reflected_k4 = fourth_power(celsius_to_kelvin(draws["reflected temperature"]))
        return np.broadcast_to(reflected_k4, (len(upward), draws.count))
    air_k4 = fourth_power(celsius_to_kelvin(draws["outside air"]))
    sky_k4 = sky_emissivity(draws["dew point"], draws["cloud"]) * air_k4
    ground_k4 = fourth_power(celsius_to_kelvin(draws.values.get("ground", draws["outside air"])))
    return view_shares(upward) @ np.stack([sky_k4, air_k4, ground_k4])


def film_flow_w_m2(
    conditions: Conditions,
    draws: Draws,
    surface_k: FloatArray,
    around_k4: FloatArray,
    emissivity: FloatArray,
    upward: FloatArray,
) -> FloatArray:
    """Return the heat flow from inside to outside by the film model, shape (g, k), [W/m2].

    `surface_k`, `around_k4` (see `radiant_k4`) and `emissivity` have shape (g, k), `upward` (see `view_shares`) (g,).
    """
    side, model = conditions.side, conditions.film.model
    air_k = celsius_to_kelvin(draws[f"{side} air"])
    warmer_k, film = surface_k - air_k, FILMS[side].get(model)
    if model == "given":
        coefficient = draws["film coefficient"]
    else:
        coefficient = _convection_w_m2k(conditions, draws, warmer_k, upward[:, None])
    flow = draws["film factor"] * coefficient * warmer_k
    if film is None or film.radiates != "included":
        seen_k4 = fourth_power(air_k) if film is not None and film.radiates == "air" else around_k4
        flow = flow + net_radiation_w_m2(emissivity, surface_k, seen_k4)
    return -flow if side == "inside" else flow


def _convection_w_m2k(conditions: Conditions, draws: Draws, warmer_k: FloatArray, upward: FloatArray) -> FloatArray:
    """Return the convection coefficient by the formula that each draw has drawn, shape (g, k), [W/(m2 K)].

    A draw without a formula takes the mean of all formulas, weighted by `Conditions.film_shares`. `warmer_k` is surface
    minus air temperature, shape (g, k), [K]; `upward` is the upward part of outward unit normals, shape (g, 1).
    """
    drawn = draws.values.get(FORMULA, np.full(draws.count, -1.0))
    wind, found = draws.values.get("wind", np.zeros(draws.count)), np.zeros(warmer_k.shape)
    for number, (film, share) in enumerate(zip(FILMS[conditions.side].values(), conditions.film_shares)):
        for which, part in ((drawn == number, 1.0), (drawn < 0.0, share)):
            if part > 0.0 and which.any():
                found[:, which] += part * film.w_m2k(wind[which], warmer_k[:, which], upward)
    return found


def most_u_w_m2k(surface: AuditedSurface, side: str) -> FloatArray:
    """Return the largest possible U-value of each triangle, 1 / (Rsi + Rse) of ISO 6946: two films, no wall, (f,).

    Rsi depends on the direction of the heat flow, up, down or level. A larger U-value contradicts the readings.
    """
    upward = surface.upward * (-1.0 if side == "outside" else 1.0)
    return 1.0 / (1.0 / FILMS["inside"]["iso-6946-combined"].w_m2k(0.0, 0.0, upward) + OUTSIDE_RESISTANCE_M2K_W)


def with_references(surface: AuditedSurface, conditions: Conditions, draws: Draws) -> Draws:
    """Return draws whose "camera offset" is computed from the contact temperatures; without references, `draws`.

    The offset makes the corrected readings near a reference equal to the temperature measured there. Of several
    references, the mean offset is taken. Errors of emissivity and reflection then largely cancel elsewhere.
    Raises `AuditError` if no triangle that counts is within `_FARTHEST_M` of a reference.
    """
    if not conditions.references:
        return draws
    offsets = []
    for number in range(len(conditions.references)):
        near = _near(surface, conditions, number)
        area = surface.area_m2[near]
        upward = np.atleast_1d(np.average(surface.upward[near], weights=area))
        emissivity = draws[emissivity_name(conditions, int(surface.surface_entry[near[0]]))]
        contact_k = celsius_to_kelvin(draws[f"contact temperature {number + 1}"])
        around_k4 = radiant_k4(conditions, draws, upward)[0]
        needed_k = reading_k(contact_k, emissivity, around_k4, *_camera_settings(draws))
        read_k = celsius_to_kelvin(float(np.average(surface.reading_c[near], weights=area)))
        own = draws.local(conditions.camera.repeatability.off_by, _OF_A_REFERENCE + number)
        offsets.append(needed_k - read_k + own)
    return replace(draws, values={**draws.values, "camera offset": np.mean(offsets, axis=0)})


def reference_doubts(conditions: Conditions, draws: Draws) -> tuple[str, ...]:
    """Return a sentence if all offsets in `draws`, from `with_references`, are outside the stated range; else none."""
    stated, found = conditions.camera.offset, draws["camera offset"]
    if not conditions.references or (stated.low <= found.max() and found.min() <= stated.high):
        return ()
    return (
        f"The contact temperatures ask for {found[0]:+.1f} K on all readings; stated are {stated.low:+g} to "
        f"{stated.high:+g} K. One of the two is wrong; the contact temperatures were used.",
    )


def _near(surface: AuditedSurface, conditions: Conditions, number: int) -> IntArray:
    """Return the triangles that count within `_AROUND_M` of reference `number`, on the nearest triangle's patch."""
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
