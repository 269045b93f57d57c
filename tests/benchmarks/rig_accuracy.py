"""How well a rig of which nothing was measured is found from drawn captures, by frames, pixels and baseline.

    python tests/benchmarks/rig_accuracy.py --captures house-corner:4:160:0.10:71 courtyard:20:160:0.05:56

Turn, direction between the lenses, angle of view, principal point, noise, drift and vignetting are drawn by the seed.
Prints the errors of turn [degrees], focal length [%], where scene points fall [thermal pixels] and offsets [K].
"""

import time
from dataclasses import dataclass

import numpy as np
import tyro
from measuring import take_turns  # noqa: F401 (finds tests.support)

from tests.support.known_rig import drawn_capture
from thermoxels_ns.capture.rig.drift import estimate_drift, sample_shared_points
from thermoxels_ns.capture.rig.search import estimate_rig

CAPTURES = (
    *("house-corner:4:160:0.05:51", "courtyard:4:160:0.20:54", "house-corner:4:160:0.10:71"),
    *("house-corner:5:160:0.20:13", "courtyard:10:160:0.05:14", "house-corner:20:160:0.10:73"),
    *("courtyard:20:160:0.05:56", "courtyard:8:120:0.10:52", "house-corner:8:120:0.20:55"),
    *("courtyard:8:120:0.05:72", "house-corner:8:120:0.05:75", "courtyard:10:120:0.05:14"),
    *("house-corner:20:80:0.20:53", "courtyard:20:80:0.05:56", "house-corner:20:80:0.10:73"),
)


@dataclass
class RigAccuracy:
    captures: tuple[str, ...] = CAPTURES
    """scene:ratio:thermal width:baseline in metres:seed. Ratio is photograph's pixels per thermal pixel along one side;
    drawing 3200 pixels wide photographs takes minutes."""
    frames: int = 36
    """Frames of each capture."""

    def main(self) -> None:
        for text in self.captures:
            scene, ratio, width, baseline_m, seed = text.split(":")
            capture, start = drawn_capture(scene, int(ratio), int(width), float(baseline_m), int(seed), self.frames)
            began = time.perf_counter()
            found = estimate_rig(capture.frames, capture.visible, start)
            seconds = time.perf_counter() - began
            drift = estimate_drift(sample_shared_points(capture.frames, found.thermal_camera, found.visible_to_thermal))
            offset_k = float(np.abs(drift.offsets_k - capture.offsets_k).max())
            print(
                f"{text}: turn {capture.turn_error_deg(found):.3f} degrees, focal length "
                f"{100 * capture.focal_error(found):.2f} %, points {capture.projection_error_px(found):.3f} pixels, "
                f"offsets {offset_k:.3f} K, rig found in {seconds:.0f} s",
                flush=True,
            )


if __name__ == "__main__":
    tyro.cli(RigAccuracy).main()
