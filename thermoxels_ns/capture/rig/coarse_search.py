"""Coarse search for a rig over all directions, rolls and focal lengths."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy import fft

from thermoxels_ns.capture.rig.fit import RigFit
from thermoxels_ns.capture.rig.score import EdgePoints, RigScore
from thermoxels_ns.capture.rig_types import FloatArray

_Spectra = tuple[npt.NDArray, ...]

_REACH_SIGMAS = 2.5
_STEP_PX = 2.5
_MOST_FRAMES = 16
_CANDIDATES = 4
_APART_PX = 3.0
_SMALLEST_OVERLAP = 0.3
_PADDING = 1.6
_CHANCE_DRAWS = 3


class CoarseSearch:
    """Compares all shifts of the photographs' edges at once, for a range of focal lengths and rolls.

    A small turn of the thermal camera shifts its image; so for one focal length and roll the scores of all turns are
    cross-correlations, which Fourier transforms give together.
    """

    def __init__(self, score: RigScore, sigmas: FloatArray, median_depth: float) -> None:
        """Take the score at the coarsest size, the ten standard deviations and the points' depth [world units]."""
        camera = score.rig.camera
        self._rig = score.rig
        # Lengths that Fourier transforms are fast at, with room for shifts.
        rows, columns = (int(fft.next_fast_len(int(_PADDING * n)) or 0) for n in (camera.height, camera.width))
        self._shape: tuple[int, int] = (rows, columns)
        content = [float(np.sum(np.abs(edges.field) ** 2 * edges.weight)) for edges in score.thermal]
        chosen = np.sort(np.argsort(-np.array(content), kind="stable")[:_MOST_FRAMES])
        self._edges = [score.edges[number] for number in chosen]
        self._thermal = [score.thermal[number] for number in chosen]
        turn = np.hypot(sigmas[:2], sigmas[3:5][::-1] / median_depth)[::-1]  # about y moves along x
        self._reach_px = np.minimum(_REACH_SIGMAS * turn * camera.fl_x, 0.5 * np.array([columns, rows]) - 2.0)
        corner_px = 0.5 * float(np.hypot(camera.width, camera.height))
        self._focals = _steps(_REACH_SIGMAS * float(sigmas[6]), _STEP_PX / (0.5 * camera.width))
        self._rolls = _steps(_REACH_SIGMAS * float(sigmas[2]), _STEP_PX / corner_px)

    def best(self) -> list[RigFit]:
        """Find the best few places that differ, best first."""
        found = self._found([self._spectra(edges.field, edges.weight) for edges in self._thermal])
        kept: list[RigFit] = []
        for rig in sorted(found, key=lambda rig: -rig.score):
            apart = [np.abs((rig.change - other.change)[:2]).max() * self._rig.camera.fl_x for other in kept]
            if not apart or min(apart) >= _APART_PX:
                kept.append(rig)
            if len(kept) == _CANDIDATES:
                break
        return kept

    def best_by_chance(self) -> float:
        """Highest score that the same search finds if edges of the same scales lie anywhere (noise, random phases)."""
        draw = np.random.default_rng(0)
        highest = 0.0
        for _ in range(_CHANCE_DRAWS):
            spectra = []
            for edges in self._thermal:
                phases = np.exp(2j * np.pi * draw.random(edges.field.shape))
                noise = np.asarray(fft.ifft2(np.asarray(fft.fft2(edges.field)) * phases))
                spectra.append(self._spectra(noise, edges.weight))
            highest = max(highest, *(rig.score for rig in self._found(spectra)))
        return highest

    def _spectra(self, field: npt.NDArray, weight: npt.NDArray) -> _Spectra:
        """Fourier transforms of a thermal image's edge values, weights and edge strengths."""
        weighted = fft.fft2((field * weight).astype(np.complex64), s=self._shape)
        planes = weight, (np.abs(field) ** 2 * weight).astype(np.float32)
        return (np.asarray(weighted), *(np.asarray(fft.rfft2(plane, s=self._shape)) for plane in planes))

    def _found(self, spectra: Sequence[_Spectra]) -> list[RigFit]:
        found: list[RigFit] = []
        for log_focal in self._focals:
            for roll in self._rolls:
                change = np.zeros(10)
                change[2], change[6] = roll, log_focal
                found += self._best_shifts(self._surface(spectra, change), change)
        return found

    def _surface(self, spectra: Sequence[_Spectra], change: FloatArray) -> FloatArray:
        """Score for every whole shift of the thermal image, shape (rows, columns), shift 0 at [0, 0]."""
        product: npt.NDArray = np.zeros(self._shape, np.complex64)
        own: npt.NDArray = np.zeros((self._shape[0], self._shape[1] // 2 + 1), np.complex64)
        other = own.copy()
        for edges, (field, weight, strength) in zip(self._edges, spectra):
            value, power, count = self._splat(edges, change)
            product += np.conj(np.asarray(fft.fft2(value))) * field
            own += np.conj(np.asarray(fft.rfft2(power))) * weight
            other += np.conj(np.asarray(fft.rfft2(count))) * strength
        overlap, strengths = np.asarray(fft.irfft2(own, s=self._shape)), np.asarray(fft.irfft2(other, s=self._shape))
        enough = overlap > _SMALLEST_OVERLAP * max(float(overlap.max()), 1e-12)
        norm = np.where(enough, np.maximum(overlap * strengths, 1e-12), np.inf)
        return np.asarray(fft.ifft2(product)).real / np.sqrt(norm)

    def _splat(self, edges: EdgePoints, change: FloatArray) -> tuple[npt.NDArray, npt.NDArray, npt.NDArray]:
        """Edge values, their power and their number in each pixel of the padded image, around which shifts wrap."""
        rows, columns = self._shape
        pixels = np.nan_to_num(self._rig.project(change, edges.points), nan=-1e6)
        x, y = np.floor(pixels[:, 0]).astype(np.int64), np.floor(pixels[:, 1]).astype(np.int64)
        spare_x, spare_y = columns - self._rig.camera.width, rows - self._rig.camera.height
        inside = (x >= -spare_x // 2) & (x < columns - spare_x // 2) & (y >= -spare_y // 2) & (y < rows - spare_y // 2)
        place, value = (y[inside] % rows) * columns + x[inside] % columns, edges.value[inside]
        real, imaginary, power, count = (
            np.bincount(place, weights, rows * columns).reshape(self._shape).astype(np.float32)
            for weights in (value.real, value.imag, np.abs(value) ** 2, np.ones(len(value)))
        )
        return real + np.complex64(1j) * imaginary, power, count

    def _best_shifts(self, surface: FloatArray, change: FloatArray) -> list[RigFit]:
        """The highest places of one surface within reach, as turns of the camera."""
        across, down = (int(np.ceil(reach)) for reach in self._reach_px)
        window = np.roll(surface, (down, across), axis=(0, 1))[: 2 * down + 1, : 2 * across + 1]
        focal = np.array([self._rig.camera.fl_x, self._rig.camera.fl_y]) * np.exp(change[6])
        found = []
        for place in np.argsort(-window, axis=None, kind="stable")[:_CANDIDATES]:
            row, column = divmod(int(place), window.shape[1])
            shifted = change.copy()
            shifted[:2] = -(row - down) / focal[1], (column - across) / focal[0]
            found.append(RigFit(shifted, float(window[row, column])))
        return found


def _steps(reach: float, step: float) -> FloatArray:
    """Values from -reach to reach, at most `step` apart, with 0 among them."""
    count = int(np.ceil(reach / step))
    return np.linspace(-reach, reach, 2 * count + 1) if count else np.zeros(1)
