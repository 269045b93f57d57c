from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras

from tests.support.plane_photographs import EYES, FOCAL, LATTICE, PLANE, SIZE, photographs, texture
from thermoxels_ns.core.threads import set_num_threads
from thermoxels_ns.data.dataset import ThermalDataset
from thermoxels_ns.multiview import stereo
from thermoxels_ns.multiview.differences import matters, photograph_differences, without_gains
from thermoxels_ns.multiview.photographs import Photographs, read_photographs
from thermoxels_ns.multiview.stereo import FEWEST_VIEWS, Depths, depths_of, feature_rays_to_depths
from thermoxels_ns.multiview.stereo_kernels import add_differences, correlate, weigh_patches

LO, HI = (-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)
TRUE_DEPTH = 1.6 - PLANE
"""All cameras look straight down from the same height."""


def depths(seen: Photographs) -> Depths:
    return depths_of(seen, LO, HI)


def changed(change) -> Photographs:
    """The photographs with other colours: `change` of (photographs, rows, columns, 3)."""
    seen = photographs()
    colours = change(seen.colours.reshape(len(EYES), SIZE, SIZE, 3).copy())
    return replace(seen, colours=np.ascontiguousarray(colours.reshape(-1, 3), dtype=np.float32))


def test_a_plane_is_found_where_it_is_whatever_the_brightness_of_photographs():
    found = depths(photographs())
    known = np.isfinite(found.depth)
    off = np.abs(found.depth[known] - TRUE_DEPTH)
    assert found.share > 0.2
    assert np.median(off) < 0.006 and np.quantile(off, 0.95) < np.median(found.error[known])
    other = depths(photographs(gains=np.exp(np.random.default_rng(3).normal(0.0, 0.2, len(EYES)))))
    assert other.share > 0.2
    assert np.nanmedian(np.abs(other.depth - TRUE_DEPTH)) < 0.006


def test_where_texture_fades_depths_come_from_what_lies_beside():
    """Costs are added up along paths: alone, no pixel in the middle of the stripe knows its depth."""
    seen = photographs()
    origins, along = seen.of_pixels(np.arange(len(seen.colours)))
    across = np.abs(origins[:, 0] + TRUE_DEPTH * along[:, 0])
    contrast = np.clip(across / 0.2, 0.0, 1.0)[:, None] ** 2
    found = depths(replace(seen, colours=(0.5 + contrast * (seen.colours - 0.5)).astype(np.float32)))
    middle = across < 0.04
    known = np.isfinite(found.depth) & middle
    assert known.sum() > 0.3 * middle.sum()
    assert np.median(np.abs(found.depth[known] - TRUE_DEPTH)) < 0.012


def test_a_plane_of_one_colour_is_found_by_its_temperature():
    seen = photographs()
    plain = replace(seen, colours=np.full_like(seen.colours, 0.5))
    found = depths(replace(plain, thermal=seen.colours.mean(1)))
    assert depths(plain).share == 0.0
    assert found.share > 0.2
    assert np.nanmedian(np.abs(found.depth - TRUE_DEPTH)) < 0.006


def test_threads_do_not_change_a_bit():
    found = []
    for threads in (1, 3):
        set_num_threads(threads)
        found.append(depths(photographs()))
    set_num_threads(None)
    for name in ("depth", "error"):
        assert np.array_equal(getattr(found[0], name), getattr(found[1], name), equal_nan=True), name


def test_a_mask_hides_its_pixels_and_leaves_the_others_right():
    def mask(colours):
        colours[:, 30:50, 20:60] = np.nan
        return colours

    found = depths(changed(mask))
    assert not np.isfinite(found.depth.reshape(len(EYES), SIZE, SIZE)[:, 30:50, 20:60]).any()
    assert found.share > 0.1
    assert np.nanquantile(np.abs(found.depth - TRUE_DEPTH), 0.95) < 0.05


@pytest.mark.parametrize("colours", ["plain", "noise", "one of each"])
def test_where_photographs_share_nothing_no_depth_is_sure(colours):
    draw = np.random.default_rng(0)

    def change(seen):
        if colours == "plain":
            return np.full_like(seen, 0.5) + draw.normal(0.0, 0.002, seen.shape)
        if colours == "noise":
            return draw.uniform(0.0, 1.0, seen.shape)
        return np.broadcast_to(draw.uniform(0.0, 1.0, (len(EYES), 1, 1, 3)), seen.shape)

    assert depths(changed(change)).share < 0.01


@pytest.mark.parametrize("chosen", [[0], [0, 1], [4, 4, 4, 4]])
def test_too_few_photographs_or_all_from_one_place_say_nothing(chosen):
    assert len(set(chosen)) <= FEWEST_VIEWS
    assert depths(photographs([EYES[number] for number in chosen])).share == 0.0
    assert depths_of(photographs(), (-0.5, -0.5, 2.0), (0.5, 0.5, 3.0)).share == 0.0  # behind all cameras


CLOSE = [(x, y, 1.6) for x in (-0.3, -0.1, 0.1, 0.3) for y in (-0.25, 0.0, 0.25)]
ROW, COLUMN = np.meshgrid(*[(np.arange(SIZE) + 0.5 - SIZE / 2) / FOCAL] * 2, indexing="ij")


def plate(noise: float) -> tuple[Photographs, np.ndarray]:
    """Photographs of a part of the plane before a plain, far background, and which pixels show the plane."""
    seen = photographs(CLOSE)
    colours = np.empty((len(CLOSE), SIZE, SIZE, 3))
    shown = np.zeros(colours.shape[:3], dtype=bool)
    for number, eye in enumerate(CLOSE):
        x, y = eye[0] + COLUMN * TRUE_DEPTH, eye[1] - ROW * TRUE_DEPTH
        shown[number] = (np.abs(x) < 0.4) & (np.abs(y) < 0.4)
        colours[number] = 0.35 + 0.1 * texture(3.0 * x, 3.0 * y)  # weak and fine, and clearly not what is behind
    colours[~shown] = 0.9 + np.random.default_rng(0).normal(0.0, noise, (int((~shown).sum()), 3))
    return replace(seen, colours=np.ascontiguousarray(colours.reshape(-1, 3), dtype=np.float32)), shown


@pytest.mark.parametrize("noise", [0.0, 0.002])
def test_an_outline_gives_its_depth_to_nothing_beside_it(noise):
    seen, shown = plate(noise)
    found = depths(seen).depth.reshape(shown.shape)
    known = np.isfinite(found)
    assert known[shown].mean() > 0.2
    assert np.median(np.abs(found[known & shown] - TRUE_DEPTH)) < 0.04
    assert (known & ~shown).sum() <= 0.001 * known.sum()


@pytest.mark.parametrize(
    "eye", [(0.5, 0.0, 1.6), (0.25, 0.1, 2.6), (0.3, 0.0, 0.9)], ids=["beside", "behind", "before"]
)
def test_from_plane_to_plane_the_picture_moves_by_a_pixel_wherever_the_other_camera_stands(eye):
    """If planes are even in inverse depth, the picture of a camera behind moves by 3 pixels where surfaces are far."""
    seen = photographs([(0.0, 0.0, 1.6), eye])
    depths = 1.0 / stereo._planes(seen, 0, [1], near=0.3, far=3.0, endless=False)
    assert (np.diff(depths) < 0.0).all()
    points = np.stack(np.broadcast_arrays(0.0, 0.0, 1.6 - depths), -1)  # through the middle pixel
    place = points @ seen.matrices[1, :, :3].T + seen.matrices[1, :, 3]
    moved = np.linalg.norm(np.diff(place[:, :2] / place[:, 2:], axis=0), axis=1)
    shown = seen.shown(1, points)[2]
    both = shown[1:] & shown[:-1]
    assert both.sum() > 20
    assert moved[both].min() > 0.6 and moved[both].max() < 1.4


@pytest.mark.parametrize(("beyond", "share"), [(0.2, 0.1), (0.8, 0.0)])
def test_what_lies_beyond_the_box_is_found_there_if_at_all_and_not_at_its_far_side(beyond, share):
    """Else all that stands behind a box would become a wall at its end; a ray to it meets nothing in the box."""
    found = depths_of(photographs(), (-0.5, -0.5, PLANE + beyond), (0.5, 0.5, PLANE + beyond + 0.6))
    points = feature_rays_to_depths(found).points
    assert found.share >= share
    assert np.count_nonzero(np.abs(points[:, 2] - PLANE) > 0.1) < 0.01 * len(found.depth)


class Frames(ThermalDataset):
    """A dataset of pictures whose red and green say where a pixel's ray goes: x and y on the plane at depth 1."""

    def __init__(self, width: int, height: int, distortion: list[float] | None, masked: bool = False):
        focal = 0.8 * width
        self.thermal_cameras: Any = object()  # of their own
        poses = torch.eye(4)[None, :3].repeat(40, 1, 1)
        poses[:, 0, 3] = torch.arange(40.0)
        lens = None if distortion is None else torch.tensor([distortion])
        self.cameras = Cameras(poses, focal, focal, width / 2, height / 2, width, height, distortion_params=lens)
        directions = self.cameras.generate_rays(camera_indices=0).directions
        x, y = directions[..., 0] / -directions[..., 2], directions[..., 1] / -directions[..., 2]
        picture = torch.stack((0.5 + 0.4 * x, 0.5 + 0.4 * y, torch.zeros_like(x)), -1)
        self.picture, self.masked = (255 * picture).round().to(torch.uint8), masked

    def __len__(self) -> int:
        return len(self.cameras)

    def get_image_uint8(self, index: int) -> torch.Tensor:
        return self.picture

    def get_mask(self, index: int) -> torch.Tensor | None:
        mask = torch.ones(*self.picture.shape[:2], 1, dtype=torch.bool)
        mask[: len(mask) // 4] = False
        return mask if self.masked else None


@pytest.mark.parametrize("distortion", [None, [-0.12, 0.03, 0.0, 0.0, 0.004, -0.006]])
@pytest.mark.parametrize(("width", "height"), [(120, 90), (1000, 750)])
def test_read_photographs_are_pinholes(distortion, width, height):
    read = read_photographs(Frames(width, height, distortion), most=32)
    assert read is not None and len(read) == 32
    assert read.centres[0, 0] == 0.0 and read.centres[-1, 0] == 39.0 and len(set(read.centres[:, 0])) == 32
    assert tuple(read.sizes[3]) == ((120, 90) if width == 120 else (160, 120))
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 9), np.linspace(-0.35, 0.35, 7))
    for k in (0, 17):
        points = np.stack((read.centres[k, 0] + 2 * x, 2 * y, np.full_like(x, -2.0), np.ones_like(x)), -1)
        u, v, depth = np.moveaxis(points @ read.matrices[k].T, -1, 0)
        assert depth == pytest.approx(2.0)
        picture = read.colours[read.firsts[k] :][: np.prod(read.sizes[k])].reshape(*read.sizes[k][::-1], 3)
        shown = picture[np.floor(v / depth).astype(int), np.floor(u / depth).astype(int)]
        pixel = 0.4 * 1.25 / read.sizes[k, 0]
        assert shown[..., 0] == pytest.approx(0.5 + 0.4 * x, abs=0.6 * pixel + 0.004)
        assert shown[..., 1] == pytest.approx(0.5 + 0.4 * y, abs=0.6 * pixel + 0.004)


def test_read_photographs_have_their_masks():
    read = read_photographs(Frames(600, 450, None, masked=True), most=32)
    rows = np.isnan(read.colours[: np.prod(read.sizes[0])].reshape(*read.sizes[0][::-1], 3)).all((1, 2))
    assert rows[:30].all() and not rows[31:].any()


@pytest.mark.parametrize("exposure", [0.0, 0.15])
def test_shallow_ramps_have_depths_in_photographs_of_any_exposure(exposure, monkeypatch):
    """A patch on a ramp correlates with each place along it; only one of these places is as bright."""
    draw = np.random.default_rng(3)
    seen = photographs(scale=0.3, gains=np.exp(draw.normal(0.0, exposure, len(EYES))))
    seen = replace(seen, colours=seen.colours + draw.normal(0.0, 0.004, seen.colours.shape).astype(np.float32))
    found = depths(seen)
    assert found.share > 0.2
    assert np.nanquantile(np.abs(found.depth - TRUE_DEPTH), 0.95) < 0.03
    monkeypatch.setattr(stereo, "DIFFERENCE", 0.0)
    assert depths_of(seen, LO, HI).share < 0.02


@pytest.mark.parametrize("lost", ["nothing", "a hole in each", "all of some"])
def test_temperatures_with_offsets_find_ramps_and_those_that_are_missing_harm_nothing(lost):
    draw = np.random.default_rng(5)
    seen = photographs(scale=0.3)
    warm = seen.colours.mean(1) + np.repeat(draw.normal(0.0, 0.05, len(EYES)), SIZE * SIZE)
    warm = (warm + draw.normal(0.0, 0.003, warm.shape)).reshape(len(EYES), SIZE, SIZE).astype(np.float32)
    if lost == "a hole in each":
        warm[:, 30:60, 20:70] = np.nan
    if lost == "all of some":
        warm[::3] = np.nan
    colours = 0.5 + 0.2 * (seen.colours - 0.5) + draw.normal(0.0, 0.004, seen.colours.shape)
    seen = replace(seen, colours=colours.astype(np.float32))
    found = depths(replace(seen, thermal=warm.ravel()))
    assert found.share > max(0.05, depths(seen).share)
    assert np.nanquantile(np.abs(found.depth - TRUE_DEPTH), 0.95) < 0.05
    again = depths(replace(seen, thermal=warm.ravel()))
    assert np.array_equal(found.depth, again.depth, equal_nan=True)


def test_what_is_endlessly_far_has_depths_far_behind_the_box():
    """All photographs look at one picture, each with an exposure of its own."""
    draw = np.random.default_rng(4)
    seen = photographs([EYES[4]] * len(EYES), gains=np.exp(draw.normal(0.0, 0.1, len(EYES))), scale=1.5)
    moved = photographs()
    seen = replace(seen, matrices=moved.matrices, centres=moved.centres)
    found = depths(replace(seen, colours=seen.colours + draw.normal(0.0, 0.006, seen.colours.shape).astype(np.float32)))
    assert found.share > 0.8  # 0.67 if differences count for what is matched at infinity
    assert np.nanmin(found.depth) > 2.0 * (1.6 + 0.5)


def test_photographs_that_do_not_show_a_place_say_nothing_about_it():
    """Three that show it: the better two count, whether or not three others look elsewhere. Of six, three count."""
    draw = np.random.default_rng(1)
    own = draw.uniform(8.0, 9.0, (1, 12, 14)).astype(np.float32)
    showing = [(own + draw.normal(0.0, off, own.shape)).astype(np.float32) for off in (1.0, 0.05, 0.1)]
    noise = np.full(1, 1e-4, np.float32)
    weights, means, variances = np.empty((25, 12, 14), np.float32), np.empty_like(own), np.empty_like(own)
    weigh_patches(own[0, ..., None], own, 2, 0.025, 0.05, noise, weights, means, variances)

    def correlation(others: list[np.ndarray]) -> np.ndarray:
        result = np.empty((12, 14, 1), np.float32)
        correlate(own, np.stack(others), 2, weights, means, variances, noise, 2, 0, result)
        return result[2:-2, 2:-2, 0]

    single, elsewhere = np.sort([correlation([one]) for one in showing], axis=0), np.full_like(own, -100.0)
    better = correlation(showing)
    assert np.allclose(better, single[1:].mean(0), atol=1e-6)
    assert np.array_equal(correlation([*showing, *3 * [elsewhere]]), better)
    assert np.allclose(correlation([*showing, *showing]), (2.0 * single[2] + single[1]) / 3.0, atol=1e-6)
    assert (correlation([showing[0], *3 * [elsewhere]]) < 0.0).all(), "one alone is not enough"


def test_differences_are_the_least_of_the_better_half_of_the_photographs_that_show_a_pixel():
    draw = np.random.default_rng(0)
    others, expected = (draw.uniform(0.0, 1.0, (6, 2, 5, 6)).astype(np.float32) for _ in range(2))
    limit = draw.uniform(0.1, 0.6, (6, 2, 1, 1)).astype(np.float32)
    limit[2, 1] = np.inf
    others[1, 0, 2], others[3, 1, 4], expected[0, 1, 3], expected[:, :, 0, 0] = -100.0, -3.0, -100.0, -100.0
    others[:2, 0, :, 3], others[1:, 0, 4, 5] = -100.0, -100.0
    cost = draw.uniform(0.0, 1.0, (5, 6, 3)).astype(np.float32)
    told = (others >= 0.0) & (expected > -1.0) & np.isfinite(limit) & (others[:, :1] >= 0.0)
    relative = np.where(told, np.minimum(np.abs(others - expected) / limit, 1.0), 0.0).sum(1) / np.maximum(
        told.sum(1), 1
    )
    best = np.sort(np.where(told.any(1), relative, 1.0), axis=0)
    used = np.maximum(2, (told.any(1).sum(0) + 1) // 2)
    assert set(used.ravel()) == {2, 3} and told.any(1).sum(0).min() == 0
    wanted = cost.copy()
    wanted[..., 1] += 0.4 * np.where(used == 2, best[:2].mean(0), best[:3].mean(0))
    add_differences(others, expected, limit, np.float32(0.4), 2, 1, cost)
    assert np.allclose(cost, wanted, atol=1e-6)


@pytest.mark.parametrize("beyond", [0.0, 0.5])
def test_pixels_of_a_steep_plane_have_neighbours_and_those_of_an_outline_have_none(beyond):
    """On a floor seen at a slant the inverse depth changes by several planes of the sweep from row to row."""
    row, column = np.mgrid[:12, :12]
    inverse = 1.0 + 0.03 * row
    inverse[:, 7:] += 0.5
    inverse[:, 6] += beyond
    error = (0.01 / inverse**2).astype(np.float32)
    agree = stereo._neighbours_agree((1.0 / inverse).astype(np.float32), error)
    inner = np.zeros_like(agree)
    inner[1:-1, 1:-1] = True
    assert agree[inner & (np.abs(column - 6) > 1)].all()
    assert not agree[:, [0, 6, 11]].any() and not agree[[0, 11]].any()


@pytest.fixture(scope="module")
def known():
    return depths_of(photographs(), LATTICE.lo, LATTICE.hi)


def unknown(known) -> np.ndarray:
    return np.full(len(known.depth), np.nan, np.float32)


def with_colours(known, colours):
    return replace(known, photographs=replace(known.photographs, colours=colours.astype(np.float32)))


def test_gains_are_found_within_half_a_percent(known):
    draw = np.random.default_rng(0)
    gain = 2.0 ** draw.normal(0.0, 0.2, (len(EYES), 1)) * (1.0 + draw.normal(0.0, 0.03, (len(EYES), 3)))
    seen = np.clip(known.photographs.colours * gain[known.photographs.numbers], 0.0, 1.0)
    found, error = photograph_differences(with_colours(known, seen), unknown(known))
    true = np.log(gain) - np.log(gain).mean(0)
    assert np.abs(found[:, :3] - true).max() < 0.012
    assert np.sqrt(np.mean((found[:, :3] - true) ** 2)) < 0.005
    assert matters(found[:, :3], error[:, :3], 0.01)
    again = without_gains(replace(known.photographs, colours=seen.astype(np.float32)), found[:, :3]).colours
    ratio = again / known.photographs.colours
    assert np.abs(ratio[seen.max(1) < 1.0] / ratio.mean() - 1.0).max() < 0.02


def test_photographs_that_differ_by_noise_alone_stay(known):
    found, error = photograph_differences(known, unknown(known))
    assert np.abs(found[:, :3]).max() < 0.005
    assert not matters(found[:, :3], error[:, :3], 0.01)
    assert not matters(found[:, 3], error[:, 3], 0.0)  # no thermal images: nothing is known
    np.testing.assert_array_equal(found[:, 3], 0.0)
    noise = np.random.default_rng(1).normal(0.0, 3.0 / 255.0, known.photographs.colours.shape)
    noisy, error = photograph_differences(with_colours(known, known.photographs.colours + noise), unknown(known))
    assert not matters(noisy[:, :3], error[:, :3], 0.01)


def test_offsets_are_found_and_their_mean_is_not(known):
    offset = np.random.default_rng(2).normal(0.3, 0.03, len(EYES))
    warm = 0.2 + 0.1 * known.photographs.colours[:, 0] + offset[known.photographs.numbers]
    found, error = photograph_differences(known, warm.astype(np.float32))
    np.testing.assert_allclose(found[:, 3], offset - offset.mean(), atol=0.002)
    assert np.all(np.abs(found[:, 3] - (offset - offset.mean())) < 4.0 * error[:, 3] + 1e-3)
    assert matters(found[:, 3], error[:, 3], 0.003)


def test_saturated_pixels_tell_no_gain(known):
    gain = np.ones((len(EYES), 1))
    gain[3] = 1.5
    seen = np.clip(known.photographs.colours * gain[known.photographs.numbers], 0.0, 1.0)
    found, _ = photograph_differences(with_colours(known, seen), unknown(known))
    np.testing.assert_allclose(np.exp(found[3, :3] - np.delete(found[:, :3], 3, 0).mean(0)), 1.5, rtol=0.015)


def test_a_photograph_that_shares_nothing_is_not_known(known):
    first = known.photographs.numbers == 0
    found, error = photograph_differences(replace(known, depth=np.where(first, np.nan, known.depth)), unknown(known))
    assert error[0, :3].min() > 1.0 > error[1:, :3].max()
    assert np.abs(found[0, :3] - found[1:, :3].mean(0)).max() < 0.01
