import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import binary_dilation

from thermoxels_ns.core.lattice import CORNER_OFFSETS, Lattice
from thermoxels_ns.field.kept_voxels import BLOCK, KeptVoxels


def lattice_of(shape) -> Lattice:
    return Lattice((0.0, 0.0, 0.0), 1.0, tuple(n + 1 for n in shape))


@st.composite
def patterns(draw) -> KeptVoxels:
    shape = draw(st.tuples(*[st.integers(1, 19)] * 3))
    share = draw(st.sampled_from([0.0, 0.02, 0.3, 0.9, 1.0]))
    random = np.random.default_rng(draw(st.integers(0, 2**20)))
    return KeptVoxels(lattice_of(shape), np.flatnonzero(random.random(int(np.prod(shape))) < share))


law = settings(max_examples=40, deadline=None, derandomize=True, database=None)


@given(patterns())
@law
def test_rows_are_those_of_the_corners_of_each_voxel(voxels):
    """Each voxel's eight rows hold its eight corners, every stored corner belongs to a voxel, each stands once."""
    shape = voxels.lattice.shape
    index = np.stack(np.unravel_index(voxels.cells, voxels.lattice.cell_shape), -1)
    expected = np.ravel_multi_index(tuple(np.moveaxis(index[:, None] + CORNER_OFFSETS, -1, 0)), shape)
    rows, _, _ = voxels.tables(torch.device("cpu"))
    np.testing.assert_array_equal(voxels.corners[rows.numpy()], expected)
    np.testing.assert_array_equal(voxels.corners, np.unique(expected))
    assert voxels.num_rows == len(voxels.corners) and len(voxels) == len(voxels.cells)
    np.testing.assert_array_equal(voxels.voxel_rows, rows.numpy()[:, ::2])
    np.testing.assert_array_equal(np.ravel_multi_index(tuple(voxels.corner_index().T), shape), voxels.corners)


@given(patterns())
@law
def test_every_voxel_of_the_lattice_is_found_or_known_to_be_absent(voxels):
    shape = voxels.lattice.cell_shape
    everywhere = torch.from_numpy(np.stack(np.unravel_index(np.arange(np.prod(shape)), shape), -1))
    expected = np.full(int(np.prod(shape)), -1)
    expected[voxels.cells] = np.arange(len(voxels))
    np.testing.assert_array_equal(voxels.number_at(everywhere).numpy(), expected)
    np.testing.assert_array_equal(voxels.mask().reshape(-1), expected >= 0)
    assert voxels.mask().shape == shape and voxels.all_kept == bool((expected >= 0).all())


@given(patterns(), st.integers(0, 3), st.integers(0, 2**20))
@law
def test_growth_is_that_of_a_cube_within_the_kept_voxels(voxels, by, seed):
    chosen = np.random.default_rng(seed).random(len(voxels)) < 0.1
    dense = np.zeros(voxels.lattice.cell_shape, dtype=bool)
    dense.reshape(-1)[voxels.cells[chosen]] = True
    cube = np.ones((2 * by + 1,) * 3, dtype=bool)
    expected = (binary_dilation(dense, cube) & voxels.mask()).reshape(-1)[voxels.cells]
    np.testing.assert_array_equal(voxels.dilated(chosen, by), expected)


def test_empty_blocks_cost_one_entry():
    """Tables follow what is kept, not the resolution."""
    voxels = KeptVoxels(lattice_of((256, 256, 256)), [0, 256**3 - 1])
    assert voxels.voxel_number.shape == (2 * BLOCK**3,) and voxels.num_rows == 16
    assert (voxels.block_slot >= 0).sum() == 2 and voxels.block_slot.shape == (32**3,)


@pytest.mark.parametrize("shape", [(1, 1, 1), (8, 3, 20)])
def test_nothing_kept(shape):
    voxels = KeptVoxels(lattice_of(shape), [])
    assert len(voxels) == voxels.num_rows == 0 and not voxels.all_kept and not voxels.mask().any()
    assert voxels.number_at(torch.zeros(3, 3, dtype=torch.int64)).tolist() == [-1, -1, -1]
