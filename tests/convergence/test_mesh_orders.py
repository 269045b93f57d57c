from functools import cache

import numpy as np
import pytest

from tests.support.stuffed_shapes import ANGLE_BOUNDS_DEG, SHAPES, centres
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import GridSnapshot
from thermoxels_ns.mesh.build import build_mesh
from thermoxels_ns.mesh.quality.checks import check_mesh
from thermoxels_ns.mesh.solid.voxels import SolidSelection

BODIES = ("sphere", "torus", "cylinder", "slab at 30 degrees", "slab at 45 degrees")
OFFSETS = ((0.11, -0.27, 0.38), (0.5, 0.0, -0.25), (-0.42, 0.33, 0.06))
"""Where the body's middle is, from the middle of the lattice, [voxels]."""
DEPTHS = {"exponential": (np.exp, 1.0), "blurred step": (lambda depth: 100.0 / (1.0 + np.exp(-2.0 * depth)), 50.0)}
"""Density as a function of the depth in voxels, and at the surface."""


@cache
def errors(name: str, cells: int, offset: tuple[float, float, float], kind: str = "exponential") -> tuple[float, ...]:
    """Relative errors of area and volume, and smallest and largest dihedral angle, [degrees]."""
    shape, size, voxels = SHAPES[name], 2.0 / cells, cells + 8
    function, threshold = DEPTHS[kind]

    def density(points: np.ndarray) -> np.ndarray:
        depth = -shape.distance((points - offset) * size) / size
        return function(np.clip(depth, -8.0, 8.0)).astype(np.float32)

    at_corners = density(centres(*(voxels + 1,) * 3))
    seen = np.ones(at_corners.shape, np.float32)
    lattice = Lattice((-0.5 * voxels * size,) * 3, size, at_corners.shape)  # type: ignore[arg-type]
    field = GridSnapshot(lattice, at_corners, 20.0 * seen, seen, density(centres(*(voxels,) * 3)))
    built = build_mesh(field, SolidSelection(density_threshold=threshold, close_gaps=0), np.eye(4))
    quality = check_mesh(built.mesh)
    angles = quality.dihedral_range_deg[0], quality.dihedral_range_deg[1]
    return quality.area_m2 / shape.area - 1.0, quality.volume_m3 / shape.volume - 1.0, *angles


@pytest.mark.parametrize("offset", OFFSETS)
@pytest.mark.parametrize("name", BODIES)
def test_area_and_volume_within_one_and_a_half_percent_at_48_voxels(name, offset):
    area, volume, low, high = errors(name, 48, offset)
    assert abs(area) < 0.015 and abs(volume) < 0.015, f"{name}: area {area:+.2%}, volume {volume:+.2%}"
    assert low >= ANGLE_BOUNDS_DEG[0] and high <= ANGLE_BOUNDS_DEG[1]


@pytest.mark.parametrize("kind", DEPTHS)
@pytest.mark.parametrize("name", BODIES)
def test_the_surface_is_less_than_a_tenth_of_a_voxel_off_at_any_resolution(name, kind):
    """So errors of volume are of first order, with a small factor: a level of density is not linear in the distance."""
    cells, shape = (24, 48, 96) if kind == "exponential" else (48, 96), SHAPES[name]
    shift = [errors(name, n, OFFSETS[0], kind)[1] * shape.volume / shape.area / (2.0 / n) for n in cells]
    assert np.abs(shift).max() < 0.1, f"{name}, {kind}: {shift} voxels"


@pytest.mark.parametrize("name", BODIES)
def test_area_goes_on_falling(name):
    """What is left at edges changes its sign with the body's place on the lattice; it is a share of a voxel wide."""
    area = errors(name, 96, OFFSETS[0])[0]
    assert abs(area) < 0.004, f"{name}: area {area:+.2%}"
