"""A heat problem: which body, made of what, at which temperatures, over which time."""

from __future__ import annotations

import numbers
import sys
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from thermoxels_ns.checks import check_finite, check_positive, check_shape
from thermoxels_ns.errors import HeatError, explain
from thermoxels_ns.fem.materials import Material
from thermoxels_ns.mesh.tetrahedra import TetMesh
from thermoxels_ns.units import ZERO_CELSIUS_K


@dataclass(frozen=True)
class TimeSteps:
    """Equal steps in time.

    >>> TimeSteps(3, 20.0).times_s.tolist()
    [0.0, 20.0, 40.0, 60.0]
    """

    steps: int
    """Number of steps, at least 1."""
    step_seconds: float
    """Length of a step, [s], above 0."""

    def __post_init__(self) -> None:
        whole = isinstance(self.steps, numbers.Integral) and not isinstance(self.steps, bool)
        if not whole or self.steps < 1:
            raise HeatError(
                explain(
                    "steps",
                    expected="a whole number of at least 1",
                    got=repr(self.steps),
                    remedy="Pass --steps 10, for example.",
                )
            )
        seconds = check_positive("step_seconds", self.step_seconds, "Pass --step-seconds 60, for example.", HeatError)
        object.__setattr__(self, "step_seconds", seconds)
        if self.steps * (seconds / sys.float_info.max) > 1.0:
            raise HeatError(
                explain(
                    "steps and step_seconds",
                    expected=f"a last time that is a number, at most {sys.float_info.max:.3g} s",
                    got=f"{self.steps} steps of {seconds:g} s",
                    remedy="Pass a shorter --step-seconds.",
                )
            )

    @property
    def times_s(self) -> npt.NDArray[np.float64]:
        """Start, then the end of every step, shape (steps + 1,), [s]."""
        return np.arange(self.steps + 1, dtype=np.float64) * self.step_seconds


@dataclass(frozen=True)
class HeatProblem:
    """Transient heat conduction in a uniform body whose boundary is insulated.

    rho c dT/dt = div(k grad T) inside, k grad T . n = 0 on the boundary, T = T0 at the start.
    """

    mesh: TetMesh
    """The body."""
    material: Material
    """What all of it is made of."""
    initial_temperature_c: npt.NDArray[np.float64] | None = None
    """Nodal temperature at the start, shape (n,), [degrees Celsius]; None: the mesh's own."""

    def __post_init__(self) -> None:
        points, tets = self.mesh.points_m, self.mesh.tets
        remedy = "Build the mesh with thermoxels_ns.mesh."
        check_shape("mesh points", points, (None, 3), remedy, HeatError)
        check_finite("mesh points", points, remedy, HeatError)
        check_shape("mesh tets", tets, (None, 4), remedy, HeatError)
        if len(tets) == 0 or tets.min() < 0 or tets.max() >= len(points):
            raise HeatError(
                explain(
                    "mesh tets",
                    expected=f"at least one tetrahedron with node numbers from 0 to {len(points) - 1}",
                    got=f"{len(tets)} tetrahedra"
                    + (f" with node numbers from {tets.min()} to {tets.max()}" if len(tets) else ""),
                    remedy=remedy,
                )
            )
        unused = len(points) - np.count_nonzero(np.bincount(tets.ravel(), minlength=len(points)))
        if unused:
            raise HeatError(
                explain(
                    "mesh points",
                    expected="every node in at least one tetrahedron",
                    got=f"{unused} of {len(points)} in none",
                    remedy="Remove the unused nodes; they have no heat capacity.",
                )
            )
        self._check_volumes(remedy)
        self._check_temperatures()

    @property
    def start_c(self) -> npt.NDArray[np.float64]:
        """Nodal temperature at the start, shape (n,), [degrees Celsius]."""
        given = self.mesh.temperature_c if self.initial_temperature_c is None else self.initial_temperature_c
        return np.asarray(given, dtype=np.float64)

    def _check_volumes(self, remedy: str) -> None:
        corner = self.mesh.points_m[self.mesh.tets]
        edges = corner[:, 1:] - corner[:, :1]
        volumes = np.einsum("ti,ti->t", edges[:, 0], np.cross(edges[:, 1], edges[:, 2])) / 6.0
        # A tetrahedron flat to round-off of its own size cannot carry gradients.
        size = np.abs(edges).max(axis=(1, 2))
        bad = int(np.count_nonzero(~(volumes > 1e-12 * size**3)))
        if bad:
            raise HeatError(
                explain(
                    "mesh tets",
                    expected="volumes above 0",
                    got=f"{bad} of {len(volumes)} flat or inverted",
                    remedy=remedy,
                )
            )

    def _check_temperatures(self) -> None:
        name = "mesh temperature_c" if self.initial_temperature_c is None else "initial_temperature_c"
        remedy = "Give one temperature in degrees Celsius per mesh node."
        start = check_shape(name, self.start_c, (len(self.mesh.points_m),), remedy, HeatError)
        check_finite(name, start, remedy, HeatError)
        if start.min() < -ZERO_CELSIUS_K:
            raise HeatError(
                explain(
                    name,
                    expected=f"temperatures above absolute zero ({-ZERO_CELSIUS_K} C)",
                    got=f"{start.min():.6g} C",
                    remedy=remedy,
                )
            )
