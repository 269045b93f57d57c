"""Adjustment of given poses to photographs: features, tracks and bundle adjustment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from thermoxels_ns.core.camera import Camera

MOST_FEATURES = 1000  # Most features of one photograph
SMALLEST_CONTRAST = 0.01  # Least contrast of a feature, of 1; with SIFT's default, 0.04, plaster has hardly any
NEIGHBOURS = 10  # Photographs that each photograph is compared with
WIDEST_DEG = 50.0  # Largest angle between the optical axes of two photographs that are compared
RATIO = 0.8  # Largest descriptor distance of a match relative to that of the second best candidate (Lowe 2004)
REACH = 0.015  # Largest distance of a match from its epipolar line, relative to the photograph's width
FEWEST_MATCHES = 8  # Photographs with fewer features are not compared
FEWEST_TRACKS = 100  # Least number of tracks of a scene; fewer tell nothing about poses
HELD_BACK = 3  # Every n-th track is held back from the trial adjustment and judges it
WORTH_IT = 0.8
"""Adjusted poses are taken if the median distance between features and points of the tracks held back falls to at most
this share of the distance with the given poses."""
POSE_ERROR_DEG = 0.2
"""Standard deviation assumed for the errors of given poses: of rotations about each axis, and of positions as a length
that this angle spans at the scene's distance. Only this prior limits rotations and moves that cancel in the images."""
_FLATTEST = 1e-3  # Least eigenvalue of a point's normal matrix: two rays at an angle of some 2.6 degrees
_ROUNDS, _SMALLEST_STEP = 20, 1e-6  # Most Gauss-Newton steps; a smaller step ends the adjustment
_OUTLYING = 3.0  # A feature that is this many median distances from its point has a quarter of the full weight
_OPENCV = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True, eq=False)
class Features:
    """Features of one photograph: places that other photographs can show too."""

    pixels: FloatArray  # Column and row of each feature, shape (k, 2), [pixels]
    descriptors: Float32Array  # Unit vectors, shape (k, 128)


@dataclass(frozen=True, eq=False)
class Tracks:
    """Sightings of points; the sightings of one point, features of several photographs, form its track."""

    photograph: IntArray  # Index of the photograph of each sighting, shape (s,)
    point: IntArray  # Number of the point of each sighting, from 0 without gaps, shape (s,)
    place: FloatArray  # x, y of each sighting at depth 1 in OpenCV camera axes, shape (s, 2)

    def of_points(self, chosen: BoolArray) -> Tracks:
        """Return only the tracks of the points that are True in `chosen` (points,), with points numbered anew."""
        kept = chosen[self.point]
        number = np.cumsum(chosen) - 1
        return Tracks(self.photograph[kept], number[self.point[kept]], self.place[kept])

    @property
    def points(self) -> int:
        """Number of points."""
        return int(self.point.max()) + 1 if len(self.point) else 0


@dataclass(frozen=True, eq=False)
class AdjustedPoses:
    """Adjusted poses, and the distances of held-back features from their points before and after."""

    poses: FloatArray  # Camera to world, OpenGL axes, shape (n, 4, 4)
    before_px: float  # Median distance between features held back and their points, with the given poses, [pixels]
    after_px: float  # The same distance with poses adjusted to the other features, [pixels]
    tracks: int  # Number of tracks that the poses are adjusted to


def features_of(picture: npt.NDArray[np.uint8], mask: BoolArray | None = None) -> Features:
    """Return the features (SIFT, Lowe 2004) of a grey photograph (h, w) at pixels that are True in `mask` (h, w).

    Descriptors are square roots of normalised histograms (RootSIFT, Arandjelovic and Zisserman 2012), so that the
    brightness and contrast of the photograph do not matter.
    """
    use = None if mask is None else mask.astype(np.uint8)
    # Without precise upscaling all features are off by a quarter of a pixel.
    sift = cv2.SIFT_create(MOST_FEATURES, contrastThreshold=SMALLEST_CONTRAST, enable_precise_upscale=True)  # type: ignore[attr-defined]
    found, descriptors = sift.detectAndCompute(picture, use)
    if descriptors is None or not len(found):
        return Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    pixels = np.array([point.pt for point in found], dtype=np.float64) + 0.5  # OpenCV's pixel centres are whole
    return Features(pixels, np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-12)))


def find_tracks(features: Sequence[Features], cameras: Sequence[Camera], poses: FloatArray) -> Tracks:
    """Match features of neighbouring photographs and return the tracks of the points that the matches link.

    A match must be near its epipolar line by the given poses (camera to world, OpenGL, (n, 4, 4)). `cameras` must have
    the size of the pictures in which features were found. Tracks with two features in a photograph are left out.
    """
    from scipy.sparse import coo_matrix  # slow to import and only needed here
    from scipy.sparse.csgraph import connected_components

    poses = poses.copy()
    poses[:, :3, 3] -= poses[:, :3, 3].mean(0)
    count = np.array([len(each.pixels) for each in features])
    firsts = np.concatenate(([0], np.cumsum(count)))
    places = [camera.rays(each.pixels)[:, :2] for camera, each in zip(cameras, features)]
    rotations, centres = _opencv(poses)
    one, other = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for a, b in _pairs(rotations, centres):
        if min(count[a], count[b]) < FEWEST_MATCHES:
            continue
        i, j = _matches(features[a].descriptors, features[b].descriptors)
        turn, shift = rotations[b] @ rotations[a].T, rotations[b] @ (centres[a] - centres[b])
        lines = np.cross(shift, np.column_stack((places[a][i], np.ones(len(i)))) @ turn.T)
        there = np.column_stack((places[b][j], np.ones(len(j))))
        off = np.abs(np.einsum("ni,ni->n", lines, there)) / np.maximum(np.linalg.norm(lines[:, :2], axis=1), 1e-12)
        good = off * cameras[b].fl_x <= REACH * cameras[b].width
        one.append(firsts[a] + i[good])
        other.append(firsts[b] + j[good])
    left, right = np.concatenate(one), np.concatenate(other)
    links = coo_matrix((np.ones(len(left)), (left, right)), shape=(firsts[-1], firsts[-1]))
    label = np.asarray(connected_components(links, directed=False)[1], dtype=np.int64)
    photograph = np.repeat(np.arange(len(features)), count)
    size = np.bincount(label)
    doubled = np.zeros(len(size), dtype=bool)
    pairs, times = np.unique(label * len(features) + photograph, return_counts=True)
    doubled[pairs[times > 1] // len(features)] = True
    chosen = ((size > 1) & ~doubled)[label]
    number = np.cumsum((size > 1) & ~doubled) - 1
    order = np.lexsort((photograph[chosen], number[label[chosen]]))
    place = np.concatenate(places) if len(places) else np.zeros((0, 2))
    return Tracks(photograph[chosen][order], number[label[chosen]][order], place[chosen][order])


def adjust_poses(tracks: Tracks, poses: FloatArray, focal: FloatArray, fixed: int = 0) -> AdjustedPoses | None:
    """Return poses adjusted to tracks by bundle adjustment, or None if tracks held back do not fit better then.

    The tracks held back, every third one, judge a trial adjustment to the others (`WORTH_IT`); the poses returned are
    adjusted to all. If `fixed` is 0, they keep the place, orientation and scale of the given poses as a whole.

    Args:
        tracks: Tracks of all photographs.
        poses: Given poses, camera to world, OpenGL axes, shape (n, 4, 4).
        focal: Focal lengths, which turn angles into pixels, shape (n,), [pixels].
        fixed: Number of photographs, at the beginning of `poses`, that keep their poses.

    Returns:
        Adjusted poses; None also if there are fewer than `FEWEST_TRACKS` tracks or a step is not finite.
    """
    middle = poses[:, :3, 3].mean(0)
    poses = poses.copy()
    poses[:, :3, 3] -= middle  # large national coordinates would cost precision
    tracks = _plausible(tracks, poses, focal)
    if tracks.points < FEWEST_TRACKS:
        return None
    judge = np.arange(tracks.points) % HELD_BACK == 0
    trial = _adjust(tracks.of_points(~judge), poses, focal, fixed)
    if trial is None:
        return None
    held = tracks.of_points(judge)
    before, after = (float(np.median(_distances(held, each, focal))) for each in (poses, trial))
    if not after <= WORTH_IT * before:
        return None
    adjusted = _adjust(tracks, poses, focal, fixed)
    if adjusted is None:
        return None
    adjusted[:, :3, 3] += middle
    return AdjustedPoses(adjusted, before, after, tracks.points)


def _pairs(rotations: FloatArray, centres: FloatArray) -> list[tuple[int, int]]:
    """Return pairs of photographs to compare: each with the nearest `NEIGHBOURS` within `WIDEST_DEG` of its axis."""
    pairs = set()
    for a in range(len(centres)):
        facing = rotations[:, 2] @ rotations[a, 2] > np.cos(np.deg2rad(WIDEST_DEG))
        far = np.linalg.norm(centres - centres[a], axis=1)
        (others,) = np.nonzero(facing & (np.arange(len(centres)) != a))
        pairs |= {(min(a, b), max(a, b)) for b in others[np.argsort(far[others], kind="stable")][:NEIGHBOURS].tolist()}
    return sorted(pairs)


def _matches(one: Float32Array, other: Float32Array) -> tuple[IntArray, IntArray]:
    """Return the indices (m,) in `one` and (m,) in `other` of descriptors that are each other's best match. Descriptors
    are (k, 128). A match must also pass Lowe's ratio test against the second best candidate (`RATIO`)."""
    likeness = one @ other.T
    best = likeness.argmax(1)
    second = np.partition(likeness, -2, axis=1)[:, -2]
    apart = [np.sqrt(np.maximum(2.0 - 2.0 * values, 0.0)) for values in (likeness[np.arange(len(one)), best], second)]
    (chosen,) = np.nonzero((apart[0] < RATIO * apart[1]) & (likeness.argmax(0)[best] == np.arange(len(one))))
    return chosen, best[chosen]


def _opencv(poses: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the rotations from world to OpenCV camera axes (n, 3, 3) and the camera centres (n, 3) of poses."""
    return _OPENCV @ poses[:, :3, :3].transpose(0, 2, 1), poses[:, :3, 3].copy()


def _triangulated(tracks: Tracks, rotations: FloatArray, centres: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the least-squares points of the rays of their sightings, (points, 3), and their normal matrices."""
    rays = np.column_stack((tracks.place, np.ones(len(tracks.place))))
    rays = np.einsum("nji,nj->ni", rotations[tracks.photograph], rays)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    normal, right = np.zeros((tracks.points, 3, 3)), np.zeros((tracks.points, 3))
    np.add.at(normal, tracks.point, across)
    np.add.at(right, tracks.point, np.einsum("nij,nj->ni", across, centres[tracks.photograph]))
    return np.linalg.solve(normal + 1e-9 * np.eye(3), right[..., None])[..., 0], normal


def _seen(
    tracks: Tracks, rotations: FloatArray, centres: FloatArray, points: FloatArray, focal: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return per sighting the point in camera axes (s, 3), and its projection minus the feature (s, 2), [pixels]."""
    local = np.einsum("nij,nj->ni", rotations[tracks.photograph], points[tracks.point] - centres[tracks.photograph])
    local[np.abs(local[:, 2]) < 1e-12, 2] = 1e-12
    return local, focal[tracks.photograph, None] * (local[:, :2] / local[:, 2:] - tracks.place)


def _distances(tracks: Tracks, poses: FloatArray, focal: FloatArray) -> FloatArray:
    """Return the distance of each sighting's feature from its triangulated point, shape (s,), [pixels]."""
    rotations, centres = _opencv(poses)
    points, _ = _triangulated(tracks, rotations, centres)
    return np.linalg.norm(_seen(tracks, rotations, centres, points, focal)[1], axis=1)


def _plausible(tracks: Tracks, poses: FloatArray, focal: FloatArray) -> Tracks:
    """Return the tracks whose points lie in front of all their cameras and near all rays, which meet at a fair angle.
    Rays are near within six median distances, or 3 pixels if that is more."""
    if not tracks.points:
        return tracks
    rotations, centres = _opencv(poses)
    points, normal = _triangulated(tracks, rotations, centres)
    local, off = _seen(tracks, rotations, centres, points, focal)
    wrong = np.linalg.eigvalsh(normal)[:, 0] < _FLATTEST
    far = np.linalg.norm(off, axis=1)
    wrong[tracks.point[(local[:, 2] <= 0.0) | (far > max(3.0, 6.0 * float(np.median(far))))]] = True
    return tracks.of_points(~wrong)


def _adjust(tracks: Tracks, poses: FloatArray, focal: FloatArray, fixed: int) -> FloatArray | None:
    """Return poses (n, 4, 4) that minimise the distances between features and points, or None if a step is not finite.

    This is bundle adjustment (Triggs and others 2000) by Gauss-Newton steps on robust squared distances (Geman and
    McClure 1987): corners of roofs and branches, which look different in each photograph, hardly count. Points are
    eliminated (Schur complement). The errors expected of the given poses, `POSE_ERROR_DEG`, are a prior.
    """
    from scipy import sparse
    from scipy.spatial.transform import Rotation

    count = len(poses)
    start, centres = _opencv(poses)
    rotations, origin = start.copy(), centres.copy()
    points, _ = _triangulated(tracks, rotations, centres)
    reach = float(np.median(np.linalg.norm(points[tracks.point] - centres[tracks.photograph], axis=1)))
    sightings, scale = len(tracks.point), focal[tracks.photograph]
    every, rows = np.arange(len(points) + 1), np.arange(sightings + 1)
    for _ in range(_ROUNDS):
        local, off = _seen(tracks, rotations, centres, points, focal)
        far = np.linalg.norm(off, axis=1)
        middle = max(float(np.median(far)), 1e-6)
        root = 1.0 / (1.0 + (far / (_OUTLYING * middle)) ** 2)[:, None]
        x, y, z = local.T
        by_local, cross = np.zeros((sightings, 2, 3)), np.zeros((sightings, 3, 3))
        by_local[:, 0, 0] = by_local[:, 1, 1] = scale / z
        by_local[:, 0, 2], by_local[:, 1, 2] = -scale * x / z**2, -scale * y / z**2
        cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -z, y, -x
        cross -= cross.transpose(0, 2, 1)
        by_point = by_local @ rotations[tracks.photograph] * root[..., None]
        by_pose = np.concatenate((-by_local @ cross * root[..., None], -reach * by_point), axis=2)
        a = sparse.bsr_array((by_pose, tracks.photograph, rows), shape=(2 * sightings, 6 * count))
        b = sparse.bsr_array((by_point, tracks.point, rows), shape=(2 * sightings, 3 * len(points)))
        right = (off * root).ravel()
        normal = np.zeros((len(points), 3, 3))
        np.add.at(normal, tracks.point, np.einsum("nki,nkj->nij", by_point, by_point))
        normal += 1e-6 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        inverse = sparse.bsr_array((np.linalg.inv(normal), every[:-1], every))
        mixed = a.T @ b
        precision = (middle / np.deg2rad(POSE_ERROR_DEG)) ** 2
        turned = Rotation.from_matrix(rotations @ start.transpose(0, 2, 1)).as_rotvec()
        prior = precision * np.column_stack((turned, (centres - origin) / reach)).ravel()
        matrix = (a.T @ a - mixed @ inverse @ mixed.T).toarray() + precision * np.eye(6 * count)
        wanted = -(a.T @ right - mixed @ (inverse @ (b.T @ right))) - prior
        step = np.zeros(6 * count)
        step[6 * fixed :] = np.linalg.solve(matrix[6 * fixed :, 6 * fixed :], wanted[6 * fixed :])
        points = points + (inverse @ (-(b.T @ right) - mixed.T @ step)).reshape(-1, 3)
        moves = step.reshape(-1, 6)
        rotations = Rotation.from_rotvec(moves[:, :3]).as_matrix() @ rotations
        centres = centres + reach * moves[:, 3:]
        if not np.isfinite(step).all():
            return None
        if np.abs(step).max() < _SMALLEST_STEP:
            break
    adjusted = poses.copy()
    adjusted[:, :3, :3] = rotations.transpose(0, 2, 1) @ _OPENCV
    adjusted[:, :3, 3] = centres
    return adjusted if fixed else _placed_like(adjusted, poses)


def _placed_like(poses: FloatArray, given: FloatArray) -> FloatArray:
    """Return poses after the similarity transform (rotation, scale, shift) that brings them closest to `given`."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_matrix(given[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1)).mean().as_matrix()
    here, there = (each[:, :3, 3] - each[:, :3, 3].mean(0) for each in (poses, given))
    here = here @ turn.T
    spread = float((here * here).sum())
    scale = float((here * there).sum()) / spread if spread > 0.0 else 1.0
    placed = poses.copy()
    placed[:, :3, :3] = turn @ poses[:, :3, :3]
    placed[:, :3, 3] = scale * here + given[:, :3, 3].mean(0)
    return placed
