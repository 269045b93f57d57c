import numpy as np
import pytest

from tests.support.stuffed_shapes import ANGLE_BOUNDS_DEG, centres, tet_mesh
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.quality.report import check_mesh
from thermoxels_ns.mesh.stuffing.isosurface import stuff


@pytest.mark.parametrize("shape", [(1, 1, 1), (3, 2, 1), (1, 4, 5), (4, 3, 5)])
def test_full_lattice_is_a_box_to_the_last_bit(shape):
    solid = stuff(np.random.default_rng(1).uniform(0.1, 1.0, shape))
    quality = check_mesh(tet_mesh(solid))
    a, b, c = shape
    assert quality.volume_m3 == pytest.approx(a * b * c, rel=1e-14)
    assert quality.area_m2 == pytest.approx(2 * (a * b + b * c + a * c), rel=1e-14)
    assert solid.on_box.all()
    assert np.array_equal(solid.points.min(axis=0), [0, 0, 0]) and np.array_equal(solid.points.max(axis=0), shape)
    assert (quality.dihedral_range_deg[0], quality.dihedral_range_deg[1]) == pytest.approx((45.0, 90.0))


@pytest.mark.parametrize("seed", range(4))
def test_linear_level_gives_its_plane_exactly(seed):
    random = np.random.default_rng(seed)
    normal = random.normal(size=3)
    normal /= np.linalg.norm(normal)
    solid = stuff(-(centres(12, 11, 10) @ normal + random.uniform(-1, 1)))
    check_mesh(tet_mesh(solid))
    # At the border the surface turns into the box within two voxels.
    nodes = solid.points[np.unique(solid.facets[~solid.on_box])]
    far = np.all((nodes > 2.0) & (nodes < np.array([10, 9, 8])), axis=1)
    distance = (nodes - [6.0, 5.5, 5.0]) @ normal
    assert np.count_nonzero(far) > 50
    assert np.ptp(distance[far]) < 1e-12


RANDOM_LEVELS = {
    "white noise": lambda random, shape: random.normal(size=shape),
    "twelve orders of magnitude": lambda random, shape: (
        random.normal(size=shape) * 10.0 ** random.uniform(-12, 0, shape)
    ),
    "six hundred orders": lambda random, shape: random.normal(size=shape) * 10.0 ** random.uniform(-300, 307, shape),
    "binary": lambda random, shape: np.where(random.random(shape) < random.uniform(0.1, 0.9), 1.0, -1.0),
    "few values, many zeros": lambda random, shape: random.choice([-1.0, -0.5, 0.0, 0.0, 0.5, 1.0], size=shape),
    "smooth": lambda random, shape: sum(
        np.cos(centres(*shape) @ random.normal(size=3) * 0.7 + random.uniform(0, 6)) for _ in range(4)
    ),
    "single precision": lambda random, shape: (random.normal(size=shape) * 1e30 ** random.uniform(-1, 1, shape)).astype(
        np.float32
    ),
}


@pytest.mark.parametrize("kind", RANDOM_LEVELS)
@pytest.mark.parametrize("seed", range(4))
def test_any_levels_give_a_sound_mesh(kind, seed):
    random = np.random.default_rng(seed)
    level = RANDOM_LEVELS[kind](random, tuple(random.integers(9, 14, size=3)))
    solid = stuff(level)
    quality = check_mesh(tet_mesh(solid))
    assert ANGLE_BOUNDS_DEG[0] <= quality.dihedral_range_deg[0]
    assert quality.dihedral_range_deg[1] <= ANGLE_BOUNDS_DEG[1]
    assert np.all((solid.points >= 0.0) & (solid.points <= level.shape))


@pytest.mark.parametrize("level", [np.full((3, 3, 3), -1.0), np.zeros((2, 2, 2)), np.ones((0, 4, 4))])
def test_nothing_solid(level):
    with pytest.raises(MeshError, match="level: expected solid voxels, with levels above 0, got none"):
        stuff(level)
