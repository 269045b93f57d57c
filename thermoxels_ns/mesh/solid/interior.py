"""The inside of bodies: cavities, space that no camera sees, walls behind seen surfaces."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import numpy as np
import numpy.typing as npt
from scipy import fft, ndimage
from scipy.spatial import KDTree

from thermoxels_ns.core.arrays import BoolArray, Float32Array
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import Views
from thermoxels_ns.mesh.solid.free_space import count_cameras
from thermoxels_ns.mesh.solid.morphology import close_gaps, connected, convex_hull, face_connected, grow, repeated

LARGEST_PASS = 4_000_000  # lattices with more voxels than this are looked at in blocks of 2^3, 4^3, ... voxels.
SHADOW_SURROUNDED = 0.1
"""Space that the shell itself hides is inside only if seen surfaces surround it at least this far, as a winding number:
behind a surface seen from one side only it is up to one half; in the shadow before a wall it is 0 or less."""
CREVICE_SURROUNDED = 0.3  # the same for space that only the filled inside hides
STRAY_SHARE = 0.005
"""Share of a body's solid voxels, strays, that may lie beyond each side of the box that bounds its hull."""
_fast_length = cast(Callable[[int], int], fft.next_fast_len)
MARGIN = 0.25  # the potential is zero this share of the lattice's size beyond it, on each side
THINNEST_GROWN = 1.5
"""A wall thinner than this has the middle of no voxel behind the seen one, so none is added, [voxels]."""


@dataclass(frozen=True)
class Interior:
    """Empty voxels that lie inside a solid."""

    enclosed: BoolArray  # voxels of cavities: no way out through voxel faces, and no camera in them
    hidden: BoolArray
    """Other voxels that cameras cannot look into, behind the surface and within the convex hull of a body."""
    rooms: int  # cavities left empty because a camera stands in them


def interior(
    cells: BoolArray, lattice: Lattice, views: Views | None, seal: int, within: BoolArray | None = None
) -> Interior:
    """Find the inside, apart from `cells`, of bodies of which only a shell was reconstructed.

    Only what lies `within` a region is filled; what stands beside it still hides. A body is what touches once openings
    of up to twice `seal` voxels are closed. Its inside are cavities of the sealed shell and, if the cameras are known,
    the space within its convex hull that they should see but do not, because the shell stands in front of it
    (`free_space`), and that the backs of seen surfaces surround (`winding_number`). Lines of sight through holes of the
    shell then end at what was filled, and crevices that are hidden now are filled where surfaces surround them well.
    """
    sealed, within = close_gaps(cells, seal), np.ones_like(cells) if within is None else within
    enclosed, room = _enclosed(cells, sealed, lattice, views, seal)
    rooms = int(face_connected(room).max()) if room.any() else 0
    if views is None or len(views.focal) == 0:
        return Interior(enclosed & within, np.zeros_like(cells), rooms)
    hidden = _hidden(sealed, within, lattice, views, seal) & ~cells & ~enclosed
    # What the filled space now encloses is as much inside as the rest.
    cavity, _ = _cavities(cells | enclosed | hidden, room | _camera_voxels(cells, lattice, views))
    return Interior(enclosed & within, (hidden | cavity) & within, rooms)


def _enclosed(
    cells: BoolArray, sealed: BoolArray, lattice: Lattice, views: Views | None, seal: int
) -> tuple[BoolArray, BoolArray]:
    """Return the cavities without a camera, of the shell and of the sealed shell, and those with one."""
    everywhere = np.ones((3, 3, 3), dtype=bool)
    cameras = _camera_voxels(cells, lattice, views)
    # Sealing takes the alcoves and corridors of a cavity, where cameras may stand as well.
    if seal and cameras.any():
        cameras = np.asarray(ndimage.binary_dilation(cameras, everywhere, iterations=2 * seal, mask=~cells), dtype=bool)
    cavity, room = _cavities(cells, cameras)
    if seal:
        wide, wide_room = _cavities(sealed, cameras)
        room |= wide_room
        if wide.any():
            # It also rounds corners off and plugs openings; both belong to the cavity.
            taken = wide | (sealed & ~cells)
            wide = np.asarray(ndimage.binary_dilation(wide, everywhere, iterations=2 * seal, mask=taken), dtype=bool)
        cavity = (cavity | wide) & ~room
    return cavity, room


def _camera_voxels(cells: BoolArray, lattice: Lattice, views: Views | None) -> BoolArray:
    cameras = np.zeros_like(cells)
    if views is not None:
        at = np.floor(lattice.world_to_index(views.camera_to_world[:, :, 3])).astype(np.int64)
        cameras[tuple(at[np.all((at >= 0) & (at < cells.shape), axis=1)].T)] = True
    return cameras


def _cavities(shell: BoolArray, cameras: BoolArray) -> tuple[BoolArray, BoolArray]:
    """Return the empty voxels without a way out through voxel faces, in cavities without a camera and with one."""
    labels = face_connected(np.pad(~shell, 1, constant_values=True))
    kept = np.ones(int(labels.max()) + 1, dtype=bool)
    kept[[0, labels[0, 0, 0]]] = False
    labels = labels[1:-1, 1:-1, 1:-1]
    rooms = np.zeros_like(kept)
    rooms[labels[cameras]] = True
    rooms &= kept
    return (kept & ~rooms)[labels], rooms[labels]


def _hidden(sealed: BoolArray, within: BoolArray, lattice: Lattice, views: Views, seal: int) -> BoolArray:
    """Return the voxels that are not seen, behind the surface and within the convex hull of a body."""
    block = 1
    while sealed.size > LARGEST_PASS * block**3:
        block *= 2
    if block > 1:
        return _hidden_in_blocks(sealed, within, lattice, views, seal, block)
    # The convex hull of every body, strays of which do not count.
    labels, hull = connected(sealed & within), np.zeros_like(sealed)
    for number, box in enumerate(ndimage.find_objects(labels), start=1):
        hull[box] |= convex_hull(_without_strays(labels[box] == number))
    if not (hull & ~sealed).any():
        return np.zeros_like(hull)
    shadow = _behind(sealed, lattice, views, SHADOW_SURROUNDED) & hull
    crevices = _behind(close_gaps(sealed | shadow, seal), lattice, views, CREVICE_SURROUNDED) & hull
    return shadow | crevices


def _behind(cells: BoolArray, lattice: Lattice, views: Views, surrounded: float) -> BoolArray:
    """Return the voxels that are not seen and whose winding number in seen surfaces is at least `surrounded`."""
    counts = count_cameras(cells, lattice, views)
    return counts.hidden & (winding_number(cells, counts.seen & ~cells) >= surrounded)


def _hidden_in_blocks(
    sealed: BoolArray, within: BoolArray, lattice: Lattice, views: Views, seal: int, block: int
) -> BoolArray:
    """Return what `_hidden` does, with one answer for a block of voxels."""
    shape = sealed.shape
    padded = np.pad((sealed, within), [(0, 0), *((0, -n % block) for n in shape)])
    cx, cy, cz = (n // block for n in padded.shape[1:])
    coarse, coarse_within = padded.reshape(2, cx, block, cy, block, cz, block).any(axis=(2, 4, 6))
    coarse_lattice = Lattice(lattice.lo, lattice.voxel_size * block, (cx + 1, cy + 1, cz + 1))
    hidden = _hidden(coarse, coarse_within, coarse_lattice, views, seal // block)

    # A block that holds a piece of the shell has an inner and an outer side; its empty voxels go with what they touch.
    inside = tuple(slice(n) for n in shape)
    seeds, partly = repeated(hidden & ~coarse, block)[inside], repeated(coarse, block)[inside] & ~sealed
    touching = ndimage.generate_binary_structure(3, 1)
    # In a corner of the shell the way is longest: across the block along all three axes.
    inner = ndimage.binary_dilation(seeds, touching, iterations=3 * (block - 1), mask=partly)
    return np.logical_or(seeds, inner)


def _without_strays(body: BoolArray) -> BoolArray:
    """Return a body without the outermost layers that hold at most `STRAY_SHARE` of its voxels, on each side."""
    most, kept = STRAY_SHARE * np.count_nonzero(body), body
    for axis in range(3):
        layers = np.count_nonzero(body, axis=tuple(other for other in range(3) if other != axis))
        inner = (np.cumsum(layers) > most) & (np.cumsum(layers[::-1])[::-1] > most)
        kept = kept & np.expand_dims(inner, tuple(other for other in range(3) if other != axis))
    return kept


def winding_number(solid: BoolArray, air: BoolArray) -> Float32Array:
    """Return the winding number of each voxel in the voxel faces between solid and air, taken from their back.

    It is 1 within a closed surface and 0 outside of it; where the surface has a hole, one half is a film across it.
    Faces with solid on both sides, or next to voxels that are neither, are no surface. For triangles see Jacobson,
    Kavan and Sorkine-Hornung 2013, Robust inside-outside segmentation using generalized winding numbers, equation 5.
    Here it is the function that jumps by one across the surface and is harmonic elsewhere: Lap w = div J with the jumps
    J, solved by sine transforms in blocks of 2^3 voxels.
    """
    shape = solid.shape
    # Lengths for which the transforms are fast, with the lattice about in the middle.
    blocks = [_fast_length(int(np.ceil((0.5 + MARGIN) * n)) + 3) - 1 for n in shape]
    before = [(count - (n + 1) // 2) // 2 for count, n in zip(blocks, shape)]
    pads = [(2 * b, 2 * count - n - 2 * b) for b, count, n in zip(before, blocks, shape)]
    side = np.pad(solid.astype(np.int8) - air.astype(np.int8), pads)
    sources = np.zeros(blocks, dtype=np.float32)
    for axis in range(3):
        jumps = _jumps(side, axis)
        sources += jumps
        np.moveaxis(sources, axis, 0)[1:] -= np.moveaxis(jumps, axis, 0)[:-1]
    waves = np.asarray(fft.dstn(sources, type=1, overwrite_x=True), dtype=np.float32)
    stiffness = [2.0 - 2.0 * np.cos(np.pi * np.arange(1, n + 1) / (n + 1)) for n in blocks]
    waves /= np.add.outer(np.add.outer(stiffness[0], stiffness[1]), stiffness[2]).astype(np.float32)
    winding = np.asarray(fft.idstn(waves, type=1, overwrite_x=True), dtype=np.float32)
    winding = winding[tuple(slice(b, b + (n + 1) // 2) for b, n in zip(before, shape))]
    return repeated(winding, 2)[tuple(slice(n) for n in shape)]


def _jumps(side: npt.NDArray[np.int8], axis: int) -> Float32Array:
    """Return the jump from each block to the next along an axis: 1 where solid is before air, -1 air before solid."""
    # A face in the middle of a block counts half at each of the block's ends.
    row, jump = np.moveaxis(side, axis, 0), np.zeros_like(side)
    np.moveaxis(jump, axis, 0)[:-1] = np.where(row[:-1] * row[1:] == -1, row[:-1], 0)
    nx, ny, nz = (n // 2 for n in side.shape)
    others = tuple(2 * other + 1 for other in range(3) if other != axis)
    pairs = jump.reshape(nx, 2, ny, 2, nz, 2).sum(axis=others, dtype=np.float32) * np.float32(0.25)
    middle, end = np.moveaxis(pairs, axis + 1, 0)
    total = end + 0.5 * middle
    np.moveaxis(total, axis, 0)[:-1] += 0.5 * np.moveaxis(middle, axis, 0)[1:]
    return total


def wall_behind(cells: BoolArray, lattice: Lattice, views: Views, thickness: float) -> BoolArray:
    """Find the empty voxels that make the seen surface as thick as a wall, the seen voxel included, [voxels].

    An empty voxel joins if it lies within the thickness of solid voxels that enough cameras see, counted from their
    outer faces, on the straight way through space that is solid or not seen. A plate that is seen from both sides does
    not grow.
    """
    added = np.zeros_like(cells)
    # The middle of a surface voxel lies half a voxel below its face, that of the last one half a voxel before the end.
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
