"""Which density is the threshold, and what is said about it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermoxels_ns.lattice import Lattice
from thermoxels_ns.mesh.solid import SolidSelection, select_solid
from thermoxels_ns.mesh.threshold import (
    FEWEST_RAYS,
    OPTICAL_DEPTH_BOUNDS,
    SHARE_OF_RAYS,
    automatic_threshold,
    optical_depth_threshold,
    percentile_threshold,
)
from thermoxels_ns.snapshot import GridSnapshot, RayEvidence

VOXEL = 0.25


def field(voxel_density: np.ndarray, ends: np.ndarray, weight: np.ndarray | None = None) -> GridSnapshot:
    """A field with the given voxels, and rays that end in voxels of the given densities."""
    lattice = Lattice((0.0, 0.0, 0.0), VOXEL, tuple(n + 1 for n in voxel_density.shape))  # type: ignore[arg-type]
    weight = np.ones_like(voxel_density) if weight is None else weight
    zero = np.zeros(lattice.shape, dtype=np.float32)
    return GridSnapshot(
        lattice,
        zero,
        zero,
        zero,
        voxel_density=voxel_density.astype(np.float32),
        evidence=RayEvidence(weight.astype(np.float32), ends.astype(np.float32)),
    )


def automatic(snapshot: GridSnapshot):
    return automatic_threshold(snapshot, snapshot.centre_density())


def wall_in_fog(fog: float = 0.0) -> np.ndarray:
    """A wall of densities 1, 2, 3, ... 10 (optical depths 0.25 to 2.5), fog around it."""
    density = np.full((10, 10, 10), fog)
    density[:, :, 5] = np.arange(1, 11)[:, None]
    return density


def test_the_threshold_leaves_the_asked_share_of_rays_a_solid_voxel_to_end_in():
    ends = np.repeat(np.arange(1.0, 11.0), 100)
    chosen = automatic(field(wall_in_fog(), ends))
    assert np.mean(ends >= chosen.density) >= SHARE_OF_RAYS
    assert np.mean(ends > chosen.density) < SHARE_OF_RAYS  # and it is the highest such density
    assert chosen.density == 2.0
    assert chosen.cells[:, :, 5].all(axis=1).tolist() == [False] + [True] * 9 and chosen.cells.sum() == 90


def test_fog_that_rays_pass_through_goes_however_much_light_it_takes():
    ends = np.repeat(np.arange(1.0, 11.0), 100)
    density = wall_in_fog(fog=0.15)
    # Nine tenths of all weight is spent in the fog.
    weight = np.where(density == 0.15, 10.0, 10.0)
    chosen = automatic(field(density, ends, weight))
    assert chosen.density == 2.0 and chosen.cells.sum() == 90
    assert "hold 9% of the weight" in chosen.explanation


def test_the_explanation_has_the_numbers():
    text = automatic(field(wall_in_fog(), np.repeat(np.arange(1.0, 11.0), 100))).explanation
    assert "Automatic: 90% of the 1000 training rays" in text and "density 2 " in text and "optical depth 0.5 " in text


@pytest.mark.parametrize(("scale", "bound"), [(1e-6, 0), (1e6, 1)])
def test_the_threshold_stays_within_bounds(scale, bound):
    density = wall_in_fog() * scale
    density[0] = 1.0  # so that something is solid at the lower bound
    chosen = automatic(field(density, np.repeat(np.arange(1.0, 11.0), 100) * scale))
    assert chosen.density == pytest.approx(OPTICAL_DEPTH_BOUNDS[bound] / VOXEL)
    assert ("the least that is not fog", "the most that is asked")[bound] in chosen.explanation


def test_the_voxel_whose_density_is_the_threshold_is_solid():
    """Densities of rays are float32 numbers that float64 arithmetic must not miss."""
    ends = np.full(1000, np.float32(1.0) / np.float32(3.0))
    density = np.zeros((3, 3, 3))
    density[1, 1, 1] = ends[0]
    assert np.argwhere(automatic(field(density, ends)).cells).tolist() == [[1, 1, 1]]


def test_without_evidence_the_rule_is_an_optical_depth_and_says_so():
    few = field(wall_in_fog(), np.ones(FEWEST_RAYS - 1))
    for snapshot, why in ((replace(few, evidence=None), "nothing is known of"), (few, "only 99 rays end")):
        chosen = automatic(snapshot)
        fixed = optical_depth_threshold(snapshot, snapshot.centre_density(), 0.5)
        assert chosen.density == fixed.density == 2.0 and np.array_equal(chosen.cells, fixed.cells)
        assert why in chosen.explanation and "optical depth 0.5" in chosen.explanation
        assert select_solid(snapshot, SolidSelection()).explanation == chosen.explanation


def test_a_threshold_of_the_user_goes_before_the_automatic_one():
    snapshot = field(wall_in_fog(), np.repeat(np.arange(1.0, 11.0), 100))
    assert select_solid(snapshot, SolidSelection(density_threshold=7.0)).threshold == 7.0
    assert select_solid(snapshot, SolidSelection(voxel_optical_depth=1.25)).threshold == 5.0
    assert select_solid(snapshot, SolidSelection(density_percentile=99.5)).threshold == np.percentile(
        snapshot.centre_density(), 99.5
    )
    assert select_solid(snapshot, SolidSelection()).threshold == 2.0


def test_percentile_says_what_it_kept():
    density = np.random.default_rng(0).random((10, 10, 10))
    chosen = percentile_threshold(density, 90.0)
    assert chosen.cells.sum() == 100
    assert "densest 10 % of all voxels" in chosen.explanation and "at least" in chosen.explanation
    density[:] = 1.0
    density[0, 0, 0] = 2.0
    tied = percentile_threshold(density, 90.0)
    assert tied.cells.sum() == 1 and "more than density 1." in tied.explanation
