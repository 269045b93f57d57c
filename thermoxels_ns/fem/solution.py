"""What a heat computation returns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True)
class HeatSolution:
    """Temperatures over time and the account of the heat."""

    times_s: npt.NDArray[np.float64]
    """Time of each state, the start first, shape (s + 1,), [s]."""
    temperature_c: npt.NDArray[np.float64]
    """Nodal temperatures, shape (s + 1, n), [degrees Celsius]."""
    heat_w: npt.NDArray[np.float64]
    """Net heat flow into the body during each step, measured as the change of its heat content over the step,
    shape (s,), [W], positive into the body. Behind an insulated boundary it is 0 up to round-off."""
    heat_content_j: npt.NDArray[np.float64]
    """Heat content above absolute zero at each time, 1^T M T with T in kelvin, shape (s + 1,), [J]."""
    energy_residual: float
    """Largest change of the heat content that no heat flow accounts for, relative to the heat content."""
    energy_residual_of_spread: float
    """The same change relative to the heat stored in the initial differences, sum m_i |T_i - mean T|: the
    stricter measure. 0 where the initial temperature is uniform and nothing changed."""
    status: str
    """The outcome as a sentence."""
    converged: bool
    """Whether every step was solved to tolerance."""
    iterations: npt.NDArray[np.int64]
    """Iterations of the linear solver in each step, shape (s,)."""
    skipped_effects: tuple[str, ...]
    """What the computation leaves out, one sentence each."""
