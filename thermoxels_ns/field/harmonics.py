"""Real spherical harmonics up to degree 2, for view-dependent colour and low-order sky functions."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

MAX_DEGREE = 2

_Y00 = 0.28209479177387814  # 1 / (2 sqrt(pi))
_Y1 = 0.4886025119029199  # sqrt(3 / (4 pi))
_Y2_OFF = 1.0925484305920792  # sqrt(15 / (4 pi))
_Y20 = 0.31539156525252005  # sqrt(5 / (16 pi))
_Y22 = 0.5462742152960396  # sqrt(15 / (16 pi))


def num_coefficients(degree: int) -> int:
    """Return the number of harmonics of degree 0 to `degree`: (degree + 1)^2.

    >>> num_coefficients(2)
    9
    """
    assert 0 <= degree <= MAX_DEGREE
    return (degree + 1) ** 2


def harmonics(directions: Float[Tensor, "n 3"], degree: int) -> Float[Tensor, "n k"]:
    """Return the orthonormal real spherical harmonics of degree 0 to `degree` at unit directions, (n, k).

    Order and signs are those of Plenoxels (Fridovich-Keil et al. 2022): l = 0; l = 1 as -y, z, -x;
    l = 2 as xy, -yz, 3z^2 - 1, -xz, x^2 - y^2, each with its normalising constant.
    """
    num_coefficients(degree)
    x, y, z = directions.unbind(-1)
    basis = [torch.full_like(x, _Y00)]
    if degree >= 1:
        basis += [-_Y1 * y, _Y1 * z, -_Y1 * x]
    if degree >= 2:
        basis += [_Y2_OFF * x * y, -_Y2_OFF * y * z, _Y20 * (3 * z * z - 1), -_Y2_OFF * x * z, _Y22 * (x * x - y * y)]
    return torch.stack(basis, -1)


def harmonics_with_unit_mean(directions: Float[Tensor, "n 3"], degree: int) -> Float[Tensor, "n k"]:
    """Return `harmonics` / Y00: the first harmonic is 1, so a sum's first coefficient is its mean over directions."""
    return harmonics(directions, degree) / _Y00
