"""A heat problem: which body, made of what, at which temperatures, over which time."""

from __future__ import annotations

import math
import numbers
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Literal, Protocol, runtime_checkable

import numpy as np

from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.core.checks import check_finite, check_positive, check_shape
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.core.units import ZERO_CELSIUS_K
from thermoxels_ns.fem.p1_kernels import refuse_flat_tets
from thermoxels_ns.fem.quantities import Bounded, Bounds
from thermoxels_ns.fem.selection import Selection
from thermoxels_ns.mesh.tetrahedra import TetMesh

MOST_CONTRAST = 1e9
"""Largest conductivity over the smallest of a body; beyond, what the worse one conducts is lost to round-off."""
_MOST = 10_000_000  # Steps or kept times; a minute each for nineteen years


@dataclass(frozen=True)
class TimeSteps:
    """Equal steps in time.

    >>> TimeSteps(3, 20.0).times_s.tolist()
    [0.0, 20.0, 40.0, 60.0]
    """

    steps: int  # Number of steps, at least 1
    step_seconds: float  # Length of a step, [s], above 0

    def __post_init__(self) -> None:
        _check_count("steps", self.steps, "Give 10, for example: steps in a scene, --steps in an export.")
        remedy = "Give 60, for example: step_seconds in a scene, --step-seconds in an export."
        seconds = check_positive("step_seconds", self.step_seconds, remedy, HeatError)
        object.__setattr__(self, "step_seconds", seconds)
        check_positive("steps times step_seconds", self.steps * seconds, "Give shorter steps.", HeatError)

    @property
    def duration_s(self) -> float:
        """Time that the body is followed for, [s]."""
        return self.steps * self.step_seconds

    @property
    def times_s(self) -> FloatArray:
        """Start, then the end of every step, shape (steps + 1,), [s]."""
        return np.arange(self.steps + 1, dtype=np.float64) * self.step_seconds

    @property
    def lengths_s(self) -> tuple[FloatArray, ...]:
        """Lengths of the steps in each interval at whose ends temperatures are kept, [s]."""
        return (np.array([self.step_seconds]),) * self.steps


@dataclass(frozen=True)
class AdaptiveSteps:
    """Steps as long as a tolerance allows.

    >>> AdaptiveSteps(3600.0, outputs=3).times_s.tolist()
    [0.0, 1200.0, 2400.0, 3600.0]
    """

    duration_s: float  # Time to follow the body for, [s], above 0
    tolerance_k: float = 0.05
    """Largest error of any temperature that the steps may make, as estimated from their embedded pair, [K]. The
    default is half of what building physics asks of a temperature (ISO 10211: 0.1 K)."""
    outputs: int = 10  # Number of equal intervals at whose ends temperatures are kept

    def __post_init__(self) -> None:
        for name, remedy in (("duration_s", "Give a time in seconds."), ("tolerance_k", "Give a tolerance in kelvin.")):
            object.__setattr__(self, name, check_positive(name, getattr(self, name), remedy, HeatError))
        _check_count("outputs", self.outputs, "Give the number of intervals, such as 10.")

    @property
    def times_s(self) -> FloatArray:
        """Start, then the end of every interval, shape (outputs + 1,), [s]."""
        return np.linspace(0.0, self.duration_s, self.outputs + 1)


@dataclass(frozen=True)
class GivenSteps:
    """Steps of given lengths, such as those of an adaptive computation, halved.

    >>> GivenSteps(6.0, (np.array([1.0, 2.0]), np.array([3.0])), 0.1).halved().lengths_s[0].tolist()
    [0.5, 0.5, 1.0, 1.0]
    """

    duration_s: float  # Time to follow the body for, [s]
    lengths_s: tuple[FloatArray, ...]
    """Lengths of the steps in each of some equal intervals at whose ends temperatures are kept, [s]."""
    tolerance_k: float
    """Tolerance of the adaptive steps that these came from, [K]. A step whose temperatures leave their range by more
    than a thousandth of it is repeated with backward Euler."""

    def halved(self, times: int = 1) -> GivenSteps:
        """Halve every step so many times."""
        parts = 2**times
        lengths_s = tuple(np.repeat(interval_s / parts, parts) for interval_s in self.lengths_s)
        return GivenSteps(self.duration_s, lengths_s, self.tolerance_k)

    @property
    def times_s(self) -> FloatArray:
        """Start, then the end of every interval, [s]."""
        return np.linspace(0.0, self.duration_s, len(self.lengths_s) + 1)


def _check_count(name: str, value: int, remedy: str) -> None:
    if not isinstance(value, numbers.Integral) or isinstance(value, bool) or not 1 <= value <= _MOST:
        raise HeatError(name, expected=f"a whole number from 1 to {_MOST:,}", got=repr(value), remedy=remedy)


@dataclass(frozen=True)
class Term:
    """What an effect adds to the heat equation besides conduction and storage; positive is into the body."""

    kind: Literal["convection", "flux", "radiation", "source", "fixed"]
    parts: IntArray  # Numbers of boundary triangles, of a source of tetrahedra, shape (k,)
    quantities: tuple[Bounded, ...]
    """convection: h and T_ambient in h (T_ambient - T); flux: what it is the product of; radiation: eps and T_s in
    factor eps (T_s^4 - T^4), temperatures in kelvin; source: [W / m3]; fixed: the temperature of the nodes."""
    factor: float = 1.0  # Stefan-Boltzmann constant of radiation, [W / (m2 K4)]


class Effect(ABC):
    """Something that a heat problem may contain besides conduction: checked input that knows its own term.

    A dataclass whose fields are quantities, or names of `patches` or `regions` that it acts on.
    """

    kind: ClassVar[str]  # What it is called in reports
    bounds: ClassVar[dict[str, Bounds]]  # Which fields are quantities, and their range

    def __post_init__(self) -> None:
        for name in ("patches", "regions"):
            if hasattr(self, name):
                object.__setattr__(self, name, _checked_names(name, getattr(self, name)))
        for name, bounds in self.bounds.items():
            object.__setattr__(self, name, bounds.check_quantity(getattr(self, name)))

    @property
    def where(self) -> tuple[str, ...]:
        """Names or patterns of the patches, or of the regions, that the effect acts on."""
        return getattr(self, "patches", None) or getattr(self, "regions", ())

    @property
    def label(self) -> str:
        """Name of the effect in reports: its kind and where it acts."""
        return f"{self.kind} on {', '.join(self.where)}"

    def bounded(self, name: str) -> Bounded:
        """Give one of the quantities of the effect with its range."""
        return Bounded(getattr(self, name), self.bounds[name])

    @abstractmethod
    def term(self, selection: Selection) -> Term:
        """Give the term of the effect in the heat equation; `HeatError` if the mesh lacks a patch or region of it."""


def _checked_names(field: str, names: object) -> tuple[str, ...]:
    """Return names as a tuple; a single text is refused because its letters would be taken for names."""
    listed = tuple(names) if isinstance(names, (tuple, list)) else ()
    if not listed or not all(isinstance(name, str) and name.strip() for name in listed):
        remedy = f'Write {field}=("name",), for example.'
        raise HeatError(field, expected="a tuple of names", got=repr(names), remedy=remedy)
    return listed


@runtime_checkable
class Conductor(Protocol):
    """What the solver asks of a material, such as `heat.materials.Material`: two numbers above 0."""

    @property
    def conductivity_w_mk(self) -> float:
        """Thermal conductivity, [W / (m K)]."""
        ...

    @property
    def heat_capacity_j_m3k(self) -> float:
        """Heat that warms a cubic metre by a kelvin, rho c, [J / (m3 K)]."""
        ...


@dataclass(frozen=True)
class HeatProblem:
    """Heat in a body: conduction, storage, and the effects that the scene calls for.

    rho c dT/dt = div(k grad T) inside, T = T0 at the start; where no effect acts on the boundary it is insulated,
    k grad T . n = 0.
    """

    mesh: TetMesh  # The body
    material: Conductor | Mapping[str, Conductor]
    """What all of it is made of, or one material per name of a region of the mesh."""
    initial_temperature_c: FloatArray | None = None
    """Nodal temperature at the start, shape (n,), [degrees Celsius]; None: the mesh's own. A steady solver starts its
    iterations from it."""
    effects: tuple[Effect, ...] = ()  # What acts on the body; several may act on one patch
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)  # Direction that points up, for effects that depend on it

    def __post_init__(self) -> None:
        points, tets = self.mesh.points_m, self.mesh.tets
        if len(tets) == 0:
            remedy = "Build the mesh with thermoxels_ns.mesh."
            raise HeatError("mesh tets", expected="at least one tetrahedron", got="none", remedy=remedy)
        refuse_flat_tets(points, tets)
        unused = len(points) - np.count_nonzero(np.bincount(tets.ravel(), minlength=len(points)))
        if unused:
            expected, got = "every node in at least one tetrahedron", f"{unused} of {len(points)} in none"
            remedy = "Remove the unused nodes; they have no heat capacity."
            raise HeatError("mesh points", expected=expected, got=got, remedy=remedy)
        self._check_temperatures()
        self._check_effects()
        _ = self.selection  # refuses tags that do not fit the mesh
        self._check_materials()

    @cached_property
    def selection(self) -> Selection:
        """The named parts of the mesh."""
        return Selection(self.mesh, self.up)

    @property
    def resolution_s(self) -> float:
        """Longest time between two looks at the effects that tells how they change in between, [s]."""
        return min((e.bounded(name).resolution_s for e in self.effects for name in e.bounds), default=math.inf)

    @property
    def start_c(self) -> FloatArray:
        """Nodal temperature at the start, shape (n,), [degrees Celsius]."""
        given = self.mesh.temperature_c if self.initial_temperature_c is None else self.initial_temperature_c
        return np.asarray(given, dtype=np.float64)

    @property
    def conductivity_w_mk(self) -> FloatArray:
        """Thermal conductivity of each tetrahedron, shape (t,), [W / (m K)]."""
        return self._of_tets("conductivity_w_mk")

    @property
    def heat_capacity_j_m3k(self) -> FloatArray:
        """Heat capacity per volume of each tetrahedron, shape (t,), [J / (m3 K)]."""
        return self._of_tets("heat_capacity_j_m3k")

    def _of_tets(self, name: str) -> FloatArray:
        if isinstance(self.material, Conductor):
            return np.full(len(self.mesh.tets), float(getattr(self.material, name)))
        known, names = self.material, self.mesh.region_names
        by_region = [float(getattr(known[region], name)) if region in known else np.nan for region in names]
        return np.array(by_region)[self.mesh.region]

    def _check_materials(self) -> None:
        if isinstance(self.material, Conductor):
            return
        remedy, names = "Give one Material, or one per region: {name of region: Material}.", self.mesh.region_names
        if not isinstance(self.material, Mapping):
            got = repr(self.material)
            raise HeatError("material", expected="a Material or a mapping", got=got, remedy=remedy)
        used = {names[number] for number in np.unique(self.mesh.region)}
        given = {name for name, material in self.material.items() if isinstance(material, Conductor)}
        wrong = {
            "none for": used - set(self.material),
            "no Material for": set(self.material) - given,
            "unknown": given - set(names),
        }
        if any(wrong.values()):
            got = "; ".join(f"{what}: {', '.join(sorted(which))}" for what, which in wrong.items() if which)
            expected = f"a Material for each of the regions {', '.join(sorted(used))}"
            raise HeatError("material", expected=expected, got=got, remedy=remedy)
        conductivities = {name: self.material[name].conductivity_w_mk for name in used}
        least, most = (choose(conductivities, key=conductivities.__getitem__) for choose in (min, max))
        if conductivities[most] > MOST_CONTRAST * conductivities[least]:
            got = f"{conductivities[least]:g} W/(m K) in {least} and {conductivities[most]:g} in {most}"
            expected = f"conductivities no more than {MOST_CONTRAST:g} times apart"
            remedy = "Leave out what conducts next to nothing, or correct the unit of one."
            raise HeatError("material", expected=expected, got=got, remedy=remedy)

    def _check_effects(self) -> None:
        wrong = [type(effect).__name__ for effect in self.effects if not isinstance(effect, Effect)]
        if wrong or not isinstance(self.effects, tuple):
            got = ", ".join(wrong) or type(self.effects).__name__
            remedy = "Use the effects of thermoxels_ns.heat.effects."
            raise HeatError("effects", expected="a tuple of effects", got=got, remedy=remedy)
        length = math.hypot(*self.up) if len(self.up) == 3 else math.nan
        if not (math.isfinite(length) and length > 0.0):
            expected, remedy = "a direction", "Give three numbers, such as (0, 0, 1)."
            raise HeatError("up", expected=expected, got=repr(self.up), remedy=remedy)
        object.__setattr__(self, "up", tuple(float(part) / length for part in self.up))

    def _check_temperatures(self) -> None:
        name = "mesh temperature_c" if self.initial_temperature_c is None else "initial_temperature_c"
        remedy = "Give one temperature in degrees Celsius per mesh node."
        start = check_shape(name, self.start_c, (len(self.mesh.points_m),), remedy, HeatError)
        check_finite(name, start, remedy, HeatError)
        if start.min() < -ZERO_CELSIUS_K:
            expected = f"temperatures above absolute zero ({-ZERO_CELSIUS_K} C)"
            raise HeatError(name, expected=expected, got=f"{start.min():.6g} C", remedy=remedy)


def effect_labels(problem: HeatProblem) -> tuple[str, ...]:
    """Names of a problem's effects for reports, all different: a second one of the same kind and place is numbered."""
    numbers: dict[str, int] = {}
    for own in (effect.label for effect in problem.effects):
        label, number = own, numbers.get(own, 1)
        while label in numbers:
            number += 1
            label = f"{own} ({number})"
        numbers[own] = number
        numbers.setdefault(label, 1)
    return tuple(numbers)
