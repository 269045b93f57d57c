"""Voxels to fill in bodies of which only the shell was reconstructed: cavities, hidden space, walls."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import numpy as np
from scipy import fft, ndimage
from scipy.spatial import KDTree

from thermoxels_ns.core.arrays import BoolArray, Float32Array
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import Views
from thermoxels_ns.mesh.solid.free_space import count_cameras
from thermoxels_ns.mesh.solid.morphology import close_gaps, connected, convex_hull, grow

LARGEST_PASS = 4_000_000  # in larger lattices, hidden space is found per block of 2^3, 4^3, ... voxels
SHADOW_SURROUNDED = 0.15
"""Least winding number of the seen surfaces at which voxels hidden by the shell count as inside. The number is up to
one half behind a surface seen from one side only, and at most 0 in the shadow before a wall. Chosen among 0.1, 0.12,
0.15, 0.2, 0.3 and 0.5 on facade, street, wild-2 and wild-14: a smaller number fills the space between separate bodies,
a larger one leaves them hollow behind surfaces seen from one side, as of a facade. Tried on 22 other scenes beside the
rules that went with it: F changed by -0.002 to 0.009."""
STRAY_SHARE = 0.005  # share of a body's voxels on each side, in the outermost layers, that may be strays
_fast_length = cast(Callable[[int], int], fft.next_fast_len)
MARGIN = 0.25  # the winding number is set to 0 at this share of the lattice's size outside the lattice, on each side
THINNEST_GROWN = 1.5
"""Least thickness of a wall that gets voxels behind the seen one, [voxels]: the next voxel's middle is this deep."""


def interior(
    cells: BoolArray, lattice: Lattice, views: Views | None, seal: int, within: BoolArray | None = None
) -> BoolArray:
    """Return a mask of the empty voxels inside bodies of which only the shell `cells` was reconstructed.

    First, openings of the shell up to twice `seal` voxels wide are closed; voxels that then touch are one body. A voxel
    is inside if it is in a cavity: empty space without a camera and without a way out through voxel faces. If cameras
    are known (`views`), a voxel of a body's convex hull is also inside if it lies in a camera's image, the shell hides
    it from cameras (`count_cameras`), and the backs of seen surfaces surround it (`SHADOW_SURROUNDED`).

    The result is restricted to the region `within` (None: everywhere); solid outside it still blocks the view.
    """
    sealed, within = close_gaps(cells, seal), np.ones_like(cells) if within is None else within
    inside, room = _enclosed(cells, sealed, lattice, views, seal)
    if views is not None and len(views.focal):
        inside |= _hidden(sealed, within, lattice, views) & ~cells
        # Cavities that the filled space encloses are inside as well.
        inside |= cavities(cells | inside, room | camera_voxels(cells, lattice, views))[0]
    return inside & within


def _enclosed(
    cells: BoolArray, sealed: BoolArray, lattice: Lattice, views: Views | None, seal: int
) -> tuple[BoolArray, BoolArray]:
    """Return two masks, cavities without and with a camera, of the shell `cells` and of the `sealed` shell together."""
    everywhere = np.ones((3, 3, 3), dtype=bool)
    cameras = camera_voxels(cells, lattice, views)
    # Sealing closes alcoves and corridors of a cavity, where cameras may stand: cameras are grown by the same width.
    if seal and cameras.any():
        cameras = np.asarray(ndimage.binary_dilation(cameras, everywhere, iterations=2 * seal, mask=~cells), dtype=bool)
    cavity, room = cavities(cells, cameras)
    if seal:
        wide, wide_room = cavities(sealed, cameras)
        room |= wide_room
        if wide.any():
            # Sealing also fills corners and openings of a cavity; the filled voxels belong to the cavity.
            taken = wide | (sealed & ~cells)
            wide = np.asarray(ndimage.binary_dilation(wide, everywhere, iterations=2 * seal, mask=taken), dtype=bool)
        cavity = (cavity | wide) & ~room
    return cavity, room


def camera_voxels(cells: BoolArray, lattice: Lattice, views: Views | None) -> BoolArray:
    """Return the voxels in which cameras stand, shape of `cells`; none if `views` is None."""
    cameras = np.zeros_like(cells)
    if views is not None:
        at = np.floor(lattice.world_to_index(views.camera_to_world[:, :, 3])).astype(np.int64)
        cameras[tuple(at[np.all((at >= 0) & (at < cells.shape), axis=1)].T)] = True
    return cameras


def cavities(shell: BoolArray, cameras: BoolArray) -> tuple[BoolArray, BoolArray]:
    """Return two masks: voxels of cavities without a camera, and of cavities with one (a voxel True in `cameras`).

    A cavity is a connected set of empty voxels without a way out of the lattice through voxel faces.
    """
    labels = connected(np.pad(~shell, 1, constant_values=True), connectivity=1)
    kept = np.ones(int(labels.max()) + 1, dtype=bool)
    kept[[0, labels[0, 0, 0]]] = False
    labels = labels[1:-1, 1:-1, 1:-1]
    rooms = np.zeros_like(kept)
    rooms[labels[cameras]] = True
    rooms &= kept
    return (kept & ~rooms)[labels], rooms[labels]


def _hidden(sealed: BoolArray, within: BoolArray, lattice: Lattice, views: Views) -> BoolArray:
    """Return a mask of voxels in a body's convex hull that no camera sees and that seen surfaces surround."""
    block = 1
    while sealed.size > LARGEST_PASS * block**3:
        block *= 2
    if block > 1:
        return _hidden_in_blocks(sealed, within, lattice, views, block)
    # The convex hull of every body is taken without its strays.
    labels, hull = connected(sealed & within), np.zeros_like(sealed)
    for number, box in enumerate(ndimage.find_objects(labels), start=1):
        hull[box] |= convex_hull(_without_strays(labels[box] == number))
    if not (hull & ~sealed).any():
        return np.zeros_like(hull)
    counts = count_cameras(sealed, lattice, views)
    return counts.hidden & hull & (winding_number(sealed, counts.seen & ~sealed) >= SHADOW_SURROUNDED)


def _hidden_in_blocks(sealed: BoolArray, within: BoolArray, lattice: Lattice, views: Views, block: int) -> BoolArray:
    """Return the result of `_hidden` at lower resolution, with one answer for each block of `block`^3 voxels."""
    shape = sealed.shape
    padded = np.pad((sealed, within), [(0, 0), *((0, -n % block) for n in shape)])
    cx, cy, cz = (n // block for n in padded.shape[1:])
    coarse, coarse_within = padded.reshape(2, cx, block, cy, block, cz, block).any(axis=(2, 4, 6))
    coarse_lattice = Lattice(lattice.lo, lattice.voxel_size * block, (cx + 1, cy + 1, cz + 1))
    hidden = _hidden(coarse, coarse_within, coarse_lattice, views)

    # The empty voxels of a block with a piece of the shell are inside if they are connected to a hidden block.
    inside = tuple(slice(n) for n in shape)
    voxels = np.ones((block, block, block), dtype=bool)
    seeds, partly = np.kron(hidden & ~coarse, voxels)[inside], np.kron(coarse, voxels)[inside] & ~sealed
    touching = ndimage.generate_binary_structure(3, 1)
    # The longest connection is in a corner of the shell: across the block along all three axes.
    inner = ndimage.binary_dilation(seeds, touching, iterations=3 * (block - 1), mask=partly)
    return np.logical_or(seeds, inner)


def _without_strays(body: BoolArray) -> BoolArray:
    """Return a body without strays: the outermost layers on each side that hold at most `STRAY_SHARE` of its voxels."""
    most, kept = STRAY_SHARE * np.count_nonzero(body), body
    for axis in range(3):
        layers = np.count_nonzero(body, axis=tuple(other for other in range(3) if other != axis))
        inner = (np.cumsum(layers) > most) & (np.cumsum(layers[::-1])[::-1] > most)
        kept = kept & np.expand_dims(inner, tuple(other for other in range(3) if other != axis))
    return kept


def winding_number(solid: BoolArray, air: BoolArray) -> Float32Array:
    """Return at each voxel the generalised winding number of the surface of all faces between `solid` and `air`.

    The number is 1 inside a closed surface and 0 outside; it changes gradually through a hole in the surface. Faces of
    a voxel that is neither solid nor air do not belong to the surface. For triangles see Jacobson, Kavan and
    Sorkine-Hornung 2013, Robust inside-outside segmentation using generalized winding numbers, equation 5. The number w
    jumps by one across the surface and is harmonic elsewhere: Lap w = div J with the jumps J (by sine transforms).
    """
    # The lattice is padded to lengths for which the transforms are fast, and lies about in the middle.
    lengths = [_fast_length(int(np.ceil((1.0 + 2.0 * MARGIN) * n)) + 3) - 1 for n in solid.shape]
    before = [(length - n) // 2 for length, n in zip(lengths, solid.shape)]
    pads = [(b, length - n - b) for b, length, n in zip(before, lengths, solid.shape)]
    side, sources = np.pad(solid.astype(np.int8) - air.astype(np.int8), pads), np.zeros(lengths, dtype=np.float32)
    for axis in range(3):
        row, source = np.moveaxis(side, axis, 0), np.moveaxis(sources, axis, 0)
        jump = np.where(row[:-1] * row[1:] == -1, row[:-1], 0)  # to the next voxel: 1 for solid before air, else -1
        source[:-1] += jump
        source[1:] -= jump
    waves = np.asarray(fft.dstn(sources, type=1, overwrite_x=True), dtype=np.float32)
    stiffness = [2.0 - 2.0 * np.cos(np.pi * np.arange(1, n + 1) / (n + 1)) for n in lengths]
    waves /= np.add.outer(np.add.outer(stiffness[0], stiffness[1]), stiffness[2]).astype(np.float32)
    winding = np.asarray(fft.idstn(waves, type=1, overwrite_x=True), dtype=np.float32)
    return winding[tuple(slice(b, b + n) for b, n in zip(before, solid.shape))]


def wall_behind(cells: BoolArray, lattice: Lattice, views: Views, thickness: float) -> BoolArray:
    """Return a mask of empty voxels that, added behind seen surfaces, make these walls of a `thickness`, [voxels].

    An empty voxel is added if its middle lies within the thickness behind the outer face of the nearest solid voxel
    that enough cameras see, and every voxel on the straight line between the two is solid or not seen. The thickness
    includes the seen voxel. A plate that is seen from both sides does not grow.
    """
    added = np.zeros_like(cells)
    # The middle of a surface voxel lies half a voxel below its face, so this is how far from it other middles may be.
    reach = thickness - 0.5
    seen = count_cameras(cells, lattice, views).seen
    surface = np.argwhere(cells & seen & grow(seen & ~cells, 1))
    if thickness < THINNEST_GROWN or len(surface) == 0:
        return added
    closed = ~seen | cells
    near = np.zeros_like(cells)
    near[tuple(surface.T)] = True
    candidates = np.argwhere(grow(near, int(reach)) & closed & ~cells)
    distance, nearest = KDTree(surface).query(candidates, distance_upper_bound=reach + 1e-6)
    found = np.isfinite(distance)
    candidates, start = candidates[found], surface[np.asarray(nearest)[found]]
    free = np.ones(len(candidates), dtype=bool)
    steps = int(np.ceil(2.0 * reach))
    for step in range(1, steps):
        share = step / steps
        between = np.rint(start + share * (candidates - start)).astype(np.int64)
        free &= closed[tuple(between.T)]
    added[tuple(candidates[free].T)] = True
    return added
