from dataclasses import replace

import numpy as np
import pytest

from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import GridSnapshot, RayEvidence
from thermoxels_ns.mesh.solid.voxels import (
    FEWEST_RAYS,
    OPAQUE_OPTICAL_DEPTH,
    OPTICAL_DEPTH_BOUNDS,
    SHARE_OF_RAYS,
    SolidSelection,
    dense_voxels,
    select_solid,
)

VOXEL = 0.25
MET = np.repeat(np.arange(1.0, 11.0), [30, 130, *[105] * 8])
"""Densities that 1,000 rays meet where they end: 3 % of them one that is too low."""


def field(
    voxel_density: np.ndarray, met: np.ndarray, weight: np.ndarray | None = None, ends: np.ndarray | None = None
) -> GridSnapshot:
    """A field with the given voxels, and rays that meet the given densities where they end."""
    lattice = Lattice((0.0, 0.0, 0.0), VOXEL, tuple(n + 1 for n in voxel_density.shape))  # type: ignore[arg-type]
    weight = np.ones_like(voxel_density) if weight is None else weight
    zero = np.zeros(lattice.shape, dtype=np.float32)
    return GridSnapshot(
        lattice,
        zero,
        zero,
        zero,
        voxel_density=voxel_density.astype(np.float32),
        evidence=RayEvidence(
            weight.astype(np.float32), met.astype(np.float32), None if ends is None else ends.astype(np.float32)
        ),
    )


def automatic(snapshot: GridSnapshot):
    return dense_voxels(snapshot, snapshot.centre_density(), SolidSelection())


def wall_in_fog(fog: float = 0.0) -> np.ndarray:
    """A wall of densities 1, 2, 3, ... 10 (optical depths 0.25 to 2.5), fog around it."""
    density = np.full((10, 10, 10), fog)
    density[:, :, 5] = np.arange(1, 11)[:, None]
    return density


def test_the_threshold_leaves_the_asked_share_of_rays_a_solid_voxel_to_end_on():
    chosen = automatic(field(wall_in_fog(), MET))
    assert (chosen.density <= MET).mean() >= SHARE_OF_RAYS
    assert (chosen.density < MET).mean() < SHARE_OF_RAYS  # and it is the highest such density
    assert chosen.density == 2.0
    assert chosen.cells[:, :, 5].all(axis=1).tolist() == [False] + [True] * 9 and chosen.cells.sum() == 90


@pytest.mark.parametrize(("scale", "bound"), [(1e-6, 0), (1e6, 1)])
def test_the_threshold_stays_within_bounds(scale, bound):
    density = wall_in_fog() * scale
    density[0] = 1.0  # so that something is solid at the lower bound
    chosen = automatic(field(density, MET * scale))
    assert chosen.density == pytest.approx(OPTICAL_DEPTH_BOUNDS[bound] / VOXEL)
    assert ("the least that is not half-transparent", "the most that is asked")[bound] in chosen.explanation


def leak() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Density, weight and ends: a little light leaks through the wall at z = 5 to one as dense at z = 3."""
    density, weight, ends = np.zeros((3, 10, 10, 10))
    density[:, :, 5] = density[:, :, 3] = 2.5
    weight[:, :, 5], ends[:, :, 5] = 10.0, 10.0
    weight[:, :, 3] = 0.8
    return density, weight, ends


def test_voxels_in_which_no_ray_ends_are_solid_only_if_they_are_opaque():
    density, weight, ends = leak()
    density[:4, :, 3] = 1.01 * OPAQUE_OPTICAL_DEPTH / VOXEL
    density[4:8, :, 3] = 0.99 * OPAQUE_OPTICAL_DEPTH / VOXEL
    chosen = automatic(field(density, MET, weight, ends))
    assert chosen.density == 2.0
    assert chosen.cells[:, :, 5].all() and chosen.cells[:4, :, 3].all() and chosen.cells.sum() == 140
    assert "60 voxels that dense are left out" in chosen.explanation


def test_a_few_dense_voxels_behind_a_surface_do_not_widen_the_body():
    """Without the ends that are counted the body would reach down to them."""
    density, weight, ends = leak()
    density[:, :, 3] = 0.0
    density[2, 2, 3] = density[7, 7, 3] = 2.5
    whole = field(density, MET, weight, ends)
    assert whole.evidence is not None
    assert not select_solid(whole, SolidSelection(region="all")).cells[:, :, :5].any()
    blind = replace(whole, evidence=replace(whole.evidence, voxel_ends=None))
    assert select_solid(blind, SolidSelection(region="all")).cells[:, :, 3].any()


def test_without_evidence_the_rule_is_an_optical_depth_and_says_so():
    few = field(wall_in_fog(), np.ones(FEWEST_RAYS - 1))
    for snapshot, why in ((replace(few, evidence=None), "nothing is known of"), (few, "only 99 rays end")):
        chosen = automatic(snapshot)
        fixed = dense_voxels(snapshot, snapshot.centre_density(), SolidSelection(voxel_optical_depth=0.5))
        assert chosen.density == fixed.density == 2.0 and np.array_equal(chosen.cells, fixed.cells)
        assert why in chosen.explanation and "optical depth 0.5" in chosen.explanation
        assert select_solid(snapshot, SolidSelection()).explanation == chosen.explanation


def test_a_threshold_of_the_user_goes_before_the_automatic_one():
    snapshot = field(wall_in_fog(), MET)
    assert select_solid(snapshot, SolidSelection(density_threshold=7.0)).threshold == 7.0
    assert select_solid(snapshot, SolidSelection(voxel_optical_depth=1.25)).threshold == 5.0
    assert select_solid(snapshot, SolidSelection(density_percentile=99.5)).threshold == np.percentile(
        snapshot.centre_density(), 99.5
    )
    assert select_solid(snapshot, SolidSelection()).threshold == 2.0
