"""Photographs and thermal images of a room corner with rich texture, by two cameras whose places are known."""

from pathlib import Path

import cv2
import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from tests.support.camera_card import counts
from thermoxels_ns.capture.rig_types import OPENGL_FROM_OPENCV
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.synthetic.scene_truth import look_at

VISIBLE = Camera(480, 360, 420.0, 420.0, 240.0, 180.0)
THERMAL = Camera(160, 128, 150.0, 150.0, 81.0, 63.0)
RIG = np.eye(4)
RIG[:3, 3] = (0.06, 0.01, 0.0)
SIDE_M, TEXELS = 4.0, 1024
# Two walls and the floor: the axis that is constant, and the two that run along the texture.
_PLANES = ((0, 1, 2), (1, 0, 2), (2, 0, 1))


def textures(seed: int = 0) -> list[np.ndarray]:
    """One picture per plane: blots of many sizes in sharp-edged patches, so that features are many and distinct."""
    rng = np.random.default_rng(seed)
    made = []
    for _ in _PLANES:
        total = np.zeros((TEXELS, TEXELS))
        for cells in (12, 32, 90, 220):
            small = rng.integers(0, 2, (cells, cells)).astype(np.float32)
            total += cv2.resize(small, (TEXELS, TEXELS), interpolation=cv2.INTER_NEAREST)
        made.append((cv2.GaussianBlur(total, (0, 0), 1.0) / 4 * 255).astype(np.uint8))
    return made


def view(camera: Camera, pose: np.ndarray, pictures: list[np.ndarray]) -> np.ndarray:
    """What a camera sees of the corner, shape (height, width)."""
    grid = np.stack(np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5), -1).reshape(-1, 2)
    rays = camera.rays(grid) * (1, -1, -1) @ pose[:3, :3].T
    origin = pose[:3, 3]
    nearest, values = np.full(len(rays), np.inf), np.zeros(len(rays), dtype=np.float32)
    shape = (camera.height, camera.width)
    for (fixed, u, v), picture in zip(_PLANES, pictures):
        with np.errstate(divide="ignore"):
            far = -origin[fixed] / rays[:, fixed]
        hit = origin + np.nan_to_num(far, posinf=0.0, neginf=0.0)[:, None] * rays
        sees = (far > 0) & (far < nearest) & (hit[:, [u, v]] >= 0).all(axis=1) & (hit[:, [u, v]] < SIDE_M).all(axis=1)
        at = (hit[:, [u, v]] / SIDE_M * TEXELS - 0.5).astype(np.float32).reshape(*shape, 2)
        seen = cv2.remap(picture, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT).ravel()
        values[sees], nearest[sees] = seen[sees], far[sees]
    return values.reshape(shape)


def poses(count: int) -> np.ndarray:
    """Cameras on an arc in front of the corner, z up, lengths in metres."""
    shares = np.linspace(0, 1, count)
    return np.array(
        [
            look_at((2.2 + 1.2 * s, 3.4 - 1.2 * s, 1.4 + 0.3 * np.sin(7 * s)), (0.4, 0.4, 0.9 + 0.2 * np.cos(5 * s)))
            for s in shares
        ]
    )


def write_card(folder: Path, count: int = 7, drift_k: float = 0.6, stray: bool = False) -> np.ndarray:
    """Write ``shotN-visible.jpg`` and ``shotN-radiometric.tiff``; return the poses of the visible camera.

    Warm is where the texture is bright. `stray` adds a pair that shows something else.
    """
    pictures, where = textures(), poses(count)
    rng = np.random.default_rng(7)
    to_visible = OPENGL_FROM_OPENCV @ np.linalg.inv(RIG) @ OPENGL_FROM_OPENCV
    folder.mkdir(parents=True, exist_ok=True)
    soft = [cv2.GaussianBlur(picture, (0, 0), 4.0) for picture in pictures]
    for number, pose in enumerate(where):
        grey = view(VISIBLE, pose, pictures)
        save(folder / f"shot{number}-visible.jpg", grey)
        warm = 15 + view(THERMAL, pose @ to_visible, soft).astype(np.float64) / 255 * 8
        warm += drift_k * (-1) ** number
        counts(folder / f"shot{number}-radiometric.tiff", warm + rng.normal(0, 0.05, warm.shape))
    if stray:
        save(folder / f"shot{count}-visible.jpg", view(VISIBLE, where[0], textures(seed=99)))
        counts(folder / f"shot{count}-radiometric.tiff", np.full((THERMAL.height, THERMAL.width), 20.0))
    return where


def save(path: Path, grey: np.ndarray) -> None:
    Image.fromarray(np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[..., None], 3, axis=2)).save(path, quality=95)


def alignment(found: np.ndarray, truth: np.ndarray) -> tuple[float, float, float]:
    """Best similarity between two sets of poses: its scale, worst place error in true units, worst angle [degrees]."""
    a, b = found[:, :3, 3], truth[:, :3, 3]
    ac, bc = a - a.mean(axis=0), b - b.mean(axis=0)
    rotation = Rotation.align_vectors(bc, ac)[0].as_matrix()
    scale = float((bc * (ac @ rotation.T)).sum() / (ac * ac).sum())
    off = np.linalg.norm(bc - scale * ac @ rotation.T, axis=1).max()
    turned = np.einsum("nji,njk->nik", rotation @ found[:, :3, :3], truth[:, :3, :3])
    angle = np.degrees(Rotation.from_matrix(turned).magnitude()).max()
    return scale, float(off), float(angle)
