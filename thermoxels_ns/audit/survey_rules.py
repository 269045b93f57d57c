"""What EN 13187 asks of a thermographic survey, and what makes its answers doubtful."""

from __future__ import annotations

from dataclasses import dataclass, fields

from thermoxels_ns.audit.conditions import Conditions
from thermoxels_ns.audit.draws import uncertain

LEAST_DIFFERENCE_K, MOST_WIND_M_S, LEAST_HOURS_WITHOUT_SUN, LEAST_HOURS_DRY = 10.0, 5.0, 2.0, 24.0
"""Difference of the airs, wind, time without sun and time since the surface was wet that EN 13187 asks for."""

_MEANT_AS_EXACT = ("emissivity set in the camera", "reflected temperature set in the camera")
_NAMES = {
    "hours_since_sun": "hours since the sun last shone on the surface",
    "sun_last_12h": "sun during the last 12 hours",
    "hours_dry": "hours since the surface was last wet",
    "least_difference_24h": "smallest difference of the airs during the last 24 hours",
}


@dataclass(frozen=True)
class SurveyCheck:
    """What is wrong with a survey, sentences and names."""

    forbidden: tuple[str, ...]  # Conditions that EN 13187 does not allow
    doubts: tuple[str, ...]  # What makes the figures less certain than their intervals say
    missing: tuple[str, ...]  # What a report after EN 13187 has to say and the conditions do not


def check_survey(conditions: Conditions) -> SurveyCheck:
    """Hold conditions against what EN 13187 asks for."""
    survey, wind, difference = conditions.survey, conditions.outside.wind, conditions.difference_k
    least, sun, dry = survey.least_difference_24h, survey.hours_since_sun, survey.hours_dry
    forbidden = []
    if difference < LEAST_DIFFERENCE_K:
        forbidden.append(f"The airs differ by {difference:.1f} K; EN 13187 asks for {LEAST_DIFFERENCE_K:g} K.")
    elif least is not None and least.value < LEAST_DIFFERENCE_K:
        forbidden.append(
            f"During the last 24 hours the airs differed by {least.value:g} K at times; EN 13187 asks for "
            f"{LEAST_DIFFERENCE_K:g} K all the time."
        )
    if wind is not None and wind.value > MOST_WIND_M_S:
        forbidden.append(f"The wind was {wind.value:.1f} m/s; EN 13187 allows {MOST_WIND_M_S:g} m/s.")
    if conditions.side == "outside":
        if sun is not None and sun.value < LEAST_HOURS_WITHOUT_SUN:
            forbidden.append(
                f"The sun shone on the surface {sun.value:g} hours before; EN 13187 asks for "
                f"{LEAST_HOURS_WITHOUT_SUN:g} hours without, heavy walls need more."
            )
        if dry is not None and dry.value < LEAST_HOURS_DRY:
            asked = f"EN 13187 asks for {LEAST_HOURS_DRY:g} hours."
            forbidden.append(f"The surface was wet {dry.value:g} hours before; {asked}")
    return SurveyCheck(tuple(forbidden), _doubts(conditions), _missing(conditions))


def _doubts(conditions: Conditions) -> tuple[str, ...]:
    found, difference = [], conditions.difference_k
    not_meant = _MEANT_AS_EXACT if conditions.outside_known else (*_MEANT_AS_EXACT, "outside air")
    exact = [name for name, what in uncertain(conditions).items() if not what.off_by and name not in not_meant]
    if exact:
        found.append(f"Taken as exact, because nothing says how far they may be off: {', '.join(exact)}.")
    if not conditions.outside_known:
        found.append(
            "The air outside is not known. U-values, psi, chi and temperature factors are shares of the difference of "
            "the airs: none can be told. Heat flow through the surface can: it follows from the room alone."
        )
    for name, air in (("inside", conditions.inside), ("outside", conditions.outside)):
        if air.lowest_24h is not None and air.highest_24h is not None:
            change = air.highest_24h.value - air.lowest_24h.value
            if change > 0.2 * difference:
                found.append(
                    f"The air {name} changed by {change:.1f} K within 24 hours, {100 * change / difference:.0f} % of "
                    "the difference of the airs. Heat flow is taken as steady; heavy walls lag behind by hours."
                )
        else:
            found.append(f"How the air {name} changed before is not known. Heat flow is taken as steady.")
    if conditions.surroundings.reflected is None and conditions.surroundings.ground is None:
        found.append("The ground is taken to be as warm as the air.")
    metal = [", ".join(surface.patches) for surface in conditions.surfaces if surface.emissivity.value < 0.7]
    if metal:
        found.append(
            f"Emissivities below 0.7 ({'; '.join(metal)}): such surfaces mirror more than they show; leave_out does "
            "without them."
        )
    if conditions.side == "inside" and conditions.outside_known:
        found.append("U-values hold where the open air is behind the surface; the mesh does not say where that is.")
    return tuple(found)


def _missing(conditions: Conditions) -> tuple[str, ...]:
    survey, camera, outside = conditions.survey, conditions.camera, conditions.outside
    said = {_NAMES.get(one.name, one.name.replace("_", " ")): getattr(survey, one.name) for one in fields(survey)}
    said["air temperature outside"] = outside.air if conditions.outside_known else None
    for name, air in (("inside", conditions.inside), ("outside", outside)):
        both = air.lowest_24h if air.highest_24h is not None else None
        said[f"lowest and highest air temperature {name} during the last 24 hours"] = both
    said |= {"wind": outside.wind, "wind direction": outside.wind_direction}
    said |= {"make and model of the camera": camera.model, "serial number of the camera": camera.serial_number}
    return tuple(name for name, value in said.items() if value in (None, ""))
