from functools import cache

import numpy as np
import pytest

from tests.support.looking_cameras import looking_at
from thermoxels_ns.core.feature_rays import MARGIN_ERRORS, MARGIN_VOXELS, FeatureRays, agrees_with_neighbours
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import Views
from thermoxels_ns.mesh.quality.checks import boundary_facets
from thermoxels_ns.mesh.solid.free_space import FacetViews, facet_views
from thermoxels_ns.mesh.tetrahedra import facet_normals
from thermoxels_ns.mesh.voxel_tets import kuhn_tets
from thermoxels_ns.multiview.photographs import Photographs, gathered
from thermoxels_ns.multiview.stereo import Depths, depths_of
from thermoxels_ns.multiview.votes import FEWEST_POINTS, air_voxels, hardly_shown, supporting_photographs, votes
from thermoxels_ns.synthetic.scene_truth import look_at
from thermoxels_ns.synthetic.solids import BoxSolid


def empty_voxels(lattice: Lattice, rays: FeatureRays) -> np.ndarray:
    """Voxels that rays cross and that hold no point, those at the edge of what is empty too."""
    crossing, points = votes(lattice, rays)
    return (crossing >= FEWEST_POINTS) & (points == 0)


BOX = Lattice.covering((-1, -1, -1), (1, 1, 1), 20)


def lines(origins, points, uncertainty=0.0) -> FeatureRays:
    origins, points = np.atleast_2d(origins).astype(float), np.atleast_2d(points).astype(float)
    number = np.repeat(np.arange(len(points)), len(origins))
    return FeatureRays(
        np.tile(origins, (len(points), 1)), number, points, np.full(len(number), uncertainty, dtype=float)
    )


def room(count: int = 4000, seed: int = 0) -> tuple[FeatureRays, np.ndarray]:
    """A room with walls at +-0.65 seen from inside, and the voxels that are free: nothing of a wall in them."""
    random = np.random.default_rng(seed)
    points = random.uniform(-0.65, 0.65, (count, 3))
    points[np.arange(count), random.integers(0, 3, count)] = random.choice([-0.65, 0.65], count)
    free = (np.abs(BOX.cell_centres()) + 0.5 * BOX.voxel_size < 0.65).all(axis=-1)
    return lines(random.uniform(-0.3, 0.3, (5, 3)), points), free


def test_of_a_room_seen_from_inside_only_free_voxels_are_carved_and_most_of_them() -> None:
    sight, free = room()
    empty = empty_voxels(BOX, sight)
    assert not (empty & ~free).any()
    assert empty.sum() > 0.6 * free.sum()


def test_a_point_without_lines_keeps_its_voxel_and_a_single_one_carves_nothing_however_many_see_it() -> None:
    sight = lines([-0.95, 0.05, 0.05], [[0.87, 0.05, 0.05], [0.88, 0.05, 0.05]])
    assert empty_voxels(BOX, sight)[8, 10, 10]
    doubted = FeatureRays(
        sight.origins, sight.point, np.concatenate((sight.points, [[-0.15, 0.05, 0.05]])), sight.uncertainty
    )
    assert not empty_voxels(BOX, doubted)[8, 10, 10]
    origins = np.random.default_rng(1).uniform(-0.1, 0.1, (40, 3)) + np.array([-0.8, 0.03, 0.03])
    assert not empty_voxels(BOX, lines(origins, [0.8, 0.05, 0.05])).any()
    assert empty_voxels(BOX, lines(origins, [[0.8, 0.05, 0.05], [0.8, 0.051, 0.05]])).any()


@pytest.mark.parametrize("uncertainty", [0.0, 0.1])
def test_what_is_carved_ends_before_the_points_by_the_margin_and_the_uncertainty(uncertainty: float) -> None:
    sight = lines([-0.95, 0.05, 0.05], [[0.87, 0.05, 0.05], [0.88, 0.05, 0.05]], uncertainty)
    carved = np.flatnonzero(empty_voxels(BOX, sight)[:, 10, 10])
    ends = BOX.index_to_world([[carved.max() + 1, 0, 0]])[0, 0]
    limit = 0.87 - MARGIN_VOXELS * BOX.voxel_size - MARGIN_ERRORS * uncertainty
    assert carved.tolist() == list(range(carved.max() + 1))
    assert limit - BOX.voxel_size < ends <= limit + 1e-9


def ground(wrong: float, per_voxel: int = 4, seed: int = 0) -> tuple[FeatureRays, np.ndarray, np.ndarray]:
    """Lines to a floor at z = -0.48, some of whose points lie below it; its voxels, and those before it."""
    random = np.random.default_rng(seed)
    points = np.column_stack((random.uniform(-0.95, 0.95, (400 * per_voxel, 2)), np.full(400 * per_voxel, -0.48)))
    cameras = np.column_stack((random.uniform(-1.5, 1.5, (6, 2)), np.full(6, 0.6)))
    below = random.random(len(points)) < wrong
    points[below] += random.uniform(0.2, 0.6, (below.sum(), 1)) * (points[below] - cameras[0])
    height = BOX.cell_centres()[..., 2]
    return lines(cameras, points), np.abs(height + 0.45) < 0.01, (height > -0.25) & (height < 0.2)


def test_without_the_lines_that_neighbours_contradict_wrong_points_carve_little_of_the_ground() -> None:
    sight, holds, above = ground(0.2)
    below = BOX.cell_centres()[..., 2] < -0.55
    believed = sight.of_points(agrees_with_neighbours(sight))
    eaten, after = empty_voxels(BOX, sight), air_voxels(BOX, believed)
    assert after[holds].mean() < 0.1 * eaten[holds].mean()
    assert after[below].mean() < 0.1 * eaten[below].mean()
    assert after[above].mean() > 0.5


def test_lines_along_faces_and_from_outside_count_as_any() -> None:
    along_a_face = lines([-3.0, 0.1, 0.1], [[0.95, 0.1, 0.1], [0.96, 0.1, 0.1]])
    empty = empty_voxels(BOX, along_a_face)
    assert empty.any(axis=(1, 2))[:17].all()
    assert not empty_voxels(BOX, lines([-3.0, 5.0, 0.0], [[3.0, 5.0, 0.0], [3.0, 5.1, 0.0]])).any()
    assert not empty_voxels(BOX, lines(np.zeros((0, 3)), np.zeros((0, 3)))).any()


def test_a_walk_meets_every_voxel_on_a_ray_and_no_other() -> None:
    draw = np.random.default_rng(3)
    for _ in range(20):
        eye, end = draw.uniform(-2.0, 2.0, 3), draw.uniform(-2.0, 2.0, 3)
        at = BOX.world_to_index(eye + np.linspace(0.0, 1.0, 40_001)[:, None] * (end - eye))
        before = np.linalg.norm(at - at[-1], axis=1) > MARGIN_VOXELS + 0.01
        place = np.floor(at[before]).astype(int)
        place = place[((place >= 0) & (place < 20)).all(1)]
        expected, met = np.zeros(BOX.cell_shape, bool), votes(BOX, lines(eye, end))[0] > 0
        expected[tuple(place.T)] = True
        left = np.argwhere(expected & ~met)
        # The last voxel is not left before the margin; a corner may be cut between two samples.
        assert (met & ~expected).sum() <= 1 and len(left) <= 2, left


def test_voxels_stay_where_two_photographs_look():
    eyes = [np.array([0.0, y, 0.0]) for y in (-0.2, 0.2)]
    poses = np.stack([look_at(eye, (1.0, eye[1], 0.0))[:3] for eye in eyes])
    views = Views(poses, *(np.full((2, 2), n) for n in (100.0, 50.0, 100)))
    at = {
        "behind": (-0.3, 0.2, 0.0),
        "before one alone": (0.2, 0.2, 0.0),
        "before both": (0.7, 0.0, 0.0),
        "far behind": (-1.5, 0.0, 0.0),
        "on the wall before both": (2.0, 0.0, 0.0),
        "on the wall before one alone": (2.0, 1.1, 0.0),
    }
    found = hardly_shown(np.array(list(at.values())), views)
    assert dict(zip(at, found.tolist())) == {name: "before both" not in name for name in at}


VOXEL = 0.05
GRID = Lattice((-1.6, -1.6, -0.4), VOXEL, (65, 65, 65))
BLOCK, GROUND = ((-0.5, -0.5, 0.4), (0.5, 0.5, 1.2)), ((-1.5, -1.5, -0.2), (1.5, 1.5, 0.0))
"""The block hangs over the ground, so that it has an underside which cameras above do not see."""
SOLID = BoxSolid([BLOCK, GROUND])
SKY = (0.55, 0.6, 0.7)
EYES = [(3.2 * np.cos(a), 3.2 * np.sin(a), 2.0 - 0.6 * (-1) ** k) for k, a in enumerate(np.arange(20) * np.pi / 10)]
WIDTH = 240


def colours(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Waves of 3 to 12 voxels in all directions; the block's side towards +x is plain."""
    rng = np.random.default_rng(1)
    waves = rng.normal(size=(24, 3))
    waves *= 2 * np.pi / (VOXEL * rng.uniform(3, 12, 24) * np.linalg.norm(waves, axis=1))[:, None]
    value = np.sin(points @ waves.T + rng.uniform(0, 6, 24)).sum(axis=1) / 12
    plain = (normals[:, 0] > 0.5) & (points[:, 2] > 0.3)
    return 0.5 + 0.3 * np.where(plain, 0.2, value)[:, None] * [1.0, 0.9, 0.8]


@cache
def drawn_photographs() -> Photographs:
    views = looking_at((0.0, 0.0, 0.4), EYES, focal=225.0, size=WIDTH)
    matrices, centres = views.matrices(), views.camera_to_world[:, :, 3]
    rng, pinholes, unknown = np.random.default_rng(0), [], np.full((WIDTH, WIDTH), np.nan, np.float32)
    side = np.arange(WIDTH) + 0.5
    pixels = np.stack([*np.meshgrid(side, side), np.ones((WIDTH, WIDTH))], -1).reshape(-1, 3)
    for matrix, centre in zip(matrices, centres):
        rays = pixels @ np.linalg.inv(matrix[:, :3]).T
        distance, normal = SOLID.intersect(centre, rays)
        picture = np.tile(SKY, (len(rays), 1))
        met = np.isfinite(distance)
        picture[met] = colours(centre + distance[met, None] * rays[met], normal[met])
        shown = (picture + rng.normal(0.0, 0.006, picture.shape)).astype(np.float32)
        pinholes.append((shown.reshape(WIDTH, WIDTH, 3), unknown, matrix))
    return gathered(pinholes, centres)


@cache
def depths() -> Depths:
    return depths_of(drawn_photographs(), (-1.6, -1.6, -0.4), (1.6, 1.6, 2.8))


def support(cells: np.ndarray, tracks: FeatureRays | None = None) -> tuple[FacetViews, np.ndarray]:
    """Views of the surface of voxels, and how many photographs support it."""
    points, facets, photos = (
        GRID.index_to_world(kuhn_tets(cells)[0]),
        boundary_facets(kuhn_tets(cells)[1]),
        drawn_photographs(),
    )
    middle, normals = points[facets].mean(axis=1), facet_normals(points, facets)
    views = facet_views(cells, GRID, photos.matrices, photos.centres, photos.sizes, middle, normals)
    found = supporting_photographs(depths(), views.middle, views.seen, VOXEL, tracks)
    return views, found.sum(axis=1)


def true_cells() -> np.ndarray:
    return SOLID.contains(GRID.cell_centres().reshape(-1, 3)).reshape(GRID.cell_shape)


def on_block(views: FacetViews, axis: int, sign: float) -> np.ndarray:
    """Places on one side of the block, three voxels or more from its edges."""
    at = views.middle
    low, high = (np.array(corner) + side * 3 * VOXEL for corner, side in zip(BLOCK, (1, -1)))
    within = np.all(((at > low) & (at < high)) | (np.arange(3) == axis), axis=1)
    return within & (at[:, 2] > 0.3) & (sign * views.normal[:, axis] > 0.5)


def before(low: tuple[float, ...], high: tuple[float, ...]) -> tuple[FacetViews, np.ndarray, np.ndarray]:
    """Support of the true solid with a box more in it, and which places lie on that box."""
    centres = GRID.cell_centres()
    more = np.all((centres > low) & (centres < high), axis=-1)
    views, count = support(true_cells() | more)
    within = (views.middle > np.array(low) - VOXEL / 4) & (views.middle < np.array(high) + VOXEL / 4)
    return views, count, np.all(within, axis=1)


def test_textured_sides_are_supported_a_plain_one_and_the_underside_are_not() -> None:
    views, count = support(true_cells())
    seen = views.seen.sum(axis=1)
    for axis, sign in ((0, -1), (1, 1), (1, -1), (2, 1)):
        side = on_block(views, axis, sign)
        assert side.sum() > 100 and np.mean(count[side] >= 3) > 0.95
    plain, under = on_block(views, 0, 1), on_block(views, 2, -1)
    assert plain.sum() > 100 and seen[plain].min() >= 5 and np.mean(count[plain] == 0) > 0.95
    assert under.sum() > 100 and not seen[under].any() and not count[under].any()
    ground = (views.normal[:, 2] > 0.5) & (views.middle[:, 2] < 0.1)
    assert np.mean(count[ground] >= 3) > 0.95


def test_a_surface_in_free_space_is_not_supported() -> None:
    """Three voxels before a textured side, five above the ground, and in the sky: photographs see what is behind."""
    y = BLOCK[0][1]
    for low, high, axis, sign in (
        ((-0.4, y - 3 * VOXEL, 0.5), (0.4, y - VOXEL, 1.1), 1, -1),
        ((-1.4, -1.4, 3 * VOXEL), (-0.9, 1.4, 5 * VOXEL), 2, 1),
        ((-0.4, -0.1, 1.4), (0.4, 0.1, 1.8), 1, -1),
    ):
        views, count, floating = before(low, high)
        outer = floating & (sign * views.normal[:, axis] > 0.5)
        assert outer.sum() > 100 and views.seen[outer].sum(axis=1).mean() > 4
        assert np.mean(count[outer] >= 3) < 0.05


def test_tracks_support_what_lies_at_their_points() -> None:
    """Four photographs saw a corner of a window on the plain side; one of them stands behind the block."""
    photos, point = drawn_photographs(), np.array([0.5, 0.1, 0.8])
    from_front = np.flatnonzero(photos.centres[:, 0] > 2.0)[:3]
    behind = int(photos.centres[:, 0].argmin())
    origins = photos.centres[[*from_front, behind]]
    tracks = FeatureRays(origins, np.zeros(4, dtype=np.int64), point[None], np.full(4, 0.01))
    views, count = support(true_cells(), tracks)
    plain, off = on_block(views, 0, 1), np.linalg.norm(views.middle - point, axis=1)
    near = plain & (off < 1.4 * VOXEL)
    assert near.sum() >= 4 and np.all(count[near] == 3)
    assert np.mean(count[plain & (off > 1.6 * VOXEL)] == 0) > 0.95
