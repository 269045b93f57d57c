"""Depths of photographs of a plane whose place is known, and where photographs say nothing of depth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.test_photo_consistency import EYES, PLANE, SIZE, photographs
from thermoxels_ns.depth_kernels import agreeing_views
from thermoxels_ns.photo_consistency import Photographs
from thermoxels_ns.plane_sweep import ANGLES_DEG, FEWEST_VIEWS, NEIGHBOURS, Depths, _neighbours, _View, depths_of
from thermoxels_ns.threads import set_num_threads

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


def test_a_plane_is_found_where_it_is():
    found = depths(photographs())
    known = np.isfinite(found.depth)
    off = np.abs(found.depth[known] - TRUE_DEPTH)
    assert found.share > 0.5
    assert np.median(off) < 0.004 and np.quantile(off, 0.95) < np.median(found.error[known])
    assert np.all(np.isfinite(found.likely[known])) and np.isfinite(found.likely).sum() >= known.sum()


def test_brightness_of_photographs_does_not_move_the_plane():
    gains = np.exp(np.random.default_rng(3).normal(0.0, 0.2, len(EYES)))
    found = depths(photographs(gains=gains))
    assert found.share > 0.5
    assert np.nanmedian(np.abs(found.depth - TRUE_DEPTH)) < 0.004


def test_threads_do_not_change_a_bit():
    found = []
    for threads in (1, 3):
        set_num_threads(threads)
        found.append(depths(photographs()))
    set_num_threads(None)
    for name in ("depth", "likely", "error"):
        assert np.array_equal(getattr(found[0], name), getattr(found[1], name), equal_nan=True), name


def test_a_mask_hides_its_pixels_and_leaves_the_others_right():
    def mask(colours):
        colours[:, 30:50, 20:60] = np.nan
        return colours

    found = depths(changed(mask))
    assert not np.isfinite(found.depth.reshape(len(EYES), SIZE, SIZE)[:, 30:50, 20:60]).any()
    assert found.share > 0.2
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


def subset(chosen: list[int]) -> Photographs:
    seen = photographs()
    colours = seen.colours.reshape(len(EYES), SIZE * SIZE, 3)[chosen].reshape(-1, 3)
    firsts = np.arange(len(chosen)) * SIZE * SIZE
    return Photographs(seen.matrices[chosen], seen.centres[chosen], seen.sizes[chosen], firsts, colours)


@pytest.mark.parametrize("chosen", [[0], [0, 1], [4, 4, 4, 4]])
def test_too_few_photographs_or_all_from_one_place_say_nothing(chosen):
    assert len(set(chosen)) <= FEWEST_VIEWS - 1
    assert depths(subset(chosen)).share == 0.0


def test_a_camera_that_looks_away_from_the_box_has_no_depths():
    away = depths_of(photographs(), (-0.5, -0.5, 2.0), (0.5, 0.5, 3.0))
    assert away.share == 0.0


def test_neighbours_see_the_same_from_directions_that_differ():
    seen = photographs()
    views = [_View.of(seen, number) for number in range(len(seen))]
    near, far = 1.1, 2.1
    chosen = _neighbours(4, views, near, far)
    assert len(chosen) == NEIGHBOURS and all(view is not views[4] for view in chosen)
    middle = np.array([seen.centres[4][0], seen.centres[4][1], PLANE])
    towards = [(view.centre - middle) / np.linalg.norm(view.centre - middle) for view in (views[4], *chosen)]
    angles = np.degrees(np.arccos([towards[0] @ other for other in towards[1:]]))
    assert np.all((angles > ANGLES_DEG[0]) & (angles < ANGLES_DEG[1])), angles


def test_a_depth_that_no_other_photograph_shares_is_not_sure():
    seen = photographs()
    total = len(seen.colours)
    depth, error = np.full(total, TRUE_DEPTH, np.float32), np.full(total, 0.01, np.float32)
    middle = SIZE // 2 * SIZE + SIZE // 2
    depth[middle] += 0.05
    inverses = np.linalg.inv(seen.matrices[:, :, :3])
    agreeing = np.zeros(total, np.int32)
    agreeing_views(0, total, seen.matrices, inverses, seen.centres, seen.sizes, seen.firsts, depth, error, agreeing)
    assert agreeing[middle] == 0
    assert agreeing[middle + 1] >= FEWEST_VIEWS
