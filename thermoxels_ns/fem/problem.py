"""A heat problem: body, materials, initial temperatures, effects with their quantities; and time steps."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Annotated, ClassVar, Literal, TypeAlias

import numpy as np
import numpy.typing as npt
from pydantic import Field

from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.core.checks import check_array, check_direction
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.core.units import ZERO_CELSIUS_K
from thermoxels_ns.core.yaml_records import raising, record
from thermoxels_ns.fem.linear_tets import refuse_flat_tets
from thermoxels_ns.fem.selection import Places, Selection
from thermoxels_ns.mesh.tetrahedra import TetMesh

MOST_CONTRAST = 1e9
"""Largest ratio of two conductivities in a body; above this ratio, the smaller one is lost to round-off."""


Count: TypeAlias = Annotated[int, Field(ge=1, le=10_000_000)]  # Steps, or kept times: nineteen years of minutes
Seconds: TypeAlias = Annotated[float, Field(gt=0.0, le=1e300)]
Positive: TypeAlias = Annotated[float, Field(gt=0.0)]
Text: TypeAlias = Annotated[str, Field(pattern=r"\S")]


@record(HeatError)
class TimeSteps:
    """Equal time steps.

    >>> TimeSteps(3, 20.0).times_s.tolist()
    [0.0, 20.0, 40.0, 60.0]
    """

    steps: Count  # Number of steps, at least 1
    step_seconds: Seconds  # Length of a step, [s], above 0

    @property
    def duration_s(self) -> float:
        """Time over which the body is followed, [s]."""
        return self.steps * self.step_seconds

    @property
    def times_s(self) -> FloatArray:
        """Time 0, then the end of every step, shape (steps + 1,), [s]."""
        return np.arange(self.steps + 1, dtype=np.float64) * self.step_seconds


@record(HeatError)
class AdaptiveSteps:
    """Time steps whose length follows from a tolerance of the error.

    >>> AdaptiveSteps(3600.0, outputs=3).times_s.tolist()
    [0.0, 1200.0, 2400.0, 3600.0]
    """

    duration_s: Seconds  # Time over which to follow the body, [s], above 0
    tolerance_k: Annotated[float, Field(gt=0.0)] = 0.05
    """Largest error of any temperature that time steps may cause, by the estimate of the scheme, [K]. The default is
    half of the error that building physics allows (ISO 10211: 0.1 K)."""
    outputs: Count = 10  # Number of equal intervals at whose ends temperatures are kept

    @property
    def times_s(self) -> FloatArray:
        """Time 0, then the end of every interval, shape (outputs + 1,), [s]."""
        return np.linspace(0.0, self.duration_s, self.outputs + 1)


@dataclass(frozen=True)
class Varying:
    """A quantity that varies with the place or with time.

    >>> sunrise = Varying(lambda places, time_s: 100.0 * min(time_s / 3600.0, 1.0))
    >>> sunrise.function(Places(np.zeros((2, 3)), np.zeros((2, 3))), 1800.0)
    50.0
    """

    function: Callable[[Places, float], npt.ArrayLike]
    """Function of the places and of the time, [s]; returns one number per place, (k,), or one for all places."""
    in_time: bool = True  # True if the numbers change with time; False: the numbers at time 0 are used at all times
    resolution_s: float = math.inf  # Longest time step that misses no change, above 0, [s]; adaptive steps obey it


def tabulated(times_s: FloatArray, values: FloatArray) -> Varying:
    """Return a quantity that is interpolated linearly between the entries of a table of times and values.

    The quantity has the first value before the first time, and the last value after the last time. Adaptive steps are
    no longer than the shortest time between two entries, so that they miss no entry.

    Args:
        times_s: Times, ascending, at least two, shape (k,), [s].
        values: Values of the quantity at these times, shape (k,).

    >>> tabulated(np.array([0.0, 3600.0, 7200.0]), np.array([10.0, 20.0, 10.0])).resolution_s
    3600.0
    """
    return Varying(partial(_interpolated, times_s, values), resolution_s=float(np.min(np.diff(times_s))))


def _interpolated(times_s: FloatArray, values: FloatArray, _: Places, time_s: float) -> float:
    return float(np.interp(time_s, times_s, values))


Quantity: TypeAlias = float | Varying  # One number for all places and times, or a function


def in_time(quantity: Quantity) -> bool:
    """Return whether a quantity changes with time."""
    return isinstance(quantity, Varying) and quantity.in_time


def values_at(quantity: Quantity, places: Places, time_s: float) -> FloatArray:
    """Return the values of a quantity at k places and a time, shape (k,)."""
    if isinstance(quantity, Varying):
        found = quantity.function(places, time_s if quantity.in_time else 0.0)
    else:
        found = quantity
    return np.broadcast_to(np.asarray(found, dtype=np.float64), (len(places),)).copy()


class Effect:
    """Something that acts on a body, such as convection; the module `forms` makes vectors and matrices of it.

    A subclass must be a dataclass whose first field names the patches or regions on which the effect acts.
    """

    kind: ClassVar[str]  # Name of this kind of effect in reports
    form: ClassVar[Literal["convection", "flux", "radiation", "source", "fixed"]]
    """Kind of term that the effect adds to the heat equation. Heat flows and fluxes are positive into the body."""

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """The coefficients of the term, by `form`; temperatures among them are in degrees Celsius.

        convection: h, T_ambient of the flux h (T_ambient - T). flux: the factors whose product is the flux. radiation:
        eps, T_s, sigma of the flux sigma eps (T_s^4 - T^4). source: heat, [W / m3]. fixed: temperature of the nodes.
        """
        return tuple(vars(self).values())[1:]

    @property
    def where(self) -> tuple[str, ...]:
        """Names or patterns of the patches (for a source: of the regions) on which the effect acts."""
        return next(iter(vars(self).values()))

    @property
    def label(self) -> str:
        """Name of the effect in reports: its kind and `where`, such as "convection on exterior-*"."""
        return f"{self.kind} on {', '.join(self.where)}"

    @property
    def changing(self) -> tuple[Varying, ...]:
        """The quantities that change with time."""
        return tuple(one for one in vars(self).values() if isinstance(one, Varying) and one.in_time)

    def parts(self, selection: Selection) -> IntArray:
        """Return the numbers of the triangles (for a source: tetrahedra) on which the effect acts, shape (k,).

        Raises `HeatError` if an entry of `where` matches no patch or region of the mesh.
        """
        return (selection.tets if self.form == "source" else selection.facets)(self.where)


@record(HeatError)
class Material:
    """A uniform, isotropic solid with constant properties.

    >>> f"{Material('concrete', 1.7, 2200.0, 880.0).diffusivity_m2_s:.4e} m2/s"
    '8.7810e-07 m2/s'
    """

    name: Text
    conductivity_w_mk: Positive  # Thermal conductivity, [W / (m K)]
    density_kg_m3: Positive  # Mass density, [kg / m3]
    specific_heat_j_kgk: Positive  # Specific heat capacity, [J / (kg K)]

    @property
    def heat_capacity_j_m3k(self) -> float:
        """Heat that warms a cubic metre by a kelvin, rho c, [J / (m3 K)]."""
        return self.density_kg_m3 * self.specific_heat_j_kgk

    @property
    def diffusivity_m2_s(self) -> float:
        """Thermal diffusivity k / (rho c), [m2 / s]."""
        return self.conductivity_w_mk / self.heat_capacity_j_m3k


@dataclass(frozen=True)
class HeatProblem:
    """A heat problem: rho c dT/dt = div(k grad T) + s in a body, T = T0 at the start, and effects on its boundary.

    The source s is 0 unless effects add one. Boundary without an effect is insulated: k grad T . n = 0 with the outward
    normal n. Raises `HeatError` if the mesh is damaged or has flat tetrahedra or unused nodes, or if materials or
    initial temperatures are missing or not possible.
    """

    mesh: TetMesh  # The body
    material: Material | Mapping[str, Material]
    """Material of the whole body, or a mapping from the name of each region of the mesh to its material."""
    initial_temperature_c: FloatArray | None = None
    """Nodal temperature T0, (n,), [degrees Celsius]; None: as in the mesh. Steady solvers start iterations from it."""
    effects: tuple[Effect, ...] = ()  # Effects that act on the body; several may act on one patch
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)  # Direction that points up, for effects that depend on it

    def __post_init__(self) -> None:
        points, tets = self.mesh.points_m, self.mesh.tets
        with raising(HeatError):
            self.mesh.check()
        refuse_flat_tets(points, tets)
        used = np.zeros(len(points), bool)
        used[tets] = True
        unused = np.count_nonzero(~used)
        if unused:
            expected, got = "every node in at least one tetrahedron", f"{unused} of {len(points)} in none"
            remedy = "Remove the unused nodes; they have no heat capacity."
            raise HeatError("mesh points", expected=expected, got=got, remedy=remedy)
        self._check_temperatures()
        self._check_materials()
        x, y, z = check_direction("up", self.up, "Give three numbers, such as (0, 0, 1).", HeatError).tolist()
        object.__setattr__(self, "up", (x, y, z))

    @cached_property
    def selection(self) -> Selection:
        """The patches and regions of the mesh by name, with their geometry."""
        return Selection(self.mesh, self.up)

    @property
    def resolution_s(self) -> float:
        """Least `Varying.resolution_s` of all quantities that change with time, [s]; inf if there is none."""
        return min((one.resolution_s for effect in self.effects for one in effect.changing), default=math.inf)

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

    @cached_property
    def materials(self) -> dict[str, Material]:
        """The material of each region that has tetrahedra, by the region's name."""
        one, used = self.material, [self.mesh.region_names[number] for number in np.unique(self.mesh.region)]
        return {name: one if isinstance(one, Material) else one[name] for name in used}

    def _of_tets(self, name: str) -> FloatArray:
        made_of = self.materials
        by_region = [float(getattr(made_of[one], name)) if one in made_of else np.nan for one in self.mesh.region_names]
        return np.array(by_region)[self.mesh.region]

    def _check_materials(self) -> None:
        if isinstance(self.material, Material):
            return
        used = {self.mesh.region_names[number] for number in np.unique(self.mesh.region)}
        missing = sorted(used - {*self.material})
        if missing:
            expected = f"a material for each of the regions {', '.join(sorted(used))}"
            remedy = "Add them, or '*' for all others to a scene."
            raise HeatError("materials", expected=expected, got=f"none for {', '.join(missing)}", remedy=remedy)
        conductivities = {name: made_of.conductivity_w_mk for name, made_of in self.materials.items()}
        least, most = (choose(conductivities, key=conductivities.__getitem__) for choose in (min, max))
        if conductivities[most] > MOST_CONTRAST * conductivities[least]:
            got = f"{conductivities[least]:g} W/(m K) in {least} and {conductivities[most]:g} in {most}"
            expected = f"conductivities no more than {MOST_CONTRAST:g} times apart"
            remedy = "Leave out what conducts next to nothing, or correct the unit of one."
            raise HeatError("material", expected=expected, got=got, remedy=remedy)

    def _check_temperatures(self) -> None:
        name = "mesh temperature_c" if self.initial_temperature_c is None else "initial_temperature_c"
        remedy = "Give one temperature in degrees Celsius per mesh node."
        if self.initial_temperature_c is None and not self.mesh.has_temperatures:
            remedy = "Add initial: {temperature_c: 15} to the scene, for example: photographs alone tell none."
            raise HeatError(name, expected="temperatures at the start", got="a mesh without", remedy=remedy)
        start = check_array(name, self.start_c, (len(self.mesh.points_m),), remedy, HeatError)
        if start.min() < -ZERO_CELSIUS_K:
            expected = f"temperatures above absolute zero ({-ZERO_CELSIUS_K} C)"
            raise HeatError(name, expected=expected, got=f"{start.min():.6g} C", remedy=remedy)


def effect_labels(problem: HeatProblem) -> tuple[str, ...]:
    """Return the names of the effects for reports, all different: a second effect with the same label gets " (2)"."""
    labels, again = dict[str, None](), Counter[str]()
    for effect in problem.effects:
        label = effect.label
        while label in labels:
            again[effect.label] += 1
            label = f"{effect.label} ({again[effect.label] + 1})"
        labels[label] = None
    return tuple(labels)
