"""The figures of a demo run, read from files and held against targets."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.core.json_values import read_json_object

_ENERGY_UNITS = ("J", "kJ", "MJ", "GJ", "TJ", "PJ")  # Each a thousand of the one before


@dataclass(frozen=True)
class Target:
    """A measured figure and the bound it should keep."""

    name: str
    measured: float  # The figure; NaN if it could not be measured
    bound: float
    at_least: bool  # True: the figure should be at least the bound. False: at most
    form: str  # How to write the figure and the bound, for instance ``{:.1f} dB``
    meaning: str  # What the figure says, for somebody who meets it for the first time

    @property
    def met(self) -> bool:
        """Whether the figure keeps its bound; NaN does not."""
        return self.measured >= self.bound if self.at_least else self.measured <= self.bound

    @property
    def measured_text(self) -> str:
        """The figure with its unit."""
        return "not measured" if math.isnan(self.measured) else self.form.format(self.measured)

    @property
    def bound_text(self) -> str:
        """The bound with its unit."""
        return ("≥ " if self.at_least else "≤ ") + self.form.format(self.bound)


@dataclass(frozen=True)
class DemoResults:
    """What a demo run achieved: the figures with a target, and others."""

    targets: tuple[Target, ...]
    others: tuple[tuple[str, str], ...]  # Further figures: name and value with unit


def read_results(eval_json: Path, summary_json: Path) -> DemoResults:
    """Read what ``ns-eval`` (on held-out views) and ``ns-export thermoxels-mesh`` wrote, or raise `ThermoxelsError`."""
    images = _Section(eval_json, "results")
    truth, heat, mesh = (_Section(summary_json, name) for name in ("truth", "heat", "mesh"))
    tolerance = truth.number("tolerance_voxels")
    targets = (
        Target(
            *("RGB PSNR, held-out views", images.number("psnr"), 26.0, True, "{:.2f} dB"),
            "How like the photographs the model's pictures are, at places where it was never shown one.",
        ),
        Target(
            *("Temperature error, all pixels, mean", images.number("thermal_mae_c"), 1.0, False, "{:.2f} °C"),
            "The same for the thermal images.",
        ),
        Target(
            *(f"Surface F-score at {tolerance:g} voxels", truth.number("fscore"), 0.6, True, "{:.3f}"),
            f"1: the surface is nowhere further than {tolerance:g} voxels from the true one, and none is missing.",
        ),
        Target(
            *("Heat conserved, relative error", heat.number("energy_residual"), 1e-9, False, "{:.0e}"),
            "Change of the heat in the insulated solid while heat flows inside it.",
        ),
    )
    others = (
        ("RGB SSIM", f"{images.number('ssim'):.3f}"),
        ("Thermal PSNR", f"{images.number('thermal_psnr'):.2f} dB"),
        ("Thermal SSIM", f"{images.number('thermal_ssim'):.3f}"),
        ("Temperature error, pixels that hit the object, mean", f"{images.number('thermal_mae_hit_c'):.2f} °C"),
        ("Temperature error, hot region, mean", f"{images.number('thermal_mae_roi_c'):.2f} °C"),
        ("Voxel size", f"{1e3 * truth.number('voxel_size_m'):.1f} mm"),
        ("Surface precision", f"{truth.number('precision'):.3f}"),
        ("Surface recall", f"{truth.number('recall'):.3f}"),
        (
            "Distance between the mesh's and the true surface, mean of both ways (Chamfer)",
            f"{truth.number('chamfer_voxels'):.2f} voxels, {1e3 * truth.number('chamfer_m'):.1f} mm",
        ),
        (
            "Temperature error of the mesh on the seen surface, mean",
            f"{truth.number('temperature_seen_mae_c'):.2f} °C "
            f"({100.0 * truth.number('share_of_seen_reached'):.0f} % of the surface)",
        ),
        (
            "Volume of the mesh",
            f"{truth.number('mesh_volume_m3'):.4g} m³ (true: {truth.number('true_volume_m3'):.4g} m³)",
        ),
        ("Surface of the mesh", f"{truth.number('mesh_area_m2'):.4g} m² (true: {truth.number('true_area_m2'):.4g} m²)"),
        ("Tetrahedra", f"{mesh.number('tets'):,.0f}"),
        ("Nodes", f"{mesh.number('nodes'):,.0f}"),
        ("Nodes with a measured temperature", f"{100.0 * mesh.number('share_of_nodes_observed'):.0f} %"),
        ("Heat content before", energy_text(heat.number("energy_before_j"))),
        ("Heat content after", energy_text(heat.number("energy_after_j"))),
    )
    return DemoResults(targets, others)


def energy_text(energy_j: float) -> str:
    """Write an energy in the unit in which it has one to three digits before the point; NaN: it was not computed.

    >>> energy_text(1.003777e11), energy_text(-2.5e6), energy_text(0.0), energy_text(999.99)
    ('100.4 GJ', '-2.5 MJ', '0 J', '1 kJ')
    """
    if math.isnan(energy_j):
        return "not computed"
    value = float(f"{energy_j:.3e}")
    power = max((number for number in range(len(_ENERGY_UNITS)) if abs(value) >= 1e3**number), default=0)
    return f"{value / 1e3**power:.4g} {_ENERGY_UNITS[power]}"


class _Section:
    """One object of a json file; asks for its numbers by name."""

    def __init__(self, path: Path, name: str) -> None:
        self._path, self._name = path, name
        self._content: Any = read_json_object(path, "Run the demo again.").get(name)
        if not isinstance(self._content, dict):
            raise self._error("an object", self._content)

    def number(self, key: str) -> float:
        """The number under `key`; NaN for null (a figure that does not exist, for instance without a surface)."""
        value = self._content.get(key, "nothing")
        if value is None:
            return math.nan
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise self._error(f"a number under {key}", value)
        return float(value)

    def _error(self, expected: str, got: object) -> ThermoxelsError:
        what = f"{self._path}: {self._name}"
        return ThermoxelsError(what, expected=expected, got=repr(got), remedy="Run the demo again.")
