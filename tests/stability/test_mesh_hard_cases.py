import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import GridSnapshot
from thermoxels_ns.mesh.build import MeshOptions, build_mesh
from thermoxels_ns.mesh.quality.report import check_mesh
from thermoxels_ns.mesh.solid.voxels import SolidSelection, select_solid

VOXEL = MeshOptions("voxel")


def snapshot(density: np.ndarray, observed_weight: np.ndarray | float = 1.0) -> GridSnapshot:
    x = np.arange(density.shape[0], dtype=np.float32)[:, None, None]
    return GridSnapshot(
        Lattice((0.0, 0.0, 0.0), 0.1, density.shape),  # type: ignore[arg-type]
        density.astype(np.float32),
        np.broadcast_to(15.0 + x, density.shape),
        np.broadcast_to(np.float32(observed_weight), density.shape),
    )


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_density_that_is_not_finite_never_reaches_the_mesher(bad):
    density = np.ones((4, 4, 4))
    density[1, 2, 3] = bad
    with pytest.raises(MeshError, match="density: expected finite numbers only, got 1 of 64"):
        snapshot(density)


@pytest.mark.parametrize("scale", [1e-30, 1e-6, 1.0, 1e30, 3e38])
def test_selection_does_not_depend_on_the_scale_of_density(scale):
    # 3e38: the sum of eight corners overflows float32.
    pattern = np.random.default_rng(3).random((9, 9, 9))
    expected = select_solid(snapshot(pattern), SolidSelection(close_gaps=0, density_percentile=90.0)).cells
    solid = select_solid(snapshot(pattern * scale), SolidSelection(close_gaps=0, density_percentile=90.0))
    assert np.isfinite(solid.threshold)
    assert np.array_equal(solid.cells, expected)


def test_one_voxel_wall():
    density = np.zeros((9, 12, 12))
    density[4:6, 1:-1, 1:-1] = 40.0
    built = build_mesh(snapshot(density), SolidSelection(close_gaps=0, density_threshold=40.0), np.eye(4), VOXEL)
    mesh, solid = built.mesh, built.solid
    assert np.unique(np.argwhere(solid.cells)[:, 0]).tolist() == [4]
    quality = check_mesh(mesh)
    assert quality.volume_m3 == pytest.approx(81 * 0.1**3)
    assert quality.area_m2 == pytest.approx((2 * 81 + 4 * 9) * 0.1**2)


def test_smallest_lattice():
    selection = SolidSelection(close_gaps=0, density_threshold=1.0)
    mesh = build_mesh(snapshot(np.ones((2, 2, 2))), selection, np.eye(4), VOXEL).mesh
    quality = check_mesh(mesh)
    assert (quality.num_nodes, quality.num_tets, quality.num_box_facets) == (8, 6, 12)


def test_opaque_body_is_seen_on_its_skin_only():
    # Thermal rays stop at the surface: the inside has no temperature of its own and gets one between the skin's.
    shape = (20, 20, 20)
    weight = np.ones(shape, dtype=np.float32)
    weight[1:-1, 1:-1, 1:-1] = 0.0
    mesh = build_mesh(
        snapshot(np.full(shape, 1e4), weight), SolidSelection(close_gaps=0, density_threshold=1.0), np.eye(4), VOXEL
    ).mesh
    assert np.count_nonzero(~mesh.observed) == 18**3
    assert np.abs(mesh.temperature_c - (15.0 + mesh.points_m[:, 0] / 0.1)).max() < 1e-6


@settings(max_examples=40, deadline=None)
@given(
    shape=st.tuples(*[st.integers(2, 6)] * 3),
    seed=st.integers(0, 2**32 - 1),
    fill=st.floats(0.05, 1.0),
    percentile=st.floats(0.0, 99.0),
    region=st.sampled_from(["auto", "all"]),
    interior=st.sampled_from(["solid", "hollow"]),
    mirror=st.booleans(),
)
def test_every_mesh_that_is_built_is_valid(shape, seed, fill, percentile, region, interior, mirror):
    random = np.random.default_rng(seed)
    density = random.random(shape) * (random.random(shape) < fill)
    selection = SolidSelection(close_gaps=0, density_percentile=percentile, region=region, interior=interior)
    field = snapshot(density)
    try:
        solid = select_solid(field, selection)
    except MeshError:
        # Only without any density, or with the same density all over.
        centre = field.lattice.corner_to_cell_mean(field.density)
        assert not centre.any() or np.ptp(centre) == 0.0
        return
    transform = np.diag([-2.0 if mirror else 2.0, 2.0, 2.0, 1.0])
    built = build_mesh(field, selection, transform, VOXEL)
    mesh = built.mesh
    quality = check_mesh(mesh)
    assert np.array_equal(built.solid.cells, solid.cells)
    assert quality.volume_m3 == pytest.approx(solid.cells.sum() * 0.2**3, rel=1e-9)
    assert solid.cells.sum() == sum(step.added - step.removed for step in solid.steps)
