"""Effects that a scene may name, such as convection and sunlight; n is the outward normal, k the conductivity."""

from __future__ import annotations

from typing import Annotated, TypeAlias

from pydantic import Field

from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.core.units import STEFAN_BOLTZMANN_W_M2K4, ZERO_CELSIUS_K
from thermoxels_ns.core.yaml_records import record
from thermoxels_ns.fem.problem import Effect, Positive, Quantity, Text, Varying

HOTTEST_C = 10_000.0
"""Highest accepted temperature, [degrees Celsius]; a higher one is a wrong unit, as the sun's surface has 5500."""

Celsius: TypeAlias = Annotated[float, Field(ge=-ZERO_CELSIUS_K, le=HOTTEST_C)]
AtLeastZero: TypeAlias = Annotated[float, Field(ge=0.0)]
Fraction: TypeAlias = Annotated[float, Field(ge=0.0, le=1.0)]
Names: TypeAlias = Annotated[tuple[Text, ...], Field(min_length=1)]


@record(HeatError)
class SurfaceEffect(Effect):
    """An effect on patches of the boundary; heat flux is positive into the body, temperatures are in degrees Celsius.

    A quantity is a number or a `Varying`, which is evaluated at centroids of boundary triangles (fixed temperatures: at
    nodes; sources: at points in tetrahedra).
    """

    patches: Names  # Names of boundary patches, or patterns such as exterior-*; * is the whole boundary


@record(HeatError)
class FixedTemperature(SurfaceEffect):
    """A surface that is kept at a given temperature: T = `temperature_c` at its nodes."""

    temperature_c: Celsius | Varying  # Temperature of the surface's nodes, [degrees Celsius], at least -273.15

    kind = "fixed temperature"
    form = "fixed"


@record(HeatError)
class HeatFlux(SurfaceEffect):
    """A given heat flux through a surface, k grad T . n = `flux_w_m2`."""

    flux_w_m2: float | Varying  # Heat flux, [W / m2], positive into the body

    kind = "heat flux"
    form = "flux"


@record(HeatError)
class Convection(SurfaceEffect):
    """Heat exchange with air (Newton's law of cooling), k grad T . n = h (T_air - T)."""

    coefficient_w_m2k: AtLeastZero | Varying  # Surface heat transfer coefficient h, [W / (m2 K)], at least 0
    air_c: Celsius | Varying  # Temperature of the air, [degrees Celsius], at least -273.15

    kind = "convection"
    form = "convection"


@record(HeatError)
class Radiation(SurfaceEffect):
    """Long-wave exchange with large surroundings such as the sky, the ground or a room (Stefan-Boltzmann law).

    The heat flux into the body is k grad T . n = sigma eps (T_s^4 - T^4), T in kelvin.
    """

    emissivity: Fraction | Varying
    """Emissivity of the surface, multiplied by the view factor if the surroundings do not fill its view; 0 to 1."""
    surroundings_c: Celsius | Varying  # Radiant temperature of the surroundings, [degrees Celsius], at least -273.15
    stefan_boltzmann_w_m2k4: Positive = STEFAN_BOLTZMANN_W_M2K4
    """Stefan-Boltzmann constant, [W / (m2 K4)]; the default is from CODATA 2018. Published benchmarks use 5.67e-8."""

    kind = "radiation"
    form = "radiation"


@record(HeatError)
class AbsorbedSolar(SurfaceEffect):
    """Sunlight that a surface absorbs, k grad T . n = absorptivity times irradiance."""

    absorptivity: Fraction | Varying  # Share of the sunlight that the surface absorbs, 0 to 1
    irradiance_w_m2: AtLeastZero | Varying  # Sunlight that falls on the surface, [W / m2] of the surface itself

    kind = "absorbed solar"
    form = "flux"


@record(HeatError)
class GroundContact(SurfaceEffect):
    """Heat exchange with the ground through a thermal resistance R, k grad T . n = (T_ground - T) / R."""

    resistance_m2k_w: Positive  # Thermal resistance between the surface and the undisturbed ground, [m2 K / W]
    ground_c: Celsius | Varying  # Temperature of the undisturbed ground, [degrees Celsius], at least -273.15

    kind = "ground contact"
    form = "convection"

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """The coefficient 1 / R, [W / (m2 K)], and the temperature of the ground."""
        return 1.0 / self.resistance_m2k_w, self.ground_c


@record(HeatError)
class InternalHeat(Effect):
    """Heat that is released inside the body, the source s = `source_w_m3` in rho c dT/dt = div(k grad T) + s."""

    regions: Names  # Names of regions, or patterns; * is the whole body
    source_w_m3: float | Varying  # Heat released per volume, [W / m3]; a negative value takes heat out

    kind = "internal heat"
    form = "source"
