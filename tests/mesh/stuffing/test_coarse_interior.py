import numpy as np
import pytest
from scipy import ndimage

from tests.support.stuffed_shapes import (
    box_distance,
    centres,
    tet_mesh,
    turn,
    volumes_and_angles,
)
from thermoxels_ns.mesh.quality.report import check_mesh
from thermoxels_ns.mesh.quality.tet_shapes import signed_volumes
from thermoxels_ns.mesh.stuffing.isosurface import stuff
from thermoxels_ns.mesh.stuffing.lattice import bcc_lattice, coarse_interior


def ball(cells: int, radius: float, offset: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    distance = np.linalg.norm(centres(cells, cells, cells) - offset, axis=-1)
    return np.clip((radius - distance) / 1.5, -1.0, 1.0)


def blobs(random: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    level = ndimage.gaussian_filter(random.normal(size=shape), 6.0, mode="wrap")
    return np.clip(level / np.abs(level).max() * 4.0 + 0.8, -1.0, 1.0)


def pinholes(random: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Levels without order, some not above 0: points move and edges are cut wherever they may."""
    level = random.uniform(size=shape) ** 8 + 1e-12
    return np.where(random.random(shape) < 6e-4, -random.choice([0.0, 1e-9, 0.5, 100.0], size=shape), level)


def smallest_numbers(random: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Levels above 0 whose means are 0 by rounding, here and there in a solid."""
    return np.where(ndimage.gaussian_filter(random.normal(size=shape), 1.5) > 0.06, 5e-324, 0.5)


def turned_box(random: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    points = centres(*shape) @ turn(random.uniform(0, 90)).T
    return np.clip(-box_distance(points, random.uniform(8, 14, size=3)) / 1.5, -1.0, 1.0)


@pytest.mark.parametrize("kind", [blobs, pinholes, smallest_numbers, turned_box], ids=lambda kind: kind.__name__)
@pytest.mark.parametrize("seed", range(3))
def test_the_inside_changes_and_the_surface_does_not(kind, seed):
    random = np.random.default_rng(seed)
    level = kind(random, tuple(random.integers(27, 34, size=3)))
    uniform = stuff(level, coarsest=1)
    volume = signed_volumes(uniform.points, uniform.tets).sum()
    count = len(uniform.tets)
    for coarsest in (2, 4, 8):
        graded = stuff(level, coarsest)
        quality = check_mesh(tet_mesh(graded), "conforming")
        # The surface is the same bits in the same order, up to node numbers.
        assert np.array_equal(graded.points[graded.facets], uniform.points[uniform.facets])
        assert np.array_equal(graded.on_box, uniform.on_box)
        assert np.array_equal(graded.points[graded.on_surface], uniform.points[uniform.on_surface])
        assert quality.volume_m3 == pytest.approx(volume, rel=1e-13)
        assert "dihedral_within_bounds" not in quality.unmet and quality.num_tets <= count
        count = quality.num_tets
    assert count < 0.9 * len(uniform.tets)


@pytest.mark.parametrize("coarsest", [2, 4, 8, 16])
def test_angles_of_the_coarse_part(coarsest):
    lattice = bcc_lattice(ball(64, 31.0))
    interior = coarse_interior(lattice, coarsest)
    points, tets = lattice.positions(np.arange(len(lattice.level))), interior.tets
    edges = np.linalg.norm(points[tets[:, 1:]] - points[tets[:, :1]], axis=-1)
    assert min(8, coarsest) <= edges.max() <= coarsest
    assert signed_volumes(points, tets).min() > 0.0
    assert volumes_and_angles(points, tets)[1:] == pytest.approx((45.0, 120.0), abs=1e-9)


def test_place_in_the_lattice_does_not_matter():
    level = ball(30, 13.0, (0.3, 0.2, 0.1))
    here = stuff(level)
    moved = stuff(np.pad(level, ((5, 0), (1, 7), (0, 3)), constant_values=-1.0))
    assert len(here.tets) < 0.7 * len(stuff(level, coarsest=1).tets)
    assert np.array_equal(here.tets, moved.tets) and np.array_equal(here.facets, moved.facets)
    assert np.allclose(here.points, moved.points - np.array([5, 1, 0]), rtol=0.0, atol=1e-13)
