"""Loss that keeps the surface flat in plain areas of photographs, in which no depth is known."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from thermoxels_ns.core.arrays import BoolArray, IntArray
from thermoxels_ns.multiview.backdrop import even_pixels
from thermoxels_ns.multiview.photographs import Photographs
from thermoxels_ns.render.ray_render import RayRequest

REACH = 64  # Largest distance of the middle pixel of three from the outer ones, [pixels]
ALIKE = 0.06  # Largest difference of a channel between the middle pixel of three and the outer ones, of 1


class PlainAreas:
    """Sampler of threes of pixels, in a row or column and equally far apart, in areas without texture.

    All pixels between the three are without texture. The middle pixel shows neither a sure depth nor a backdrop. The
    outer pixels may lie on the rim of the plain area, where depths are known. ``len`` is the number of middle pixels.

    Args:
        photographs: Pinhole photographs.
        known: True for pixels with a sure depth, shape (pixels,).
        backdrop: True for pixels that show a plain backdrop, shape (pixels,).
    """

    def __init__(self, photographs: Photographs, known: BoolArray, backdrop: BoolArray) -> None:
        self._photographs, self._backdrop = photographs, backdrop
        found = []
        for (width, height), first in zip(photographs.sizes.tolist(), photographs.firsts.tolist()):
            pixels, shape = slice(first, first + width * height), (height, width)
            plain = even_pixels(photographs.colours[pixels].reshape(*shape, 3)) & ~backdrop[pixels].reshape(shape)
            open_to = plain & ~known[pixels].reshape(shape)
            for apart, step in ((_even_around(plain), 1), (_even_around(plain.T).T, width)):
                farthest = np.minimum(np.where(open_to, apart, 0), REACH).ravel()
                (at,) = np.nonzero(farthest)
                found.append(np.stack((first + at, farthest[at], np.full(len(at), step))))
        self._middle, self._farthest, self._step = np.concatenate(found, axis=1)

    def __len__(self) -> int:
        return len(self._middle)

    def request(
        self, count: int, near: float, generator: torch.Generator, device: torch.device
    ) -> tuple[RayRequest, Float[Tensor, " rays"]]:
        """Return rays through n <= `count` random threes of pixels, (3 n,), and their lengths to depth 1, (3 n,).

        The outer pixels of one side come first, then all middle pixels, then the other side. The rays want neither
        colour nor temperature. The logarithms of distances between pixels are uniform. Threes whose colours differ by
        more than `ALIKE`, or whose pixels show the backdrop, are left out. `near` is in world units; `generator` must
        be on the CPU.
        """
        chosen = torch.randint(len(self._middle), (count,), generator=generator).numpy()
        share = torch.rand(count, generator=generator).numpy()
        apart = np.rint(self._farthest[chosen] ** share).astype(np.int64) * self._step[chosen]
        three = self._middle[chosen] + np.array([[-1], [0], [1]]) * apart
        colours = self._photographs.colours[three]
        three = three[:, (np.abs(colours - colours[1]) <= ALIKE).all(axis=(0, 2)) & ~self._backdrop[three].any(axis=0)]
        origins, along = self._photographs.of_pixels(three.ravel())
        length = np.linalg.norm(along, axis=1)
        arrays = origins, along / length[:, None], length
        origins, directions, length = (torch.from_numpy(values).float().to(device) for values in arrays)
        nothing = torch.zeros(len(length), dtype=torch.bool, device=device)
        return RayRequest(origins, directions, near, None, nothing, nothing), length


def _even_around(even: BoolArray) -> IntArray:
    """Return for each pixel the largest n for which all pixels up to n - 1 columns left and right are even, (h, w)."""
    column, last = np.arange(even.shape[1]), even.shape[1] - 1
    left = column - np.maximum.accumulate(np.where(even, -1, column), axis=1)
    right = np.minimum.accumulate(np.where(even, last + 1, column)[:, ::-1], axis=1)[:, ::-1] - column
    return np.minimum(np.minimum(left, right), np.minimum(column, last - column))


def bend_loss(
    depth: Float[Tensor, " rays"], opacity: Float[Tensor, " rays"], length: Float[Tensor, " rays"], voxel_size: float
) -> Float[Tensor, ""]:
    """Return the mean over threes of pixels of sqrt(1 + x^2) - 1, where x is how far the surface bends, [voxels].

    x is the distance along the middle ray between the surface and the straight line through the surface at the outer
    pixels; on a plane, inverse depth is linear in the image. Threes with a ray of opacity below one half count 0.

    Args:
        depth: Distance along each ray to the surface, [world units], in the order of `PlainAreas.request`.
        opacity: Opacity of each ray.
        length: Length of each ray to depth 1, second result of `PlainAreas.request`.
        voxel_size: Edge of a voxel, [world units].
    """
    solid = (opacity.detach().view(3, -1) > 0.5).all(dim=0)
    distance, length = depth.view(3, -1)[:, solid], length.view(3, -1)[:, solid]
    first, _, last = length / distance
    off = (2.0 * length[1] / (first + last) - distance[1]) / voxel_size
    return (torch.sqrt(off * off + 1.0) - 1.0).sum() / max(1, solid.numel())
