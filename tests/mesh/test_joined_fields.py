"""Blocks of one field, trained apart, become this field again."""

from dataclasses import replace

import numpy as np
import pytest

from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import GridSnapshot, RayEvidence, Views
from thermoxels_ns.mesh.joined_fields import joined

SIZE = 0.25
RANDOM = np.random.default_rng(5)


def field(cells: tuple[int, int, int]) -> GridSnapshot:
    """A random field whose every value says where it is from."""
    shape = tuple(n + 1 for n in cells)
    lattice = Lattice((-1.0, 2.0, 0.5), SIZE, shape)
    rays = RayEvidence(
        RANDOM.random(500, dtype=np.float32),
        (RANDOM.random((500, 3)) * cells).astype(np.float32),
        np.tile(np.float32([1.0, 0.0, 0.0]), (500, 1)),
    )
    poses = np.concatenate([np.tile(np.eye(3), (6, 1, 1)), RANDOM.normal(size=(6, 3, 1))], axis=2)
    views = Views(poses, np.full((6, 2), 100.0), np.full((6, 2), 50.0), np.full((6, 2), 100))
    arrays = [RANDOM.random((*shape, *more), dtype=np.float32) for more in ((), (), (), (3,))]
    density, temperature, weight, colour = arrays
    return GridSnapshot(lattice, density, temperature, weight, None, colour, rays, views)


def block_of(whole: GridSnapshot, low: int, high: int, seen: slice) -> GridSnapshot:
    """The voxels from `low` to before `high` along x, in a world of their own whose origin is their middle."""
    rays, views = whole.evidence, whole.views
    assert rays is not None and views is not None
    middle = 0.5 * (low + high) * SIZE
    x, y, z = whole.lattice.lo
    inside = (rays.ends[:, 0] >= low) & (rays.ends[:, 0] < high)
    ends = rays.ends[inside] - np.float32([low, 0.0, 0.0])
    poses = views.camera_to_world[seen] - [[0.0, 0.0, 0.0, 1.0]] * np.array([[middle], [0.0], [0.0]])
    corners = slice(low, high + 1)
    shape = (high - low + 1, *whole.lattice.shape[1:])
    return GridSnapshot(
        Lattice((x + low * SIZE - middle, y, z), SIZE, shape),
        *(array[corners] for array in (whole.density, whole.temperature_c, whole.observed_weight)),
        None,
        whole.colour[corners],
        RayEvidence(rays.half_depth_density[inside], ends, rays.directions[inside]),
        Views(poses, views.focal[seen], views.centre[seen], views.size[seen]),
    )


def three_blocks() -> tuple[GridSnapshot, list[GridSnapshot], np.ndarray]:
    whole, ends = field((20, 5, 4)), [(0, 8), (6, 14), (12, 20)]
    blocks = [block_of(whole, *pair, seen) for pair, seen in zip(ends, (slice(0, 4), slice(2, 6), slice(0, 6)))]
    return whole, blocks, np.array([[0.5 * (low + high) * SIZE, 0.0, 0.0] for low, high in ends])


def test_blocks_of_one_field_become_it_again() -> None:
    whole, blocks, shifts = three_blocks()
    found, owner = joined(blocks, shifts)
    assert found.lattice.shape == whole.lattice.shape and found.lattice.lo == pytest.approx(whole.lattice.lo)
    for name in ("density", "temperature_c", "observed_weight", "colour"):
        np.testing.assert_array_equal(getattr(found, name), getattr(whole, name))
    np.testing.assert_allclose(found.centre_density(), whole.centre_density(), rtol=1e-6)
    order = [np.lexsort(one.evidence.ends.T.round(4)) for one in (found, whole)]
    np.testing.assert_allclose(found.evidence.ends[order[0]], whole.evidence.ends[order[1]], atol=1e-5)
    met = [one.evidence.half_depth_density[rows] for one, rows in zip((found, whole), order)]
    np.testing.assert_array_equal(*met)
    poses = [one.views.camera_to_world[np.argsort(one.views.camera_to_world[:, 0, 3])] for one in (found, whole)]
    np.testing.assert_allclose(*poses, atol=1e-12)
    assert [np.unique(layer).tolist() for layer in owner] == [[0]] * 7 + [[1]] * 6 + [[2]] * 7


def test_each_takes_its_half_of_the_overlap_and_nothing_is_known_beside_them() -> None:
    _, blocks, shifts = three_blocks()
    marked = [replace(one, density=np.full_like(one.density, 1.0 + number)) for number, one in enumerate(blocks)]
    shifts[1, 1] += 2 * SIZE
    found, owner = joined(marked, shifts)
    assert np.unique(found.density).tolist() == [0.0, 1.0, 2.0, 3.0]
    assert found.density[:7, 0].max() == 1.0 and found.density[14:, 0].min() == 3.0
    assert (owner[:6, 5:] == -1).all() and not found.density[:6, 6:].any()


@pytest.mark.parametrize("fault", ["half a voxel off", "other voxels", "a gap"])
def test_blocks_that_do_not_fit_are_refused(fault) -> None:
    _, blocks, shifts = three_blocks()
    if fault == "a gap":
        blocks, shifts = [blocks[0], blocks[2]], shifts[[0, 2]]
    elif fault == "other voxels":
        lattice = blocks[1].lattice
        blocks[1] = replace(blocks[1], lattice=Lattice(lattice.lo, 1.01 * SIZE, lattice.shape))
    else:
        shifts[1, 2] += 0.5 * SIZE
    with pytest.raises(MeshError, match="alone" if fault == "a gap" else "voxels"):
        joined(blocks, shifts)
