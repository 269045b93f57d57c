"""Which photographs agree that a surface lies where it is said to lie."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.feature_rays import FeatureRays
from thermoxels_ns.core.kernel_cache import kernel
from thermoxels_ns.core.threads import run_ranges
from thermoxels_ns.multiview.photographs import Photographs

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

MOST_COMPARED = 12  # Photographs compared at a place; of more, as many taken evenly from their list
STEEPEST_COSINE = 0.25  # A photograph that looks at a surface under a smaller cosine to its normal is not compared
RADIUS = 3  # Samples from the middle of a square patch to its sides
SPACING = 0.5  # Distance between samples, [voxels]; that of the photographs' pixels where that is more
NEAR, FAR = (-1.5, -1.0, -0.5, 0.0, 0.5, 1.0, 1.5), (-4.0, -3.5, -3.0, 3.0, 3.5, 4.0)
"""How far out of the surface the patch is tried, [voxels]: where it is said to lie, and where it is not."""
LEAST_CORRELATION = 0.8  # Correlation from which two photographs show the same
LEAST_DROP = 0.1  # By how much it must fall from the surface to `FAR`: what looks alike at all distances has no place
NOISE = 2.0 / 255.0  # Standard deviation of brightness within a patch that is noise
TRACK_REACH = 1.5  # Distance from a surface up to which a track's point lies on it, [voxels]

_SHIFTS, _NUM_NEAR = np.array(NEAR + FAR), len(NEAR)
_SIDE = 2 * RADIUS + 1
_LEVELS = 5
_NOTHING, _PLAIN, _TEXTURE = 0, 1, 2
"""What a photograph shows of a patch: not all of it, nothing but noise, or more."""


def supporting_photographs(
    photographs: Photographs,
    middle: FloatArray,
    normal: FloatArray,
    seen: BoolArray,
    voxel_size: float,
    tracks: FeatureRays | None = None,
) -> BoolArray:
    """Tell which photographs show, by texture and parallax or by a track, that a surface lies at given places.

    At each place a square patch is laid along the surface and moved along its normal, in steps of half a voxel within
    `NEAR`, and to `FAR`. Of each photograph that sees the place not too obliquely, what it shows of the patch is read
    (bilinear, from the picture averaged down until its pixels are as large as the distance between samples). The shift
    at which the correlations (normalised, zero mean) of all pairs from `LEAST_CORRELATION` on have the largest sum is
    where photographs put the surface. If that is within `NEAR`, two photographs agree that correlate there at least so
    well, and by `LEAST_DROP` better than anywhere in `FAR`. Three that agree with each other support the surface, and
    where there are no three, the two that agree best (many pairs are compared, and some agree by chance). So a plain
    wall, an edge along the line between two cameras and photographs from one place tell nothing, and a surface that
    hangs in free space is refuted.

    A photograph supports too what it sees within `TRACK_REACH` of a track's point that it saw.

    Args:
        photographs: Pinhole photographs, best some 400 pixels wide; NaN where masked.
        middle: Places, shape (g, 3), [world units].
        normal: Unit normals of the surface there, shape (g, 3).
        seen: Whether each photograph sees each place, shape (g, photographs).
        voxel_size: Edge of a voxel, [world units].
        tracks: Lines from photographs to points, in the same world.

    Returns:
        Whether each photograph supports each place, only where it sees it, shape (g, photographs).
    """
    brightness, firsts, sizes = _pyramids(photographs)
    focal = np.sqrt(np.abs(np.linalg.det(photographs.matrices[:, :, :3])))
    result = np.zeros(seen.shape, dtype=np.bool_)
    places = [np.ascontiguousarray(values) for values in (middle, normal, seen)]
    cameras = (photographs.matrices, photographs.centres, focal, brightness, firsts, sizes)

    def work(begin: int, end: int) -> None:
        _compare(begin, end, *places, *cameras, _SHIFTS * voxel_size, SPACING * voxel_size, result)

    run_ranges(work, len(middle), 256)
    if tracks is not None and len(tracks.point) and len(middle):
        result |= _by_tracks(tracks, photographs.centres, middle, TRACK_REACH * voxel_size)
    return result & seen


def _pyramids(photographs: Photographs) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Brightness of all photographs averaged down by 1, 2, 4, ..., and first pixel and size of each such picture."""
    pictures, sizes = [], []
    for first, (width, height) in zip(photographs.firsts, photographs.sizes):
        picture = photographs.colours[first : first + width * height].mean(axis=1).reshape(height, width)
        for _ in range(_LEVELS):
            pictures.append(np.ascontiguousarray(picture, dtype=np.float32).ravel())
            sizes.append(picture.shape[::-1])
            size = tuple(max(1, side // 2) for side in picture.shape[::-1])
            picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA))
    firsts = np.concatenate(([0], np.cumsum([picture.size for picture in pictures])[:-1]))
    return np.concatenate(pictures), firsts.reshape(-1, _LEVELS), np.array(sizes).reshape(-1, _LEVELS, 2)


def _by_tracks(tracks: FeatureRays, centres: FloatArray, middle: FloatArray, reach: float) -> BoolArray:
    """Which photographs have a line to a point within `reach` of each place, shape (g, photographs)."""
    from scipy.spatial import KDTree  # slow to import and only needed here

    off, photograph = KDTree(centres).query(tracks.origins)
    own = np.asarray(off) <= 1e-3 * reach
    near = KDTree(middle).query_ball_point(tracks.points, reach)
    count = np.array([len(places) for places in near])[tracks.point[own]]
    found = np.zeros((len(middle), len(centres)), dtype=np.bool_)
    places = [place for point in tracks.point[own] for place in near[point]]
    found[np.array(places, dtype=np.int64), np.repeat(np.asarray(photograph)[own], count)] = True
    return found


@kernel(fastmath={"contract", "reassoc"})
def _read(brightness, first, sizes, level, matrix, frame, spacing, local, patch):
    """Fill a patch with what a picture shows of it, at mean 0 and length 1; say how much: see `_NOTHING`.

    `frame` holds the patch's middle and two directions in the world, `local` is for the same in pixels.
    """
    width, height = sizes[level]
    scale_x, scale_y = width / sizes[0, 0], height / sizes[0, 1]
    for i in range(3):
        for j in range(3):
            local[i, j] = matrix[i, 0] * frame[j, 0] + matrix[i, 1] * frame[j, 1] + matrix[i, 2] * frame[j, 2]
        local[i, 0] += matrix[i, 3]
    total, k = 0.0, 0
    for i in range(-RADIUS, RADIUS + 1):
        for j in range(-RADIUS, RADIUS + 1):
            s, t = i * spacing, j * spacing
            depth = local[2, 0] + s * local[2, 1] + t * local[2, 2]
            if depth <= 0.0:
                return _NOTHING
            column = (local[0, 0] + s * local[0, 1] + t * local[0, 2]) / depth * scale_x - 0.5
            row = (local[1, 0] + s * local[1, 1] + t * local[1, 2]) / depth * scale_y - 0.5
            if not (column >= 0.0 and row >= 0.0 and column < width - 1 and row < height - 1):
                return _NOTHING
            left, top = int(column), int(row)
            right, down = np.float32(column - left), np.float32(row - top)
            at = first + top * width + left
            above = brightness[at] + right * (brightness[at + 1] - brightness[at])
            at += width
            below = brightness[at] + right * (brightness[at + 1] - brightness[at])
            patch[k] = above + down * (below - above)
            total += patch[k]
            k += 1
    mean, square = np.float32(total / k), np.float32(0.0)
    for n in range(k):
        patch[n] -= mean
        square += patch[n] * patch[n]
    if np.isnan(square):  # a pixel is masked
        return _NOTHING
    patch *= np.float32(1.0 / np.sqrt(square + k * NOISE * NOISE))
    return _TEXTURE if square >= k * NOISE * NOISE else _PLAIN


@kernel(fastmath={"contract", "reassoc"})
def _compare(
    begin: int,
    end: int,
    middle,
    normal,
    seen,
    matrices,
    centres,
    focal,
    brightness,
    firsts,
    sizes,
    shifts,
    least,
    result,
):
    """Fill rows of `result`, see `supporting_photographs`; shifts and least spacing of samples in world units."""
    num_shifts = len(shifts)
    patches = np.empty((num_shifts, MOST_COMPARED, _SIDE * _SIDE), np.float32)
    shown = np.empty((num_shifts, MOST_COMPARED), np.int64)
    alike = np.empty((num_shifts, MOST_COMPARED, MOST_COMPARED), np.float32)
    agrees = np.empty((MOST_COMPARED, MOST_COMPARED), np.bool_)
    frame, local = np.empty((3, 3)), np.empty((3, 3))
    candidates, pixel = np.empty(len(centres), np.int64), np.empty(len(centres))
    for p in range(begin, end):
        n = normal[p]
        count = 0
        for camera in range(len(centres)):
            if not seen[p, camera]:
                continue
            towards = centres[camera] - middle[p]
            distance = np.sqrt((towards * towards).sum())
            if (towards * n).sum() < STEEPEST_COSINE * distance:
                continue
            m = matrices[camera, 2]
            depth = m[0] * middle[p, 0] + m[1] * middle[p, 1] + m[2] * middle[p, 2] + m[3]
            candidates[count], pixel[count] = camera, depth / focal[camera]
            count += 1
        chosen = min(count, MOST_COMPARED)
        if chosen < 2:
            continue
        for k in range(chosen):
            take = k * count // chosen
            candidates[k], pixel[k] = candidates[take], pixel[take]
        spacing = max(least, pixel[:chosen].mean())
        across = frame[1]
        across[:] = 0.0
        across[np.argmin(np.abs(n))] = 1.0
        across -= (across * n).sum() * n
        across /= np.sqrt((across * across).sum())
        frame[2] = np.cross(n, across)

        textured = 0
        for shift in range(num_shifts):
            frame[0] = middle[p] + shifts[shift] * n
            for k in range(chosen):
                one = candidates[k]
                level = min(max(int(np.round(np.log2(spacing / pixel[k]))), 0), _LEVELS - 1)
                first, patch = firsts[one, level], patches[shift, k]
                shown[shift, k] = _read(
                    brightness, first, sizes[one], level, matrices[one], frame, spacing, local, patch
                )
                textured += shown[shift, k] == _TEXTURE and shift < _NUM_NEAR
        if textured < 2:
            continue
        best, most = -1, 0.0
        for shift in range(num_shifts):
            total = 0.0
            for k in range(chosen):
                for other in range(k):
                    score = np.float32(-1.0)
                    if shown[shift, k] == _TEXTURE and shown[shift, other] == _TEXTURE:
                        score = (patches[shift, k] * patches[shift, other]).sum()
                    elif shown[shift, k] != _NOTHING and shown[shift, other] != _NOTHING:
                        score = np.float32(0.0)
                    alike[shift, k, other] = score
                    if score >= LEAST_CORRELATION:
                        total += score
            if total > most:
                best, most = shift, total
        if best < 0 or best >= _NUM_NEAR:
            continue
        pair, highest = (-1, -1), np.float32(0.0)
        for k in range(chosen):
            for other in range(k):
                here, elsewhere = alike[best, k, other], alike[_NUM_NEAR:, k, other].max()
                agrees[k, other] = here >= LEAST_CORRELATION and -1.0 < elsewhere <= here - LEAST_DROP
                if agrees[k, other] and here > highest:
                    pair, highest = (k, other), here
        if pair[0] >= 0:
            result[p, candidates[pair[0]]] = result[p, candidates[pair[1]]] = True
        for k in range(chosen):
            for other in range(k):
                for third in range(other if agrees[k, other] else 0):
                    if agrees[k, third] and agrees[other, third]:
                        for one in (k, other, third):
                            result[p, candidates[one]] = True
