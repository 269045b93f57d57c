"""Write the table of figures of README.md and docs/start.md from a demo's results, or check it against them.

    python tools/figures.py demo           # the results in the folder demo become the figures that are shown
    python tools/figures.py --check        # do the pages show docs/figures.json?
    python tools/figures.py --check demo   # and does this demo agree with it, but for noise?

docs/figures.json holds the numbers that are shown, and the version of the package that measured them: another version
needs a new demo. The demo's own code reads and compares what its commands wrote.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from runpy import run_path
from typing import NamedTuple

DOCS = Path(__file__).resolve().parents[1] / "docs"
KEPT = DOCS / "figures.json"
PAGES = (DOCS.parent / "README.md", DOCS / "start.md")
BEGIN, END = "<!-- figures: written by tools/figures.py -->\n", "<!-- end of figures -->"

Figures = dict[str, float]


class Row(NamedTuple):
    """A row of the table; `text` and `target` are filled with the figures by name."""

    what: str
    text: str
    target: str


ROWS = (
    Row("RGB PSNR on held-out views", "{psnr:.1f} dB", "26 dB or more"),
    Row("temperature, mean absolute error over all pixels (range 35 K)", "{thermal_mae_c:.2f} °C", "1.0 °C or less"),
    Row(
        "surface F-score at 1.5 voxels of {voxel_cm:.0f} cm",
        "{fscore:.2f} (precision {precision:.2f}, recall {recall:.2f})",
        "0.6 or more",
    ),
    Row("surface of the mesh against the true {true_area_m2:.1f} m²", "{area_percent:+.1f} %", ""),
    Row("volume of the mesh against the true {true_volume_m3:.1f} m³", "{volume_percent:+.1f} %", ""),
    Row(
        "distance between surface and true surface, mean of both ways",
        "{chamfer_voxels:.1f} voxels, {chamfer_cm:.1f} cm",
        "",
    ),
    Row("temperature of the mesh where cameras see it, mean absolute error", "{temperature_seen_mae_c:.2f} °C", ""),
    Row("true U-values and psi that lie in the audit's 90 % intervals", "{held:.0f} of {compared:.0f}", "all"),
)
NOISE = {
    "psnr": 0.5,
    "thermal_mae_c": 0.05,
    "fscore": 0.02,
    "precision": 0.02,
    "recall": 0.02,
    "area_percent": 1.0,
    "volume_percent": 1.0,
    "chamfer_voxels": 0.1,
    "chamfer_cm": 0.7,
    "temperature_seen_mae_c": 0.05,
    "voxel_cm": 0.5,
}
"""By how much figures may differ between machines, versions of PyTorch and seeds; those not named, not in five digits.
With other seeds the F-score differs by 0.02."""


def version() -> str:
    """Return the version of the package."""
    return run_path(str(DOCS.parent / "thermoxels_ns" / "core" / "version.py"))["__version__"]


def read_demo(folder: Path) -> Figures:
    """Return the figures of a finished demo; raises `KeyError` where one is missing."""
    from thermoxels_ns.commands.demo_results import compare, numbers_of

    image = numbers_of(folder / "eval.json", "results")
    truth = numbers_of(folder / "export" / "summary.json", "truth")
    compared = compare(folder / "audit" / "answers.json", folder / "survey" / "patches.yaml")
    return {
        **{name: image(name) for name in ("psnr", "thermal_mae_c")},
        **{name: truth(name) for name in ("fscore", "precision", "recall", "chamfer_voxels", "temperature_seen_mae_c")},
        **{name: truth(name) for name in ("true_area_m2", "true_volume_m3")},
        "voxel_cm": 100 * truth("voxel_size_m"),
        "chamfer_cm": 100 * truth("chamfer_m"),
        "area_percent": 100 * (truth("mesh_area_m2") / truth("true_area_m2") - 1),
        "volume_percent": 100 * (truth("mesh_volume_m3") / truth("true_volume_m3") - 1),
        "held": sum(one.held for one in compared),
        "compared": len(compared),
    }


def table(figures: Figures) -> str:
    """Return the table, as it stands between the two marks of a page."""
    head = "| house, 42 training views of 320 x 240, 128 voxels | measured | target |\n|---|---|---|\n"
    return head + "".join(f"| {r.what} | {r.text} | {r.target} |\n" for r in ROWS).format(**figures)


def with_table(page: str, figures: Figures) -> str:
    """Return the text of a page with the table of these figures between its marks."""
    before, rest = page.split(BEGIN)
    return before + BEGIN + table(figures) + END + rest.split(END, 1)[1]


def differences(shown: Figures, found: Figures) -> list[str]:
    """List the figures that differ by more than noise, each as a sentence."""
    return [
        f"{name}: shown {shown[name]:.4g}, found {found[name]:.4g}, noise {NOISE.get(name, 0):g}"
        for name in shown
        if not abs(found[name] - shown[name]) <= NOISE.get(name, 1e-5 * abs(shown[name]))
    ]


def main(words: list[str]) -> int:
    """Do what the module's text says; return the exit status."""
    check, folders = "--check" in words, [Path(word) for word in words if word != "--check"]
    if len(folders) > 1 or not (check or folders):
        print(__doc__)
        return 2
    if not check:
        figures = {name: float(f"{value:.6g}") for name, value in read_demo(folders[0]).items()}
        KEPT.write_text(json.dumps({"version": version()} | figures, indent=1) + "\n", encoding="utf-8")
        for page in PAGES:
            page.write_text(with_table(page.read_text(encoding="utf-8"), figures), encoding="utf-8")
    shown = json.loads(KEPT.read_text(encoding="utf-8"))
    measured, pages = shown.pop("version"), {page: page.read_text(encoding="utf-8") for page in PAGES}
    wrong = [f"docs/figures.json: measured with version {measured}, this is {version()}; run make demo figures"]
    wrong = [] if measured == version() else wrong
    wrong += [
        f"{page.name}: its table is not that of docs/figures.json; run make figures"
        for page, text in pages.items()
        if with_table(text, shown) != text
    ]
    wrong += differences(shown, read_demo(folders[0])) if folders else []
    print(*wrong or ["The figures agree."], sep="\n")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
