"""Cameras that write their temperatures as plain counts, and how many degrees a count is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from thermoxels_ns.radiometry.thermal_files import ThermalUnit

CameraName = Literal["workswell", "flir-high-gain", "flir-low-gain", "flir-duo", "sensefly"]


@dataclass(frozen=True)
class CountScale:
    """A camera's counts: degrees C = count * celsius_per_count + celsius_offset."""

    celsius_per_count: float
    celsius_offset: float
    cameras: str
    """Which cameras write so, in words."""

    @property
    def unit(self) -> ThermalUnit:
        """The same for `thermal_files`."""
        return ThermalUnit.linear(self.celsius_per_count, self.celsius_offset)


COUNT_SCALES: dict[CameraName, CountScale] = {
    "workswell": CountScale(1.0 / 40.0, -100.0, "Workswell WIRIS Pro and later"),
    "flir-high-gain": CountScale(0.04, -273.15, "FLIR Duo Pro R and Vue Pro R, range -25 to 135 C"),
    "flir-low-gain": CountScale(0.4, -273.15, "FLIR Duo Pro R and Vue Pro R, range -40 to 550 C"),
    "flir-duo": CountScale(0.01, -273.15, "FLIR Duo R (the first one)"),
    "sensefly": CountScale(0.01, -100.0, "senseFly thermoMAP and Duet T"),
}
"""From the makers' manuals. FLIR's two gains cannot be told apart by the file, so the user says which."""

_RECOGNISED: tuple[tuple[str, str, CameraName], ...] = (
    ("workswell", "wiris pro", "workswell"),
    ("sensefly", "", "sensefly"),
)
"""Maker, start of the model and preset of the cameras that a file names without doubt, in small letters."""


def recognised_camera(make: str | None, model: str | None) -> CameraName | None:
    """Find the preset of a camera by what its file says of it; None where the file leaves a choice.

    >>> recognised_camera("Workswell", "WIRIS Pro")
    'workswell'
    >>> recognised_camera("FLIR", "Duo Pro R") is None
    True
    """
    make, model = (make or "").strip().lower(), (model or "").strip().lower()
    for maker, start, name in _RECOGNISED:
        if make.startswith(maker) and model.startswith(start):
            return name
    return None


def known_cameras() -> str:
    """The presets in one line, for messages."""
    return ", ".join(f"{name} ({scale.cameras})" for name, scale in COUNT_SCALES.items())
