import json
import re
from pathlib import Path
from runpy import run_path

import pytest

from thermoxels_ns.audit.draws import Interval
from thermoxels_ns.commands import demo_results
from thermoxels_ns.commands.demo_results import Compared

ROOT = Path(__file__).parents[1]
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")),
    *sorted((ROOT / "docs").glob("*.md")),
]
FIGURES = run_path(str(ROOT / "tools" / "figures.py"))
SHOWN = json.loads((ROOT / "docs" / "figures.json").read_text())
MEASURED_WITH = SHOWN.pop("version")


def test_the_first_page_is_short():
    assert len((ROOT / "README.md").read_text().splitlines()) <= 150


def anchors(page: Path) -> set[str]:
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path):
    links = re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8"))
    for link in links:
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        assert link.startswith("https:") or target.is_file(), link
        assert not anchor or anchor in anchors(target), link


def test_every_page_is_in_the_navigation_of_the_site():
    named = set(re.findall(r"^ +- (?:.*: )?(\S+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE))
    assert {page.name for page in PAGES[3:]} == named - {"index.md", "contributing.md", "changes.md"}


def test_the_tables_of_figures_show_the_kept_ones():
    assert FIGURES["main"](["--check"]) == 0


@pytest.mark.parametrize(
    ("file", "old", "new", "said"),
    [
        ("README.md", f"{SHOWN['psnr']:.1f} dB", "36.9 dB", "README.md: its table"),
        ("docs/start.md", "26 dB or more", "20 dB or more", "start.md: its table"),
        ("docs/figures.json", str(SHOWN["psnr"]), "36.9", "README.md: its table"),
        ("thermoxels_ns/core/version.py", MEASURED_WITH, "9.9", f"measured with version {MEASURED_WITH}, this is 9.9"),
    ],
)
def test_figures_edited_by_hand_or_of_another_version_are_found(tmp_path, capsys, file, old, new, said):
    names = ("tools/figures.py", "README.md", "docs/start.md", "docs/figures.json", "thermoxels_ns/core/version.py")
    for name in names:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        text = (ROOT / name).read_text(encoding="utf-8")
        assert name != file or old in text
        (tmp_path / name).write_text(text.replace(old, new) if name == file else text, encoding="utf-8")
    assert run_path(str(tmp_path / "tools" / "figures.py"))["main"](["--check"]) == 1
    assert said in capsys.readouterr().out


@pytest.mark.parametrize(("psnr", "status"), [(SHOWN["psnr"], 0), (SHOWN["psnr"] - 1, 1)])
def test_a_demo_is_read_and_compared(tmp_path, capsys, monkeypatch, psnr, status):
    s = SHOWN
    areas = {"mesh_area_m2": s["true_area_m2"] * (1 + s["area_percent"] / 100), "voxel_size_m": s["voxel_cm"] / 100}
    areas |= {
        "mesh_volume_m3": s["true_volume_m3"] * (1 + s["volume_percent"] / 100),
        "chamfer_m": s["chamfer_cm"] / 100,
    }
    (tmp_path / "export").mkdir()
    (tmp_path / "export/summary.json").write_text(json.dumps({"truth": s | areas}))
    (tmp_path / "eval.json").write_text(json.dumps({"results": s | {"psnr": psnr}}))
    held = [Compared("wall", "W", 1.0, Interval(1.0, 0.9, 1.1))] * int(s["compared"])
    monkeypatch.setattr(demo_results, "compare", lambda answers, rules: held)
    assert FIGURES["main"](["--check", str(tmp_path)]) == status
    assert ("psnr: shown" in capsys.readouterr().out) == bool(status)
