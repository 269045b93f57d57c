from dataclasses import replace

import numpy as np
import pytest

from tests.support.looking_cameras import looking_at
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import Views
from thermoxels_ns.mesh.quality.checks import boundary_facets
from thermoxels_ns.mesh.solid.free_space import facet_views, seen_facets
from thermoxels_ns.mesh.tetrahedra import facet_normals
from thermoxels_ns.mesh.voxel_tets import kuhn_tets

LATTICE = Lattice((2.0, -1.0, 0.5), 0.25, (33, 33, 33))
H = LATTICE.voxel_size
MIDDLE = LATTICE.index_to_world([16.0, 16.0, 16.0])


def views(*centres: np.ndarray, target: np.ndarray = MIDDLE, focal: float = 100.0) -> Views:
    """Cameras with images of 400 x 300 pixels, wide enough (126 degrees) unless told otherwise."""
    number = len(centres)
    poses = looking_at(target, centres).camera_to_world if number else np.zeros((0, 3, 4))
    return Views(
        poses, np.full((number, 2), focal), np.tile([200.0, 150.0], (number, 1)), np.tile([400, 300], (number, 1))
    )


def voxel_surface(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centroids and outward normals of a voxel body's triangles, those of the faces themselves, in world units."""
    points = LATTICE.index_to_world(kuhn_tets(cells)[0])
    facets = boundary_facets(kuhn_tets(cells)[1])
    return points[facets].mean(axis=1), facet_normals(points, facets)


def block(*spans: tuple[int, int]) -> np.ndarray:
    cells = np.zeros(LATTICE.cell_shape, dtype=bool)
    cells[tuple(slice(low, high) for low, high in spans)] = True
    return cells


WHOLE = (0, 32)
PLATE = block(WHOLE, WHOLE, (15, 16))
ABOVE = LATTICE.index_to_world([16.0, 16.0, 36.0])


def test_a_sphere_is_seen_up_to_its_horizon() -> None:
    radius = 10.3
    distance = np.linalg.norm((LATTICE.cell_centres() - MIDDLE) / H, axis=-1) - radius
    cells, camera = distance < 0.0, MIDDLE + np.array([12.0, 3.0, -2.0])
    centroids, _ = voxel_surface(cells)
    outward = (centroids - MIDDLE) / np.linalg.norm(centroids - MIDDLE, axis=1, keepdims=True)
    seen = seen_facets(cells, views(camera), LATTICE, centroids, outward)
    towards = camera - MIDDLE - radius * H * outward
    elevation = np.degrees(np.arcsin(np.einsum("ij,ij->i", outward, towards) / np.linalg.norm(towards, axis=1)))
    assert np.count_nonzero(elevation > 12.0) > 1000
    assert seen[elevation > 12.0].all()
    assert not seen[elevation < -9.0].any()  # as far as the normals of a staircase are off
    assert seen.mean() == pytest.approx((elevation > 0.0).mean(), abs=0.08)


def test_an_obstacle_casts_its_shadow() -> None:
    """A small block hangs over a plate; what lies behind its middle is hidden, what its outline clears is seen."""
    cells = block(WHOLE, WHOLE, (2, 4)) | block((12, 20), (12, 20), (14, 16))
    centroids, normals = voxel_surface(cells)
    camera = LATTICE.index_to_world([16.0, 16.0, 40.0])
    seen = seen_facets(cells, views(camera), LATTICE, centroids, normals)
    index = LATTICE.world_to_index(centroids)
    ground = (normals[:, 2] > 0.5) & (index[:, 2] < 5.0)
    # The outline of the block's upper and lower side, seen from (16, 16, 40), on the plate at height 4.
    off = np.abs(index[:, :2] - 16.0).max(axis=1)
    inner, outer = 4.0 * 36.0 / 26.0, 4.0 * 36.0 / 24.0
    assert not seen[ground & (off < inner - 1.0)].any()
    assert seen[ground & (off > outer + 1.0)].all()
    assert np.count_nonzero(ground & (off < inner - 1.0)) > 50
    assert np.count_nonzero(ground & (off > outer + 1.0)) > 1000

    beside = views(camera, LATTICE.index_to_world([44.0, 16.0, 30.0]), LATTICE.index_to_world([-12.0, 16.0, 30.0]))
    assert seen_facets(cells, beside, LATTICE, centroids, normals)[ground].all()


@pytest.mark.parametrize(("principal", "middle"), [((200.0, 150.0), (0.0, 0.0)), ((400.0, 300.0), (-8.0, 6.0))])
def test_the_image_ends_at_its_borders(principal, middle) -> None:
    """20 voxels away, 400 x 300 pixels at a focal length of 500 pixels show 16 x 12 voxels."""
    centroids, normals = voxel_surface(PLATE)
    narrow = replace(views(ABOVE, focal=500.0), centre=np.array([principal]))
    seen = seen_facets(PLATE, narrow, LATTICE, centroids, normals)
    off = np.abs((centroids - ABOVE) @ narrow.camera_to_world[0][:, :2] / H - middle)
    upper = normals[:, 2] > 0.5
    assert seen[upper & (off[:, 0] < 7.5) & (off[:, 1] < 5.5)].all()
    assert not seen[~upper | (off[:, 0] > 8.5) | (off[:, 1] > 6.5)].any()


@pytest.mark.parametrize("cameras", [views(), views(ABOVE, target=2.0 * ABOVE - MIDDLE)], ids=["none", "turned away"])
def test_cameras_that_do_not_look_see_nothing(cameras) -> None:
    assert not seen_facets(PLATE, cameras, LATTICE, *voxel_surface(PLATE)).any()


def room() -> np.ndarray:
    return block((4, 28), (4, 28), (4, 28)) & ~block((7, 25), (7, 25), (7, 25))


def test_a_camera_in_a_room_sees_its_walls_and_no_other() -> None:
    cells = room()
    centroids, normals = voxel_surface(cells)
    camera = LATTICE.index_to_world([10.3, 12.1, 14.2])
    one = views(camera)
    six = views(*[camera] * 6, target=camera + np.vstack((np.eye(3), -np.eye(3))))
    inner = np.abs(LATTICE.world_to_index(centroids) - 16.0).max(axis=1) < 9.5
    assert np.array_equal(seen_facets(cells, six, LATTICE, centroids, normals), inner)
    assert 0 < np.count_nonzero(seen_facets(cells, one, LATTICE, centroids, normals)) < np.count_nonzero(inner)


def test_a_gap_of_one_voxel_can_be_looked_into() -> None:
    cells = block(WHOLE, WHOLE, (10, 20)) & ~block((16, 17), WHOLE, (12, 20))
    centroids, normals = voxel_surface(cells)
    index = LATTICE.world_to_index(centroids)
    walls = (np.abs(index[:, 0] - 16.5) < 0.6) & (np.abs(normals[:, 0]) > 0.5) & (index[:, 2] > 17.0)
    # Straight above the gap: the middle of its walls lies half a voxel off the line of sight.
    camera = LATTICE.index_to_world([16.5, 16.0, 40.0])
    seen = seen_facets(cells, views(camera), LATTICE, centroids, normals)
    assert np.count_nonzero(walls) > 100
    assert seen[walls].mean() > 0.9


def test_more_cameras_see_more_and_their_order_does_not_matter() -> None:
    cells = room() & ~block((25, 28), (13, 19), (13, 19))
    centroids, normals = voxel_surface(cells)
    positions = [MIDDLE + 9.0 * np.array(d) for d in ([1, 0, 0], [0, 1, 0.2], [-0.5, -0.5, 1], [0.8, 0.1, 0.1])]
    each = [seen_facets(cells, views(p), LATTICE, centroids, normals) for p in positions]
    together = np.any(each, axis=0)
    assert np.array_equal(seen_facets(cells, views(*positions), LATTICE, centroids, normals), together)
    assert np.array_equal(seen_facets(cells, views(*positions[::-1]), LATTICE, centroids, normals), together)
    assert together.sum() > max(s.sum() for s in each)
    cameras = views(*positions)
    looks = cameras.matrices(), cameras.camera_to_world[:, :, 3], cameras.size
    found = facet_views(cells, LATTICE, *looks, centroids, normals)
    assert np.array_equal(found.seen[found.group].T, each)
