"""Which photographs support a surface: a drawn box with one plain side on textured ground, whose truth is exact."""

from functools import cache

import numpy as np

from tests.support.looking_cameras import looking_at
from thermoxels_ns.core.feature_rays import FeatureRays
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.mesh.boundary.visibility import FacetViews, facet_views
from thermoxels_ns.mesh.quality.checks import facet_normals
from thermoxels_ns.mesh.voxel_tets import kuhn_tets, voxel_facets
from thermoxels_ns.multiview.photographs import Photographs
from thermoxels_ns.multiview.stereo import Depths, depths_of
from thermoxels_ns.multiview.votes import supporting_photographs
from thermoxels_ns.synthetic.solids import BoxSolid

VOXEL = 0.05
LATTICE = Lattice((-1.6, -1.6, -0.4), VOXEL, (65, 65, 65))
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
def photographs() -> Photographs:
    views = looking_at((0.0, 0.0, 0.4), EYES, focal=225.0, size=WIDTH)
    matrices, centres = views.matrices(), views.camera_to_world[:, :, 3]
    rng, pictures = np.random.default_rng(0), []
    side = np.arange(WIDTH) + 0.5
    pixels = np.stack([*np.meshgrid(side, side), np.ones((WIDTH, WIDTH))], -1).reshape(-1, 3)
    for matrix, centre in zip(matrices, centres):
        rays = pixels @ np.linalg.inv(matrix[:, :3]).T
        distance, normal = SOLID.intersect(centre, rays)
        picture = np.tile(SKY, (len(rays), 1))
        met = np.isfinite(distance)
        picture[met] = colours(centre + distance[met, None] * rays[met], normal[met])
        pictures.append(picture + rng.normal(0.0, 0.006, picture.shape))
    firsts = np.arange(len(EYES)) * WIDTH * WIDTH
    shown = np.concatenate(pictures).astype(np.float32)
    return Photographs(matrices, centres, views.size, firsts, shown, np.full(len(shown), np.nan, np.float32))


@cache
def depths() -> Depths:
    return depths_of(photographs(), (-1.6, -1.6, -0.4), (1.6, 1.6, 2.8))


def support(cells: np.ndarray, tracks: FeatureRays | None = None) -> tuple[FacetViews, np.ndarray]:
    """Views of the surface of voxels, and how many photographs support it."""
    points, facets, photos = LATTICE.index_to_world(kuhn_tets(cells)[0]), voxel_facets(cells), photographs()
    middle, normals = points[facets].mean(axis=1), facet_normals(points, facets)
    views = facet_views(cells, LATTICE, photos.matrices, photos.centres, photos.sizes, middle, normals)
    found = supporting_photographs(depths(), views.middle, views.seen, VOXEL, tracks)
    return views, found.sum(axis=1)


def true_cells() -> np.ndarray:
    return SOLID.contains(LATTICE.cell_centres().reshape(-1, 3)).reshape(LATTICE.cell_shape)


def on_block(views: FacetViews, axis: int, sign: float) -> np.ndarray:
    """Places on one side of the block, three voxels or more from its edges."""
    at = views.middle
    low, high = (np.array(corner) + side * 3 * VOXEL for corner, side in zip(BLOCK, (1, -1)))
    within = np.all(((at > low) & (at < high)) | (np.arange(3) == axis), axis=1)
    return within & (at[:, 2] > 0.3) & (sign * views.normal[:, axis] > 0.5)


def before(low: tuple[float, ...], high: tuple[float, ...]) -> tuple[FacetViews, np.ndarray, np.ndarray]:
    """Support of the true solid with a box more in it, and which places lie on that box."""
    centres = LATTICE.cell_centres()
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
    photos, point = photographs(), np.array([0.5, 0.1, 0.8])
    from_front = np.flatnonzero(photos.centres[:, 0] > 2.0)[:3]
    behind = int(photos.centres[:, 0].argmin())
    origins = photos.centres[[*from_front, behind]]
    tracks = FeatureRays(origins, np.zeros(4, dtype=np.int64), point[None], np.full(4, 0.01))
    views, count = support(true_cells(), tracks)
    plain, off = on_block(views, 0, 1), np.linalg.norm(views.middle - point, axis=1)
    near = plain & (off < 1.4 * VOXEL)
    assert near.sum() >= 4 and np.all(count[near] == 3)
    assert np.mean(count[plain & (off > 1.6 * VOXEL)] == 0) > 0.95
