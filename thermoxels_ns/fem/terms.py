"""Terms of the heat equation besides conduction and storage, and the effects that add them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, TypeAlias

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.quantities import Bounded, Bounds
from thermoxels_ns.fem.selection import Selection


@dataclass(frozen=True)
class _OnFacets:
    effect: str  # Label of the effect that it comes from
    facets: npt.NDArray[np.int64]  # Numbers of boundary triangles, shape (k,)


@dataclass(frozen=True)
class ConvectionTerm(_OnFacets):
    """Convection or ground contact, q = h (T_ambient - T) through boundary triangles, positive into the body."""

    coefficient_w_m2k: Bounded
    ambient_c: Bounded


@dataclass(frozen=True)
class FluxTerm(_OnFacets):
    """A given heat flux through boundary triangles, positive into the body."""

    factors: tuple[Bounded, ...]  # The heat flux is the product of these, [W / m2]


@dataclass(frozen=True)
class RadiationTerm(_OnFacets):
    """q = sigma eps (T_s^4 - T^4) through boundary triangles, temperatures in kelvin, positive into the body."""

    emissivity: Bounded
    surroundings_c: Bounded
    stefan_boltzmann_w_m2k4: float


@dataclass(frozen=True)
class SourceTerm:
    """A given heat source in tetrahedra."""

    effect: str
    tets: npt.NDArray[np.int64]
    source_w_m3: Bounded


@dataclass(frozen=True)
class FixedTerm(_OnFacets):
    """Given temperatures at the nodes of boundary triangles."""

    temperature_c: Bounded


Term: TypeAlias = ConvectionTerm | FluxTerm | RadiationTerm | SourceTerm | FixedTerm  # All kinds


class Effect(ABC):
    """Something that a heat problem may contain besides conduction: checked input that knows its own terms.

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
        """Names or patterns of the patches, or of the regions, that it acts on."""
        return getattr(self, "patches", None) or getattr(self, "regions", ())

    @property
    def label(self) -> str:
        """Name for reports: what it is and where."""
        return f"{self.kind} on {', '.join(self.where)}"

    def bounded(self, name: str) -> Bounded:
        """Give one of its quantities with its range."""
        return Bounded(getattr(self, name), self.bounds[name])

    @abstractmethod
    def terms(self, selection: Selection) -> tuple[Term, ...]:
        """Give the terms that it adds to the heat equation of a body; `HeatError` if that lacks a patch or region."""


def _checked_names(field: str, names: object) -> tuple[str, ...]:
    """Return names as a tuple; a single text is refused because its letters would be taken for names."""
    listed = tuple(names) if isinstance(names, (tuple, list)) else ()
    if not listed or not all(isinstance(name, str) and name.strip() for name in listed):
        remedy = f'Write {field}=("name",), for example.'
        raise HeatError(field, expected="a tuple of names", got=repr(names), remedy=remedy)
    return listed
