"""Poses that photographs themselves agree on: features, tracks and bundle adjustment around given poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import BoolArray, Float32Array, FloatArray, IntArray
from thermoxels_ns.core.camera import Camera

MOST_FEATURES = 1000  # Features of one photograph
SMALLEST_CONTRAST = 0.01  # Of a feature, of 1; SIFT's own default, 0.04, finds hardly any on plaster
NEIGHBOURS = 10  # Photographs that one is compared with
WIDEST_DEG = 50.0  # Angle between the axes of two photographs that are compared
RATIO = 0.8  # Distance of a match relative to the second best one (Lowe 2004)
REACH = 0.015  # Distance from its epipolar line at which a match is accepted, relative to the photograph's width
FEWEST_MATCHES = 8
FEWEST_TRACKS = 100  # In all photographs together; fewer say nothing about poses
HELD_BACK = 3  # Every n-th track takes no part in the trial, and judges it
WORTH_IT = 0.8
"""What the median distance between features and points of the tracks held back must fall to, relative to what it was
with the poses given."""
POSE_ERROR_DEG = 0.2
"""Standard deviation of the errors of poses given, about each axis, and of positions by as much as it moves the scene's
middle. Turns and moves that cancel each other in the photographs are held by it alone."""
_FLATTEST = 1e-3  # Smallest eigenvalue of a point's normal matrix: rays of an angle of about 2 degrees
_ROUNDS, _SMALLEST_STEP = 20, 1e-6
_OUTLYING = 3.0  # Medians of the distance at which a feature counts a quarter
_OPENCV = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True, eq=False)
class Features:
    """What stands out in one photograph."""

    pixels: FloatArray  # Shape (k, 2)
    descriptors: Float32Array  # Unit vectors, shape (k, 128)


@dataclass(frozen=True, eq=False)
class Tracks:
    """Features that several photographs show of the same points."""

    photograph: IntArray  # Of each sighting, shape (s,)
    point: IntArray  # Of each sighting, 0, 1, ..., shape (s,)
    place: FloatArray  # Where its photograph shows it, at depth 1 in OpenCV axes, shape (s, 2)

    def of_points(self, chosen: BoolArray) -> Tracks:
        """Only some points, one boolean each, numbered anew."""
        kept = chosen[self.point]
        number = np.cumsum(chosen) - 1
        return Tracks(self.photograph[kept], number[self.point[kept]], self.place[kept])

    @property
    def points(self) -> int:
        """How many points there are."""
        return int(self.point.max()) + 1 if len(self.point) else 0


@dataclass(frozen=True, eq=False)
class AdjustedPoses:
    """Poses that fit what photographs show, and by how much better."""

    poses: FloatArray  # Camera to world, OpenGL axes, shape (n, 4, 4)
    before_px: float  # Median distance between features held back and their points, with the poses given, [pixels]
    after_px: float  # The same with poses adjusted to the other features
    tracks: int


def features_of(picture: npt.NDArray[np.uint8], mask: BoolArray | None = None) -> Features:
    """Find features (SIFT, Lowe 2004) in a grey photograph (h, w); only where its `mask` (h, w) is true.

    Descriptors are roots of normalised histograms, by which brightness and contrast of a photograph do not count
    (RootSIFT, Arandjelovic and Zisserman 2012).
    """
    use = None if mask is None else mask.astype(np.uint8)
    # Without precise upscaling all features lie a quarter of a pixel aside.
    sift = cv2.SIFT_create(MOST_FEATURES, contrastThreshold=SMALLEST_CONTRAST, enable_precise_upscale=True)  # type: ignore[attr-defined]
    found, descriptors = sift.detectAndCompute(picture, use)
    if descriptors is None or not len(found):
        return Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    pixels = np.array([point.pt for point in found], dtype=np.float64) + 0.5  # OpenCV's pixel centres are whole
    return Features(pixels, np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-12)))


def find_tracks(features: Sequence[Features], cameras: Sequence[Camera], poses: FloatArray) -> Tracks:
    """Match features of neighbouring photographs, as far as poses (n, 4, 4) that are nearly right allow it.

    Cameras are those of the pictures in which features were found. Tracks that show two features of one photograph are
    left out.
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
    """Adjust poses to tracks where that helps tracks that took no part in it.

    The adjusted poses as a whole stand where the given ones do, as large as they.

    Args:
        tracks: Tracks of all photographs.
        poses: Camera to world as given, OpenGL axes, shape (n, 4, 4).
        focal: Focal lengths [pixels], shape (n,): they turn angles into pixels.
        fixed: The first so many photographs keep their poses.

    Returns:
        None where tracks are too few, or those held back do not get nearer to their points.
    """
    middle = poses[:, :3, 3].mean(0)
    poses = poses.copy()
    poses[:, :3, 3] -= middle  # coordinates of a country would cost digits
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
    """Photographs that are compared: those beside each other that look the same way."""
    pairs = set()
    for a in range(len(centres)):
        facing = rotations[:, 2] @ rotations[a, 2] > np.cos(np.deg2rad(WIDEST_DEG))
        far = np.linalg.norm(centres - centres[a], axis=1)
        (others,) = np.nonzero(facing & (np.arange(len(centres)) != a))
        pairs |= {(min(a, b), max(a, b)) for b in others[np.argsort(far[others], kind="stable")][:NEIGHBOURS].tolist()}
    return sorted(pairs)


def _matches(one: Float32Array, other: Float32Array) -> tuple[IntArray, IntArray]:
    """Features that are each other's nearest, much nearer than the second."""
    likeness = one @ other.T
    best = likeness.argmax(1)
    second = np.partition(likeness, -2, axis=1)[:, -2]
    apart = [np.sqrt(np.maximum(2.0 - 2.0 * values, 0.0)) for values in (likeness[np.arange(len(one)), best], second)]
    (chosen,) = np.nonzero((apart[0] < RATIO * apart[1]) & (likeness.argmax(0)[best] == np.arange(len(one))))
    return chosen, best[chosen]


def _opencv(poses: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rotations from world to OpenCV camera axes (n, 3, 3) and centres (n, 3)."""
    return _OPENCV @ poses[:, :3, :3].transpose(0, 2, 1), poses[:, :3, 3].copy()


def _triangulated(tracks: Tracks, rotations: FloatArray, centres: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points nearest to the rays of their sightings, (points, 3), and their normal matrices (points, 3, 3)."""
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
    """Points in the axes of the cameras that see them (s, 3), and how far their features are off (s, 2), [pixels]."""
    local = np.einsum("nij,nj->ni", rotations[tracks.photograph], points[tracks.point] - centres[tracks.photograph])
    depth = np.where(np.abs(local[:, 2:]) > 1e-12, local[:, 2:], 1e-12)
    return local, focal[tracks.photograph, None] * (local[:, :2] / depth - tracks.place)


def _distances(tracks: Tracks, poses: FloatArray, focal: FloatArray) -> FloatArray:
    """Distances between features and their triangulated points, [pixels]."""
    rotations, centres = _opencv(poses)
    points, _ = _triangulated(tracks, rotations, centres)
    return np.linalg.norm(_seen(tracks, rotations, centres, points, focal)[1], axis=1)


def _plausible(tracks: Tracks, poses: FloatArray, focal: FloatArray) -> Tracks:
    """Tracks in front of their photographs whose rays meet nearly, at an angle."""
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
    """Poses and points that bring features and points together (bundle adjustment, Triggs and others 2000).

    Gauss-Newton steps on robust squared distances (Geman and McClure 1987: corners of roofs and branches, which no two
    photographs show at the same place, pull hardly at all), points eliminated (Schur complement), with the errors
    expected of the poses given as a prior. None where it fails.
    """
    from scipy import sparse
    from scipy.spatial.transform import Rotation

    count = len(poses)
    start, centres = _opencv(poses)
    rotations, origin = start.copy(), centres.copy()
    points, _ = _triangulated(tracks, rotations, centres)
    reach = float(np.median(np.linalg.norm(points[tracks.point] - centres[tracks.photograph], axis=1)))
    sightings, scale = len(tracks.point), focal[tracks.photograph]
    rows = np.arange(2 * sightings)

    def block(values: FloatArray, column: IntArray, width: int, total: int) -> sparse.csr_matrix:
        columns = (column[:, None] * width + np.arange(width))[:, None, :].repeat(2, axis=1)
        return sparse.csr_matrix(
            (values.ravel(), (rows.repeat(width), columns.ravel())), (2 * sightings, width * total)
        )

    for _ in range(_ROUNDS):
        local, off = _seen(tracks, rotations, centres, points, focal)
        far = np.linalg.norm(off, axis=1)
        middle = max(float(np.median(far)), 1e-6)
        root = 1.0 / (1.0 + (far / (_OUTLYING * middle)) ** 2)[:, None]
        x, y, z = local.T
        z = np.where(np.abs(z) > 1e-12, z, 1e-12)
        by_local, cross = np.zeros((sightings, 2, 3)), np.zeros((sightings, 3, 3))
        by_local[:, 0, 0] = by_local[:, 1, 1] = scale / z
        by_local[:, 0, 2], by_local[:, 1, 2] = -scale * x / z**2, -scale * y / z**2
        cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -z, y, -x
        cross -= cross.transpose(0, 2, 1)
        by_point = by_local @ rotations[tracks.photograph] * root[..., None]
        by_pose = np.concatenate((-by_local @ cross * root[..., None], -reach * by_point), axis=2)
        a, b = block(by_pose, tracks.photograph, 6, count), block(by_point, tracks.point, 3, len(points))
        right = (off * root).ravel()
        normal = np.zeros((len(points), 3, 3))
        np.add.at(normal, tracks.point, np.einsum("nki,nkj->nij", by_point, by_point))
        normal += 1e-6 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        inverse = sparse.block_diag(list(np.linalg.inv(normal)), format="csr")
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
    """Poses turned, scaled and moved together so that, as a whole, they stand where the given ones do."""
    u, _, vt = np.linalg.svd(np.einsum("nij,nkj->ik", given[:, :3, :3], poses[:, :3, :3]))
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    here, there = (each[:, :3, 3] - each[:, :3, 3].mean(0) for each in (poses, given))
    here = here @ turn.T
    spread = float((here * here).sum())
    scale = float((here * there).sum()) / spread if spread > 0.0 else 1.0
    placed = poses.copy()
    placed[:, :3, :3] = turn @ poses[:, :3, :3]
    placed[:, :3, 3] = scale * here + given[:, :3, 3].mean(0)
    return placed
