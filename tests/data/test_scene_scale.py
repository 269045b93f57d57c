import math

import pytest

from thermoxels_ns.core.errors import SceneError, ThermoxelsError
from thermoxels_ns.data.scene_scale import (
    choose_scale,
    scale_from_known_distance,
    scale_from_option,
    scale_from_scene_file,
    up_from_scene_file,
)


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf, True, "2"])
def test_scale_and_distance_must_be_above_zero(value):
    with pytest.raises(ThermoxelsError, match=r"^metres_per_unit: "):
        scale_from_option(value)
    with pytest.raises(ThermoxelsError, match=r"^distance_m: "):
        scale_from_known_distance((0, 0, 0), (1, 0, 0), value)


@pytest.mark.parametrize("point", [(1.0, 2.0), (1.0, math.nan, 3.0), "door", (1.0, "x", 2.0), None])
@pytest.mark.parametrize("error", [-0.1, math.nan, "small"])
def test_points_and_standard_errors_that_are_none(point, error):
    with pytest.raises(ThermoxelsError, match=r"^point_b"):
        scale_from_known_distance((0, 0, 0), point, 1.0)
    with pytest.raises(ThermoxelsError, match=r"^standard_error_m: "):
        scale_from_known_distance((0, 0, 0), (1, 0, 0), 1.0, error)


@pytest.mark.parametrize(
    ("meta", "named"),
    [
        ({"metres_per_unit": 1, "metres_per_unit_standard_error": -1}, "metres_per_unit_standard_error"),
        ({"metres_per_unit_standard_error": 0.1}, "metres_per_unit_standard_error"),
        ({"metres_per_unit": 1, "up": [0, 0, math.nan]}, "up entry 3"),
    ],
)
def test_bad_scene_file(meta, named):
    with pytest.raises(SceneError, match=f"^transforms.json: {named}: "):
        scale_from_scene_file(meta)
        up_from_scene_file(meta)


def test_the_user_goes_before_the_scene_file_and_it_says_so():
    assert scale_from_scene_file({}) is None and up_from_scene_file({}) is None
    meta = {"metres_per_unit": 0.25, "metres_per_unit_standard_error": 0.01, "up": [0, -3, 4]}
    chosen = choose_scale(scene_file=meta)
    assert chosen is not None
    assert (chosen.metres_per_unit, chosen.standard_error) == (0.25, 0.01)
    assert "transforms.json" in chosen.source and up_from_scene_file(meta) == (0.0, -0.6, 0.8)
    chosen = choose_scale(option=3.0, scene_file=meta)
    assert chosen is not None
    assert chosen.metres_per_unit == 3.0
    assert "user" in chosen.source and "goes before the 0.25 m per unit of transforms.json" in chosen.source
    measured = scale_from_known_distance((0, 0, 0), (2, 0, 0), 1.0, 0.1)
    chosen = choose_scale(known_distance=measured, scene_file=meta)
    assert chosen is not None
    assert (chosen.metres_per_unit, chosen.standard_error) == (0.5, 0.05)
    assert "goes before" in chosen.source
