import numpy as np
import pytest

from tests.support.looking_cameras import looking_at
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import Views
from thermoxels_ns.mesh.solid.free_space import MOST_CAMERAS, CameraCounts, count_cameras

LATTICE = Lattice((-1.0, -1.0, -1.0), 0.125, (17, 17, 17))


def sight_by_lines(cells: np.ndarray, lattice: Lattice, views: Views) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How many images hold each voxel, how many lines of sight are free, and how many pass close to an edge of solid.

    The lines are sampled every fifth of a voxel. A line is close if it changes its mind when voxels are a bit larger or
    smaller, or if the voxel is within one of the border of the image.
    """
    centres = lattice.cell_centres().reshape(-1, 3)
    held = np.zeros(len(centres), dtype=int)
    free = np.zeros_like(held)
    close = np.zeros_like(held)
    own = np.stack(np.meshgrid(*map(np.arange, cells.shape), indexing="ij"), axis=-1).reshape(-1, 3)
    for pose, focal, centre, size in zip(views.camera_to_world, views.focal, views.centre, views.size):
        local = (centres - pose[:, 3]) @ pose[:, :3]
        depth = -local[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            pixel = np.stack(
                (centre[0] + focal[0] * local[:, 0] / depth, centre[1] - focal[1] * local[:, 1] / depth), 1
            )
        inside = (depth > 0) & np.all((pixel >= 0) & (pixel <= size), axis=1)
        voxel_px = focal * lattice.voxel_size / np.maximum(np.abs(depth), 1e-9)[:, None]
        clear = (depth > 0) & np.all((pixel >= voxel_px) & (pixel <= size - voxel_px), axis=1)
        clear |= (depth < -lattice.voxel_size) | np.any((pixel < -voxel_px) | (pixel > size + voxel_px), axis=1)
        eye, end = lattice.world_to_index(pose[:, 3]), own + 0.5
        length = np.linalg.norm(end - eye, axis=1)
        blocked = {0.45: np.zeros(len(own), bool), 0.0: np.zeros(len(own), bool), -0.45: np.zeros(len(own), bool)}
        for t in np.arange(0.0, length.max(), 0.2):
            point = eye + (end - eye) * np.minimum(t / length, 1.0)[:, None]
            before = np.any(np.abs(point - end) > 0.5, axis=1) & (t > 1.5) & (t < length)
            for wider, found in blocked.items():
                at = np.floor(point).astype(int)
                if wider:
                    solid = _near(cells, point, wider)
                else:
                    ok = np.all((at >= 0) & (at < cells.shape), axis=1)
                    solid = np.zeros(len(point), bool)
                    solid[ok] = cells[tuple(at[ok].T)]
                found |= solid & before
        held += inside
        free += inside & ~blocked[0.0]
        close += (blocked[0.45] != blocked[-0.45]) | ~clear
    return tuple(a.reshape(cells.shape) for a in (held, free, close))  # type: ignore[return-value]


def _near(cells: np.ndarray, point: np.ndarray, wider: float) -> np.ndarray:
    """Solid at any (wider above 0) or all (below) of the corners of a small cube around the points."""
    found = []
    for offset in np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T * abs(wider):
        at = np.floor(point + offset).astype(int)
        ok = np.all((at >= 0) & (at < cells.shape), axis=1)
        solid = np.zeros(len(point), bool)
        solid[ok] = cells[tuple(at[ok].T)]
        found.append(solid)
    return np.any(found, axis=0) if wider > 0 else np.all(found, axis=0)


@pytest.mark.parametrize(
    "eye",
    [(4.0, 0.3, 0.2), (-2.0, -2.5, 3.0), (0.31, -0.27, 0.93), (0.05, 0.05, 3.0), (3.0, 3.0, 3.0), (-0.85, 0.15, 0.15)],
)
def test_counts_are_those_of_straight_lines_of_sight(eye):
    cells = np.zeros(LATTICE.cell_shape, dtype=bool)
    cells[6:10, 4:12, 5:7] = True
    cells[2:5, 2:5, 10:13] = True
    views = looking_at((0.0, 0.0, 0.0), eye)
    held, free, close = sight_by_lines(cells, LATTICE, views)
    counts = count_cameras(cells, LATTICE, views)
    clear = close == 0
    assert clear.mean() > 0.5 and len(np.unique(free[clear])) == 2
    assert np.array_equal(counts.in_image[clear], held[clear])
    assert np.array_equal(counts.free[clear], free[clear])
    assert np.mean(counts.free != free) < 0.05  # along edges it is a matter of a fraction of a voxel


def test_every_voxel_is_counted_once_by_a_camera_on_a_diagonal_of_the_lattice():
    empty = np.zeros(LATTICE.cell_shape, dtype=bool)
    for eye in ((2.0, 2.0, 2.0), (0.0, 0.0, 0.0), (0.07, 0.07, 0.07), (-3.0, 0.0, 3.0)):
        target = (0.5, 0.0, 0.0) if not any(eye) else (0.0, 0.0, 0.0)
        counts = count_cameras(empty, LATTICE, looking_at(target, eye, focal=1.0, size=2000))
        to_voxel, ahead = LATTICE.cell_centres() - eye, np.asarray(target) - eye
        cosine = to_voxel @ ahead / (np.linalg.norm(to_voxel, axis=-1) * np.linalg.norm(ahead))
        assert (counts.in_image[cosine > 0.2] == 1).all() and (counts.in_image[cosine < -0.2] == 0).all(), eye
        assert counts.in_image.max() == 1
        assert np.array_equal(counts.free, counts.in_image)


def test_what_no_image_holds_is_neither_seen_nor_hidden():
    counts = count_cameras(
        np.zeros(LATTICE.cell_shape, dtype=bool), LATTICE, looking_at((0, 0, 0), (3.0, 0, 0), focal=2000.0)
    )
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
    counts = count_cameras(
        np.zeros((4, 4, 4), dtype=bool), Lattice((-1, -1, -1), 0.5, (5, 5, 5)), looking_at((0, 0, 0), eyes)
    )
    assert (counts.in_image == MOST_CAMERAS).all() and (counts.free == MOST_CAMERAS).all()
