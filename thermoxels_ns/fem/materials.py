"""What a body is made of, as far as heat conduction is concerned."""

from __future__ import annotations

from dataclasses import dataclass

from thermoxels_ns.core.checks import check_positive
from thermoxels_ns.core.errors import HeatError


@dataclass(frozen=True)
class Material:
    """A uniform, isotropic solid with constant properties.

    >>> f"{Material('concrete', 1.7, 2200.0, 880.0).diffusivity_m2_s:.4e} m2/s"
    '8.7810e-07 m2/s'
    """

    name: str
    """Name for reports."""
    conductivity_w_mk: float
    """Thermal conductivity, [W / (m K)], above 0."""
    density_kg_m3: float
    """Mass density, [kg / m3], above 0."""
    specific_heat_j_kgk: float
    """Specific heat capacity, [J / (kg K)], above 0."""

    def __post_init__(self) -> None:
        if not (isinstance(self.name, str) and self.name.strip()):
            raise HeatError("material name", expected="a name", got=repr(self.name), remedy="Give the material a name.")
        for field, unit in (
            ("conductivity_w_mk", "W/(m K)"),
            ("density_kg_m3", "kg/m3"),
            ("specific_heat_j_kgk", "J/(kg K)"),
        ):
            remedy = f"Give {self.name} a value in {unit}."
            object.__setattr__(self, field, check_positive(field, getattr(self, field), remedy, HeatError))

    @property
    def heat_capacity_j_m3k(self) -> float:
        """Heat that warms a cubic metre by a kelvin, rho c, [J / (m3 K)]."""
        return self.density_kg_m3 * self.specific_heat_j_kgk

    @property
    def diffusivity_m2_s(self) -> float:
        """Thermal diffusivity k / (rho c), [m2 / s]."""
        return self.conductivity_w_mk / self.heat_capacity_j_m3k
