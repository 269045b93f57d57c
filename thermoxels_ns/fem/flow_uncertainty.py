"""What round-off and unbalanced residuals may have changed in temperatures and heat flows."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.kernel_cache import kernel
from thermoxels_ns.core.units import ZERO_CELSIUS_K
from thermoxels_ns.fem.implicit_equation import ROUND_OFF
from thermoxels_ns.fem.p1_kernels import _cross, _dot, _sides
from thermoxels_ns.fem.system import HeatSystem

Vector = npt.NDArray[np.float64]

MOST_UNCERTAIN = 0.01  # Share of the heat flow above which an answer is refused
_SAFETY = 4.0  # For matrices that are not quite M-matrices, of which alone the bounds are exact
_ASSEMBLY = 4.0  # Round-off of a sum of a few products, in eps
_NOTHING = 1e-9  # Differences below this share of the absolute temperature let no heat flow to speak of
_ENOUGH_K = 1e-6  # A bound of temperatures that need not be sharper, [K]
_EPS = float(np.finfo(np.float64).eps)


@dataclass(frozen=True)
class Uncertainty:
    """Bounds of what floating point and the solvers may have changed; discretisation is another matter."""

    temperature_k: float  # Of any temperature, [K]
    heat_w: float  # Of any effect's heat flow, [W]
    refusal: str = ""  # Why heat flows are too uncertain to be given, a sentence; else empty


def steady_uncertainty(
    system: HeatSystem, relative_k: Vector, rest_k: Vector | None, time_s: float, through_w: float
) -> Uncertainty:
    """Bound what is uncertain in a steady state with temperatures `relative_k` + `rest_k`, shape (n,), [K].

    `through_w` is the heat that flows through patches, [W]; through nodes of one patch it may flow in and out, too.

    With A e = r, of an M-matrix A whose row sums are what leaves the body per kelvin, no effect's flow is wrong by more
    than the sum of |r|, since heat r that is put in at a node leaves through all effects together. No temperature is
    wrong by more than sum |r_i| R_i, R_i being the resistance from node i to the surroundings along a path (Rayleigh's
    monotonicity law: Doyle and Snell, Random Walks and Electric Networks, 1984). What r is computed with adds its
    round-off. Round-off in the entries of K counts by the energy that it adds, over the range of temperatures.
    """
    fixed = system.fixed.nodes
    exchanged_w, exchanged_bound_w = system.exchanged_heat(relative_k, time_s, rest_k)
    conducted_w, bound_w = system.conducted_heat(relative_k, rest_k)
    left_w = np.abs(exchanged_w - conducted_w)
    through_w = max(through_w, 0.5 * float(np.sum(np.abs(exchanged_w)) + np.sum(left_w[fixed])))
    left_w[fixed] = 0.0
    left_w += ROUND_OFF * (exchanged_bound_w + bound_w)
    heat_w = _SAFETY * float(np.sum(left_w))
    low, high = system.surroundings_k(time_s)
    ends = [end for end in (low, high) if np.isfinite(end)] + [float(relative_k.min()), float(relative_k.max())]
    range_k, inside_k = max(ends) - min(ends), float(np.ptp(relative_k))
    # Given temperatures are rounded when the reference is taken from them, and when it is added to what is found.
    rounded_k = 4.0 * _EPS * (max(map(abs, ends)) + 2.0 * abs(system.reference_c))
    resistance = _path_resistance(system, time_s, relative_k)
    kelvin = rounded_k + _SAFETY * float(np.sum(left_w[resistance > 0.0] * resistance[resistance > 0.0]))
    if inside_k > 0.0:
        wrong, energy, _ = _assembly_energy(system, relative_k)
        heat_w += _ASSEMBLY * wrong / inside_k + through_w * rounded_k / range_k
        kelvin += _ASSEMBLY * inside_k * wrong / energy if energy > 0.0 else 0.0
    level_k = max(map(abs, ends)) + abs(system.reference_c + ZERO_CELSIUS_K)
    much = heat_w > MOST_UNCERTAIN * through_w and range_k > _NOTHING * level_k
    return Uncertainty(kelvin, heat_w, describe(heat_w, through_w, "W") if much else "")


def describe(uncertain: float, whole: float, unit: str) -> str:
    """Say that heat flows are not known."""
    return (
        f"Heat flows are uncertain by up to {uncertain:.1e} {unit} of {whole:.1e} {unit}, over {MOST_UNCERTAIN:.0%}: "
        "cells are too flat, or conductivities, coefficients of convection or steps too far apart, for the digits of "
        "floating point. Use cells of more even shape, or leave out layers and airs that are next to perfect."
    )


@dataclass
class TimeUncertainty:
    """What a computation through time has left uncertain so far.

    Heat that a step leaves unbalanced, or that is lost when its temperatures are rounded, comes out sooner or later:
    the sum of it bounds what heat flows are wrong by. Fields are per step.
    """

    heat_w: list[float] = field(default_factory=list)  # Unbalanced at most, [W]
    rounded_j: list[float] = field(default_factory=list)  # Lost when temperatures were rounded, [J]
    exchanged_j: list[float] = field(default_factory=list)  # Exchanged with the surroundings, [J]
    lengths_s: list[float] = field(default_factory=list)  # Length, [s]
    assembly: float = 0.0  # Share of conduction that round-off changes

    def add(
        self, system: HeatSystem, relative_k: Vector, uncertain_w: float, exchanged_j: float, step_s: float
    ) -> None:
        """Count a step that ended at temperatures of shape (n,), [K]."""
        rounded_k = _EPS * max(float(relative_k.max()), -float(relative_k.min()))
        if not self.lengths_s:  # given temperatures are rounded when the reference is taken from them
            rounded_k += _EPS * (rounded_k / _EPS + 2.0 * abs(system.reference_c))
        self.heat_w.append(uncertain_w)
        self.rounded_j.append(system.total_mass_j_k * rounded_k)
        self.exchanged_j.append(exchanged_j)
        self.lengths_s.append(step_s)

    def heat_j(self, system: HeatSystem, end_k: Vector) -> Vector:
        """Heat that may be wrong up to the end of each step, shape (s,), [J]; last temperatures, shape (n,), [K].

        What round-off in the entries of K and in volumes does to temperatures is kept for `temperature_k`.
        """
        lengths_s, inside_k = np.array(self.lengths_s), float(np.ptp(end_k))
        wrong, energy, thin = _assembly_energy(system, end_k)
        self.assembly = _ASSEMBLY * (thin + (wrong / energy if energy > 0.0 else 0.0))
        assembly_w = _ASSEMBLY * wrong / inside_k if inside_k > 0.0 else 0.0
        lost_j = np.cumsum((np.array(self.heat_w) + assembly_w) * lengths_s + np.array(self.rounded_j))
        return _SAFETY * lost_j + _ASSEMBLY * thin * np.cumsum(self.exchanged_j)

    def temperature_k(self, system: HeatSystem, highest_k: float) -> float:
        """Bound of what any temperature is wrong by; the highest is relative to the reference, [K]."""
        heat_w, lengths_s = np.array(self.heat_w), np.array(self.lengths_s)
        mass, pieces, rounded_k = system.nodal_mass_j_k, system.pieces, 4.0 * _EPS * len(heat_w) * highest_k
        per_watt = lengths_s / float(mass.min())
        if float(np.sum(heat_w * per_watt)) > _ENOUGH_K:
            # A piece changes as a whole, and in itself by no more than heat times the resistance to any of its nodes.
            roots = np.unique(pieces.number, return_index=True)[1]
            inside = 2.0 * float(np.max(_path_resistance(system, 0.0, None, roots)))
            per_watt = np.minimum(per_watt, lengths_s / float(pieces.sums(mass).min()) + inside)
            if not system.matrix_in_time:
                per_watt = np.minimum(per_watt, float(np.max(_path_resistance(system, 0.0))))
        rounded_k += 4.0 * _EPS * (highest_k + 2.0 * abs(system.reference_c)) + self.assembly * highest_k
        return rounded_k + _SAFETY * float(np.sum(heat_w * per_watt))


def _path_resistance(
    system: HeatSystem, time_s: float, radiating_k: Vector | None = None, roots: npt.NDArray[np.int64] | None = None
) -> Vector:
    """Resistance from each node to the surroundings, or to some nodes, along some good path, shape (n,), [K / W]."""
    held_w_k = system.held_w_k(time_s, np.inf) if roots is None else np.zeros(system.num_nodes)
    if radiating_k is not None and system.nonlinear:
        held_w_k = held_w_k + system.radiation_slope(radiating_k, time_s) @ np.ones(system.num_nodes)
    resistance = np.full(system.num_nodes, np.inf)
    np.divide(1.0, held_w_k, out=resistance, where=held_w_k > 0.0)
    resistance[system.fixed.nodes if roots is None else roots] = 0.0
    stiffness = system.stiffness
    _relax(stiffness.indptr, stiffness.indices, stiffness.data, resistance)
    return resistance


def _assembly_energy(system: HeatSystem, relative_k: Vector) -> tuple[float, float, float]:
    """Round-off in T^T K T from the entries of K, T^T K T, [W K], and the largest round-off of a volume as a share."""
    problem, stiffness = system.problem, system.stiffness
    points, tets = np.ascontiguousarray(problem.mesh.points_m), problem.mesh.tets
    conductivity = np.broadcast_to(np.asarray(problem.conductivity_w_mk, np.float64), len(tets))
    wrong, energy, thin = _tets_energy(points, tets, np.ascontiguousarray(conductivity), relative_k)
    if system.num_nodes == len(points):
        return wrong, energy, thin
    # Not every pair of nodes of quadratic tetrahedra whose entry is large is close together.
    root = np.sqrt(np.abs(stiffness.diagonal()))
    more, energy = _matrix_energy(stiffness.indptr, stiffness.indices, stiffness.data, root, relative_k)
    return wrong + more, energy, thin


@kernel
def _relax(indptr, indices, data, resistance):
    """Lower each node's resistance by way of its neighbours, back and forth, until none falls to a fifth."""
    changed = True
    while changed:
        changed = False
        for sweep in range(2):
            for step in range(len(resistance)):
                row = step if sweep == 0 else len(resistance) - 1 - step
                least = resistance[row]
                for k in range(indptr[row], indptr[row + 1]):
                    if data[k] < 0.0:
                        least = min(least, resistance[indices[k]] - 1.0 / data[k])
                changed |= least < 0.2 * resistance[row]
                resistance[row] = least


@kernel
def _matrix_energy(indptr, indices, data, root, values):
    wrong = energy = 0.0
    for row in range(len(values)):
        for k in range(indptr[row], indptr[row + 1]):
            square = (values[indices[k]] - values[row]) ** 2
            wrong += 0.5 * root[row] * root[indices[k]] * square
            energy -= 0.5 * data[k] * square
    return _EPS * wrong, energy


@kernel
def _tets_energy(points, tets, conductivity, values):
    wrong = energy = thinnest = 0.0
    for t in range(len(tets)):
        tet = tets[t]
        a, b, c = _sides(points, tet, 1.0)
        n1, n2, n3 = _cross(b, c), _cross(c, a), _cross(a, b)
        n0 = (-n1[0] - n2[0] - n3[0], -n1[1] - n2[1] - n3[1], -n1[2] - n2[2] - n3[2])
        # Sums of the sizes of what the normals' components and the volume are made of.
        m1, m2, m3 = _sizes(b, c), _sizes(c, a), _sizes(a, b)
        six_volumes = _dot(a, n1)
        start = values[tet[0]]
        u, v, w = values[tet[1]] - start, values[tet[2]] - start, values[tet[3]] - start
        square = lost = blurred = 0.0
        for x in range(3):
            slope = u * n1[x] + v * n2[x] + w * n3[x]
            square += slope * slope
            lost += abs(slope) * (abs(u) * m1[x] + abs(v) * m2[x] + abs(w) * m3[x])
            s0, s1, s2, s3 = abs(n0[x]), abs(n1[x]), abs(n2[x]), abs(n3[x])
            blurred += s0 * (s1 * u * u + s2 * v * v + s3 * w * w)
            blurred += s1 * s2 * (u - v) ** 2 + s1 * s3 * (u - w) ** 2 + s2 * s3 * (v - w) ** 2
        thin = (abs(a[0]) * m1[0] + abs(a[1]) * m1[1] + abs(a[2]) * m1[2]) / six_volumes
        factor = conductivity[t] / (6.0 * six_volumes)
        wrong += factor * (2.0 * lost + blurred + thin * square)
        energy += factor * square
        thinnest = max(thinnest, thin)
    return _EPS * wrong, energy, _EPS * thinnest


@kernel
def _sizes(u, v):
    return (
        abs(u[1] * v[2]) + abs(u[2] * v[1]),
        abs(u[2] * v[0]) + abs(u[0] * v[2]),
        abs(u[0] * v[1]) + abs(u[1] * v[0]),
    )
