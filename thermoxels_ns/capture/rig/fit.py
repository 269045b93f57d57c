"""Maximises a score of rigs under a prior, and finds the covariance of the maximum."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from thermoxels_ns.capture.rig.score import RigScore
from thermoxels_ns.capture.rig.windows import WindowScore
from thermoxels_ns.capture.rig_types import FloatArray

_DIFFERENCE_PX = 0.05
_MOST_STEPS = 20
_GRADIENT_TOLERANCE = 3e-2


@dataclass(frozen=True, eq=False)
class RigFit:
    """Ten changes of a rig and the score that they reach."""

    change: FloatArray
    score: float


class RigMaximizer:
    """Maximises weight * score - 0.5 * sum((change / sigma)^2) over the changes whose sigma is above 0.

    The weight makes the score's curvature H the information that it carries: with G the scatter of the frames'
    contributions to the slope, the covariance of the maximum alone is H^-1 G H^-1 (the sandwich of M-estimators, Huber
    1967, frames taken as independent), which (weight * H)^-1 equals if weight * G = H. The median over H's principal
    directions is taken, because those that the images hardly determine have no reliable ratio.

    Errors of parts that show the same things are correlated: where `correlated` of them are, their scatter counts that
    many times.
    """

    def __init__(
        self, score: RigScore | WindowScore, sigmas: FloatArray, median_depth: float, correlated: float = 1.0
    ) -> None:
        """Take a score, the prior standard deviations, the scene's median depth and how many parts are correlated."""
        self._correlated = correlated
        self._score = score
        self._sigmas = sigmas
        self._free = np.flatnonzero(sigmas > 0.0)
        self._scale = sigmas[self._free]
        focal = score.rig.camera.fl_x
        reach = 0.5 * score.rig.camera.width
        per_pixel = np.array([1 / focal] * 3 + [median_depth / focal] * 3 + [1 / reach] + [1.0] * 2 + [0.2])
        self._step = _DIFFERENCE_PX * per_pixel[self._free] / self._scale

    def maximize(self, change: FloatArray) -> RigFit:
        """Maximise from `change` on (BFGS)."""
        z = change[self._free] / self._scale
        weight, information, _ = self._information(z)
        root = np.linalg.cholesky(np.linalg.inv(weight * information + np.eye(len(z))))

        def negative(y: FloatArray) -> tuple[float, FloatArray]:
            point = z + root @ y
            value, slopes = self._score.slopes(self._full(point))
            slope = weight * slopes.sum(axis=0)[self._free] * self._scale - point
            return -(weight * value - 0.5 * float(point @ point)), -(root.T @ slope)

        options = {"maxiter": _MOST_STEPS, "gtol": _GRADIENT_TOLERANCE}
        best = minimize(negative, np.zeros(len(z)), jac=True, method="BFGS", options=options)
        change = self._full(z + root @ best.x)
        return RigFit(change, self._score.value(change))

    def covariance(self, change: FloatArray) -> FloatArray:
        """Covariance of the ten changes at a maximum, shape (10, 10); 0 for those that are kept fixed."""
        weight, information, scatter = self._information(change[self._free] / self._scale)
        posterior = np.linalg.inv(weight * information + np.eye(len(self._free)))
        spread = posterior @ (weight**2 * scatter + np.eye(len(self._free))) @ posterior
        result = np.zeros((len(change), len(change)))
        result[np.ix_(self._free, self._free)] = spread * np.outer(self._scale, self._scale)
        return result

    def _full(self, z: FloatArray) -> FloatArray:
        change = np.zeros(len(self._sigmas))
        change[self._free] = z * self._scale
        return change

    def _information(self, z: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        """Weight, curvature made positive and scatter of the frames' slopes, in standard deviations of the start."""
        _, slopes = self._score.slopes(self._full(z))
        own = slopes[:, self._free] * self._scale
        total, frames = own.sum(axis=0), len(own)
        centred = own - own.mean(axis=0)
        scatter: FloatArray = centred.T @ centred * (self._correlated * frames / max(frames - 1, 1))
        curvature: FloatArray = np.empty((len(z), len(z)))
        for number, step in enumerate(self._step):
            moved = z.copy()
            moved[number] += step
            ahead = self._score.slopes(self._full(moved))[1].sum(axis=0)[self._free] * self._scale
            curvature[number] = (total - ahead) / step
        symmetric: FloatArray = 0.5 * (curvature + curvature.T)
        values, vectors = np.linalg.eigh(symmetric)
        values = np.maximum(np.abs(values), 1e-6 * max(float(np.abs(values).max()), 1e-12))
        ratio = np.einsum("ij,ik,kj->j", vectors, scatter, vectors) / values
        weight = 1.0 / max(float(np.median(ratio)), 1e-9)
        information = np.asarray((vectors * values) @ vectors.T, dtype=np.float64)
        return weight, information, scatter
