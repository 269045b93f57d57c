"""Lines of sight from cameras to points of structure from motion: what dataparser and model share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Sightlines:
    """Straight lines from cameras to points that they see: what lies between is air. World units."""

    origins: FloatArray
    """Where the cameras stood, shape (s, 3)."""
    point: IntArray
    """Index into `points`, ascending, shape (s,)."""
    points: FloatArray
    """Shape (n, 3)."""
    uncertainty: FloatArray
    """Standard error of each line's length, shape (s,)."""

    def moved(self, rotation: FloatArray, translation: FloatArray, scale: float) -> Sightlines:
        """The same lines in another world: scale (rotation p + translation)."""
        origins, points = (scale * (p @ rotation.T + translation) for p in (self.origins, self.points))
        return Sightlines(origins, self.point, points, scale * self.uncertainty)
