"""The automatic threshold puts the surface where rays end: from the field through its evidence to the solid voxels."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pytest
import torch
from nerfstudio.cameras.rays import RayBundle

from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import GridSnapshot, RayEvidence
from thermoxels_ns.field.voxel_grid import VoxelGrid
from thermoxels_ns.mesh.solid.voxels import SolidSelection, dense_voxels
from thermoxels_ns.render.ray_render import RayRequest, RenderOptions
from thermoxels_ns.render.renderers import GridSamples, sample_rays
from thermoxels_ns.training.ray_statistics import field_evidence

LATTICE = Lattice((0.0, 0.0, 0.0), 0.125, (17, 9, 9))
VOXEL = LATTICE.voxel_size
EMPTY = 1e-6
PLACES = [7.03, 7.2, 7.35, 7.45, 7.55, 7.7, 7.9]


@dataclass(frozen=True)
class Layers:
    """A field whose density depends on x alone, seen by rays along -x."""

    logarithm: npt.NDArray[np.float64]
    """Logarithm of the density [1 / world unit] at each layer of corners."""

    def sample_rays(self, origins, directions) -> GridSamples:
        return sample_rays(self.grid, RayRequest(origins, directions), RenderOptions(), "fused")

    @property
    def grid(self) -> VoxelGrid:
        grid = VoxelGrid(LATTICE, sh_degree=None, activation="exp")
        grid.density.data = torch.as_tensor(self.logarithm, dtype=torch.float32).repeat_interleave(81)[:, None]
        return grid

    def snapshot(self) -> GridSnapshot:
        """The field with what 1,600 rays say."""
        y, z = np.meshgrid(*[np.linspace(0.05, 7.95, 40)] * 2, indexing="ij")
        origins = torch.tensor(np.stack([np.full_like(y, 24.0), y, z], -1).reshape(-1, 3) * VOXEL).float()
        directions = torch.tensor([-1.0, 0.0, 0.0]).expand_as(origins)
        seen = field_evidence(self, [RayBundle(origins, directions, torch.ones(len(origins), 1))])
        weight, ends = (v.view(LATTICE.cell_shape).float().numpy() for v in (seen.voxel_weight, seen.voxel_ends))
        zero = np.zeros(LATTICE.shape, np.float32)
        evidence = RayEvidence(weight, seen.half_depth_density.numpy(), ends)
        density = self.grid.voxel_density().numpy()
        return GridSnapshot(LATTICE, zero, zero, zero, voxel_density=density, evidence=evidence)

    def half_way(self) -> float:
        """Where rays have spent half of their weight, [voxels] along x, integrated finely."""
        x = np.linspace(16.0, 0.0, 160_001)
        taken = np.cumsum(np.exp(np.minimum(np.interp(x, np.arange(17), self.logarithm), 15.0))) * VOXEL * 1e-4
        half = -np.log(0.5 + 0.5 * np.exp(-taken[-1]))
        return float(np.interp(half, taken, x))


def surface_of(snapshot: GridSnapshot) -> float:
    """Where density crosses the automatic threshold between voxel centres, [voxels] along x; from outside."""
    chosen = dense_voxels(snapshot, snapshot.centre_density(), SolidSelection())
    row = np.log(np.maximum(snapshot.centre_density()[:, 4, 4], 1e-30))
    level = np.log(chosen.density)
    first = int(np.flatnonzero(row >= level - 1e-6).max())
    return first + 0.5 + float((row[first] - level) / (row[first] - row[first + 1]))


def ramp(place: float, steepness: float, before: float = EMPTY) -> Layers:
    """Density 40 at x = `place`, e^`steepness` times as much a voxel farther in; fog of density `before` in front."""
    return Layers(np.maximum(np.log(40.0) + steepness * (place - np.arange(17.0)), np.log(before)))


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("steepness", [1.0, 3.0, 10.0, 40.0])
def test_soft_and_sharp_surfaces_lie_within_half_a_voxel_of_where_rays_end(place, steepness):
    field = ramp(place, steepness)
    assert abs(surface_of(field.snapshot()) - field.half_way()) <= 0.5


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("steepness", [3.0, 10.0, 40.0])
def test_fog_before_a_wall_stays_outside(place, steepness):
    """A voxel of the fog takes 5 % of the light; a sharp wall may begin anywhere in the last voxel of it."""
    field = ramp(place, steepness, before=0.4)
    assert abs(surface_of(field.snapshot()) - field.half_way()) <= 0.5


def test_what_a_surface_lets_through_makes_nothing_solid_behind_it():
    """A wall of optical depth 3 lets 5 % through to one of 1.5, behind which no camera could see anything."""
    logarithm = np.full(17, np.log(EMPTY))
    logarithm[9:11], logarithm[4:6] = np.log(3.0 / VOXEL), np.log(1.5 / VOXEL)
    field = Layers(logarithm)
    snapshot = field.snapshot()
    assert abs(surface_of(snapshot) - field.half_way()) <= 0.5
    cells = dense_voxels(snapshot, snapshot.centre_density(), SolidSelection()).cells
    assert cells.any(axis=(1, 2)).nonzero()[0].tolist() == [9] and cells[9].all()
    assert snapshot.evidence is not None and snapshot.evidence.voxel_weight[4].sum() > 40.0  # of 1,600 rays
