import numpy as np
import pytest

from tests.support.looking_cameras import looking_at
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import RayEvidence
from thermoxels_ns.mesh.solid.free_space import (
    MOST_CAMERAS,
    CameraCounts,
    count_cameras,
    distance_to_ends,
    first_solid,
    without_front,
)

LATTICE = Lattice((-1.0, -1.0, -1.0), 0.125, (17, 17, 17))
EMPTY = np.zeros(LATTICE.cell_shape, dtype=bool)


def crossings(cells: np.ndarray, eye: np.ndarray, along: np.ndarray, wider: float = 0.0) -> tuple[np.ndarray, ...]:
    """Distances (rays, solid voxels) where rays enter and leave solid voxels, wider by so much on all sides."""
    solid = np.argwhere(cells)
    with np.errstate(divide="ignore", invalid="ignore"):
        faces = [(solid[None] + side - eye) / along[:, None] for side in (-wider, 1.0 + wider)]
    return np.fmin(*faces).max(axis=2), np.fmax(*faces).min(axis=2)


@pytest.mark.parametrize("seed", range(6))
def test_rays_meet_the_first_voxel_that_they_cross(seed: int) -> None:
    random = np.random.default_rng(seed)
    shape = tuple(random.integers(1, 40, size=3))
    cells = random.random(shape) < random.choice([0.002, 0.02, 0.3])
    cells[tuple(random.integers(0, shape))] = True
    eye = random.uniform(-1.0, 2.0, 3) * shape
    ends = random.uniform(-0.3, 1.3, (200, 3)) * shape
    ends[:60, seed % 3] = eye[seed % 3]  # rays within a plane of voxels,
    ends[:20, (seed + 1) % 3] = eye[(seed + 1) % 3]  # along an axis,
    ends[20:30] = np.round(ends[20:30])  # and to lattice corners
    along = (ends - eye) / np.linalg.norm(ends - eye, axis=1, keepdims=True)

    near, far = crossings(cells, eye, along)
    clear = np.maximum(near, 1.5)
    nearest = np.where(far - clear > 1e-6, clear, np.inf).min(axis=1)
    grazed = np.abs(far - clear).min(axis=1) < 1e-6
    assert grazed.mean() < 0.2
    np.testing.assert_allclose(first_solid(cells, eye, along)[~grazed], nearest[~grazed], rtol=1e-9)
    reach = np.where(np.isfinite(nearest), 0.99 * nearest, 1e3)
    assert np.isinf(first_solid(cells, eye, along, reach)[~grazed]).all()


@pytest.mark.parametrize(
    "eye",
    [(4.0, 0.3, 0.2), (-2.0, -2.5, 3.0), (0.31, -0.27, 0.93), (0.05, 0.05, 3.0), (3.0, 3.0, 3.0), (-0.85, 0.15, 0.15)],
)
def test_counts_are_those_of_straight_lines_of_sight(eye):
    cells = np.zeros(LATTICE.cell_shape, dtype=bool)
    cells[6:10, 4:12, 5:7] = True
    cells[2:5, 2:5, 10:13] = True
    views, ends = looking_at((0.0, 0.0, 0.0), eye), np.argwhere(np.ones_like(cells)) + 0.5
    local = (LATTICE.index_to_world(ends) - eye) @ views.camera_to_world[0, :, :3]
    inside = -local[:, 2] - np.abs(local[:, :2]).max(axis=1)  # an image is 90 degrees wide
    start, solid = LATTICE.world_to_index(np.array(eye)), np.argwhere(cells)
    length = np.linalg.norm(ends - start, axis=1, keepdims=True)
    other = (ends[:, None] != solid + 0.5).any(axis=2)
    blocked = {}
    for wider in (0.45, 0.0, -0.45):
        near, far = crossings(cells, start, (ends - start) / length, wider)
        before = np.minimum(far, length - 0.5 - wider) - np.maximum(near, 1.5) > 1e-9
        blocked[wider] = (before & other).any(axis=1)
    held, free = inside >= 0.0, (inside >= 0.0) & ~blocked[0.0]
    clear = (np.abs(inside) > 2.0 * LATTICE.voxel_size) & (blocked[0.45] == blocked[-0.45])
    counts = count_cameras(cells, LATTICE, views)
    assert clear.mean() > 0.5 and len(np.unique(free[clear])) == 2
    assert np.array_equal(counts.in_image.ravel()[clear], held[clear])
    assert np.array_equal(counts.free.ravel()[clear], free[clear])
    assert np.mean(counts.free.ravel() != free) < 0.05  # along edges it is a matter of a fraction of a voxel


def test_every_voxel_is_counted_once_by_a_camera_on_a_diagonal_of_the_lattice():
    for eye in ((2.0, 2.0, 2.0), (0.0, 0.0, 0.0), (0.07, 0.07, 0.07), (-3.0, 0.0, 3.0)):
        target = (0.5, 0.0, 0.0) if not any(eye) else (0.0, 0.0, 0.0)
        counts = count_cameras(EMPTY, LATTICE, looking_at(target, eye, focal=1.0, size=2000))
        to_voxel, ahead = LATTICE.cell_centres() - eye, np.asarray(target) - eye
        cosine = to_voxel @ ahead / (np.linalg.norm(to_voxel, axis=-1) * np.linalg.norm(ahead))
        assert (counts.in_image[cosine > 0.2] == 1).all() and (counts.in_image[cosine < -0.2] == 0).all(), eye
        assert counts.in_image.max() == 1
        assert np.array_equal(counts.free, counts.in_image)


def test_what_no_image_holds_is_neither_seen_nor_hidden():
    counts = count_cameras(EMPTY, LATTICE, looking_at((0, 0, 0), (3.0, 0, 0), focal=2000.0))
    outside = counts.in_image == 0
    assert outside.mean() > 0.5 and not (counts.seen | counts.hidden)[outside].any() and counts.seen[~outside].all()


def test_a_floater_on_the_camera_does_not_blind_it():
    cells = np.zeros(LATTICE.cell_shape, dtype=bool)
    eye = (0.05, 0.05, 0.93)
    cells[7:10, 7:10, 14:] = True
    counts = count_cameras(cells, LATTICE, looking_at((0, 0, 0), eye))
    assert counts.free[8, 8, 4] == 1
    cells[7:10, 7:10, 12] = True
    assert count_cameras(cells, LATTICE, looking_at((0, 0, 0), eye)).free[8, 8, 4] == 0


def test_one_camera_in_ten_must_see_a_voxel():
    in_image = np.array([0, 1, 1, 10, 10, 11, 40, 40], dtype=np.uint8)
    free = np.array([0, 0, 1, 0, 1, 1, 3, 4], dtype=np.uint8)
    counts = CameraCounts(in_image, free)
    assert counts.seen.tolist() == [False, False, True, False, True, False, False, True]
    assert counts.hidden.tolist() == [False, True, False, True, False, True, True, False]


def test_many_cameras_are_thinned_out():
    eyes = np.column_stack((np.full(300, 3.0), np.linspace(-1, 1, 300), np.zeros(300)))
    counts = count_cameras(EMPTY, LATTICE, looking_at((0, 0, 0), eyes, focal=30.0))
    assert (counts.in_image == MOST_CAMERAS).all() and (counts.free == MOST_CAMERAS).all()


SHAPE = (12, 6, 6)
Y, Z = (values.ravel() for values in np.meshgrid(np.arange(24) / 4 + 0.1, np.arange(24) / 4 + 0.1))


def kept_of(cells: np.ndarray, evidence: RayEvidence) -> np.ndarray:
    return without_front(cells, evidence, distance_to_ends(evidence, cells.shape))


def rays(*surfaces: tuple[float, float]) -> RayEvidence:
    """576 rays along x that end at each x of `surfaces`, in the direction of its sign."""
    ends = [np.column_stack((np.full_like(Y, x), Y, Z)) for x, _ in surfaces]
    directions = [np.tile([sign, 0.0, 0.0], (len(Y), 1)) for _, sign in surfaces]
    arrays = (np.concatenate(each).astype(np.float32) for each in (ends, directions))
    return RayEvidence(np.ones(len(Y) * len(surfaces), np.float32), *arrays)


@pytest.mark.parametrize("place", np.arange(3.05, 5.0, 0.1))
def test_a_body_ends_within_half_a_voxel_of_where_rays_end(place):
    """Whichever voxels in front were solid: all that hold a piece of the surface, or one layer more."""
    for first in (int(place), int(place) - 1):
        cells = np.zeros(SHAPE, bool)
        cells[first:] = True
        kept = kept_of(cells, rays((place, 1.0)))
        assert kept[:, 1:5, 1:5].any(axis=(1, 2)).tolist() == (np.arange(12) + 0.5 >= place - 1e-6).tolist()
    distance = distance_to_ends(rays((place, 1.0)), SHAPE)[int(place), 1:5, 1:5]
    np.testing.assert_allclose(distance, place - int(place) - 0.5, atol=1e-5)


@pytest.mark.parametrize(("left", "right"), [(5.6, 5.65), (5.7, 5.6), (5.9, 5.95), (5.1, 5.05)])
def test_a_sheet_thinner_than_a_voxel_stays_where_it_is_seen_from_both_sides(left, right):
    cells = np.zeros(SHAPE, bool)
    cells[[5, 9]] = True
    assert np.array_equal(kept_of(cells, rays((left, 1.0), (right, -1.0))), cells)


def test_what_no_ray_reaches_stays_and_what_lies_outside_of_the_lattice_tells_nothing():
    cells = np.ones(SHAPE, bool)
    kept = kept_of(cells, rays((3.2, 1.0), (40.0, 1.0), (-7.0, -1.0)))
    assert kept[5:].all() and kept[0].all()  # farther than the reach from any end


def test_a_region_that_holds_nothing_but_the_front_stays():
    cells = np.zeros(SHAPE, bool)
    cells[3] = True
    assert np.array_equal(kept_of(cells, rays((4.7, 1.0))), cells)
