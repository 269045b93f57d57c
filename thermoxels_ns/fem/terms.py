"""The kinds of terms that the heat equation can have besides conduction and storage.

Effects are turned into these, and the solver knows these only. They are data: how they become vectors and matrices on
the nodes stands in `forms.py`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from thermoxels_ns.fem.quantities import Bounded


@dataclass(frozen=True)
class RobinTerm:
    """q = h (T_ambient - T) through boundary triangles, positive into the body."""

    effect: str
    """Label of the effect that it comes from."""
    facets: npt.NDArray[np.int64]
    """Numbers of boundary triangles, shape (k,)."""
    coefficient_w_m2k: Bounded
    """h, [W / (m2 K)]."""
    ambient_c: Bounded
    """T_ambient, [degrees Celsius]."""


@dataclass(frozen=True)
class FluxTerm:
    """A given heat flux through boundary triangles, positive into the body."""

    effect: str
    """Label of the effect that it comes from."""
    facets: npt.NDArray[np.int64]
    """Numbers of boundary triangles, shape (k,)."""
    factors: tuple[Bounded, ...]
    """The heat flux is the product of these, [W / m2]."""


@dataclass(frozen=True)
class RadiationTerm:
    """q = sigma eps (T_s^4 - T^4) through boundary triangles, temperatures in kelvin, positive into the body."""

    effect: str
    """Label of the effect that it comes from."""
    facets: npt.NDArray[np.int64]
    """Numbers of boundary triangles, shape (k,)."""
    emissivity: Bounded
    """eps, [1]."""
    surroundings_c: Bounded
    """T_s, [degrees Celsius]."""
    stefan_boltzmann_w_m2k4: float
    """sigma, [W / (m2 K4)]."""


@dataclass(frozen=True)
class SourceTerm:
    """A given heat source in tetrahedra."""

    effect: str
    """Label of the effect that it comes from."""
    tets: npt.NDArray[np.int64]
    """Numbers of tetrahedra, shape (k,)."""
    source_w_m3: Bounded
    """Heat source, [W / m3]."""


@dataclass(frozen=True)
class FixedTerm:
    """Given temperatures at the nodes of boundary triangles."""

    effect: str
    """Label of the effect that it comes from."""
    facets: npt.NDArray[np.int64]
    """Numbers of boundary triangles, shape (k,)."""
    temperature_c: Bounded
    """Temperature, [degrees Celsius]."""


Term: TypeAlias = RobinTerm | FluxTerm | RadiationTerm | SourceTerm | FixedTerm
"""All kinds."""
