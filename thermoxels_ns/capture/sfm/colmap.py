"""Runs COLMAP in a process of its own, reports why that process stopped, and converts COLMAP's models."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from threadpoolctl import threadpool_limits

from thermoxels_ns.capture.sfm.sfm_model import SfmModel
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.data.colmap_model import camera_to_world

Say = Callable[[str], None]
_Result = TypeVar("_Result")

_KILLED = -int(getattr(signal, "SIGKILL", 9))
_FATAL_ONLY = 3
FIELDS: dict[str, tuple[str, ...]] = {
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2"),
}
"""COLMAP's lens models that --lens offers, and the order of their parameters; f is both focal lengths."""


def run_in_process(
    work: Callable[..., _Result], arguments: tuple[Any, ...], folder: Path, say: Say = lambda _: None
) -> _Result:
    """Call ``work(*arguments, say)`` in a new process, wait for its end and return the result of `work`.

    On some errors, such as a thread that cannot write, COLMAP aborts its process; the caller's process survives that.
    If the caller's process ends or is killed, the new process ends too. `work` must be a function at the top of a
    module, and its arguments and result must be picklable.

    Raises:
        ThermoxelsError: `work` raised this error, or the process ended without a result.
        OSError: `work` raised this error.
    """
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe(duplex=False)
    log = folder / "colmap.log"
    child = context.Process(target=_serve, args=(there, log, work, arguments), daemon=True)
    child.start()
    there.close()
    ended: tuple[Any, Exception | None] | None = None  # the result of `work`, and the error that `work` raised
    try:
        with suppress(EOFError):
            while ended is None:
                message = here.recv()
                if isinstance(message, str):
                    say(message)
                else:
                    ended = message
        child.join()
    finally:
        if child.is_alive():
            child.kill()
            child.join()
        words = log.read_text("utf-8", "replace") if log.is_file() else ""
        log.unlink(missing_ok=True)
    if ended is None:
        reason = _reason(child.exitcode, words)
        remedy = "Check free space and memory and run the command again; if that does not help, begin anew with "
        raise ThermoxelsError("COLMAP", expected="to end", got=reason, remedy=remedy + "--from-stage poses.")
    if ended[1] is not None:
        raise ended[1]
    return ended[0]


def _serve(pipe: Connection, log: Path, work: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    """Call `work` in the new process and send its result or error; COLMAP's output goes to the file `log`."""
    with log.open("ab") as file:
        for stream in (1, 2):
            os.dup2(file.fileno(), stream)
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    import pycolmap  # has its own BLAS, whose sums depend on its number of threads: imported before threadpool_limits

    log_of_colmap: Any = pycolmap.logging
    log_of_colmap.minloglevel = _FATAL_ONLY
    ended: tuple[Any, Exception | None]
    with threadpool_limits(1, "blas"):
        try:
            ended = work(*arguments, pipe.send), None
        except (ThermoxelsError, OSError) as problem:
            ended = None, problem
    pipe.send(ended)


def _exit_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _reason(status: int | None, words: str) -> str:
    """Return why the process ended: its exit status, and the last line of output that names an error (or any line)."""
    if status == _KILLED:
        return "it was killed, as systems do where memory runs out (lower --threads, --image-size or --max-features)"
    said = [line for line in words.splitlines() if line.strip()]
    telling = [line for line in said if "error" in line.lower()] or said[-1:]
    return f"exit status {status}" + (f" ({telling[-1]})" if telling else "")


def model_of_colmap(reconstruction: Any, frame_of_image: Mapping[str, str], size: tuple[int, int]) -> SfmModel:
    """Convert a pycolmap.Reconstruction with one camera into an `SfmModel`.

    The model has the posed images that are keys of `frame_of_image`, in that order. `size` is the original photographs'
    width and height, from which the images may have been reduced.
    """
    by_name = {image.name: image for image in reconstruction.images.values() if image.has_pose}
    posed = [by_name[name] for name in frame_of_image if name in by_name]
    camera = reconstruction.cameras[posed[0].camera_id]
    values: dict[str, Any] = dict(zip(FIELDS[camera.model.name], map(float, camera.params)))
    focal = values.pop("f", None)
    if focal is not None:
        values |= {"fl_x": focal, "fl_y": focal}
    found = Camera(int(camera.width), int(camera.height), **values)
    factor = np.array([size[0] / found.width, size[1] / found.height])
    ids = sorted(reconstruction.points3D)
    points = [reconstruction.points3D[i] for i in ids]
    number = {i: n for n, i in enumerate(ids)}
    poses, frames, seen, pixels = [], [], [], []
    for index, image in enumerate(posed):
        poses.append(camera_to_world(image))
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
