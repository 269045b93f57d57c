"""Where the camera stood: structure from motion on the photographs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from thermoxels_ns.capture.masks import PhotographMasks
from thermoxels_ns.capture.photograph import open_photograph, read_photograph_facts
from thermoxels_ns.capture.sfm.feature_matching import FeatureOptions, LensModel, Matching, fill_database
from thermoxels_ns.capture.sfm.mapping import MIN_FRAMES, MatchedPhotographs, map_photographs, triangulate
from thermoxels_ns.capture.sfm.model import SfmModel
from thermoxels_ns.capture.stage_types import CameraModel
from thermoxels_ns.core.errors import SceneError

_GUESSED_FOCAL = 1.0
"""Of the longest side, where the photograph does not say: a lens of 53 degrees."""
_JPEG_QUALITY = 95
_DATABASE = "features.db"


@dataclass(frozen=True)
class PoseOptions:
    """How poses are found."""

    image_size: int = 1600
    """Longest side to which photographs are reduced for features, [pixels]."""
    max_features: int = 4000
    """Features per photograph."""
    matching: Matching = "auto"
    """Which photographs are compared."""
    lens: LensModel = "SIMPLE_RADIAL"
    """Lens model."""
    seed: int = 0
    threads: int = 2


@dataclass(frozen=True)
class Poses:
    """The poses found, and the photographs without one."""

    model: SfmModel
    dropped: Mapping[str, str]
    """Why, by the frame's name."""


def find_poses(
    photographs: Mapping[str, Path],
    folder: Path,
    focal_px: float | None = None,
    masks: PhotographMasks | None = None,
    options: PoseOptions | None = None,
    say: Callable[[str], None] = lambda _: None,
) -> Poses:
    """Find camera and poses from photographs of one camera alone (incremental structure from motion by COLMAP).

    Args:
        photographs: Files by the frame's name, in the order they were taken.
        folder: For features, matches and reduced photographs; what an interrupted run left is used.
        focal_px: Focal length that the photographs state, [pixels]; None: unknown.
        masks: Where photographs may be used; None: everywhere.
        options: Sizes and limits.
        say: Told how far it is.

    Returns:
        The largest group of photographs that fit together, and why the others are not in it.

    Raises:
        SceneError: Fewer than 3 photographs fit together, or a photograph cannot be decoded.
    """
    options = options or PoseOptions()
    if len(photographs) < MIN_FRAMES:
        raise _too_few(len(photographs), "photographs")
    size, other = common_size(photographs)
    dropped = {
        name: f"{w} x {h} pixels, the others {size[0]} x {size[1]}: another camera or mode"
        for name, (w, h) in other.items()
    }
    names = [name for name in photographs if name not in dropped]
    if len(names) < MIN_FRAMES:
        raise _too_few(len(names), "photographs of one size")
    images = _reduced(photographs, names, folder / "images", size, options.image_size)
    mask_folder = _write_masks(masks, images, folder / "masks")
    start = start_camera(size, focal_px).resized(*images.camera_size)
    features = FeatureOptions(options.max_features, options.matching, options.lens, options.seed, options.threads)
    matched = MatchedPhotographs(folder / _DATABASE, folder / "images", images.files, size)
    fill_database(
        matched.database, matched.images, list(images.files), start, focal_px is not None, mask_folder, features, say
    )
    mapped = map_photographs(matched, options.seed, say)
    found = 0 if mapped is None else len(mapped.model.frames)
    if mapped is None or found < MIN_FRAMES:
        raise _too_few(found, "photographs that fit together")
    for name in names:
        if name in mapped.elsewhere:
            dropped[name] = f"fits only to {mapped.elsewhere[name]} others, in a part of its own"
        elif name not in mapped.model.frames:
            dropped[name] = "too few matches with the other photographs"
    return Poses(mapped.model, dropped)


def add_points(
    given: SfmModel,
    photographs: Mapping[str, Path],
    folder: Path,
    masks: PhotographMasks | None = None,
    options: PoseOptions | None = None,
    say: Callable[[str], None] = lambda _: None,
) -> SfmModel:
    """Find the points that photographs with known poses share; camera and poses stay as they are.

    Args:
        given: Camera and poses; its points are replaced.
        photographs: Files by the frame's name; at least those of `given`.
        folder: For features, matches and reduced photographs.
        masks: Where photographs may be used; None: everywhere.
        options: Sizes and limits.
        say: Told how far it is.

    Raises:
        SceneError: There are fewer than two photographs, or they are of another size than the camera's.
    """
    options = options or PoseOptions()
    names = list(given.frames)
    if len(names) < 2:
        raise SceneError(
            "given poses",
            expected="poses of at least 2 photographs, which see the same points",
            got=len(names),
            remedy="Give poses of more photographs, or let thermoxels capture find them.",
        )
    size, other = common_size({name: photographs[name] for name in names})
    if other or size != (given.camera.width, given.camera.height):
        raise SceneError(
            "given poses",
            expected=f"photographs of {given.camera.width} x {given.camera.height} pixels, as their camera has",
            got=f"{size[0]} x {size[1]}",
            remedy="Use the photographs that the poses were computed from.",
        )
    images = _reduced(photographs, names, folder / "images", size, options.image_size)
    mask_folder = _write_masks(masks, images, folder / "masks")
    camera = given.camera.resized(*images.camera_size)
    features = FeatureOptions(options.max_features, options.matching, "OPENCV", options.seed, options.threads)
    matched = MatchedPhotographs(folder / _DATABASE, folder / "images", images.files, size)
    fill_database(matched.database, matched.images, list(images.files), camera, True, mask_folder, features, say)
    return triangulate(matched, given, options.seed, say)


def start_camera(size: tuple[int, int], focal_px: float | None) -> CameraModel:
    """A camera to begin with: the photographs' own focal length or a usual one, the principal point at the centre."""
    focal = focal_px or _GUESSED_FOCAL * max(size)
    return CameraModel(size[0], size[1], focal, focal, size[0] / 2.0, size[1] / 2.0)


@dataclass(frozen=True)
class _ReducedImages:
    files: dict[str, str]
    """Frame by the file's name, in order."""
    camera_size: tuple[int, int]


def common_size(photographs: Mapping[str, Path]) -> tuple[tuple[int, int], dict[str, tuple[int, int]]]:
    """Find the size that most photographs have, and the frames of another size with theirs.

    Raises:
        SceneError: There is no photograph, or one cannot be read.
    """
    sizes = {}
    for name, path in photographs.items():
        facts = read_photograph_facts(path)
        sizes[name] = (facts.width, facts.height)
    if not sizes:
        raise _too_few(0, "photographs")
    counted = list(sizes.values())
    common = max(dict.fromkeys(counted), key=counted.count)
    return common, {name: size for name, size in sizes.items() if size != common}


def _reduced(
    photographs: Mapping[str, Path], names: Sequence[str], folder: Path, size: tuple[int, int], longest: int
) -> _ReducedImages:
    """Write the photographs for COLMAP: smaller, and without EXIF, by which it would turn them."""
    factor = min(1.0, longest / max(size))
    small = (max(1, round(size[0] * factor)), max(1, round(size[1] * factor)))
    folder.mkdir(exist_ok=True)
    digits = max(4, int(math.log10(max(len(names), 1))) + 1)
    files = {}
    for index, name in enumerate(names):
        file = f"{index:0{digits}d}.jpg"
        files[file] = name
        if not (folder / file).is_file():
            picture = open_photograph(photographs[name])
            if small != size:
                picture = picture.resize(small, Image.Resampling.BOX if factor < 0.5 else Image.Resampling.LANCZOS)
            temporary = folder / f".{file}"
            picture.save(temporary, format="JPEG", quality=_JPEG_QUALITY)
            temporary.replace(folder / file)
    return _ReducedImages(files, small)


def _write_masks(masks: PhotographMasks | None, images: _ReducedImages, folder: Path) -> Path | None:
    """Write masks as COLMAP looks for them: the photograph's name with .png behind it."""
    if masks is None or not masks.any:
        return None
    folder.mkdir(exist_ok=True)
    for file, frame in images.files.items():
        use = Image.fromarray(np.where(masks.of(frame), np.uint8(255), np.uint8(0)))
        use.resize(images.camera_size, Image.Resampling.NEAREST).save(folder / f"{file}.png")
    return folder


def _too_few(got: int, what: str) -> SceneError:
    return SceneError(
        "poses",
        expected=f"at least {MIN_FRAMES} {what}",
        got=got,
        remedy="Take more photographs with more overlap (each part of the scene in three or more), in focus and "
        "with texture; or give poses with --poses.",
    )
