"""Plain areas of photographs, in which no depth is known, get the flattest surface that photographs allow."""

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
    """Areas without texture, in which it draws three pixels in a row or column, equally far apart.

    All pixels between the three are without texture. The middle pixel shows neither a sure depth nor a backdrop. The
    outer ones may lie on the rim of the plain area, where depths are known.

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
        """Return the rays through at most `count` threes of pixels, and their lengths at depth 1 in the photograph.

        The outer pixels of one side come first, then all middle ones, then the other side: (3 n,) rays, which want
        neither colour nor temperature. Distances between pixels are drawn evenly by their logarithms. Threes whose
        colours differ, or whose outer pixels show the backdrop, are left out. `near` is in world units; the generator
        is on the CPU.
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
    """Return the largest n, (h, w), for which the pixels up to n - 1 columns left and right of a pixel are all even."""
    column, last = np.arange(even.shape[1]), even.shape[1] - 1
    left = column - np.maximum.accumulate(np.where(even, -1, column), axis=1)
    right = np.minimum.accumulate(np.where(even, last + 1, column)[:, ::-1], axis=1)[:, ::-1] - column
    return np.minimum(np.minimum(left, right), np.minimum(column, last - column))


def bend_loss(
    depth: Float[Tensor, " rays"], opacity: Float[Tensor, " rays"], length: Float[Tensor, " rays"], voxel_size: float
) -> Float[Tensor, ""]:
    """Return how far the surface is from flat on threes of pixels: the mean of sqrt(1 + x^2) - 1, [voxels].

    On a plane the inverse depth is linear in the image. x is the distance, [voxels], from the surface at the middle
    pixel to where the line between the outer ones meets its ray. Threes with a ray of opacity below one half count 0.

    Args:
        depth: Distance along each ray to the surface, [world units], in the order of `PlainAreas.request`.
        opacity: Opacity of each ray.
        length: Distance along each ray to depth 1 in the photograph.
        voxel_size: Edge of a voxel, [world units].
    """
    solid = (opacity.detach().view(3, -1) > 0.5).all(dim=0)
    distance, length = depth.view(3, -1)[:, solid], length.view(3, -1)[:, solid]
    first, _, last = length / distance
    off = (2.0 * length[1] / (first + last) - distance[1]) / voxel_size
    return (torch.sqrt(off * off + 1.0) - 1.0).sum() / max(1, solid.numel())
