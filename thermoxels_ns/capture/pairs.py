"""Finds which thermal image belongs to which photograph."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import partial
from pathlib import Path

import numpy as np

from thermoxels_ns.capture.folder_scan import ROLE_WORDS, CameraFile, CameraFolder, natural_key, scan_folder, words_of
from thermoxels_ns.capture.settings import CaptureSettings
from thermoxels_ns.core.errors import SceneError, printable

_DJI = re.compile(r"^(?P<head>.*?dji)_(?:(?P<time>\d{14})_)?(?P<number>\d{3,})_(?P<role>[a-z])(?P<tail>.*)$")
_DJI_LATE_S = 3.0  # largest difference between the time stamps of the two images of one shot, [s]
_DJI_PHOTOGRAPHS = ("v", "w")
"""Letters of DJI's photographs, preferred letter first. The zoom camera's z is not used: its focal length varies."""
_LAST_LETTERS = frozenset({"t", "v", "w", "r"})
_CLEARLY_NEARER = 2.0
_CLOCK_STEP_S = 0.5
"""The nearest file, t seconds away, is ambiguous if the next is within both _CLEARLY_NEARER * t + _CLOCK_STEP_S and the
time limit."""
_REMEDY = (
    "Copy photographs and thermal files (FLIR or DJI R-JPEG, radiometric TIFF, .npy, .csv) of the same shots into the "
    "folder, as the camera wrote them; give both of a shot the same name (DJI: _T and _V or _W), or the right time "
    "(--clock-offset-s, --time-limit-s)."
)


@dataclass(frozen=True)
class Pair:
    """One photograph and its thermal image, named by their paths relative to the capture folder, with "/"."""

    photograph: str
    thermal: str  # the same as `photograph` if the camera writes both into one file
    how: str  # the rule by which the two files were paired

    @property
    def in_one_file(self) -> bool:
        """True if photograph and thermal image are in the same file."""
        return self.photograph == self.thermal


@dataclass(frozen=True)
class PairSearch:
    """All pairs of a folder, and for every other camera file the reason why no pair contains that file."""

    pairs: tuple[Pair, ...]  # sorted by the photographs' paths (`natural_key`)
    unpaired: dict[str, str] = field(default_factory=dict)  # reason by file, relative to the capture folder


def search_pairs(
    folder: Path, settings: CaptureSettings, without: Sequence[Path] = (), say: Callable[[str], None] = lambda _: None
) -> PairSearch:
    """Return the pairs in a folder, except its folders `without`. Files that cannot be read are in `unpaired`.

    Raises `SceneError` if there is no pair, or if a file cannot be read and `settings.skip_bad` is off.
    """
    found = scan_folder(folder, without, say)
    search = find_pairs(found, settings.time_limit_s, settings.clock_offset_s)
    if found.unreadable and not settings.skip_bad:
        first = next(iter(found.unreadable.values()))
        more = f" {len(found.unreadable) - 1} more cannot be read." if len(found.unreadable) > 1 else ""
        remedy = "" if "--skip-bad" in first else " To go on without such files, pass --skip-bad True."
        raise SceneError(f"{first}{more}{remedy}")
    if search.pairs:
        unreadable = {_name(path, folder): why for path, why in found.unreadable.items()}
        return replace(search, unpaired=unreadable | search.unpaired)
    roles = Counter(file.role for file in found.files)
    parts = [
        *((roles["photograph"], "photographs"), (roles["thermal"], "thermal images")),
        (roles["thermal picture"], "pictures named thermal, without temperatures"),
        *((len(found.unreadable), "unreadable files"), (found.others, "files of other kinds")),
    ]
    got = ", ".join(f"{number} {what}" for number, what in parts if number) or "no files"
    for name, why in list(search.unpaired.items())[:1]:
        got += f" ({Path(name).name}: {why})"
    raise SceneError(str(found.folder), expected="photographs with thermal images", got=got, remedy=_REMEDY)


def find_pairs(found: CameraFolder, time_limit_s: float = 1.5, clock_offset_s: float = 0.0) -> PairSearch:
    """Return pairs of photographs and thermal images, by four rules in turn: one file, DJI's names, equal names, time.

    Names are compared without words for the kind of image: ``10-58-15-636-visible.jpg`` pairs with
    ``10-58-15-636-radiometric.tiff``. Two files pair by time if each is the other's nearest, at most `time_limit_s`
    away, and no second file is about as near. `clock_offset_s` says how far the thermal camera's clock is ahead.
    """
    pairs: list[tuple[CameraFile, CameraFile, str]] = []
    unpaired = dict[Path, str]()
    both = [file for file in found.files if file.role == "both"]
    pairs += [(file, file, "both in one file") for file in both]
    photographs = [file for file in found.files if file.role == "photograph"]
    thermal = [file for file in found.files if file.role in ("thermal", "thermal picture")]
    for step in (_by_dji_names, partial(_by_names, folder=found.folder)):
        matched, explained = step(photographs, thermal)
        pairs += matched
        unpaired |= explained
        used = {file.path for pair in matched for file in pair[:2]} | set(explained)
        photographs = [file for file in photographs if file.path not in used]
        thermal = [file for file in thermal if file.path not in used]
    matched, explained = _by_time(photographs, thermal, time_limit_s, clock_offset_s)
    pairs += matched
    unpaired |= explained
    ordered = sorted(pairs, key=lambda pair: natural_key(pair[0].path.relative_to(found.folder)))
    left_out = sorted(unpaired.items(), key=lambda item: natural_key(item[0]))
    return PairSearch(
        tuple(Pair(_name(one.path, found.folder), _name(two.path, found.folder), how) for one, two, how in ordered),
        {_name(path, found.folder): why for path, why in left_out},
    )


def _name(path: Path, folder: Path) -> str:
    return printable(path.relative_to(folder).as_posix())


_Found = tuple[list[tuple[CameraFile, CameraFile, str]], dict[Path, str]]


def _by_dji_names(photographs: Sequence[CameraFile], thermal: Sequence[CameraFile]) -> _Found:
    """Return pairs such as DJI_0001_T and DJI_0001_V (or _W), and by path the reasons why other files have no pair.
    The times in the two names may differ by up to `_DJI_LATE_S`."""
    taken: dict[tuple, list[tuple[re.Match[str], CameraFile]]] = defaultdict(list)
    for file in (*photographs, *thermal):
        match = _DJI.match(file.path.stem.lower())
        if match:
            taken[(file.path.parent, match["head"], match["number"], match["tail"])].append((match, file))
    pairs, others = [], []
    for group in taken.values():
        photos = [(match, file) for match, file in group if file.role == "photograph"]
        for match, file in group:
            if match["role"] != "t" or file.role == "photograph":
                continue
            near = [(m["role"], f) for m, f in photos if _seconds_apart(m, match) <= _DJI_LATE_S]
            sides = [[f for letter, f in near if letter == each] for each in _DJI_PHOTOGRAPHS]
            best = next((side for side in sides if side), [])
            if len(best) == 1:
                pairs.append((best[0], file, "DJI's names"))
                others.append([f.path for _, f in near if f is not best[0]])
    counted = Counter(photo.path for photo, _, _ in pairs)
    clear, explained = [], dict[Path, str]()
    for pair, rest in zip(pairs, others):
        if counted[pair[0].path] == 1:
            clear.append(pair)
            explained |= {path: f"{pair[0].path.name} is the partner of {pair[1].path.name}" for path in rest}
    return clear, {path: why for path, why in explained.items() if path not in counted}


def _seconds_apart(first: re.Match[str], second: re.Match[str]) -> float:
    if not first["time"] or not second["time"]:
        return 0.0 if first["time"] == second["time"] else np.inf

    def seconds(digits: str) -> int:
        return int(digits[6:8]) * 86400 + int(digits[8:10]) * 3600 + int(digits[10:12]) * 60 + int(digits[12:])

    return abs(seconds(first["time"]) - seconds(second["time"]))


def _by_names(photographs: Sequence[CameraFile], thermal: Sequence[CameraFile], folder: Path) -> _Found:
    """Return pairs of files with equal names (`_shot`), and by path the reasons why other files have no pair. If
    several files share a name, their folders (`place`) must be equal too."""

    def place(file: CameraFile) -> tuple[str, ...]:
        folders = file.path.relative_to(folder).parts[:-1]
        return tuple(word for part in folders for word in words_of(part) if word not in ROLE_WORDS)

    def groups(files: Sequence[CameraFile], key: Callable[[CameraFile], tuple]) -> list[list[CameraFile]]:
        grouped = defaultdict[tuple, list[CameraFile]](list)
        for file in files:
            grouped[key(file)].append(file)
        return list(grouped.values())

    pairs, explained = [], dict[Path, str]()
    for group in groups((*photographs, *thermal), lambda file: _shot(file.path.stem)):
        roles = Counter(file.role for file in group)
        several = max(roles["photograph"], roles["thermal"]) > 1
        for part in groups(group, place) if several else [group]:
            photos = [file for file in part if file.role == "photograph"]
            thermals = [file for file in part if file.role == "thermal"]
            pictures = [file for file in part if file.role == "thermal picture"]
            for picture in pictures if thermals else []:
                explained[picture.path] = f"a picture for the eye; the temperatures are in {thermals[0].path.name}"
            thermals = thermals or pictures
            if len(photos) == 1 and len(thermals) == 1:
                pairs.append((photos[0], thermals[0], "equal names"))
            elif photos and thermals:
                listed = ", ".join(file.path.name for file in (*photos, *thermals))
                why = f"ambiguous: {len(photos)} photographs and {len(thermals)} thermal images share a name ({listed})"
                explained |= {file.path: why for file in (*photos, *thermals)}
    return pairs, explained


def _shot(stem: str) -> tuple[str, ...]:
    """Return the words (`words_of`) of a file name that identify the shot, without words for the kind of image."""
    words = words_of(stem)
    kept = tuple(word for word in words if word not in ROLE_WORDS)
    if len(kept) > 1 and kept[-1] in _LAST_LETTERS:
        kept = kept[:-1]
    return kept or words


def _by_time(
    photographs: Sequence[CameraFile], thermal: Sequence[CameraFile], limit_s: float, offset_s: float
) -> _Found:
    """Return pairs of files that are close in time, see `find_pairs`, and by path the reasons for all other files."""
    explained = {file.path: "no partner of this name, and no time in the file" for file in (*photographs, *thermal)}
    photos, thermals = ([file for file in side if file.taken_at is not None] for side in (photographs, thermal))
    if not photos or not thermals:
        return [], explained
    at = [
        np.array([(f.taken_at - datetime.min).total_seconds() for f in side if f.taken_at])
        for side in (photos, thermals)
    ]
    apart = np.abs(at[0][:, None] - (at[1][None, :] - offset_s))
    chosen: dict[Path, tuple[CameraFile, float]] = {}
    for files, others, table in ((photos, thermals, apart), (thermals, photos, apart.T)):
        for file, row in zip(files, table):
            order = np.argsort(row, kind="stable")[:2]
            (partner, *more), (nearest, *seconds) = [others[number] for number in order], row[order].tolist()
            name = partner.path.name
            if nearest > limit_s:
                why = f"no partner of this name; the nearest in time, {name}, is {nearest:.1f} s away"
            elif more and seconds[0] <= min(_CLEARLY_NEARER * nearest + _CLOCK_STEP_S, limit_s):
                two = f"{name} ({nearest:.1f} s) and {more[0].path.name} ({seconds[0]:.1f} s)"
                why = f"ambiguous: {two} are about as near in time"
            else:
                chosen[file.path] = partner, nearest
                why = f"{name}, the nearest in time, is nearer to another or ambiguous"
            explained[file.path] = why
    pairs = []
    for photo in photos:  # a pair counts only if each file is the clear choice of the other
        partner, nearest = chosen.get(photo.path, (None, 0.0))
        if partner is not None and chosen.get(partner.path, (None,))[0] is photo:
            pairs.append((photo, partner, f"taken {nearest:.1f} s apart"))
            del explained[photo.path], explained[partner.path]
    return pairs, explained
