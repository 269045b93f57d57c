"""Poses of a scene folder made to fit its photographs, where they do not."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
import numpy.typing as npt
from PIL import Image

from thermoxels_ns.core.camera import Camera
from thermoxels_ns.data.scene_file import Frame, SceneFile

PoseSource = Literal["auto", "given"]

LONGEST_SIDE = 640  # Pixels along the longer side of the pictures in which features are sought
MOST_PHOTOGRAPHS = 500  # With more, poses stay as given: the normal equations would take minutes
FEWEST_PHOTOGRAPHS = 3

FloatArray = npt.NDArray[np.float64]


def refine_poses(
    scene: SceneFile, training: Sequence[int], say: Callable[[str], None]
) -> tuple[SceneFile, dict[int, FloatArray]]:
    """Adjust the poses of the photographs that train to each other, where that makes features fit that took no part.

    Thermal cameras of their own follow their photographs. Held-out photographs keep the poses given, so that they
    judge; where they themselves say that they were taken from is returned beside.

    Returns:
        The scene with poses adjusted (the same scene where they fit as given), and by number of the frame the poses
        (4, 4) that other photographs' features fit.
    """
    began = time.perf_counter()
    frames = scene.frames
    others = [number for number in range(len(frames)) if number not in set(training)]
    usable = all(frame.intrinsics.lens == "perspective" for frame in frames)
    if not usable or not FEWEST_PHOTOGRAPHS <= len(training) <= MOST_PHOTOGRAPHS:
        return scene, {}
    from thermoxels_ns.multiview.bundle_adjustment import adjust_poses, features_of, find_tracks

    pictures = [_picture(frames[number]) for number in training]
    features, cameras = [features_of(picture, mask) for picture, mask, _ in pictures], [each[2] for each in pictures]
    poses, focal = np.stack([frames[number].pose for number in training]), np.array([c.fl_x for c in cameras])
    found = adjust_poses(find_tracks(features, cameras, poses), poses, focal)
    if found is None:
        say(f"poses: kept, features that photographs share ask for no others; {time.perf_counter() - began:.1f} s")
        return scene, {}
    moved = list(frames)
    for number, pose in zip(training, found.poses):
        frame = frames[number]
        thermal = None if frame.thermal_pose is None else pose @ np.linalg.inv(frame.pose) @ frame.thermal_pose
        moved[number] = replace(frame, pose=pose, thermal_pose=thermal)
    for number in others:
        picture, mask, camera = _picture(frames[number])
        features.append(features_of(picture, mask))
        cameras.append(camera)
    every = np.concatenate((found.poses, [frames[number].pose for number in others])) if others else found.poses
    tracks, fitted = find_tracks(features, cameras, every), {}
    held_out = np.zeros(tracks.points, dtype=bool)
    held_out[tracks.point[tracks.photograph >= len(training)]] = True
    focal = np.array([camera.fl_x for camera in cameras])
    theirs = adjust_poses(tracks.of_points(held_out), every, focal, fixed=len(training)) if held_out.any() else None
    if theirs is not None:
        fitted = dict(zip(others, theirs.poses[len(training) :]))
    say(
        f"poses: those given are off, adjusted to {found.tracks} points that photographs share; features that took no "
        f"part lie {found.after_px:.2f} pixels from their points, {found.before_px:.2f} with the poses given; "
        f"{time.perf_counter() - began:.1f} s (--refine-poses given keeps them)"
    )
    return replace(scene, frames=moved), fitted


def _picture(frame: Frame) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.bool_] | None, Camera]:
    """A photograph in grey of at most `LONGEST_SIDE` pixels, its mask, and its camera at that size."""
    grey, mask = frame.read_picture("L", LONGEST_SIDE)
    factor = LONGEST_SIDE / max(grey.size)
    if factor < 1.0:
        size = (max(1, round(factor * grey.size[0])), max(1, round(factor * grey.size[1])))
        grey, mask = grey.resize(size, Image.Resampling.BOX), mask and mask.resize(size, Image.Resampling.NEAREST)
    use = None if mask is None else np.array(mask) > 0
    return np.array(grey), use, frame.intrinsics.resized(*grey.size)
