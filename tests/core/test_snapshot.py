from dataclasses import replace

import numpy as np
import pytest

from tests.support.looking_cameras import looking_at
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import GridSnapshot, RayEvidence, Views


def full() -> GridSnapshot:
    """A snapshot of 2 x 3 x 4 corners with everything known."""
    ones = np.ones((2, 3, 4), np.float32)
    return GridSnapshot(
        Lattice((0.0, 0.0, 0.0), 1.0, (2, 3, 4)),
        ones,
        ones,
        ones,
        np.ones((1, 2, 3), np.float32),
        np.ones((2, 3, 4, 3), np.float32),
        RayEvidence(np.ones((1, 2, 3), np.float32), *(np.ones(shape, np.float32) for shape in (7, (7, 3), (7, 3)))),
        Views(np.zeros((5, 3, 4)), np.ones((5, 2)), np.zeros((5, 2)), np.ones((5, 2), np.int64)),
    )


@pytest.mark.parametrize("part", ["evidence", "views"])
def test_what_cannot_be_is_refused_by_name(part):
    """Another shape, numbers that are not finite, and numbers beyond what they may be."""
    whole = getattr(full(), part)
    beyond = {"voxel_weight": -1e-3, "half_depth_density": -1.0, "directions": 2.0, "focal": 0.0, "size": 0}
    for name, array in vars(whole).items():
        wrong = [array[..., None]]
        values = [np.nan, np.inf] if array.dtype.kind == "f" else []
        for value in (*values, *([beyond[name]] if name in beyond else [])):
            wrong.append(array.copy())
            wrong[-1].reshape(-1)[-1] = value
        for one in wrong:
            with pytest.raises(MeshError, match=f"^grid snapshot {name}: "):
                replace(full(), **{part: replace(whole, **{name: one})})
    for name in ("voxel_density", "colour"):
        with pytest.raises(MeshError, match=f"^grid snapshot {name}: expected shape"):
            replace(full(), **{name: np.ones((2, 3, 4), np.float32)})


def test_what_is_shown_well_ends_where_pixels_per_area_fall_off():
    """Eight cameras 2 away from a point at which all are pointed; visibility falls with the square of the distance."""
    angle = 0.25 * np.pi * np.arange(8)
    views = looking_at((0.0, 0.0, 0.0), 2.0 * np.column_stack((np.cos(angle), np.sin(angle), 0.0 * angle)), focal=200.0)
    reach = np.full(8, 2.0)
    places = np.array([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (2.5, 0.0, 0.0), (0.0, 0.0, 3.0)])
    # At (2.5, 0, 0), seen by three of eight, it is 0.6 / 8; nobody looks up to (0, 0, 3).
    assert views.shown_well(places, reach).tolist() == [True, True, False, False]
    one = np.where(np.arange(8) == 0, reach, np.nan)  # of the others it is not known what they are pointed at
    behind = np.array([(-2.9, 0.0, 0.0), (-3.5, 0.0, 0.0), (2.9, 0.0, 0.0)])
    assert views.shown_well(behind, one).tolist() == [True, False, False]  # (2 / 4.9)^2 = 0.17, (2 / 5.5)^2 = 0.13
    # Pointed at what is 3 away, it shows places up to 3 / sqrt(0.15) = 7.7 away well.
    farther = np.array([(-5.5, 0.0, 0.0), (-6.0, 0.0, 0.0)])
    assert views.shown_well(farther, 1.5 * one).tolist() == [True, False]
    assert views.shown_well(places, np.full(8, np.nan)).all()
