"""How the temperatures of a capture were measured, in words: what an auditor has to know before believing them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from thermoxels_ns.capture.frames import CaptureFrame
from thermoxels_ns.radiometry.conditions import Conditions

_MOST_LISTED = 4


def measurement_rows(frames: Sequence[CaptureFrame]) -> list[tuple[str, str]]:
    """Describe file formats and the settings that degrees were computed with.

    Args:
        frames: Those of the scene.

    Returns:
        Names and texts; where frames differ, each kind with the number of its frames, the most frequent first.
    """
    rows = []
    formats = [_format(frame) for frame in frames if frame.format]
    if formats:
        rows.append(("thermal files", _counted(formats)))
    conditions = [conditions_text(frame.conditions) for frame in frames if frame.conditions]
    if conditions:
        rows.append(("computed with", _counted(conditions)))
    return rows


def conditions_text(conditions: Conditions) -> str:
    """Say what a temperature was computed with.

    >>> conditions_text(Conditions(emissivity=0.95, reflected_c=20.0))
    'emissivity 0.95, reflected temperature 20 °C'
    >>> conditions_text(Conditions())
    'emissivity 1 and no air between: apparent temperatures, which are too near that of the surroundings'
    """
    parts = [f"emissivity {conditions.emissivity:.4g}"]
    if conditions.emissivity < 1 and conditions.reflected_c is not None:
        parts.append(f"reflected temperature {conditions.reflected_c:.4g} °C")
    if conditions.distance_m > 0:
        parts.append(f"{conditions.distance_m:.4g} m of air of {100 * conditions.relative_humidity:.3g} % humidity")
        if conditions.air_c is not None:
            parts[-1] += f" and {conditions.air_c:.4g} °C"
    if conditions.window_transmission < 1:
        parts.append(f"a window that passes {100 * conditions.window_transmission:.4g} %")
    if len(parts) == 1 and conditions.emissivity == 1:
        return "emissivity 1 and no air between: apparent temperatures, which are too near that of the surroundings"
    return ", ".join(parts)


def _format(frame: CaptureFrame) -> str:
    step = "" if frame.celsius_per_count is None else f" with {frame.celsius_per_count:.4g} K per count"
    return f"{frame.format}{step}"


def _counted(texts: Sequence[str]) -> str:
    counted = Counter(texts).most_common()
    if len(counted) == 1:
        return counted[0][0]
    listed = [f"{text} ({count} frames)" for text, count in counted[:_MOST_LISTED]]
    more = len(counted) - len(listed)
    return "; ".join(listed) + (f"; {more} more kinds" if more else "")
