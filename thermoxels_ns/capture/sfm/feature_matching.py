"""Finds features of the photographs and their matches, and stores both in COLMAP's database."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from thermoxels_ns.capture.settings import LensModel, Matching
from thermoxels_ns.capture.sfm.colmap import run_in_process
from thermoxels_ns.core.arrays import IntArray
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.core.checks import replace_when_done

EXHAUSTIVE_UP_TO = 80  # auto matching compares all pairs up to this number of photographs; time grows with its square
_NEIGHBOURS = 8
"""Sequential matching: each photograph is matched with the next `_NEIGHBOURS`, and with those 2, 4, 8, ... times
`_NEIGHBOURS` places ahead."""
_ANCHORS = 40
"""Sequential matching: so many photographs, spread over the capture, are also matched with each other, so that a path
that returns to its start is closed."""
_CHUNK = 8
_PAIR_CHUNK = 200


@dataclass(frozen=True)
class PoseOptions:
    """Options of structure from motion; `CaptureSettings` has fields of the same names."""

    image_size: int = 1600  # Longest side to which photographs are reduced for features, [pixels]
    max_features: int = 4000  # Most features per photograph
    matching: Matching = "auto"  # Which pairs of photographs are compared, see `image_pairs`
    lens: LensModel = "SIMPLE_RADIAL"  # COLMAP's name of the lens model
    seed: int = 0  # Seed of all random choices; the same seed gives the same bits
    threads: int = 2  # Number of threads for finding and matching features


@dataclass(frozen=True)
class ReducedPhotographs:
    """Files that COLMAP reads and writes: reduced photographs, their masks, and a database of features and matches."""

    database: Path  # COLMAP's database file, made if it does not exist; COLMAP also writes to its folder
    images: Path  # folder of the reduced photographs, all of one size
    frame_of_image: Mapping[str, str]
    """Frame name by file name in `images`, in the order the photographs were taken."""
    size: tuple[int, int]
    """Width and height of the original photographs, [pixels]; the photographs in `images` may be smaller."""
    masks: Path | None = None  # folder of pictures that are black where features are not used; None: no masks


def image_pairs(count: int, matching: Matching) -> IntArray:
    """Return the pairs of photographs to match, sorted, shape (p, 2): indices in order of time, the smaller first.

    "exhaustive" gives every pair, "sequential" neighbours in time and some far pairs; "auto" chooses by `count`.

    >>> image_pairs(3, "exhaustive").tolist()
    [[0, 1], [0, 2], [1, 2]]
    """
    if matching == "exhaustive" or (matching == "auto" and count <= EXHAUSTIVE_UP_TO):
        return np.stack(np.triu_indices(count, 1), axis=1).astype(np.int64)
    steps = [*range(1, _NEIGHBOURS), *(_NEIGHBOURS * 2**power for power in range(count.bit_length()))]
    first, step = (grid.ravel() for grid in np.meshgrid(np.arange(count), steps, indexing="ij"))
    near = np.stack([first, first + step], axis=1)
    anchors = np.unique(np.linspace(0, count - 1, min(_ANCHORS, count)).round().astype(np.int64))
    far = anchors[np.stack(np.triu_indices(len(anchors), 1), axis=1)]
    return np.unique(np.concatenate([near[near[:, 1] < count], far]).astype(np.int64), axis=0)


def fill_database(
    photographs: ReducedPhotographs, camera: Camera, known_focal: bool, options: PoseOptions, say: Callable[[str], None]
) -> None:
    """Find features in photographs and match them, adding to what an interrupted run left in the database.

    `camera` is the start value of the lens, at the size of the reduced photographs; `known_focal` is True if its focal
    length is stated by photographs or poses, not guessed.
    """
    arguments = photographs, camera, known_focal, options
    run_in_process(_find_and_match, arguments, photographs.database.parent, say)


def _find_and_match(
    photographs: ReducedPhotographs, camera: Camera, known_focal: bool, options: PoseOptions, say: Callable[[str], None]
) -> None:
    import pycolmap

    _add_images(photographs, camera, options.lens, known_focal)
    database, names = photographs.database, list(photographs.frame_of_image)
    reader = pycolmap.ImageReaderOptions(camera_model=options.lens, existing_camera_id=1)
    if photographs.masks is not None:
        reader.mask_path = str(photographs.masks)
    extraction = pycolmap.FeatureExtractionOptions(use_gpu=False, num_threads=options.threads)
    extraction.sift.max_num_features = options.max_features
    for start in range(0, len(names), _CHUNK):  # COLMAP skips photographs that already have features
        some = names[start : start + _CHUNK]
        given: dict[str, Any] = {"reader_options": reader, "extraction_options": extraction}
        pycolmap.extract_features(database, photographs.images, some, **given)
        say(f"features: {start + len(some)} of {len(names)} photographs")
    pairs = image_pairs(len(names), options.matching)
    matching = pycolmap.FeatureMatchingOptions(use_gpu=False, num_threads=options.threads)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = options.seed
    listed = database.with_name("pairs.txt")
    for start in range(0, len(pairs), _PAIR_CHUNK):
        some = pairs[start : start + _PAIR_CHUNK]
        listed.write_text("".join(f"{names[a]} {names[b]}\n" for a, b in some), encoding="utf-8")
        pairing: Any = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = str(listed)
        pycolmap.match_image_pairs(database, matching, pairing, verification)
        say(f"matches: {start + len(some)} of {len(pairs)} pairs of photographs")


def as_colmap(camera: Camera, lens: LensModel) -> Any:
    """Return a camera as a pycolmap.Camera with number 1 and the given lens model."""
    import pycolmap

    numbers = [camera.fl_x, camera.fl_y, camera.cx, camera.cy, camera.k1, camera.k2, camera.p1, camera.p2]
    if lens != "OPENCV":
        numbers = [numbers[0], *numbers[2 : 5 if lens == "SIMPLE_RADIAL" else 6]]
    return pycolmap.Camera(camera_id=1, model=lens, width=camera.width, height=camera.height, params=numbers)


def _add_images(photographs: ReducedPhotographs, camera: Camera, lens: LensModel, known_focal: bool) -> None:
    """Create the database with photographs numbered in order; the feature threads would number them by chance."""
    import pycolmap

    if photographs.database.is_file():
        return
    names = photographs.frame_of_image
    with replace_when_done(photographs.database) as temporary, pycolmap.Database.open(temporary) as opened:
        colmap_camera = as_colmap(camera, lens)
        colmap_camera.has_prior_focal_length = known_focal
        opened.write_camera(colmap_camera, use_camera_id=True)
        rig = pycolmap.Rig(rig_id=1)
        rig.add_ref_sensor(colmap_camera.sensor_id)
        opened.write_rig(rig, use_rig_id=True)
        for number, name in enumerate(names, start=1):
            image = pycolmap.Image(name=name, camera_id=1, image_id=number)
            opened.write_image(image, use_image_id=True)
            frame = pycolmap.Frame(frame_id=number, rig_id=1)
            frame.add_data_id(image.data_id)
            opened.write_frame(frame, use_frame_id=True)
