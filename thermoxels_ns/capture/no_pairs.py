"""A folder in which nothing belongs together: what it holds, why that is no capture, and what to do."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from thermoxels_ns.capture.camera_files import CameraFile, CameraFolder, shown_name
from thermoxels_ns.core.errors import SceneError

_DJI_LIBRARY = (
    "DJI's thermal images also need DJI's own library: download the DJI Thermal SDK and pass --dji-library with the "
    "path of libdirp.so (libdirp.dll on Windows)."
)


def no_pairs(found: CameraFolder, unpaired: Mapping[Path, str], has_dji_library: bool) -> SceneError:
    """Describe a folder without a pair.

    Args:
        found: What it holds.
        unpaired: Why each file is in no pair.
        has_dji_library: Whether the user has named DJI's library.

    Returns:
        The error to raise: what there is, one file with its reason, and a remedy that fits what is missing.
    """
    photographs = [file for file in found.files if file.role == "photograph"]
    thermal = [file for file in found.files if file.role == "thermal"]
    pictures = [file for file in found.files if file.role == "thermal picture"]
    got = _counted(found, len(photographs), len(thermal), len(pictures))
    example = next((item for item in unpaired.items() if item[0] not in found.passed_over), None)
    if example is not None:
        got += f" ({example[0].name}: {example[1]})"
    remedies = [_remedy(photographs, thermal, pictures)]
    if found.passed_over:
        path, why = next(iter(found.passed_over.items()))
        remedies.append(f"Not looked at: {shown_name(path)}: {why}.")
    if any(file.dji for file in thermal) and not has_dji_library:
        remedies.append(_DJI_LIBRARY)
    return SceneError(str(found.folder), expected="photographs with thermal images", got=got, remedy=" ".join(remedies))


def _counted(found: CameraFolder, photographs: int, thermal: int, pictures: int) -> str:
    parts = [_number(photographs, "photograph"), _number(thermal, "thermal image")]
    if pictures:
        parts.append(_number(pictures, "picture") + " for the eye, named thermal, without temperatures")
    if found.unreadable:
        parts.append(_number(len(found.unreadable), "file") + " that cannot be read")
    if found.others:
        parts.append(_number(found.others, "file") + " of other kinds")
    return ", ".join(parts)


def _number(count: int, what: str) -> str:
    return f"{count or 'no'} {what}{'' if count == 1 else 's'}"


def _remedy(photographs: list[CameraFile], thermal: list[CameraFile], pictures: list[CameraFile]) -> str:
    if photographs and thermal:
        return (
            "Give both of a shot the same name, or the right time (--clock-offset-s, --time-limit-s), or list them in "
            "a file with --pairs."
        )
    if thermal:
        words = "Copy the photographs of the same shots into the folder too."
        if any(file.dji for file in thermal):
            words += " DJI names them as the thermal image, with _V or _W in place of _T."
        return words
    if photographs or pictures:
        return (
            "Copy the thermal files as the camera wrote them (FLIR or DJI R-JPEG, radiometric TIFF, .npy, .csv) into "
            "the folder too; pictures that were edited, sent or exported have lost their temperatures."
        )
    return "Pass the folder that the memory card was copied to."
