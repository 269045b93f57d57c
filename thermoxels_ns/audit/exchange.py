"""Compute the heat exchange of groups of triangles in every draw; correct readings by contact temperatures."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy import sparse

from thermoxels_ns.audit.conditions import BALANCE, FILM_MODELS, WINDLESS, Conditions, Film, FilmModel
from thermoxels_ns.audit.draws import FORMULA, Draws, emissivity_name
from thermoxels_ns.audit.heat_flow import (
    CONVECTION,
    SIMPLE,
    fourth_power,
    net_radiation_w_m2,
    reading_k,
    sky_emissivity,
    surface_temperature_k,
    view_shares,
)
from thermoxels_ns.audit.surface import AlikeTriangles, AuditedSurface
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
    """Temperature and heat flow of g groups of triangles in k draws; draw 0 is made of the stated values."""

    surface_c: FloatArray  # Surface temperature, corrected, shape (g, k), [degrees Celsius]
    flow_w_m2: FloatArray  # Heat flow from inside to outside, shape (g, k), [W/m2]


class PartTotals(NamedTuple):
    """Totals and means over each of p parts of the surface in k draws; draw 0 is made of the stated values."""

    area_m2: FloatArray  # Area, shape (p,), [m2]
    surface_c: FloatArray  # Mean surface temperature, shape (p, k), [degrees Celsius]
    flow_w: FloatArray  # Heat flow from inside to outside, shape (p, k), [W]
    slope_w_k: FloatArray  # Change of the stated flow per kelvin that all readings of a part are higher, shape (p,)


def exchange(conditions: Conditions, groups: AlikeTriangles, draws: Draws, warmer_k: float = 0.0) -> Exchange:
    """Return the surface temperature and the heat flow of each group in each draw.

    Readings plus `warmer_k` [K] are corrected for emissivity and reflection; the film model gives the heat flow.
    """
    emissivity = np.stack([draws[emissivity_name(conditions, n)] for n in range(len(conditions.surfaces))])
    emissivity = emissivity[groups.surface_entry]
    around_k4 = radiant_k4(conditions, draws, groups.upward)
    reading_k = celsius_to_kelvin(groups.reading_c + warmer_k)[:, None] + draws["camera offset"]
    surface_k = surface_temperature_k(reading_k, emissivity, around_k4, *_camera_settings(draws))
    flow = film_flow_w_m2(conditions, draws, surface_k, around_k4, emissivity, groups.upward)
    return Exchange(surface_k - ZERO_CELSIUS_K, flow)


def slopes(conditions: Conditions, groups: AlikeTriangles, draws: Draws) -> Exchange:
    """Return by how much an `exchange` of the stated values changes per kelvin of readings, shape (g, 1)."""
    low, high = (exchange(conditions, groups, draws.stated, step) for step in (-HALF_STEP_K, HALF_STEP_K))
    return Exchange(*((above - below) / (2.0 * HALF_STEP_K) for below, above in zip(low, high)))


def _camera_settings(draws: Draws) -> tuple[FloatArray, FloatArray]:
    """Return the emissivity and the reflected temperature, [K], set in the camera; 0 C if no temperature was stated."""
    reflected_c = draws.values.get("reflected temperature set in the camera", np.zeros(draws.count))
    return draws["emissivity set in the camera"], celsius_to_kelvin(reflected_c)


def part_totals(conditions: Conditions, groups: AlikeTriangles, draws: Draws, rows: sparse.csr_array) -> PartTotals:
    """Return totals of p parts, whose `AlikeTriangles.rows` are `rows`, (2 p, g)."""
    parts = (len(rows.indptr) - 1) // 2
    area, off = rows[:parts].tocsc(), rows[parts:]
    total = np.asarray(area.sum(axis=1)).reshape(-1, 1)
    slope = slopes(conditions, groups, draws)
    temperature, flow_w = (np.repeat(off @ one, draws.count, axis=1) for one in slope)
    for part in chunks(len(groups.reading_c), draws):
        some = exchange(conditions, groups.some(part), draws)
        flow_w += area[:, part] @ some.flow_w_m2
        temperature += area[:, part] @ some.surface_c
    mean_c = temperature / np.where(total > 0.0, total, 1.0)
    return PartTotals(total[:, 0], mean_c, flow_w, (area @ slope.flow_w_m2)[:, 0])


def chunks(count: int, draws: Draws) -> Iterator[slice]:
    """Yield slices that divide `count` groups so that draws of a slice have about `CHUNK` values."""
    step = max(1, CHUNK // draws.count)
    yield from (slice(start, start + step) for start in range(0, count, step))


def triangle_exchange(
    conditions: Conditions, surface: AuditedSurface, groups: AlikeTriangles, draws: Draws
) -> tuple[FloatArray, FloatArray]:
    """Return surface temperature [degrees Celsius] and heat flow [W/m2] of each triangle, shape (f,) each.

    Both follow from the first draw, the stated values. Both are NaN where a triangle does not count.
    """
    of, pairs = groups.of_triangle, zip(exchange(conditions, groups, draws), slopes(conditions, groups, draws))
    temperature, flow = (
        np.where(surface.counted, mean[of, 0] + groups.off_k * slope[of, 0], np.nan) for mean, slope in pairs
    )
    return temperature, flow


def radiant_k4(conditions: Conditions, draws: Draws, upward: FloatArray) -> FloatArray:
    """Return the fourth power of the surroundings' radiant temperature, (g, k), [K^4]; `upward`: see `view_shares`."""
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
    model, inside = conditions.film.model, conditions.side == "inside"
    air_k = celsius_to_kelvin(draws["inside air" if inside else "outside air"])
    warmer_k, upward = surface_k - air_k, upward[:, None]
    simple = SIMPLE[conditions.side].get(model)
    if model == "given":
        coefficient = draws["film coefficient"]
    elif simple is not None:
        coefficient = simple.w_m2k(draws.values.get("wind", np.zeros(draws.count)), warmer_k, upward)
    else:
        coefficient = _convection_w_m2k(conditions, draws, warmer_k, upward)
    flow = draws["film factor"] * coefficient * warmer_k
    if simple is None or simple.radiates != "included":
        flow = flow + net_radiation_w_m2(emissivity, surface_k, around_k4 if simple is None else fourth_power(air_k))
    return -flow if inside else flow


def _convection_w_m2k(conditions: Conditions, draws: Draws, warmer_k: FloatArray, upward: FloatArray) -> FloatArray:
    """Return the coefficient of convection by the formula of each draw, shape (g, k); draws without one take the mean.

    `warmer_k` is surface minus air, shape (g, k), `upward` the upward part of normals, shape (g, 1).
    """
    formulas, model = CONVECTION[conditions.side], conditions.film.model
    drawn = draws.values.get(FORMULA, np.full(draws.count, -1.0))
    shares = conditions.film_shares if model == BALANCE else [float(name == model) for name in formulas]
    wind, found = draws.values.get("wind", np.zeros(draws.count)), np.zeros(warmer_k.shape)
    for number, (one, share) in enumerate(zip(formulas.values(), shares)):
        for which, part in ((drawn == number, 1.0), (drawn < 0.0, share)):
            if part > 0.0 and which.any():
                found[:, which] += part * one.w_m2k(wind[which], warmer_k[:, which], upward)
    return found


def other_models(conditions: Conditions) -> tuple[tuple[FilmModel, Conditions], ...]:
    """Return the film models for which the conditions suffice, with conditions that use them; the stated one first."""
    own = conditions.film
    windless = conditions.side == "outside" and conditions.outside.wind is None
    others: list[tuple[FilmModel, Conditions]] = [
        (model, replace(conditions, film=Film(model, own.factor)))
        for model in FILM_MODELS[conditions.side]
        if model not in (own.model, "given") and (not windless or model in WINDLESS)
    ]
    return ((own.model, conditions), *others)


def most_u_w_m2k(surface: AuditedSurface, conditions: Conditions, which: IntArray) -> float:
    """Return the U-value that the films of air on both sides allow without any wall, [W/(m2 K)].

    1 / (Rsi + Rse) of ISO 6946, by the direction in which heat flows through each of the triangles `which`; the mean by
    area. A larger U-value is impossible: an input clashes with the readings.
    """
    upward = surface.upward[which] * (-1.0 if conditions.side == "outside" else 1.0)
    inside = SIMPLE["inside"]["iso-6946-combined"].w_m2k(0.0, 0.0, upward)
    allowed = 1.0 / (1.0 / inside + OUTSIDE_RESISTANCE_M2K_W)
    return float(np.average(allowed, weights=surface.area_m2[which]))


def with_references(surface: AuditedSurface, conditions: Conditions, draws: Draws) -> Draws:
    """Return draws whose "camera offset" is computed from the contact temperatures; without references, `draws`.

    The offset is the correction with which readings near a reference give the temperature measured there; for several
    references it is the mean correction. Errors of emissivity and reflection then largely cancel elsewhere.
    Raises `AuditError` if no triangle that counts is near a reference.
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
    """Return one sentence if the offset in `draws`, from `with_references`, is outside its stated range; else none."""
    stated, found = conditions.camera.offset, draws["camera offset"]
    if not conditions.references or (stated.low <= found.max() and found.min() <= stated.high):
        return ()
    return (
        f"The contact temperatures ask for {found[0]:+.1f} K on all readings; stated are {stated.low:+g} to "
        f"{stated.high:+g} K. One of the two is wrong; the contact temperatures were used.",
    )


def _near(surface: AuditedSurface, conditions: Conditions, number: int) -> IntArray:
    """Return the triangles that count around reference `number`, all on the patch of the nearest triangle."""
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
