"""Compare the figures of a demo with targets and with the exact scene, and build the page that shows both."""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from thermoxels_ns.audit.draws import Interval
from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.checks import plain_os_errors
from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.core.json_values import read_json_object
from thermoxels_ns.mesh.boundary.patches import apply_patches, load_patch_rules
from thermoxels_ns.reports.page import build_page, colours, gradient, image_file
from thermoxels_ns.synthetic.drawn_scenes import BRIDGE_PSI_W_MK, house_corner, true_u_w_m2k

_AGAIN = "Run the demo again."
_BRIDGE_PATCH = "side-wall"  # Patch on which nothing covers the thermal bridge, so that its psi is known exactly
_POINTS = 200_000  # Number of points on the true surface over which true U-values are averaged
_INPUTS_SHOWN = 6


@dataclass(frozen=True)
class Target:
    """A measured figure of a demo and the bound that the figure should keep."""

    name: str
    measured: float  # Value of the figure; NaN if it could not be measured
    bound: float
    at_least: bool  # True: the figure should be at least the bound; False: at most the bound
    form: str  # Format of figure and bound with the unit, for instance ``{:.1f} dB``
    meaning: str  # Sentence that explains the figure to somebody who has never met it

    @property
    def met(self) -> bool:
        """True if the figure keeps its bound; False for NaN."""
        return self.measured >= self.bound if self.at_least else self.measured <= self.bound

    @property
    def measured_text(self) -> str:
        """The figure with its unit, or "not measured" for NaN."""
        return "not measured" if math.isnan(self.measured) else self.form.format(self.measured)

    @property
    def bound_text(self) -> str:
        """The bound with its unit, behind "≥" or "≤"."""
        return ("≥ " if self.at_least else "≤ ") + self.form.format(self.bound)


def read_results(eval_json: Path, summary_json: Path) -> tuple[Target, ...]:
    """Return figures from the json files of ``ns-eval`` and ``ns-export thermoxels-mesh``, with their targets."""
    image, truth = numbers_of(eval_json, "results"), numbers_of(summary_json, "truth")
    tolerance = truth("tolerance_voxels")
    return (
        Target(
            *("RGB PSNR, held-out views", image("psnr"), 26.0, True, "{:.2f} dB"),
            "How like the photographs the model's pictures are, at places where it was never shown one.",
        ),
        Target(
            *("Temperature error, all pixels, mean", image("thermal_mae_c"), 1.0, False, "{:.2f} °C"),
            "The same for the thermal images.",
        ),
        Target(
            *(f"Surface F-score at {tolerance:g} voxels", truth("fscore"), 0.6, True, "{:.3f}"),
            f"1: the surface is nowhere further than {tolerance:g} voxels from the true one, and none is missing.",
        ),
    )


def numbers_of(path: Path, name: str) -> Callable[[str], float]:
    """Return a function from a key to its number in the object `name` of a json file, NaN for null (not measured)."""
    content = read_json_object(path, _AGAIN)[name]
    return lambda key: math.nan if content[key] is None else float(content[key])


@dataclass(frozen=True)
class Compared:
    """A figure of the audit and its true value."""

    name: str
    unit: str
    true: float
    found: Interval | None  # Interval of the audit; None if the audit does not have the figure

    @property
    def held(self) -> bool:
        """True if the true value lies in the interval."""
        return self.found is not None and self.found.low <= self.true <= self.found.high


def compare(answers: Path, rules: Path) -> tuple[Compared, ...]:
    """Return U-values and psi of an audit's answers.json beside their true values; `rules`: the house's patch file."""
    content, true = read_json_object(answers, _AGAIN), true_u_of_patches(rules)
    found = [
        Compared(one["name"], "W/(m2 K)", true[one["name"]], Interval(**one["u_w_m2k"])) for one in content["patches"]
    ]
    wanted = ("line", _BRIDGE_PATCH, "")
    bridges = [one for one in content["defects"] if (one["kind"], one["patch"], one["not_counted"]) == wanted]
    longest = max(bridges, key=lambda one: one["length_m"], default=None)
    psi = None if longest is None else Interval(**longest["coefficient"])
    return (*found, Compared(f"thermal bridge in {_BRIDGE_PATCH}, psi", "W/(m K)", BRIDGE_PSI_W_MK, psi))


def true_u_of_patches(rules: Path) -> dict[str, float]:
    """Return the mean true U-value, [W/(m2 K)], of the exact house on each patch of a file of patches, by name."""
    points, normals = house_corner().solid.surface_points(_POINTS)
    every, none = np.ones(len(points), dtype=bool), np.zeros(len(points), dtype=bool)
    where = {"centroids_m": points, "normals": normals, "up": (0.0, 0.0, 1.0), "seen": every, "on_box": none}
    applied = apply_patches(load_patch_rules(rules), **where)
    u: FloatArray = true_u_w_m2k(points)
    return {applied.names[n]: float(u[applied.number == n].mean()) for n in np.unique(applied.number)}


def audit_target(compared: Sequence[Compared]) -> Target:
    """Return the share of figures whose true value lies in the interval, with the target 100 %."""
    share = sum(one.held for one in compared) / len(compared)
    return Target(
        *("Audit: true U-values and psi in their intervals", 100.0 * share, 100.0, True, "{:.0f} %"),
        "The audit's answers beside what the house was drawn with; its intervals are to hold 90 % in the long run.",
    )


def demo_page(
    folder: Path,
    targets: Iterable[Target],
    compared: Sequence[Compared],
    seconds: Sequence[tuple[str, float]],
    commands: Sequence[str],
) -> str:
    """Return the html text of a demo's page; `seconds` are names and durations of the demo's steps.

    Raises `ThermoxelsError` if a picture is missing in `folder`.
    """
    export, renders, drawn = folder / "export", folder / "renders" / "test", folder / "scene"
    photographs = sorted((drawn / "images").glob("frame_train_*"))
    held_out = sorted(path.stem for path in (drawn / "images").glob("frame_eval_*"))
    bounds = read_json_object(drawn / "temperature_bounds.json", _AGAIN)
    with plain_os_errors(folder, "a picture that the demo's commands write", _AGAIN, ThermoxelsError):
        inputs = []
        for number in range(_INPUTS_SHOWN):
            path = photographs[number * len(photographs) // _INPUTS_SHOWN]
            with Image.open(drawn / "thermal" / f"{path.stem}.png") as counts:  # 16 bits that span the bounds
                thermal = colours(np.asarray(counts, dtype=np.float64) / 65535.0, (0.0, 1.0))
            inputs.append((path.read_bytes(), image_file(thermal, quality=88)))
        kinds = ("gt-rgb", "rgb", "gt-thermal", "thermal")
        return build_page(
            "demo.html.j2",
            photographs=len(photographs),
            targets=targets,
            compared=compared,
            inputs=inputs,
            views=[(name, [(renders / of / f"{name}.png").read_bytes() for of in kinds]) for name in held_out],
            gradient=gradient(),
            ends_c=[float(bounds[f"absolute_{end}_temperature"]) for end in ("min", "max")],
            night=(folder / "heat" / "surface-end.png").read_bytes(),
            mesh=(export / "mesh.png").read_bytes(),
            measured=(export / "mesh-measured.png").read_bytes(),
            seconds=seconds,
            commands=commands,
            config=shlex.quote(str(folder / "outputs" / "demo" / "thermoxels" / "run" / "config.yml")),
            exported=shlex.quote(str(export / "mesh.vtu")),
        )
