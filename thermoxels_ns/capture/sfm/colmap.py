"""Runs COLMAP in a process of its own, and converts COLMAP's models."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from multiprocessing.connection import Connection
from typing import Any, TypeVar

import numpy as np
from threadpoolctl import threadpool_limits

from thermoxels_ns.capture.rig_types import OPENGL_FROM_OPENCV
from thermoxels_ns.capture.sfm.sfm_model import SfmModel
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.data.colmap_model import lens_entries

Say = Callable[[str], None]
_Result = TypeVar("_Result")

_FATAL_ONLY = 3
_POLL_S = 0.1
_pipe: Connection  # of the new process


def run_in_process(work: Callable[..., _Result], arguments: tuple[Any, ...], say: Say = lambda _: None) -> _Result:
    """Call ``work(*arguments, say)`` in a new process and return the result of `work`.

    On some errors, such as a thread that cannot write, COLMAP says why and aborts its process; the caller's process
    survives that. If the caller's process is killed, the new process ends too. `work` must be a function at the top of
    a module, and its arguments and result must be picklable.

    Raises:
        ThermoxelsError: `work` raised this error, or the process ended without a result.
        OSError: `work` raised this error.
    """
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe(duplex=False)
    with ProcessPoolExecutor(1, context, _prepare, (there,)) as process:
        running = process.submit(_call, work, arguments)
        while not running.done() or here.poll():
            if here.poll(_POLL_S):
                say(here.recv())
        try:
            return running.result()
        except (ThermoxelsError, OSError):
            raise
        except Exception as problem:  # what pycolmap raises, or that the process aborted or was killed
            remedy = (
                "Check free space; where memory runs out, lower --threads, --image-size or --max-features; if that "
                "does not help, begin anew with --from-stage poses."
            )
            raise ThermoxelsError("COLMAP", expected="to finish its work", got=problem, remedy=remedy) from problem


def _prepare(pipe: Connection) -> None:
    """Prepare the new process: its lines of progress go to `pipe`, and it ends when the caller's process ends."""
    global _pipe
    _pipe = pipe
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    import pycolmap

    log_of_colmap: Any = pycolmap.logging
    log_of_colmap.minloglevel = _FATAL_ONLY
    threadpool_limits(1, "blas")  # pycolmap has its own BLAS, whose sums depend on its number of threads


def _call(work: Callable[..., _Result], arguments: tuple[Any, ...]) -> _Result:
    return work(*arguments, _pipe.send)


def _exit_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def model_of_colmap(reconstruction: Any, frame_of_image: Mapping[str, str], size: tuple[int, int]) -> SfmModel:
    """Convert a pycolmap.Reconstruction with one camera into an `SfmModel`.

    The model has the posed images that are keys of `frame_of_image`, in that order. `size` is the original photographs'
    width and height, from which the images may have been reduced.
    """
    by_name = {image.name: image for image in reconstruction.images.values() if image.has_pose}
    posed = [by_name[name] for name in frame_of_image if name in by_name]
    camera = reconstruction.cameras[posed[0].camera_id]
    values: dict[str, Any] = lens_entries(camera.model.name, camera.params)
    found = Camera(int(camera.width), int(camera.height), **values)
    factor = np.array([size[0] / found.width, size[1] / found.height])
    ids = sorted(reconstruction.points3D)
    points = [reconstruction.points3D[i] for i in ids]
    number = {i: n for n, i in enumerate(ids)}
    poses, frames, seen, pixels = [], [], [], []
    for index, image in enumerate(posed):
        poses.append(np.vstack([image.cam_from_world().inverse().matrix(), [0.0, 0.0, 0.0, 1.0]]) @ OPENGL_FROM_OPENCV)
        # A scene point may have two features in one photograph; only the first feature is kept.
        own = {number[f.point3D_id]: f.xy for f in reversed(image.points2D) if f.has_point3D()}
        order = sorted(own)
        frames += [index] * len(order)
        seen += order
        pixels += [own[point] for point in order]
    return SfmModel(
        tuple(frame_of_image[image.name] for image in posed),
        found.resized(*size),
        np.stack(poses),
        np.array([point.xyz for point in points], dtype=np.float64).reshape(-1, 3),
        np.array([point.error for point in points], dtype=np.float64) * float(factor.mean()),
        np.array(frames, dtype=np.int64),
        np.array(seen, dtype=np.int64),
        np.array(pixels, dtype=np.float64).reshape(-1, 2) * factor,
    )
