"""The audit that ends the demo: what was found of the drawn house beside what is so."""

from __future__ import annotations

import math
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from thermoxels_ns.audit.draws import Interval
from thermoxels_ns.commands.demo_results import Target
from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.checks import writable_folder
from thermoxels_ns.core.json_values import read_json_object
from thermoxels_ns.core.yaml_records import configs_folder
from thermoxels_ns.mesh.boundary.patch_rules import load_patch_rules
from thermoxels_ns.mesh.boundary.patches import apply_patches
from thermoxels_ns.reports.interval_text import interval_text
from thermoxels_ns.reports.page import Section, Table
from thermoxels_ns.synthetic.catalogue import make_scene
from thermoxels_ns.synthetic.house_corner import BRIDGE_PSI_W_MK, HOUSE, true_u_w_m2k

PATCHES, CONDITIONS = "patches.yaml", "conditions.yaml"
_BRIDGE_PATCH = "side-wall"  # Where nothing stands before the band, and its psi is that of the drawing
_POINTS = 200_000  # On the true surface, from which the mean U-value of each element is told


@dataclass(frozen=True)
class Compared:
    """A figure of the audit beside the true one."""

    name: str
    unit: str
    true: float
    found: Interval | None  # None: not found

    @property
    def held(self) -> bool:
        """Whether the interval holds the truth."""
        return self.found is not None and self.found.low <= self.true <= self.found.high


def write_survey(folder: Path) -> Path:
    """Put the elements of the house and the conditions of its survey into a folder, where the commands find them."""
    survey = writable_folder(folder / "survey")
    for name in (PATCHES, CONDITIONS):
        shutil.copyfile(configs_folder() / f"{HOUSE}-{name}", survey / name)
    return survey


def compare(answers: Path) -> tuple[Compared, ...]:
    """Hold answers.json against the drawing; raises `ThermoxelsError` if it cannot be read."""
    content = read_json_object(answers, "Run the demo again.")
    true = true_u_of_patches(configs_folder() / f"{HOUSE}-{PATCHES}")
    found = [
        Compared(one["name"], "W/(m2 K)", true[one["name"]], Interval(**one["u_w_m2k"])) for one in content["patches"]
    ]
    bridges = [
        one
        for one in content["defects"]
        if (one["kind"], one["patch"], one["not_counted"]) == ("line", _BRIDGE_PATCH, "")
    ]
    longest = max(bridges, key=lambda one: one["length_m"], default=None)
    psi = None if longest is None else Interval(**longest["coefficient"])
    return (*found, Compared(f"thermal bridge in {_BRIDGE_PATCH}, psi", "W/(m K)", BRIDGE_PSI_W_MK, psi))


def true_u_of_patches(rules: Path) -> dict[str, float]:
    """Mean true U-value of each element that a file of patches cuts out of the house, [W/(m2 K)]."""
    points, normals = make_scene(HOUSE).surface_points(_POINTS)
    every, none = np.ones(len(points), dtype=bool), np.zeros(len(points), dtype=bool)
    up = (0.0, 0.0, 1.0)
    applied = apply_patches(
        load_patch_rules(rules), centroids_m=points, normals=normals, up=up, seen=every, on_box=none
    )
    u: FloatArray = true_u_w_m2k(points)
    return {applied.names[n]: float(u[applied.number == n].mean()) for n in np.unique(applied.number)}


def audit_target(compared: Sequence[Compared]) -> Target:
    """How many of the figures lie in their intervals: all of them should."""
    share = sum(one.held for one in compared) / len(compared) if compared else math.nan
    return Target(
        *("Audit: true U-values and psi in their intervals", 100.0 * share, 100.0, True, "{:.0f} %"),
        "The audit's answers beside what the house was drawn with; its intervals are to hold 90 % in the long run.",
    )


def audit_section(compared: Sequence[Compared]) -> Section:
    """The truth beside the answer, as a part of the demo's page."""
    rows = tuple(
        (
            one.name,
            f"{one.true:.2f}",
            "not found" if one.found is None else interval_text(one.found, one.unit),
            "yes" if one.held else "no",
        )
        for one in compared
    )
    words = (
        "The house is drawn so that each element's surface is as warm as its U-value makes it: 20 °C inside, 0 °C "
        "outside, and 8 W/(m² K) between surface and air (Dall'O and others 2013, 0.578 m/s of wind). The audit was "
        "told airs and wind that are off by less than it was told they may be. It knows the photographs, thermal "
        "images, poses and which part of the surface is which element, and nothing else.",
        "Drawn by formula, not by heat flow through a wall: reveals, ground, roof and balcony have temperatures that "
        "were made up, and no part of them is compared.",
    )
    table = Table(("Element", "true", "found, 90 % interval", "in it"), rows, look="narrow")
    return Section("Audit: the truth beside the answer", words=words, tables=(table,))
