from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import pytest
import torch
from nerfstudio.cameras.rays import RayBundle

from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import GridSnapshot, RayEvidence
from thermoxels_ns.field.voxel_grid import VoxelGrid
from thermoxels_ns.mesh.solid.voxels import (
    FEWEST_RAYS,
    OPTICAL_DEPTH_BOUNDS,
    SHARE_OF_RAYS,
    SolidSelection,
    dense_voxels,
    select_solid,
)
from thermoxels_ns.render.ray_render import RayRequest, RenderOptions
from thermoxels_ns.render.renderers import GridSamples, sample_rays
from thermoxels_ns.training.ray_statistics import field_evidence

VOXEL = 0.25
MET = np.repeat(np.arange(1.0, 11.0), [30, 130, *[105] * 8])
"""Densities that 1,000 rays meet where they end: 3 % of them one that is too low."""


def field(voxel_density: np.ndarray, met: np.ndarray) -> GridSnapshot:
    """A field with the given voxels, and rays that meet the given densities where they end, outside of the lattice."""
    lattice = Lattice((0.0, 0.0, 0.0), VOXEL, tuple(n + 1 for n in voxel_density.shape))  # type: ignore[arg-type]
    zero = np.zeros(lattice.shape, dtype=np.float32)
    down = np.tile(np.array([0.0, 0.0, -1.0], np.float32), (len(met), 1))
    evidence = RayEvidence(met.astype(np.float32), np.full((len(met), 3), -9.0, np.float32), down)
    density = voxel_density.astype(np.float32)
    return GridSnapshot(lattice, zero, zero, zero, voxel_density=density, evidence=evidence)


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


def test_without_evidence_the_rule_is_an_optical_depth_and_says_so():
    few = field(wall_in_fog(), np.ones(FEWEST_RAYS - 1))
    for snapshot in (replace(few, evidence=None), few):
        chosen = automatic(snapshot)
        fixed = dense_voxels(snapshot, snapshot.centre_density(), SolidSelection(density_threshold=0.5 / VOXEL))
        assert chosen.density == fixed.density == 2.0 and np.array_equal(chosen.cells, fixed.cells)
        assert "optical depth 0.5" in select_solid(snapshot, SolidSelection()).steps[0].remark


def test_a_threshold_of_the_user_goes_before_the_automatic_one():
    snapshot = field(wall_in_fog(), MET)
    assert select_solid(snapshot, SolidSelection(density_threshold=7.0)).threshold == 7.0
    highest = np.percentile(snapshot.centre_density(), 99.5)
    assert select_solid(snapshot, SolidSelection(density_percentile=99.5)).threshold == highest
    assert select_solid(snapshot, SolidSelection()).threshold == 2.0


LAYERS = Lattice((0.0, 0.0, 0.0), 0.125, (17, 9, 9))
EMPTY = 1e-6


@dataclass(frozen=True)
class Layers:
    """A field whose density depends on x alone, seen by rays along -x."""

    logarithm: npt.NDArray[np.float64]
    """Logarithm of the density [1 / world unit] at each layer of corners."""

    def sample_rays(self, origins, directions) -> GridSamples:
        return sample_rays(self.grid, RayRequest(origins, directions), RenderOptions(), "fused")

    @property
    def grid(self) -> VoxelGrid:
        grid = VoxelGrid(LAYERS, sh_degree=None, activation="exp")
        grid.density.data = torch.as_tensor(self.logarithm, dtype=torch.float32).repeat_interleave(81)[:, None]
        return grid

    def snapshot(self) -> GridSnapshot:
        """The field with what 1,600 rays say."""
        y, z = np.meshgrid(*[np.linspace(0.05, 7.95, 40)] * 2, indexing="ij")
        origins = torch.tensor(np.stack([np.full_like(y, 24.0), y, z], -1).reshape(-1, 3) * LAYERS.voxel_size).float()
        directions = torch.tensor([-1.0, 0.0, 0.0]).expand_as(origins)
        rays = [RayBundle(origins, directions, torch.ones(len(origins), 1))]
        evidence = field_evidence(self.grid, self.sample_rays, rays)[2]
        zero = np.zeros(LAYERS.shape, np.float32)
        density = self.grid.voxel_density().numpy()
        return GridSnapshot(LAYERS, zero, zero, zero, voxel_density=density, evidence=evidence)

    def half_way(self) -> float:
        """Where rays have spent half of their weight, [voxels] along x, integrated finely."""
        x = np.linspace(16.0, 0.0, 160_001)
        density = np.exp(np.minimum(np.interp(x, np.arange(17), self.logarithm), 15.0))
        taken = np.cumsum(density) * LAYERS.voxel_size * 1e-4
        half = -np.log(0.5 + 0.5 * np.exp(-taken[-1]))
        return float(np.interp(half, taken, x))


def surface_of(snapshot: GridSnapshot) -> float:
    """Where density crosses the automatic threshold between voxel centres, [voxels] along x; from outside."""
    chosen = automatic(snapshot)
    row = np.log(np.maximum(snapshot.centre_density()[:, 4, 4], 1e-30))
    level = np.log(chosen.density)
    first = int(np.flatnonzero(row >= level - 1e-6).max())
    return first + 0.5 + float((row[first] - level) / (row[first] - row[first + 1]))


@pytest.mark.parametrize("place", [7.03, 7.2, 7.45, 7.55, 7.9])
@pytest.mark.parametrize(
    ("steepness", "before"),
    [(1.0, EMPTY), (3.0, EMPTY), (10.0, EMPTY), (40.0, EMPTY), (3.0, 0.4), (10.0, 0.4), (40.0, 0.4)],
)
def test_soft_and_sharp_surfaces_lie_within_half_a_voxel_of_where_rays_end(place, steepness, before):
    """A voxel of the fog takes 5 % of the light; a sharp wall may begin anywhere in the last voxel of it."""
    # Density 40 at the place, e^steepness times as much a voxel farther in, fog in front.
    field = Layers(np.maximum(np.log(40.0) + steepness * (place - np.arange(17.0)), np.log(before)))
    assert abs(surface_of(field.snapshot()) - field.half_way()) <= 0.5
