"""Finds the poses of the photographs by structure from motion."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from threadpoolctl import threadpool_limits

from thermoxels_ns.capture.photograph import open_photograph
from thermoxels_ns.capture.settings import CaptureSettings
from thermoxels_ns.capture.sfm.sfm_model import SfmModel
from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.core.checks import replace_when_done, writable_folder
from thermoxels_ns.core.errors import OutputError, SceneError, ThermoxelsError
from thermoxels_ns.data.colmap_model import PARAMETERS, camera_to_world, lens_entries, read_model

MIN_FRAMES = 3  # smallest number of photographs that are reconstructed
_SAID_EVERY = 10
_GUESSED_FOCAL = 1.0  # focal length as a share of the longest side, if no photograph states one (53 degrees of view)
_JPEG_QUALITY = 95
_DATABASE, _IMAGES = "features.db", "images"
MODEL_FOLDER = "model"  # name of the folder of COLMAP's model, in the folder of the stage
EVAL_INTERVAL = 8
EXHAUSTIVE_UP_TO = 80  # largest number of photographs of which all pairs are matched; time grows with its square
_NEIGHBOURS = 8
"""Above `EXHAUSTIVE_UP_TO`, each photograph is matched with the next `_NEIGHBOURS`, and with the photographs that are
2, 4, 8, ... times `_NEIGHBOURS` places ahead."""
_ANCHORS = 40
"""Above `EXHAUSTIVE_UP_TO`, so many photographs, evenly spread over the capture, are also matched with each other, so
that a path that returns to its start is closed."""
_CHUNK = 8
_PAIR_CHUNK = 200
_FATAL_ONLY = 3


def find_poses(
    photographs: Mapping[str, Path],
    size: tuple[int, int],
    folder: Path,
    settings: CaptureSettings,
    focal_px: float | None = None,
    say: Callable[[str], None] = lambda _: None,
) -> None:
    """Find lens, poses and points from the photographs of one camera by COLMAP's incremental structure from motion.

    `photographs` maps frame names to files of `size` (width, height), in the order in which they were taken.
    `focal_px` is their stated focal length (None: a guess). COLMAP's model of the largest set of photographs that fit
    together is written to `MODEL_FOLDER` in `folder`, with the names that photographs have in the scene.

    Results of an interrupted run in `folder` are reused. On some errors, such as a thread that cannot write, COLMAP
    states the reason and aborts the process; the next run continues there. Raises `SceneError` if fewer than 3
    photographs fit together or a photograph cannot be decoded, and `ThermoxelsError` if COLMAP raised an error.
    """
    import pycolmap

    if len(photographs) < MIN_FRAMES:
        raise _too_few(len(photographs), "photographs of one size")
    names, small = _reduced(photographs, folder / _IMAGES, size, settings.image_size)
    params = ""
    if focal_px is not None:
        start = {"cx": small[0] / 2.0, "cy": small[1] / 2.0}
        start |= dict.fromkeys(("f", "fl_x", "fl_y"), focal_px * small[0] / size[0])
        params = ",".join(str(start.get(name, 0.0)) for name in PARAMETERS[settings.lens])
    log_of_colmap: Any = pycolmap.logging
    log_of_colmap.minloglevel = _FATAL_ONLY
    try:
        with threadpool_limits(1, "blas"):  # pycolmap has its own BLAS, whose sums depend on its number of threads
            _find_and_match(folder, names, params, settings, say)
            posed = _map(folder, len(names), settings.seed, say)
    except (ThermoxelsError, OSError):
        raise
    except Exception as problem:  # pycolmap raises RuntimeError, ValueError and others
        remedy = (
            "Check free space and memory (lower --threads, --image-size or --max-features); if that does not help, "
            "begin anew with --from-stage poses."
        )
        raise ThermoxelsError("COLMAP", expected="to finish its work", got=problem, remedy=remedy) from problem
    if posed < MIN_FRAMES:
        raise _too_few(posed, "photographs that fit together")


def _reduced(
    photographs: Mapping[str, Path], images: Path, size: tuple[int, int], longest: int
) -> tuple[list[str], tuple[int, int]]:
    """Write photographs for COLMAP, at most `longest` pixels wide and high, into the folder `images`. Returns the
    files' names, in the order of `photographs`, and their width and height [pixels]. The files have no EXIF
    orientation, because COLMAP would turn them by it."""
    factor = min(1.0, longest / max(size))
    small = max(1, round(size[0] * factor)), max(1, round(size[1] * factor))
    images.mkdir(exist_ok=True)
    digits = max(4, len(str(len(photographs))))
    files = [f"{index:0{digits}d}.jpg" for index in range(len(photographs))]
    for file, photograph in zip(files, photographs.values()):
        if not (images / file).is_file():
            picture = open_photograph(photograph)
            if small != size:
                much = max(small) < 0.5 * max(size)
                picture = picture.resize(small, Image.Resampling.BOX if much else Image.Resampling.LANCZOS)
            with replace_when_done(images / file) as temporary:
                picture.save(temporary, quality=_JPEG_QUALITY)
    return files, small


def _too_few(got: int, what: str) -> SceneError:
    remedy = (
        "Take more photographs with more overlap (each part of the scene in three or more), in focus and with texture."
    )
    return SceneError("poses", expected=f"at least {MIN_FRAMES} {what}", got=got, remedy=remedy)


def _map(folder: Path, count: int, seed: int, say: Callable[[str], None]) -> int:
    """Write the model of the largest group of photographs that fit together; return their number; no group: 0."""
    import pycolmap

    found = 2  # COLMAP does not call next_image for the first pair

    def next_image() -> None:
        nonlocal found
        found += 1
        if found % _SAID_EVERY == 0:
            say(f"poses: {min(found, count)} of {count} photographs")

    pycolmap.set_random_seed(seed)
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = seed
    options.mapper.random_seed = seed
    options.triangulation.random_seed = seed
    # One thread gives the same result each time: sums over threads vary in the last bits, which can decide on a point.
    options.num_threads = 1
    options.mapper.num_threads = 1
    options.min_model_size = MIN_FRAMES
    given = folder / _DATABASE, folder / _IMAGES, folder, options
    groups: dict[int, Any] = pycolmap.incremental_mapping(*given, next_image_callback=next_image)
    if not groups:
        return 0
    largest = max(groups.values(), key=lambda group: (group.num_reg_images(), len(group.points3D)))
    posed = sorted(largest.reg_image_ids())
    for image, name in zip(posed, scene_names(len(posed))):
        largest.image(image).name = f"{name}.jpg"
    new = writable_folder(folder / f"new-{MODEL_FOLDER}")
    largest.write(new)
    try:
        read_model(new)  # COLMAP does not notice a full disk
    except SceneError as problem:
        expected, got = f"to write {folder / MODEL_FOLDER}", "files that are cut off"
        raise OutputError("poses", expected=expected, got=got, remedy="Check free space.") from problem
    shutil.rmtree(folder / MODEL_FOLDER, ignore_errors=True)
    new.rename(folder / MODEL_FOLDER)
    return len(posed)


def scene_names(count: int) -> list[str]:
    """Return names of `count` frames, without suffix. Every 8th from the 5th on evaluates; of 2 to 6, the last but one.

    >>> scene_names(5)[3:]
    ['frame_eval_00004', 'frame_train_00005']
    """
    offset = min(EVAL_INTERVAL // 2, max(count - 2, 0)) if count > 1 else -1
    digits = max(5, len(str(count)))
    sets = ["eval" if number % EVAL_INTERVAL == offset else "train" for number in range(count)]
    return [f"frame_{kind}_{number:0{digits}d}" for number, kind in enumerate(sets, start=1)]


def read_poses(folder: Path, names: Sequence[str], size: tuple[int, int]) -> SfmModel:
    """Return the model that `find_poses` wrote to `folder`, at the size of the original photographs.

    `names` are the names of the frames that `find_poses` got, in its order; `size` is the original photographs' width
    and height. Raises `SceneError` if the model is damaged.
    """
    try:
        cameras, images, points = read_model(folder / MODEL_FOLDER)
    except SceneError as problem:
        remedy = "Find the poses again with --from-stage poses."
        raise SceneError("poses", expected="those that were kept", got=problem, remedy=remedy) from problem
    posed, ids = [images[number] for number in sorted(images)], sorted(points)
    lens, number = cameras[posed[0].camera_id], {point: row for row, point in enumerate(ids)}
    values: dict[str, Any] = lens_entries(lens.model, lens.params)
    camera = Camera(int(lens.width), int(lens.height), **values)
    factor = 0.5 * (size[0] / camera.width + size[1] / camera.height)
    model = SfmModel(
        tuple(names[int(image.id) - 1] for image in posed),
        camera.resized(*size),
        np.stack([camera_to_world(image) for image in posed]),
        np.array([points[point].xyz for point in ids], dtype=np.float64).reshape(-1, 3),
        np.array([float(points[point].error) for point in ids]) * factor,
        seen=(),
        errors_px=(),
    )
    seen, errors_px = list[IntArray](), list[FloatArray]()
    for frame, image in enumerate(posed):
        # A photograph may show a point by two features; the first counts.
        features = zip(reversed(image.point3D_ids.tolist()), reversed(image.xys))
        own = {number[point]: pixel for point, pixel in features if point in number}
        seen.append(np.array(sorted(own), dtype=np.int64))
        pixels = np.array([own[row] for row in seen[-1].tolist()]).reshape(-1, 2)
        shown = camera.project(model.in_camera(frame, model.points[seen[-1]]))
        errors_px.append(np.linalg.norm(shown - pixels, axis=1) * factor)
    return replace(model, seen=tuple(seen), errors_px=tuple(errors_px))


def image_pairs(count: int) -> IntArray:
    """Return the pairs of `count` photographs to match, sorted, shape (p, 2): indices in order of time, smaller first.

    Up to `EXHAUSTIVE_UP_TO` photographs, these are all pairs; above it, neighbours in time and some far pairs.

    >>> image_pairs(3).tolist()
    [[0, 1], [0, 2], [1, 2]]
    """
    if count <= EXHAUSTIVE_UP_TO:
        return np.stack(np.triu_indices(count, 1), axis=1).astype(np.int64)
    steps = [*range(1, _NEIGHBOURS), *(_NEIGHBOURS * 2**power for power in range(count.bit_length()))]
    first, step = (grid.ravel() for grid in np.meshgrid(np.arange(count), steps, indexing="ij"))
    near = np.stack([first, first + step], axis=1)
    anchors = np.unique(np.linspace(0, count - 1, min(_ANCHORS, count)).round().astype(np.int64))
    far = anchors[np.stack(np.triu_indices(len(anchors), 1), axis=1)]
    return np.unique(np.concatenate([near[near[:, 1] < count], far]).astype(np.int64), axis=0)


def _find_and_match(
    folder: Path, names: list[str], params: str, settings: CaptureSettings, say: Callable[[str], None]
) -> None:
    """Find features in the reduced photographs, match them, and write both to the database in `folder`. Results of an
    interrupted run in the database are kept. `names` are the reduced photographs' files in the order in which they were
    taken. `params` are the lens's parameters at that size, as COLMAP writes them; empty: guessed."""
    import pycolmap

    database, images = folder / _DATABASE, folder / _IMAGES
    reader = pycolmap.ImageReaderOptions(camera_model=settings.lens, camera_params=params)
    reader.default_focal_length_factor = _GUESSED_FOCAL
    if not database.is_file():
        # Photographs are numbered here, in order; the threads that find features would number them by chance.
        with replace_when_done(database) as temporary:
            pycolmap.Database.open(temporary).close()
            pycolmap.import_images(temporary, images, pycolmap.CameraMode.SINGLE, names, reader)
    extraction = pycolmap.FeatureExtractionOptions(use_gpu=False, num_threads=settings.threads)
    extraction.sift.max_num_features = settings.max_features
    for start in range(0, len(names), _CHUNK):  # COLMAP skips photographs that already have features
        some = names[start : start + _CHUNK]
        given: dict[str, Any] = {"reader_options": reader, "extraction_options": extraction}
        pycolmap.extract_features(database, images, some, **given)
        say(f"features: {start + len(some)} of {len(names)} photographs")
    pairs = image_pairs(len(names))
    matching = pycolmap.FeatureMatchingOptions(use_gpu=False, num_threads=settings.threads)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = settings.seed
    listed = database.with_name("pairs.txt")
    for start in range(0, len(pairs), _PAIR_CHUNK):
        some = pairs[start : start + _PAIR_CHUNK]
        listed.write_text("".join(f"{names[a]} {names[b]}\n" for a, b in some), encoding="utf-8")
        pairing: Any = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = str(listed)
        pycolmap.match_image_pairs(database, matching, pairing, verification)
        say(f"matches: {start + len(some)} of {len(pairs)} pairs of photographs")
