from dataclasses import fields
from itertools import product

import numpy as np
import pytest
from scipy import ndimage
from scipy.sparse.linalg import spsolve

from tests.support.stuffed_shapes import (
    ANGLE_BOUNDS_DEG,
    box_distance,
    centres,
    stiffness,
    tet_mesh,
    turn,
    volumes_and_angles,
)
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.quality.report import check_mesh
from thermoxels_ns.mesh.quality.tet_shapes import signed_volumes
from thermoxels_ns.mesh.stuffing.coarse_interior import balanced_octree, coarse_interior, split_in_eight
from thermoxels_ns.mesh.stuffing.isosurface import StuffedSolid, stuff
from thermoxels_ns.mesh.stuffing.lattice import bcc_lattice


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


def at_the_border(random: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    distance = np.linalg.norm(centres(*shape) - random.choice([-13.0, 0.0, 13.0], size=3), axis=-1)
    return np.clip((16.0 - distance) / 1.5, -1.0, 1.0).astype(np.float32)


LEVELS = (blobs, pinholes, smallest_numbers, turned_box, at_the_border)


def same_surface(first: StuffedSolid, second: StuffedSolid) -> bool:
    """Whether boundary triangles and their points are the same bits and in the same order, up to node numbers."""
    return (
        np.array_equal(first.points[first.facets], second.points[second.facets])
        and np.array_equal(first.on_box, second.on_box)
        and np.array_equal(first.points[first.on_surface], second.points[second.on_surface])
    )


@pytest.mark.parametrize("kind", LEVELS, ids=lambda kind: kind.__name__)
@pytest.mark.parametrize("seed", range(3))
def test_the_inside_changes_and_the_surface_does_not(kind, seed):
    random = np.random.default_rng(seed)
    level = kind(random, tuple(random.integers(27, 34, size=3)))
    uniform = stuff(level, coarsest=1)
    volume = signed_volumes(uniform.points, uniform.tets).sum()
    count = len(uniform.tets)
    for coarsest in (2, 4, 8):
        graded = stuff(level, coarsest)
        quality = check_mesh(tet_mesh(graded))
        assert same_surface(graded, uniform)
        assert quality.volume_m3 == pytest.approx(volume, rel=1e-13)
        assert (
            ANGLE_BOUNDS_DEG[0] <= quality.dihedral_range_deg[0] <= quality.dihedral_range_deg[1] <= ANGLE_BOUNDS_DEG[1]
        )
        assert quality.num_tets <= count
        count = quality.num_tets
    assert count < 0.9 * len(uniform.tets)


@pytest.mark.parametrize("radius", [6.2, 7.9, 9.5, 11.3, 12.8])
def test_balls_anywhere(radius):
    random = np.random.default_rng(int(10 * radius))
    level = ball(31, radius, tuple(random.uniform(-1, 1, size=3)))
    graded, uniform = stuff(level), stuff(level, coarsest=1)
    quality = check_mesh(tet_mesh(graded))
    assert same_surface(graded, uniform)
    assert quality.volume_m3 == pytest.approx(signed_volumes(uniform.points, uniform.tets).sum(), rel=1e-13)
    assert quality.num_tets < len(uniform.tets)


@pytest.mark.parametrize("coarsest", [2, 4, 8, 16])
def test_angles_of_the_coarse_part(coarsest):
    lattice = bcc_lattice(ball(64, 31.0))
    interior = coarse_interior(lattice, coarsest)
    assert interior is not None
    points, tets = lattice.positions(np.arange(len(lattice.level))), interior.tets
    edges = np.linalg.norm(points[tets[:, 1:]] - points[tets[:, :1]], axis=-1)
    assert min(8, coarsest) <= edges.max() <= coarsest
    assert signed_volumes(points, tets).min() > 0.0
    assert volumes_and_angles(points, tets)[1:] == pytest.approx((45.0, 120.0), abs=1e-9)


def test_full_box_by_hand():
    """A box of 8 voxels with eight cubes of two in its middle, and nothing larger."""
    solid, uniform = stuff(np.ones((8, 8, 8))), stuff(np.ones((8, 8, 8)), coarsest=1)
    quality = check_mesh(tet_mesh(solid))
    # Gone: four around each face of the 4^3 voxels. New: four at each outer face of them, and between the cubes, at
    # each of 12 faces, one at two sides inside and two at the other two.
    assert len(uniform.tets) - len(solid.tets) == 4 * (3 * 4 * 4 * 5) - 4 * 6 * 4 * 4 - 12 * 6
    # Gone: the voxels' centres, and the voxel corners in the middle of the 12 faces between the cubes and of their 6
    # common edges. The middles of the cubes are voxel corners too and stay.
    assert len(uniform.points) - len(solid.points) == 4**3 + 12 + 6
    assert quality.volume_m3 == pytest.approx(512.0, rel=1e-14)
    assert solid.on_box.all() and same_surface(solid, uniform)


@pytest.mark.parametrize("name", ["wall", "rod", "small box", "noise"])
def test_nothing_deep_leaves_the_mesh_as_it_is(name):
    level = np.full((16, 17, 18), -1.0)
    if name == "wall":
        level[5:10, 1:-1, 1:-1] = 1.0
    elif name == "rod":
        level[6:11, 6:11] = 1.0
    elif name == "small box":
        level[5:10, 5:10, 5:10] = 1.0
    else:
        level = np.random.default_rng(1).normal(size=level.shape)
    graded, uniform = stuff(level), stuff(level, coarsest=1)
    for item in fields(StuffedSolid):
        assert np.array_equal(getattr(graded, item.name), getattr(uniform, item.name)), item.name


def test_place_in_the_lattice_does_not_matter():
    level = ball(30, 13.0, (0.3, 0.2, 0.1))
    here = stuff(level)
    moved = stuff(np.pad(level, ((5, 0), (1, 7), (0, 3)), constant_values=-1.0))
    assert len(here.tets) < 0.7 * len(stuff(level, coarsest=1).tets)
    assert np.array_equal(here.tets, moved.tets) and np.array_equal(here.facets, moved.facets)
    assert np.allclose(here.points, moved.points - np.array([5, 1, 0]), rtol=0.0, atol=1e-13)


@pytest.mark.parametrize("level", [ball(23, 10.0), np.ones((15, 16, 17))], ids=["ball", "box"])
def test_linear_temperature_is_reproduced(level):
    """Steady conduction between nodes of the surface at linear temperatures: the patch test of conforming elements."""
    solid = stuff(level)
    assert len(solid.tets) < len(stuff(level, coarsest=1).tets)
    exact = solid.points @ [1.0, -2.0, 0.5] + 3.0
    matrix = stiffness(solid.points, solid.tets)
    free, fixed = np.flatnonzero(~solid.on_surface), np.flatnonzero(solid.on_surface)
    found = spsolve(matrix[free][:, free].tocsc(), -matrix[free][:, fixed] @ exact[fixed])
    assert np.abs(found - exact[free]).max() < 1e-10


@pytest.mark.parametrize("bad", [0, 3, 6, -2, 2.0, True, None, "4"])
def test_edges_that_are_no_power_of_two(bad):
    with pytest.raises(
        MeshError, match=r"coarsest: expected 1, 2, 4, 8 or another power of two, \[voxels\], got .* Pass 4, or 1"
    ):
        stuff(np.ones((3, 3, 3)), coarsest=bad)


def test_no_edge_is_too_large():
    level = ball(30, 13.0)
    assert np.array_equal(stuff(level, coarsest=2**40).tets, stuff(level, coarsest=64).tets)
    assert np.array_equal(stuff(level, coarsest=np.int64(4)).tets, stuff(level).tets)


def edges_of_cubes(cells: np.ndarray, largest: int) -> np.ndarray:
    """Edge of the cube that each voxel is in, [voxels]."""
    edges = np.ones(cells.shape, dtype=np.int64)
    for number, level in enumerate(balanced_octree(cells, largest)):
        whole = level
        for below in range(number, -1, -1):
            half = tuple(-(-n // 2**below) for n in cells.shape)
            whole = split_in_eight(whole, half)
        edges[whole] = 2 ** (number + 1)
    return edges


def edges_from_above(cells: np.ndarray, largest: int) -> np.ndarray:
    """The same by splitting: the largest cubes that hold nothing else, halved until all neighbours fit."""
    edges = np.ones(cells.shape, dtype=np.int64)
    size = 2
    while size <= largest:
        for corner in product(*(range(0, n - size + 1, size) for n in cells.shape)):
            cube = tuple(slice(c, c + size) for c in corner)
            if cells[cube].all():
                edges[cube] = size
        size *= 2
    while True:
        smallest = ndimage.minimum_filter(edges, size=3, mode="constant", cval=1)
        wrong = edges > 2 * smallest
        if not wrong.any():
            return edges
        for size in np.unique(edges[wrong]):
            lowest = np.argwhere(wrong & (edges == size)) // size * size
            for corner in np.unique(lowest, axis=0):
                edges[tuple(slice(c, c + size) for c in corner)] = size // 2


@pytest.mark.parametrize("largest", [1, 2, 4, 16, 2**40])
@pytest.mark.parametrize("seed", range(4))
def test_every_cube_is_as_large_as_balance_allows(seed, largest):
    random = np.random.default_rng(seed)
    shape = tuple(random.integers(20, 40, size=3))
    cells = random.random(shape) > 10.0 ** -random.uniform(2, 4.5)
    found = edges_of_cubes(cells, largest)
    assert np.array_equal(found, edges_from_above(cells, min(largest, 64)))
    assert found.max() <= largest and np.all(found[~cells] == 1)


def test_sizes_in_a_large_cube():
    edges = edges_of_cubes(np.ones((62, 62, 62), dtype=bool), 64)
    middle = edges[31, 31]
    # One layer of every size, as far as where the sizes begin allows: 2, 4, 8 and so on from either side.
    assert middle[:32].tolist() == [2] * 4 + [4] * 4 + [8] * 8 + [16] * 16
    assert middle[32:].tolist() == [16] * 16 + [8] * 8 + [4] * 4 + [2] * 2
