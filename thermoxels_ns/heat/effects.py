"""Effects that a scene may name: convection, radiation, sunlight, sources and others; n is the outward normal."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from thermoxels_ns.core.units import ZERO_CELSIUS_K
from thermoxels_ns.fem.problem import Effect, Term
from thermoxels_ns.fem.quantities import Bounded, Bounds, Quantity
from thermoxels_ns.fem.selection import Selection

STEFAN_BOLTZMANN_W_M2K4 = 5.670374419e-8  # Stefan-Boltzmann constant (CODATA 2018), [W / (m2 K4)]

HOTTEST_C = 10_000.0
"""Highest temperature that is accepted, [degrees Celsius]; above it a unit is wrong: the sun's surface has 5500."""
_ABSOLUTE_ZERO_C = -ZERO_CELSIUS_K


@dataclass(frozen=True)
class SurfaceEffect(Effect):
    """An effect on patches of the boundary.

    In all effects temperatures are in degrees Celsius, and a positive heat flux goes into the body. A quantity is a
    number or a `Varying`, which is evaluated at centroids of boundary triangles (fixed temperatures: at nodes;
    sources: at points in tetrahedra).
    """

    patches: tuple[str, ...]  # Names of boundary patches, or patterns such as exterior-*; * is the whole boundary

    form: ClassVar[
        Literal["convection", "flux", "fixed"]
    ]  # The form of the equation below, into which the quantities go in the order of `bounds`

    def term(self, selection: Selection) -> Term:
        """Return the effect's equation on the triangles of its patches."""
        return Term(self.form, selection.facets(self.patches), tuple(self.bounded(name) for name in self.bounds))


@dataclass(frozen=True)
class FixedTemperature(SurfaceEffect):
    """A surface that is kept at a given temperature: T = `temperature_c` at its nodes."""

    temperature_c: Quantity  # Temperature of the surface, [degrees Celsius], at least -273.15; evaluated at nodes

    kind = "fixed temperature"
    form = "fixed"
    bounds = {"temperature_c": Bounds("temperature_c", "degrees Celsius", _ABSOLUTE_ZERO_C, HOTTEST_C)}


@dataclass(frozen=True)
class HeatFlux(SurfaceEffect):
    """A given heat flux through a surface, k grad T . n = `flux_w_m2`."""

    flux_w_m2: Quantity  # Heat flux, [W / m2], positive into the body

    kind = "heat flux"
    form = "flux"
    bounds = {"flux_w_m2": Bounds("flux_w_m2", "W/m2")}


@dataclass(frozen=True)
class Convection(SurfaceEffect):
    """Heat exchange with air (Newton's law of cooling), k grad T . n = h (T_air - T)."""

    coefficient_w_m2k: Quantity  # Surface heat transfer coefficient h, [W / (m2 K)], at least 0
    air_c: Quantity  # Temperature of the air, [degrees Celsius], at least -273.15

    kind = "convection"
    form = "convection"
    bounds = {
        "coefficient_w_m2k": Bounds("coefficient_w_m2k", "W/(m2 K)", 0.0),
        "air_c": Bounds("air_c", "degrees Celsius", _ABSOLUTE_ZERO_C, HOTTEST_C),
    }


@dataclass(frozen=True)
class Radiation(SurfaceEffect):
    """Long-wave exchange with large surroundings such as the sky, the ground or a room (Stefan-Boltzmann law)."""

    emissivity: Quantity
    """Emissivity of the surface, times the view factor of the surroundings if they do not fill its view; 0 to 1."""
    surroundings_c: Quantity  # Radiant temperature of the surroundings, [degrees Celsius], at least -273.15
    stefan_boltzmann_w_m2k4: float = STEFAN_BOLTZMANN_W_M2K4
    """Stefan-Boltzmann constant, [W / (m2 K4)]; the default is CODATA 2018's. Published benchmarks use 5.67e-8."""

    kind = "radiation"
    bounds = {
        "emissivity": Bounds("emissivity", "1", 0.0, 1.0),
        "surroundings_c": Bounds("surroundings_c", "degrees Celsius", _ABSOLUTE_ZERO_C, HOTTEST_C),
        "stefan_boltzmann_w_m2k4": Bounds(
            "stefan_boltzmann_w_m2k4", "W/(m2 K4)", 0.0, above_low=True, varies=False, remedy="Give 5.670374419e-8."
        ),
    }

    def term(self, selection: Selection) -> Term:
        """Return the term of the heat flux into the body, k grad T . n = sigma eps (T_s^4 - T^4), T in kelvin."""
        quantities = self.bounded("emissivity"), self.bounded("surroundings_c")
        return Term("radiation", selection.facets(self.patches), quantities, self.stefan_boltzmann_w_m2k4)


@dataclass(frozen=True)
class AbsorbedSolar(SurfaceEffect):
    """Sunlight that a surface absorbs, k grad T . n = absorptivity times irradiance."""

    absorptivity: Quantity  # Share of the sunlight that the surface absorbs, 0 to 1
    irradiance_w_m2: Quantity  # Sunlight that falls on the surface, [W / m2] of the surface itself, at least 0

    kind = "absorbed solar"
    form = "flux"
    bounds = {
        "absorptivity": Bounds("absorptivity", "1", 0.0, 1.0),
        "irradiance_w_m2": Bounds("irradiance_w_m2", "W/m2", 0.0),
    }


@dataclass(frozen=True)
class GroundContact(SurfaceEffect):
    """Heat exchange with the ground through a thermal resistance."""

    resistance_m2k_w: float  # Thermal resistance between the surface and the undisturbed ground, [m2 K / W], above 0
    ground_c: Quantity  # Temperature of the undisturbed ground, [degrees Celsius], at least -273.15

    kind = "ground contact"
    bounds = {
        "resistance_m2k_w": Bounds("resistance_m2k_w", "m2 K/W", 0.0, above_low=True, varies=False),
        "ground_c": Bounds("ground_c", "degrees Celsius", _ABSOLUTE_ZERO_C, HOTTEST_C),
    }

    def term(self, selection: Selection) -> Term:
        """Return the term of the heat flux into the body, k grad T . n = (T_ground - T) / R, R the resistance."""
        coefficient = Bounds("1 / resistance_m2k_w", "W/(m2 K)", 0.0)
        conductance = Bounded(coefficient.check_quantity(1.0 / self.resistance_m2k_w), coefficient)
        return Term("convection", selection.facets(self.patches), (conductance, self.bounded("ground_c")))


@dataclass(frozen=True)
class InternalHeat(Effect):
    """Heat that is set free inside the body."""

    regions: tuple[str, ...]  # Names of regions, or patterns; * is the whole body
    source_w_m3: Quantity  # Heat set free per volume, [W / m3]; a negative value takes heat out

    kind = "internal heat"
    bounds = {"source_w_m3": Bounds("source_w_m3", "W/m3")}

    def term(self, selection: Selection) -> Term:
        """Return the term of the source s = `source_w_m3` in rho c dT/dt = div(k grad T) + s."""
        return Term("source", selection.tets(self.regions), (self.bounded("source_w_m3"),))
