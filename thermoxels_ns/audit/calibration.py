"""Calibration: find the properties of walls for which computed surface temperatures agree with measured ones.

The heat equation is solved in the mesh, with the conditions' film model on the photographed side and ISO 6946 on the
other side: steady, or, with heat capacities, from the beginning of the weather file on. Gauss-Newton's method finds the
logarithms of the unknown properties with the least sum of squared differences, weighted by area (Beck and Arnold 1977,
Parameter Estimation in Engineering and Science).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, cast

import numpy as np
from scipy.optimize import least_squares

from thermoxels_ns.audit.conditions import Calibrate, Conditions
from thermoxels_ns.audit.draws import FORMULA, Draws, Interval, emissivity_name, interval_of
from thermoxels_ns.audit.exchange import HALF_STEP_K, film_flow_w_m2, radiant_k4, triangle_exchange
from thermoxels_ns.audit.heat_flow import FILMS
from thermoxels_ns.audit.surface import AuditedSurface, chosen_names
from thermoxels_ns.core.arrays import BoolArray, FloatArray
from thermoxels_ns.core.errors import AuditError
from thermoxels_ns.core.measured import Measured
from thermoxels_ns.core.units import celsius_to_kelvin
from thermoxels_ns.fem.problem import Varying
from thermoxels_ns.fem.selection import matching_names
from thermoxels_ns.fem.steady import solve_steady
from thermoxels_ns.fem.time_loop import solve_heat
from thermoxels_ns.heat.effects import Convection
from thermoxels_ns.heat.materials import Material
from thermoxels_ns.heat.scene import HeatScene
from thermoxels_ns.heat.scene_fields import OUTSIDE_RESISTANCE_M2K_W

_UNITS = {"conductivity": "W/(m K)", "thickness": "m", "capacity": "kJ/(m3 K)"}
_BEFORE, _ABSORPTANCE = "air before the weather file", "absorptance of the walls"  # Used with a history of weather only
_LEAST_STEP_H, _STEPS_OF_AN_AGE = 0.125, 4.0  # Shortest time step; longer ones are a quarter of the time to the survey
_UNSEEN_DAY_K = 10.0  # Least half range of the air before a weather file of less than a day, [K]
_LINEAR = 1e-9  # Relative tolerance of the linear equations of a time step
_TOLD_SHARE = 0.05  # If the air before the file changes a property by this share or more, `Calibration.doubt` says so
_STEP = 1e-4  # Step of difference quotients with respect to the logarithm of a property
_MOST_STEP, _ENOUGH, _MOST_STEPS = 1.0, 1e-3, 30  # Largest step and stopping step of logarithms; most steps
_FAR = 4.0  # A property whose logarithm moves farther than this from the start is not determined
_LEAST_K = 0.02  # Least change of surface temperatures, root mean square, if a property becomes e times as large
_MOST_SPREAD = 0.5  # Largest standard deviation by noise and drift of the logarithm of a determined property
_SMALL_SHARE = 0.1  # Properties with a smaller share than this in a combination are not named
_OF_A_PATCH, _OF_THE_NOISE, _OF_WHAT_IS_STATED = 3 * 10**6, 4 * 10**6, 5 * 10**6  # Numbers that seed random errors


@dataclass(frozen=True)
class Calibration:
    """Result of a calibration: the values of the unknown properties, or the reason why there are none."""

    found: Mapping[str, Interval]  # Unknown properties by name, such as "conductivity of wall"; empty if refused
    units: Mapping[str, str]  # Unit of each property, known or unknown
    refused: str  # Sentences that say why no values are found; empty if values are found
    moved_most_by: Mapping[str, str]  # By unknown property: the uncertain quantity that changes its value most
    misfit_k: float  # Root mean square of measured minus computed surface temperature, weighted by area, [K]
    difference_k: FloatArray
    """Measured minus computed surface temperature, shape (f,), [K]; NaN for triangles outside the fit."""
    history_h: float = 0.0  # How long before the survey the computed history of the airs begins, [h]; 0: steady
    doubt: str = ""  # Sentence on a history that is too short; empty if it is long enough


def calibrated(conditions: Conditions, surface: AuditedSurface, draws: Draws) -> Calibration | None:
    """Return the unknown properties of `Conditions.calibrate`, fitted to the readings; None if there is no `calibrate`.

    Raises `AuditError` or `HeatError` if mesh, model and weather file do not fit together.
    """
    asked = conditions.calibrate
    if asked is None:
        return None
    fit = _Fit(_Wall(conditions, asked, surface), draws)
    names = fit.names
    units = {name: _UNITS[name.split()[0]] for name in asked.stated()}
    refused = fit.what_cannot_be_told(units)
    difference = np.full(len(surface.counted), np.nan)
    difference[fit.wall.counted] = fit.residual_k
    misfit = float(np.sqrt(fit.weight @ fit.residual_k**2))
    history_h = fit.wall.history_h
    if refused:
        return Calibration({}, units, refused, {}, misfit, difference, history_h)
    logarithms, most, before = fit.spread()
    found = {}
    for name, drawn in zip(names, logarithms):
        one = interval_of(np.exp(np.clip(drawn, -20.0, 20.0)) * fit.start[name])
        least, largest = one.value * np.exp(-_FAR), one.value * np.exp(_FAR)
        found[name] = Interval(
            one.value, one.low if one.low > least else 0.0, one.high if one.high < largest else np.inf
        )
    doubt = ""
    if np.expm1(before).max() >= _TOLD_SHARE:
        moved = ", ".join(f"{name} by {100.0 * share:.0f} %" for name, share in zip(names, np.expm1(before)))
        doubt = (
            f"The weather file begins {history_h:g} h before the survey, too late for what this wall remembers: from "
            f"the warmest to the coldest air that may have been before, {moved}; that is in the intervals."
        )
    return Calibration(found, units, "", dict(zip(names, most)), misfit, difference, history_h, doubt)


class _Wall:
    """The body with its films; computes surface temperatures for given properties and draws."""

    def __init__(self, conditions: Conditions, asked: Calibrate, surface: AuditedSurface) -> None:
        self.conditions, self.asked, self.surface = conditions, asked, surface
        names, patch = surface.selection.patch_names, surface.selection.facet_patch
        behind = chosen_names("calibrate: behind", names, asked.behind)
        insulated = {name for pattern in asked.adiabatic for name in matching_names(names, pattern)}
        self.behind = np.flatnonzero(np.isin(patch, [names.index(name) for name in behind - insulated]))
        seen = [n for n, name in enumerate(names) if name not in behind | insulated]
        self.seen = np.flatnonzero(np.isin(patch, seen))
        self.counted = self.seen[surface.counted[self.seen]]
        if not len(self.counted) or not len(self.behind):
            got = "no such surface" if not len(self.behind) else f"nothing that counts but on {', '.join(behind)}"
            remedy = 'Name the patches on the far side of what was photographed, such as ["interior-*"].'
            raise AuditError("calibrate: behind", expected="another side of the body", got=got, remedy=remedy)
        bare = sorted({names[n] for n in np.unique(patch[self.seen[surface.surface_entry[self.seen] < 0]])})
        if bare:
            remedy = f"Add {{patches: [{bare[0]}], emissivity: 0.93 +- 0.02}} to surfaces, or name it in behind."
            raise AuditError(
                "surfaces", expected="an emissivity for every patch", got=f"none for {bare[0]}", remedy=remedy
            )
        there = tuple(names[n] for n in np.unique(patch[self.behind]))
        self._layers = dict[str, BoolArray]()  # By name of the layer: on which of `behind` it lies, shape (b,)
        for name, layer in asked.layers.items():
            on = chosen_names(f"calibrate: layers: {name}", there, layer.patches)
            self._layers[name] = np.isin(patch[self.behind], [names.index(one) for one in on])
        regions = surface.mesh.region_names
        made_of = chosen_names("calibrate: conductivity", regions, asked.conductivity, "regions")
        unknown = sorted({regions[n] for n in np.unique(surface.mesh.region)} - made_of)
        if unknown:
            remedy = f"Add {unknown[0]}: 0.8 W/(m K), or '*' for all others."
            expected = "one for every region of the mesh"
            raise AuditError("calibrate: conductivity", expected=expected, got=f"none for {unknown[0]}", remedy=remedy)
        self.history = self._history() if asked.heat_capacity else None
        self.stated = asked.stated()
        if self.history is not None:
            change_k, weather = self.history["outside_c"], conditions.weather
            unseen_k = _UNSEEN_DAY_K if self.history_h < 24.0 else 0.0
            self.stated[_BEFORE] = Measured(0.0, max(float(np.abs(change_k - change_k[0]).max()), unseen_k))
            if self.history["sun_w_m2"].any() and weather is not None:
                self.stated[_ABSORPTANCE] = weather.absorptance

    @property
    def history_h(self) -> float:
        """How long before the survey the history begins, [h]; 0 without one."""
        return 0.0 if self.history is None else float(self.history["hours"][-1])

    def _history(self) -> dict[str, FloatArray]:
        """Return the weather at t times by name, (t,) each: `hours` since the file begins, and means of each column.

        A mean is over the time step before its hour; the first value is the mean of the first day, the last the value
        at the survey. Airs are minus those at the survey, [K]; sun is in [W/m2]. Earlier time steps are longer.
        """
        series = self.conditions.history()
        if "outside_c" not in series:
            remedy = "Add it, or remove heat_capacity from calibrate for steady heat flow."
            raise AuditError("weather: file", expected="a column outside_c", got=", ".join(series), remedy=remedy)
        hours, ages = series["hours"] - series["hours"][0], [0.0]
        while ages[-1] < hours[-1]:
            step = max(_LEAST_STEP_H, 2.0 ** np.floor(np.log2(max(ages[-1], _LEAST_STEP_H) / _STEPS_OF_AN_AGE)))
            ages.append(min(ages[-1] + step, hours[-1]))
        ends = hours[-1] - np.array(ages[::-1])
        grid = np.union1d(hours, ends)
        found = {"hours": ends}
        for name in ("outside_c", "inside_c", "sun_w_m2"):
            values = series.get(name, np.zeros(len(hours)))
            values = np.interp(grid, hours, values - (0.0 if name == "sun_w_m2" else values[-1]))
            total = np.append(0.0, np.cumsum(0.5 * (values[1:] + values[:-1]) * np.diff(grid)))
            day = min(24.0, hours[-1])
            before = np.interp(day, grid, total) / day
            means = np.diff(np.interp(ends, grid, total)) / np.diff(ends)
            found[name] = np.concatenate([[before], means[:-1], values[-1:]])
        return found

    def computed_c(self, values: Mapping[str, float], draws: Draws, measured_c: FloatArray) -> FloatArray:
        """Return the temperature of each triangle in `counted`, (c,), [C], for `values` of all properties by name.

        The film on the photographed side is that of draw 0 of `draws`, replaced by its tangent at `measured_c`, (c,),
        [C]. With a history, the body begins in the steady state of the first day, and backward Euler steps lead to the
        survey; the radiant temperature around then differs from that at the survey by as much as the air.
        """
        mesh, names = self.surface.mesh, np.array(self.surface.selection.patch_names)
        start_c = np.full(len(self.surface.counted), float(measured_c.mean()))
        start_c[self.counted] = measured_c
        coefficient, air_c = self._photographed_side(draws, start_c[self.seen])
        inside = self.conditions.side == "inside"
        far_air_c = float(draws["outside air" if inside else "inside air"][0])
        far = self._far_side(values)
        materials = {
            name: Material(name, values[f"conductivity of {name}"], 1000.0, values.get(f"capacity of {name}", 1000.0))
            for name in self.asked.conductivity
        }

        def scene(near_c: Varying | float, far_c: Varying | float) -> HeatScene:
            films = []
            for facets, film, air in ((self.seen, coefficient, near_c), (self.behind, far, far_c)):
                patches = tuple(names[np.unique(self.surface.selection.facet_patch[facets])].tolist())
                films.append(Convection(patches, Varying(partial(_always, film), in_time=False), air))
            return HeatScene(materials, convection=tuple(films), adiabatic=self.asked.adiabatic, initial_c=far_air_c)

        up, facets = self.surface.selection.up, mesh.facets[self.counted]
        if self.history is None:
            state = solve_steady(scene(Varying(partial(_always, air_c), in_time=False), far_air_c).problem(mesh, up=up))
            return state.temperature_c[facets].mean(axis=1)
        ends_s, room = 3600.0 * self.history["hours"], self.history["inside_c"]
        outside = self.history["outside_c"].copy()
        outside[0] += values[_BEFORE]
        sun = values.get(_ABSORPTANCE, 0.0) * self.history["sun_w_m2"]
        # The sun acts like warmer air (sol-air temperature, Mackey and Wright 1944).
        open_air = outside + (OUTSIDE_RESISTANCE_M2K_W if inside else 1.0 / coefficient[:, None]) * sun
        near, beyond = (room, open_air) if inside else (open_air, room)
        airs = partial(_at, ends_s, air_c[:, None] + near), partial(_at, ends_s, far_air_c + beyond)
        problem = scene(*map(Varying, airs)).problem(mesh, up=up)
        start_c = solve_steady(problem).temperature_c
        problem = replace(problem, initial_temperature_c=start_c)
        found = solve_heat(problem, np.diff(ends_s), relative_tolerance=_LINEAR)
        return found.temperature_c[-1][facets].mean(axis=1)

    def _photographed_side(self, draws: Draws, at_c: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return (s,) coefficients, and air temperatures, of linear convection: the film's tangent at `at_c`, (s,)."""
        surface, upward = self.surface, self.surface.upward[self.seen]
        every = np.stack([draws[emissivity_name(self.conditions, n)] for n in range(len(self.conditions.surfaces))])
        emissivity = every[surface.surface_entry[self.seen]]
        around_k4 = radiant_k4(self.conditions, draws, upward)

        def flow(warmer_k: float) -> FloatArray:
            surface_k = celsius_to_kelvin(at_c + warmer_k)[:, None]
            out = film_flow_w_m2(self.conditions, draws, surface_k, around_k4, emissivity, upward)[:, 0]
            return -out if self.conditions.side == "inside" else out

        low, mean, high = (flow(step) for step in (-HALF_STEP_K, 0.0, HALF_STEP_K))
        coefficient = np.maximum((high - low) / (2.0 * HALF_STEP_K), 1e-3)
        return coefficient, at_c - mean / coefficient

    def _far_side(self, values: Mapping[str, float]) -> FloatArray:
        """Return the coefficient of film and layers on the side not photographed, shape (b,), [W/(m2 K)]."""
        far = FILMS["inside" if self.conditions.side == "outside" else "outside"]["iso-6946-combined"]
        resistance = np.ones(len(self.behind)) / far.w_m2k(0.0, 0.0, self.surface.upward[self.behind])
        for name, where in self._layers.items():
            resistance = resistance + where * values[f"thickness of {name}"] / values[f"conductivity of {name}"]
        return 1.0 / resistance


# Functions of places and time for `Varying`.
def _always(value: FloatArray, *_: object) -> FloatArray:
    return value


def _at(times_s: FloatArray, values: FloatArray, _: object, time_s: float) -> FloatArray:
    """Return the column of `values`, (k, t) or (t,), at the entry of `times_s` nearest to a time."""
    return values[..., int(np.argmin(np.abs(times_s - time_s)))]


class _Fit:
    """The least-squares fit of m unknown properties for the stated values, and its change with uncertain quantities."""

    def __init__(self, wall: _Wall, draws: Draws) -> None:
        self.wall, self.draws = wall, draws
        self.names = [one.name() for one in wall.asked.unknown]
        self.stated = wall.stated
        self.start = {name: self.stated[name].value for name in self.names}
        area = wall.surface.area_m2[wall.counted]
        self.weight = area / area.sum()
        self._first = draws.first(0)
        self.logarithm = self._search()

    def _residual(self, logarithm: FloatArray, draws: Draws, known: Mapping[str, float] | None = None) -> FloatArray:
        values = {name: one.value for name, one in self.stated.items()} | dict(known or {})
        values |= {name: self.start[name] * float(np.exp(x)) for name, x in zip(self.names, logarithm)}
        wall = self.wall
        measured = triangle_exchange(wall.conditions, wall.surface, draws).surface_c[wall.counted]
        return measured - wall.computed_c(values, draws, measured)

    def _search(self) -> FloatArray:
        """Return the logarithms of property over start with the least squares, (m,): Gauss-Newton in a trust region.

        Sets `residual_k`, (c,), minus its Jacobian `slope`, (c, m), the eigenvectors `directions` of the weighted
        J^T J, and `sensitive_k`, (m,): the root mean square change of temperature per unit step along each of them.
        """
        root, steps = np.sqrt(self.weight), _STEP * np.eye(len(self.names))

        def residual(x: FloatArray) -> FloatArray:
            return root * self._residual(x, self._first)

        def slope(x: FloatArray) -> FloatArray:
            here = residual(x)
            return np.stack([(residual(x + step) - here) / _STEP for step in steps], axis=1)

        far, jacobian = (-2.0 * _FAR, 2.0 * _FAR), cast(Any, slope)  # stubs of scipy take no function
        found = least_squares(residual, np.zeros(len(steps)), jacobian, far, ftol=_ENOUGH, xtol=_ENOUGH)
        self.residual_k, self.slope = found.fun / root, -found.jac / root[:, None]
        values, self.directions = np.linalg.eigh(found.jac.T @ found.jac)
        self.sensitive_k = np.sqrt(np.maximum(values, 0.0))
        return found.x

    def what_cannot_be_told(self, units: Mapping[str, str]) -> str:
        """Return sentences on properties that the readings do not determine; empty if all are determined."""
        far = [
            f"No {name} explains the readings: however {'small' if x < 0.0 else 'large'} it is, the computed surface "
            "is on one side of the measured one. Check the airs, the camera's offset and what is taken as known."
            for name, x in zip(self.names, self.logarithm)
            if abs(x) > _FAR
        ]
        return " ".join(far) or " ".join(
            self._combination(direction, sensitive, units)
            for direction, sensitive, off in zip(self.directions.T, self.sensitive_k, self._local_spread())
            if sensitive < _LEAST_K or off > _MOST_SPREAD
        )

    def _combination(self, direction: FloatArray, sensitive_k: float, units: Mapping[str, str]) -> str:
        """Return a sentence on a combination of properties, `direction` of logarithms (m,), that is not determined."""
        share = direction / direction[np.argmax(np.abs(direction))]
        which = [n for n in np.argsort(-np.abs(share), kind="stable") if abs(share[n]) >= _SMALL_SHARE]
        named = [self.names[n] for n in which]
        if len(which) == 1:
            return (
                f"The readings do not tell the {named[0]}: were it twice as much, surface temperatures would change by "
                f"{np.log(2.0) * sensitive_k:.2g} K. Take it as known, or measure a surface that it acts on."
            )
        told = f"{', '.join(named[:-1])} and {named[-1]} cannot be told apart"
        power = -float(share[which[1]])  # known is the first property times the second to this power
        if len(which) > 2 or abs(abs(power) - 1.0) >= 0.05:
            return f"{told}: only a combination of them is known. Take all but one of them as known."
        values = [self.start[name] * np.exp(self.logarithm[n]) for n, name in zip(which, named)]
        what, between = ("ratio", "per") if power < 0.0 else ("product", "times")
        known = f"{values[0] * values[1] ** power:.3g} {units[named[0]]} {between} {units[named[1]]}"
        return f"{told}: their {what} is, {known}. Take one of the two as known."

    def _local(self, gain: FloatArray) -> Iterator[tuple[int, FloatArray]]:
        """Yield each patch, and the change of `gain`, (m, c), @ residuals if its readings rise by 1 K, (m,)."""
        patch = self.wall.surface.selection.facet_patch[self.wall.counted]
        for number in np.unique(patch):
            yield int(number), gain[:, patch == number].sum(axis=1)

    def _noise(self, gain: FloatArray) -> FloatArray:
        """Return the covariance, shape (m, m), of `gain`, (m, c), @ residuals by independent noise of nodal readings.

        The variance of a node is three times that of the residuals, as a triangle's reading is the mean of three nodes.
        """
        facets = self.wall.surface.mesh.facets[self.wall.counted]
        nodes, number = np.unique(facets, return_inverse=True)
        at_nodes = np.stack([np.bincount(number.ravel(), np.repeat(row / 3.0, 3), len(nodes)) for row in gain])
        return 3.0 * float(self.weight @ self.residual_k**2) * at_nodes @ at_nodes.T

    def _local_spread(self) -> FloatArray:
        """Return the standard deviation along each of `directions`, (m,), due to noise and the patches' own errors."""
        told = np.maximum(self.sensitive_k, 1e-12)
        gain = (self.directions.T / told[:, None] ** 2) @ (self.slope.T * self.weight)
        variance = np.diag(self._noise(gain)).copy()
        off = self.wall.conditions.camera.repeatability.off_by
        for _, moved in self._local(gain):
            variance += off**2 / 3.0 * moved**2
        return np.sqrt(variance)

    def spread(self) -> tuple[FloatArray, list[str], FloatArray]:
        """Return the logarithms of the properties in every draw, (m, k), the quantity that changes each property most,
        and the change of each logarithm by the air before the weather file, (m,).

        For each uncertain quantity that acts on all readings, the fit is repeated at both ends of its range, and a
        parabola interpolates in between; for film formulas, the fit is repeated with each. The effects are added up.
        """
        gain = np.linalg.solve(self.slope.T @ (self.weight[:, None] * self.slope), self.slope.T * self.weight)
        off, count = self.wall.conditions.camera.repeatability.off_by, self.draws.count
        drawn = np.repeat(self.logarithm[:, None], count, axis=1)
        moved: dict[str, FloatArray] = {}
        for name, values in self._uncertain().items():
            if name == FORMULA:
                which, place = np.unique(values[1:], return_inverse=True)
                each = np.stack([self._follow(gain, name, value) for value in which], axis=1) - self.logarithm[:, None]
                drawn[:, 1:] += each[:, place]
                moved[name] = np.ptp(each, axis=1)
                continue
            at = values - values[0]
            low, high = at.min(), at.max()
            below, above = (self._follow(gain, name, values[0] + end) - self.logarithm for end in (low, high))
            if low == 0.0 or high == 0.0:  # stated at an end of what is possible, such as no wind: a line
                rise, bend = (above / high if high > 0.0 else below / low), np.zeros(len(below))
            else:  # the parabola through (low, below), (0, 0) and (high, above)
                bend = (above / high - below / low) / (high - low)
                rise = above / high - bend * high
            drawn += rise[:, None] * at + bend[:, None] * at**2
            moved[name] = np.abs(above - below)
        for number, step in self._local(gain):
            drawn += step[:, None] * self.draws.local(off, _OF_A_PATCH + number)
        noise = np.random.default_rng((self.draws.seed, _OF_THE_NOISE)).standard_normal((len(drawn), count))
        noise[:, 0] = 0.0
        drawn += np.linalg.cholesky(self._noise(gain) + 1e-18 * np.eye(len(drawn))) @ noise
        most = [max(moved, key=lambda name: moved[name][n]) if moved else "" for n in range(len(self.names))]
        return drawn, most, moved.get(_BEFORE, np.zeros(len(self.names)))

    def _uncertain(self) -> dict[str, FloatArray]:
        """Return the draws, (k,), of each inexact quantity that acts on all readings: conditions, known properties."""
        common = {name: values for name, values in self.draws.values.items() if not name.startswith("contact")}
        for number, (name, one) in enumerate(self.stated.items()):
            if name not in self.start:
                common[name] = one.value + self.draws.local(one.off_by, _OF_WHAT_IS_STATED + number)
        return {name: values for name, values in common.items() if np.ptp(values) > 0.0}

    def _follow(self, gain: FloatArray, name: str, value: float) -> FloatArray:
        """Return the logarithms, (m,), with `gain` @ residuals = 0 if quantity `name` is `value` (Broyden's method)."""
        common = name in self.draws.values
        draws = Draws({**self._first.values, name: np.array([value])}) if common else self._first
        known = {} if common else {name: value}
        x, inverse = self.logarithm.copy(), np.eye(len(self.logarithm))
        pull = gain @ self._residual(x, draws, known)
        for _ in range(_MOST_STEPS):
            step = np.clip(inverse @ pull, -_MOST_STEP, _MOST_STEP)
            x = x + step
            if np.abs(step).max() < _ENOUGH or np.abs(x - self.logarithm).max() > _FAR + _MOST_STEP:
                break
            after = gain @ self._residual(x, draws, known)
            change = inverse @ (pull - after)
            if abs(step @ change) > 1e-12:
                inverse = inverse + np.outer(step - change, step @ inverse) / (step @ change)
            pull = after
        return x
