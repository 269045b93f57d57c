import numpy as np
import pytest
from scipy.spatial import KDTree

from tests.support.stuffed_shapes import SHAPES, Shape, box_distance, centres, on_surface, tet_mesh, turn
from thermoxels_ns.mesh.quality.checks import check_mesh, dihedral_range_deg
from thermoxels_ns.mesh.quality.tet_shapes import signed_volumes
from thermoxels_ns.mesh.stuffing.isosurface import StuffedSolid, stuff
from thermoxels_ns.mesh.stuffing.sharp_edges import ANGLES_DEG, Surface, sharpen
from thermoxels_ns.mesh.tetrahedra import facet_areas, facet_normals

CELLS = 48
VOXEL = 2.0 / CELLS
SHIFT = np.array([0.0137, -0.0071, 0.0043])
"""Where the middle of `stuffed_shapes.Shape` is not."""


def turned(seed: int) -> np.ndarray:
    axes, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return axes * np.linalg.det(axes)


def turned_box(half: tuple[float, float, float], seed: int) -> Shape:
    rotation, (a, b, c) = turned(seed), half
    return Shape(lambda p: box_distance(p @ rotation, np.array(half)), 8 * a * b * c, 8 * (a * b + b * c + a * c))


def sharpened(level: np.ndarray) -> tuple[StuffedSolid, StuffedSolid, np.ndarray]:
    """A mesh before and after, and its nodes that moved."""
    solid = stuff(level)
    sharp = sharpen(solid, level.shape)
    return solid, sharp, np.flatnonzero(np.any(solid.points != sharp.points, axis=1))


def relative_errors(shape: Shape, solid: StuffedSolid) -> tuple[float, float]:
    points = solid.points * VOXEL
    volume, area = signed_volumes(points, solid.tets).sum(), facet_areas(points, solid.facets).sum()
    return volume / shape.volume - 1.0, area / shape.area - 1.0


def crossings(solid: StuffedSolid) -> int:
    """How often a side of a boundary triangle passes through another one near it that has none of its nodes."""
    corners = solid.points[solid.facets]
    pairs = KDTree(corners.mean(axis=1)).query_pairs(1.4, output_type="ndarray")
    apart = ~(solid.facets[pairs[:, 0], :, None] == solid.facets[pairs[:, 1], None, :]).any(axis=(1, 2))
    side, through = np.concatenate([pairs[apart], pairs[apart, ::-1]]).T
    found = 0
    for start, end in ((0, 1), (1, 2), (2, 0)):
        triangle, p, q = corners[through], corners[side, start], corners[side, end]
        normal = np.cross(triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0])
        height_p, height_q = (np.einsum("ij,ij->i", end - triangle[:, 0], normal) for end in (p, q))
        share = height_p / np.where(height_p == height_q, 1.0, height_p - height_q)
        at = p + share[:, None] * (q - p)
        inside = height_p * height_q < 0.0
        for n in range(3):
            inward = np.cross(triangle[:, (n + 1) % 3] - triangle[:, n], at - triangle[:, n])
            inside &= np.einsum("ij,ij->i", inward, normal) > 0.0
        found += np.count_nonzero(inside)
    return found


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_boxes_at_any_angle(seed, noise):
    shape = turned_box((0.7, 0.25, 0.5), seed)
    level = shape.level(CELLS, 1.0)
    level = np.clip(level + noise * np.random.default_rng(seed).normal(size=level.shape), -1.0, 1.0)
    solid, sharp, _ = sharpened(level)
    (volume, area), (old_volume, old_area) = relative_errors(shape, sharp), relative_errors(shape, solid)
    # Noise adds area of its own, everywhere.
    assert abs(area) < 0.005 + 0.03 * noise and abs(volume) < 0.004
    assert area > old_area + 0.015 and abs(volume) < 0.7 * abs(old_volume)
    check_mesh(tet_mesh(sharp))
    assert signed_volumes(sharp.points, sharp.tets).min() > 4.5e-4


def test_concave_edges_as_well():
    """An L in cross section: five convex edges along it and a concave one."""
    rotation = turned(5)

    def distance(p: np.ndarray) -> np.ndarray:
        q = p @ rotation
        foot = box_distance(q - [0.0, -0.3, 0.0], np.array([0.7, 0.2, 0.4]))
        return np.minimum(foot, box_distance(q - [-0.45, 0.1, 0.0], np.array([0.25, 0.6, 0.4])))

    shape = Shape(distance, 0.8 * 0.96, 2 * 0.96 + 0.8 * 5.2)
    solid, sharp, _ = sharpened(shape.level(CELLS, 1.0))
    assert relative_errors(shape, solid)[1] < -0.03
    assert abs(relative_errors(shape, sharp)[1]) < 0.005
    # Along the inner edge the surface retreats.
    step = sharp.points - solid.points
    normals = Surface.of(solid).node_normals
    assert np.count_nonzero(np.einsum("ij,ij->i", step, normals) < -0.1) > 10


def test_angles_move_length_and_topology_are_as_promised():
    for seed in range(3):
        solid, sharp, nodes = sharpened(turned_box((0.5, 0.4, 0.3), seed).level(32, 1.0))
        assert len(nodes) > 100
        assert np.all(np.linalg.norm(sharp.points - solid.points, axis=1) <= 1.0)
        assert on_surface(solid)[nodes].all()
        assert sharp.tets is solid.tets and sharp.facets is solid.facets
        around = solid.tets[np.isin(solid.tets, nodes).any(axis=1)]
        low, high = dihedral_range_deg(sharp.points, around)
        assert ANGLES_DEG[0] - 1e-9 <= low <= high <= ANGLES_DEG[1] + 1e-9


def test_moved_nodes_lie_on_the_true_edges_and_corners():
    half = np.array([0.7, 0.25, 0.5])
    _, sharp, nodes = sharpened(SHAPES["slab at 30 degrees"].level(CELLS, 1.0))
    inside = np.abs(((sharp.points[nodes] - 0.5 * CELLS) * VOXEL - SHIFT) @ turn(30.0)) - half
    # On an edge two of three coordinates are those of a face; at a corner all are.
    second = np.sort(np.abs(inside), axis=1)[:, 1] / VOXEL
    assert np.quantile(second, 0.9) < 0.1 and second.max() < 0.45
    corners = np.abs(inside).max(axis=1) / VOXEL < 0.2
    assert 4 <= np.count_nonzero(corners) <= 8


@pytest.mark.parametrize("name", ["sphere", "torus"])
@pytest.mark.parametrize("noise", [0.0, 0.1, 0.4])
def test_smooth_and_noisy_surfaces_stay(name, noise):
    level = SHAPES[name].level(CELLS)
    level += noise * np.random.default_rng(1).normal(size=level.shape)
    solid, sharp, nodes = sharpened(level)
    assert len(nodes) <= 2e-4 * np.count_nonzero(on_surface(solid))
    assert relative_errors(SHAPES[name], sharp)[1] == pytest.approx(relative_errors(SHAPES[name], solid)[1], abs=1e-3)


def test_what_lies_on_the_border_stays_there():
    tilt = turn(3.0) @ np.roll(turn(-1.5), 2, axis=(0, 1))
    box = box_distance((centres(30, 30, 30) - [9.0, 0.0, 0.0]) @ tilt, np.array([14.3, 8.2, 7.4]))
    solid, sharp, nodes = sharpened(np.clip(-box, -1.0, 1.0))
    assert solid.on_box.any() and len(nodes) > 50
    border = np.unique(solid.facets[solid.on_box])
    assert np.array_equal(solid.points[border], sharp.points[border])
    check_mesh(tet_mesh(sharp))
    assert np.all(np.abs(facet_normals(sharp.points, sharp.facets[sharp.on_box])) == [1.0, 0.0, 0.0])


@pytest.mark.parametrize("seed", [0, 1, 39])
def test_edges_that_face_each_other_do_not_cross(seed):
    """Two bars, edge to edge, less than two voxels apart."""
    random = np.random.default_rng(seed)
    axes, half = turned(seed), np.array([0.25, 0.25, 0.25])
    away = random.uniform(0.3, 0.8) * VOXEL + 0.25 * np.sqrt(2.0)
    middle = np.array([away, random.uniform(-0.05, 0.05), 0.03])

    def distance(p: np.ndarray) -> np.ndarray:
        q = p @ axes
        return np.minimum(box_distance((q - middle) @ turn(45.0), half), box_distance((q + middle) @ turn(45.0), half))

    solid, sharp, nodes = sharpened(Shape(distance, 1.0, 1.0).level(CELLS, 1.0))
    assert len(nodes) > 100
    assert crossings(solid) == 0 and crossings(sharp) == 0


def test_a_body_that_is_all_border():
    solid = stuff(np.ones((3, 4, 5)))
    assert sharpen(solid, (3, 4, 5)) is solid
