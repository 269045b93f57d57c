"""The rig from a folder of board pictures: the same two cameras, a heated checker board in different places."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from thermoxels_ns.capture.camera_files import scan_folder
from thermoxels_ns.capture.frames import read_frames
from thermoxels_ns.capture.pairs import PairOptions, find_pairs
from thermoxels_ns.capture.photograph import open_photograph
from thermoxels_ns.capture.rig.board_rig import CheckerBoard, rig_from_boards
from thermoxels_ns.capture.rig.inputs import BASELINE_SIGMA_M, rig_start
from thermoxels_ns.capture.settings import CaptureSettings
from thermoxels_ns.capture.sfm.metric_scale import MetricScale
from thermoxels_ns.capture.stage_types import CameraModel, RigEstimate
from thermoxels_ns.core.errors import SceneError, explain
from thermoxels_ns.radiometry.camera_file import RadiometryOptions

_SIZE = re.compile(r"(\d{1,3})\s*[xX]\s*(\d{1,3})")
_SHIFTS = slice(3, 6)
"""Of a rig's ten parameters, those that are lengths."""


def board_of(settings: CaptureSettings) -> CheckerBoard | None:
    """The board that the options describe; None where they name no pictures of one.

    Raises:
        SceneError: An option of the board is missing, or has no meaning without the others.
    """
    given = {
        "--board-photos": settings.board_photos,
        "--board": settings.board,
        "--board-square-m": settings.board_square_m,
    }
    missing = [name for name, value in given.items() if value is None]
    if len(missing) == len(given):
        return None
    if missing or settings.rig is not None:
        raise SceneError(
            "checker board",
            expected="--board-photos, --board and --board-square-m together, and no --rig beside them",
            got=("no " + " and no ".join(missing)) if missing else "all of them and --rig",
            remedy="Pass --board-photos FOLDER --board 7x5 --board-square-m 0.03, or none of them.",
        )
    match = _SIZE.fullmatch(str(settings.board).strip())
    if match is None:
        raise SceneError(
            "--board",
            expected="inner corners along both sides, such as 7x5",
            got=repr(settings.board),
            remedy="Count the corners where four squares meet; one less than squares.",
        )
    sides = sorted(map(int, match.groups()), reverse=True)
    assert settings.board_square_m is not None
    return CheckerBoard(sides[0], sides[1], settings.board_square_m)


def rig_from_board_photos(
    source: Path,
    board: CheckerBoard,
    visible: CameraModel,
    thermal_size: tuple[int, int],
    folder: Path,
    settings: CaptureSettings,
    radiometry: RadiometryOptions,
    say: Callable[[str], None] = lambda _: None,
) -> RigEstimate:
    """Find the rig from a folder with photographs and thermal images of a board.

    Args:
        source: The folder; its files are paired and read like those of the capture.
        board: What is in the pictures.
        visible: Camera of the capture's photographs, which took these too.
        thermal_size: Width and height of the capture's thermal images.
        folder: For what is read.
        settings: How pairs are recognised, and what is known of the lens.
        radiometry: How files become degrees.
        say: Told how far it is.

    Returns:
        The rig, lengths in metres.

    Raises:
        SceneError: There are no pairs, they come from another camera, or fewer than three show the board to both
            cameras; the message lists what each pair shows.
    """
    found = scan_folder(source)
    if found.unreadable and not settings.skip_bad:
        raise SceneError(next(iter(found.unreadable.values())))
    search = find_pairs(found, PairOptions(settings.time_limit_s, settings.clock_offset_s))
    if not search.pairs:
        example = next((f"{path.name}: {why}" for path, why in search.unpaired.items()), "no camera files")
        raise SceneError(
            f"board pictures in {source}",
            expected="photographs with thermal images",
            got=f"none; {example}",
            remedy="Give both of a shot the same name or time.",
        )
    read = read_frames(search.pairs, source, folder, radiometry, settings.skip_bad, settings.thermal_mask, say)
    if read.thermal_size != thermal_size:
        raise SceneError(_another_camera("thermal images", thermal_size, read.thermal_size))
    pairs, names = [], []
    for frame in read.frames:
        photograph = open_photograph(frame.photograph)
        if photograph.size != (visible.width, visible.height):
            problem = _another_camera(frame.photograph_source, (visible.width, visible.height), photograph.size)
            raise SceneError(problem)
        pairs.append((np.asarray(photograph.convert("L")), np.load(frame.thermal, allow_pickle=False)))
        names.append(frame.name)
    start = rig_start(read.frames, visible, thermal_size, settings.thermal_field_of_view_deg)
    estimate = rig_from_boards(pairs, visible, replace(start, translation_sigma=BASELINE_SIGMA_M), board)
    if not estimate.determined:
        raise SceneError(
            f"board pictures in {source}",
            expected=f"at least three pairs in which both cameras show the {board.columns} x {board.rows} corners",
            got=estimate.explanation + f" Pairs: {_listed(names)}",
            remedy="Check --board; heat the board evenly, hold it still, and let it fill a third of the picture.",
        )
    say(f"board: {estimate.explanation}")
    return estimate


def in_scene_units(rig: RigEstimate, scale: MetricScale | None, missing: str) -> RigEstimate:
    """Turn a rig in metres into one in units of the scene.

    Raises:
        SceneError: The scene's scale is unknown.
    """
    if scale is None:
        raise SceneError(
            "scale",
            expected="a known scale, because a board gives the distance of the lenses in metres",
            got=f"none: {missing}",
            remedy="Pass --known-distance or --marker-side-m; poses that were found are kept.",
        )
    transform, covariance = rig.visible_to_thermal.copy(), rig.covariance.copy()
    transform[:3, 3] /= scale.metres_per_unit
    covariance[_SHIFTS] /= scale.metres_per_unit
    covariance[:, _SHIFTS] /= scale.metres_per_unit
    return replace(rig, visible_to_thermal=transform, covariance=covariance)


def _another_camera(name: str, wanted: Sequence[int], got: Sequence[int]) -> str:
    return explain(
        f"board pictures: {name}",
        expected=f"{wanted[0]} x {wanted[1]} pixels, as in the capture",
        got=f"{got[0]} x {got[1]}",
        remedy="Photograph the board with the same cameras in the same mode.",
    )


def _listed(names: Sequence[str], most: int = 10) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
