from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from thermoxels_ns.core.feature_rays import FeatureRays
from thermoxels_ns.multiview.backdrop import mean_colours, plain_backdrop, upwards
from thermoxels_ns.multiview.differences import without_gains
from thermoxels_ns.multiview.evidence import PhotographEvidence
from thermoxels_ns.multiview.photographs import Photographs, gathered
from thermoxels_ns.multiview.stereo import Depths, feature_rays_to_depths

WIDTH, HEIGHT, FOCAL = 60, 48, 50.0
SKY, WALL, GROUND, DARK = (0.55, 0.57, 0.6), (0.9, 0.88, 0.85), (0.3, 0.35, 0.2), (0.1, 0.1, 0.15)


LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""The axes of a level camera, x right, y down, z forward, in a world with z up."""


def turned_by(angle: float) -> np.ndarray:
    return np.array([[np.cos(angle), np.sin(angle), 0.0], [-np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])


def house(sky=SKY, wall=WALL, wall_warmth=np.nan, turns=(0,) * 6) -> tuple[Photographs, np.ndarray]:
    """Six photographs of a plain wall with a dark roof and window above plain ground, and where the sky is.

    With `turns` the camera was held turned by that many quarter turns for each photograph.
    """
    picture = np.empty((HEIGHT, WIDTH, 3), np.float32)
    warm = np.full((HEIGHT, WIDTH), 0.1 if np.isfinite(wall_warmth) else np.nan, np.float32)
    picture[:], picture[36:] = sky, GROUND
    picture[14:36, 15:45], picture[12:14, 13:47], picture[20:28, 24:34] = wall, DARK, DARK
    warm[12:36, 15:45] = wall_warmth
    is_sky = np.ones((HEIGHT, WIDTH), dtype=bool)
    is_sky[12:14, 13:47] = is_sky[14:36, 15:45] = is_sky[36:] = False
    noise = np.random.default_rng(0).normal(0.0, 0.004, (6, HEIGHT, WIDTH, 3))
    pinholes, centres, skies = [], [], []
    for number in range(6):
        quarter = np.linalg.matrix_power(np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]), turns[number])
        shown = np.rot90(picture + noise[number], turns[number])
        middle = np.array([[FOCAL, 0, shown.shape[1] / 2], [0, FOCAL, shown.shape[0] / 2], [0, 0, 1]])
        centres.append(np.array([0.2 * number, -3.0, 1.0]))
        rotation = quarter @ LEVEL @ turned_by(0.1 * number)
        matrix = middle @ np.column_stack((rotation, -rotation @ centres[-1]))
        pinholes.append((shown.astype(np.float32), np.rot90(warm, turns[number]), matrix))
        skies.append(np.rot90(is_sky, turns[number]).ravel())
    return gathered(pinholes, centres), np.concatenate(skies)


def first_of(seen: Photographs, count: int) -> Photographs:
    length = dict.fromkeys(("colours", "thermal"), count * WIDTH * HEIGHT)
    length |= dict.fromkeys(("matrices", "centres", "sizes", "firsts"), count)
    return replace(seen, **{name: getattr(seen, name)[:some] for name, some in length.items()})


def found(seen: Photographs) -> np.ndarray:
    return plain_backdrop(seen, np.full(len(seen.colours), np.nan, np.float32))[0]


@pytest.mark.parametrize("turns", [(0,) * 6, (1,) * 6, (3,) * 6, (0, 2, 0, 0, 0, 0)])
def test_the_sky_is_found_and_neither_wall_nor_ground_whatever_the_axes_of_the_world_are(turns):
    """Worlds of structure from motion stand in any direction: a street's sky is not at their z axis."""
    seen, is_sky = house(turns=turns)
    tilt = Rotation.from_rotvec([1.3, -0.4, 2.0]).as_matrix()
    matrices = np.concatenate((seen.matrices[:, :, :3] @ tilt.T, seen.matrices[:, :, 3:]), axis=2)
    turned = replace(seen, matrices=matrices, centres=seen.centres @ tilt.T)
    if len(set(turns)) == 1:
        assert np.allclose(upwards(turned), tilt[:, 2], atol=1e-6)
    for backdrop in (found(seen), found(turned)):
        assert not backdrop[~is_sky].any()
        assert backdrop[is_sky].mean() > 0.9


def test_a_white_wall_under_a_white_sky_is_none():
    seen, is_sky = house(sky=(0.95, 0.95, 0.95), wall=(0.95, 0.95, 0.95), wall_warmth=0.6)
    backdrop = found(seen)
    assert backdrop[~is_sky].mean() < 0.01 and backdrop[is_sky].mean() > 0.8


def test_a_sky_that_some_photographs_show_overexposed_is_one():
    seen, is_sky = house(sky=(0.9, 0.9, 0.9), wall=(0.5, 0.45, 0.4))
    gain = np.array([1.0, 1.3, 0.8, 0.9, 1.2, 0.95])
    exposed = np.minimum(seen.colours * gain[seen.numbers, None], 1.0).astype(np.float32)
    corrected = without_gains(replace(seen, colours=exposed), np.log(gain)[:, None].repeat(3, axis=1))
    backdrop, bright = found(corrected), gain[seen.numbers] > 1.1
    assert backdrop[is_sky & bright].mean() > 0.8 and backdrop[is_sky & ~bright].mean() > 0.8
    assert not backdrop[~is_sky].any()


def test_a_pixel_whose_depth_is_known_is_none():
    seen, _ = house()
    depth = np.full(len(seen.colours), np.nan, np.float32)
    depth[: WIDTH * 6] = 2.0  # the upper rows of the first photograph
    assert not plain_backdrop(seen, depth)[0][: WIDTH * 6].any()


def room() -> tuple[Photographs, np.ndarray, np.ndarray]:
    """What eight cameras see of a room from inside, all round; depths of its walls; which pixels show the ceiling.

    The room is 6 x 6 m wide and 3 m high. Walls and ceiling are plain and have temperatures of 0.5 and 0.6.
    """
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    middle = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    along = np.column_stack((columns.ravel(), rows.ravel(), np.ones(HEIGHT * WIDTH))) @ np.linalg.inv(middle).T @ LEVEL
    draw, pinholes, centres, depths = np.random.default_rng(0), [], [], []
    for turn in map(turned_by, 0.25 * np.pi * np.arange(8)):
        centre = -1.5 * turn[1] + (0.0, 0.0, 1.6)  # stands back from the wall that it looks at
        with np.errstate(divide="ignore"):
            far = np.where(along @ turn > 0, np.array([3.0, 3.0, 3.0]) - centre, np.array([-3.0, -3.0, 0.0]) - centre)
            reach = far / (along @ turn)
        ceiling = (reach.argmin(1) == 2) & ((along @ turn)[:, 2] > 0)
        colours = np.where(ceiling[:, None], SKY, WALL) + draw.normal(0.0, 0.004, (len(along), 3))
        picture = colours.reshape(HEIGHT, WIDTH, 3).astype(np.float32)
        matrix = middle @ np.column_stack((LEVEL @ turn, -LEVEL @ turn @ centre))
        pinholes.append((picture, np.where(ceiling, 0.6, 0.5).astype(np.float32), matrix))
        centres.append(centre)
        depths.append(np.where(ceiling, np.nan, reach.min(1)))
    depth = np.concatenate(depths).astype(np.float32)
    return gathered(pinholes, centres), depth, np.isnan(depth)


def test_a_plain_ceiling_is_no_sky_unless_it_is_colder_than_all_around():
    """Photographs of a room show walls behind their cameras, those of a house do not. A yard is open above."""
    seen, depth, is_ceiling = room()
    assert 0.1 < is_ceiling.mean() < 0.6
    backdrop, beside, ceiling = plain_backdrop(seen, depth)
    assert not backdrop.any() and not beside.any()
    assert ceiling[is_ceiling].mean() > 0.8 and not ceiling[~is_ceiling].any()
    yard = replace(seen, thermal=np.where(is_ceiling, np.float32(0.1), seen.thermal))
    assert plain_backdrop(yard, depth)[0][is_ceiling].mean() > 0.8
    branches = is_ceiling & (np.arange(len(depth)) % 3 == 0)  # upright lines on the sky, with depths that are wrong
    wrong = np.where(branches, np.float32(3.0), depth)
    assert np.mean(branches[np.isfinite(wrong)]) > 0.06
    assert plain_backdrop(yard, wrong)[0].any() and not plain_backdrop(yard, wrong)[2].any()
    beyond = replace(seen, thermal=np.where(is_ceiling, np.float32(np.nan), seen.thermal))  # too cold for the camera
    assert plain_backdrop(beyond, depth)[0][is_ceiling].mean() > 0.8
    unknown = replace(seen, thermal=np.full_like(seen.thermal, np.nan))
    assert not any(shown.any() for shown in plain_backdrop(unknown, depth)[::2])
    two = first_of(seen, 2)  # which show nothing that stands behind their cameras
    assert plain_backdrop(two, depth[: len(two.colours)])[0].any()


def test_a_ceiling_lies_on_the_hull_of_the_walls():
    seen, depth, is_ceiling = room()
    rays = feature_rays_to_depths(Depths(seen, depth, np.float32(0.02) * depth))
    evidence = PhotographEvidence(seen, depth, np.zeros_like(is_ceiling), is_ceiling, rays, None, None)
    box = np.full(3, -4.0), np.full(3, 4.0)
    to_ceiling = evidence.plain_rays(*box)
    assert to_ceiling is not None and len(to_ceiling.point) == is_ceiling.sum()
    assert np.abs(to_ceiling.points[:, 2] - 3.0).max() < 0.1
    outside = np.random.default_rng(0).uniform((10.0, -9.0, 0.0), (20.0, 9.0, 9.0), (len(rays.point) // 20, 3))
    through_a_window = FeatureRays(outside, np.arange(len(outside)), outside, np.zeros(len(outside)))
    seen_outside = replace(evidence, feature_rays=rays.joined_with(through_a_window)).plain_rays(*box)
    assert seen_outside is not None and np.abs(seen_outside.points[:, 2] - 3.0).max() < 0.1
    inexact = np.arange(len(rays.point)) % 3 == 0
    points = rays.points * np.where(inexact, np.random.default_rng(1).normal(1.0, 0.1, len(inexact)), 1.0)[:, None]
    of_mixed = replace(rays, points=points, uncertainty=np.where(inexact, 1.0, rays.uncertainty))
    by_the_exact = replace(evidence, feature_rays=of_mixed).plain_rays(*box)
    assert by_the_exact is not None and np.abs(by_the_exact.points[:, 2] - 3.0).max() < 0.1
    assert replace(evidence, feature_rays=None).plain_rays(*box) is None
    with_walls = replace(evidence, ceiling=np.ones_like(is_ceiling)).plain_rays(*box)  # all that looks like the ceiling
    assert with_walls is not None and len(to_ceiling.point) <= len(with_walls.point) < 1.05 * len(to_ceiling.point)
    assert np.abs(with_walls.points[:, 2] - 3.0).max() < 0.1
    low = replace(rays, points=rays.points * (1.0, 1.0, 0.3))  # below the cameras, which see no ceiling from there
    assert replace(evidence, feature_rays=low).plain_rays(*box) is None


def test_what_looks_like_the_sky_beside_it_has_no_depth_of_its_own():
    """An outline that is a pixel too wide: its depths on the sky go, and those on the wall stay."""
    seen, is_sky = house()
    outline = np.zeros((6, HEIGHT, WIDTH), bool)
    sky = is_sky.reshape(6, HEIGHT, WIDTH)
    outline[:, :-1] |= sky[:, :-1] & ~sky[:, 1:]
    depth = np.where(outline.ravel() | ~is_sky, np.float32(2.0), np.float32(np.nan))
    backdrop, beside, _ = plain_backdrop(seen, depth)
    assert beside[outline.ravel()].mean() > 0.9 and not beside[~is_sky].any()
    assert not (backdrop & beside).any()


def test_points_get_the_colour_that_photographs_show_there_and_not_that_of_the_sky():
    seen, _ = house()
    inverse = np.linalg.inv(seen.matrices[0][:, :3])
    at = [seen.centres[0] + 4.0 * inverse @ np.array([x, y, 1.0]) for x, y in ((30.0, 32.0), (30.0, 5.0))]
    alone = first_of(seen, 1)
    backdrop = found(seen)[: WIDTH * HEIGHT]
    wall, sky = mean_colours(alone, backdrop, np.array(at))
    assert wall == pytest.approx(WALL, abs=0.02)
    rest = alone.colours[~backdrop].mean(0)
    assert sky == pytest.approx(rest, abs=1e-4)
