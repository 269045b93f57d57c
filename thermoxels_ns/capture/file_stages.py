"""The stages that read the camera's files: pairs and temperatures."""

from __future__ import annotations

from pathlib import Path

from thermoxels_ns.capture import results
from thermoxels_ns.capture.camera_files import SUFFIXES, files_below, scan_folder, shown_name
from thermoxels_ns.capture.frames import CaptureFrames, read_frames
from thermoxels_ns.capture.job import PAGE_NAME, CaptureJob
from thermoxels_ns.capture.no_pairs import no_pairs
from thermoxels_ns.capture.pairs import Pair, PairOptions, find_pairs, read_pair_list
from thermoxels_ns.capture.stages import fingerprint, given_fingerprints, read_json, write_json
from thermoxels_ns.core.errors import SceneError

_MOST_NAMED = 10
"""Files left out that are named while the command runs."""


def pair_stage(job: CaptureJob) -> tuple[Pair, ...]:
    """Find which photograph belongs to which thermal image.

    Raises:
        SceneError: A file cannot be read and is not to be skipped, the list of pairs is wrong, or there are no pairs.
    """
    settings = job.settings
    options = PairOptions(settings.time_limit_s, settings.clock_offset_s)
    listed = [] if settings.pairs is None else [settings.pairs]
    inside, passed_over = files_below(job.source, [job.output])
    if settings.pairs is None:
        inside = [path for path in inside if path.suffix.lower() in SUFFIXES]
    depends = {
        "options": options,
        "files": fingerprint(inside, job.source),
        "passed_over": sorted(map(str, passed_over)),
        "list": given_fingerprints(listed),
        "skip_bad": settings.skip_bad,
    }

    def work(folder: Path) -> None:
        unreadable: dict[Path, str] = {}
        if settings.pairs is not None:
            search = read_pair_list(settings.pairs, job.source)
        else:
            found = scan_folder(job.source, [job.output], job.say)
            search, unreadable = find_pairs(found, options), found.unreadable
            if unreadable and not settings.skip_bad:
                first = next(iter(unreadable.values()))
                more = f" {len(unreadable) - 1} more cannot be read." if len(unreadable) > 1 else ""
                remedy = "" if "--skip-bad" in first else " To go on without such files, pass --skip-bad True."
                raise SceneError(f"{first}{more}{remedy}")
            if not search.pairs:
                raise no_pairs(found, search.unpaired, settings.dji_library is not None)
        results.save_pairs(folder, search, job.source)
        write_json(folder / "unreadable.json", {shown_name(path): why for path, why in unreadable.items()})
        job.say(f"pairs: {len(search.pairs)}, files without a partner: {len(search.unpaired)}")
        left_out = [(shown_name(path), why) for path, why in (unreadable | search.unpaired).items()]
        for name, why in left_out[:_MOST_NAMED]:
            job.say(f"left out: {name}: {why}")
        if len(left_out) > _MOST_NAMED:
            job.say(f"left out: {len(left_out) - _MOST_NAMED} more; {PAGE_NAME} names all")

    folder = job.cache.run("pairs", depends, work)
    pairs, unpaired = results.load_pairs(folder, job.source)
    job.dropped |= read_json(folder / "unreadable.json") | unpaired
    return pairs


def temperature_stage(job: CaptureJob, pairs: tuple[Pair, ...]) -> CaptureFrames:
    """Read the pairs: degrees from thermal files, photographs out of files that hold both.

    Raises:
        ThermoxelsError: A file cannot be read and is not to be skipped, or no pair is left.
    """
    settings = job.settings
    options = job.radiometry()
    library = settings.dji_library if settings.dji_library and settings.dji_library.is_file() else None
    depends = {
        "options": options,
        "library": given_fingerprints([library]),
        "skip_bad": settings.skip_bad,
        "mask": given_fingerprints([settings.thermal_mask]),
    }

    def work(folder: Path) -> None:
        read = read_frames(pairs, job.source, folder, options, settings.skip_bad, settings.thermal_mask, job.say)
        job.say(
            f"temperatures: {len(read.frames)} thermal images of {read.thermal_size[0]} x {read.thermal_size[1]} pixels"
        )

    read = CaptureFrames.load(job.cache.run("temperatures", depends, work), job.source)
    job.dropped |= read.dropped
    return read
