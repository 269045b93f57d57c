from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from tests.support.heat_meshes import mesh_from
from thermoxels_ns.mesh.quality.picture import picture_of_quality
from thermoxels_ns.mesh.quality.report import QualityReport, quality_report
from thermoxels_ns.mesh.tetrahedra import TetMesh
from thermoxels_ns.mesh.voxel_tets import kuhn_tets


@dataclass(frozen=True)
class Drawn:
    """A report, its picture's file and what was drawn."""

    report: QualityReport
    path: Path
    figure: Figure


def box_mesh() -> TetMesh:
    corners, tets = kuhn_tets(np.ones((3, 4, 2), dtype=bool))
    return mesh_from(corners * 0.5, tets)


def draw(path: Path, report: QualityReport) -> Drawn:
    figures = []
    save = Figure.savefig
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", lambda self, *a, **k: (figures.append(self), save(self, *a, **k))[1])
        picture_of_quality(path, report)
    return Drawn(report, path, figures[0])


@pytest.fixture(scope="module")
def good(tmp_path_factory) -> Drawn:
    return draw(tmp_path_factory.mktemp("good") / "new" / "quality.png", quality_report(box_mesh(), "voxel"))


@pytest.fixture(scope="module")
def damaged(tmp_path_factory) -> Drawn:
    """A mesh that misses three criteria of five, in numbers that take much room."""
    mesh = box_mesh()
    moved = mesh.points_m + np.random.default_rng(0).normal(size=mesh.points_m.shape) * 0.4
    mesh = replace(mesh, points_m=moved, facets=mesh.facets[:-9], facet_tags=mesh.facet_tags[:-9])
    report = quality_report(mesh, "conforming", length_unit="input unit")
    report = replace(report, num_nodes=12_345_678, num_tets=71_234_567, num_facets=1_234_567, num_box_facets=123_456)
    return draw(tmp_path_factory.mktemp("damaged") / "quality.png", report)


def words_in(figure: Figure) -> list[str]:
    return [text.get_text() for axis in figure.axes for text in axis.texts]


def test_picture_is_one_png_and_nothing_else(good):
    with Image.open(good.path) as picture:
        assert picture.format == "PNG"
        pixels = np.asarray(picture.convert("RGB"))
    assert pixels.shape[0] > 800 and pixels.shape[1] > 1000
    assert np.mean(np.all(pixels == 255, axis=-1)) > 0.5
    assert np.mean(np.any(pixels < 200, axis=-1)) > 0.02
    assert [p.name for p in good.path.parent.iterdir()] == ["quality.png"]


def test_it_says_which_criteria_are_met(good, damaged):
    kept, broken = words_in(good.figure), words_in(damaged.figure)
    assert kept.count("yes") == 7 and "Criteria of a voxel boundary: 7 of 7 met" in kept and "45°" in kept
    assert broken.count("no") == len(damaged.report.unmet) == 3 and "164.8°" in broken
    assert "3 m³" in kept and "1; 1" in kept
    assert "voxel" in good.figure.get_suptitle()


@pytest.mark.parametrize("which", ["good", "damaged"])
def test_no_words_overlap_or_leave_the_picture(request, which):
    figure = request.getfixturevalue(which).figure
    texts = [text for axis in figure.axes for text in axis.texts if text.get_text()]
    boxes = [text.get_window_extent() for text in texts]
    assert len(boxes) > 40
    for number, box in enumerate(boxes):
        words, page = texts[number].get_text(), figure.bbox
        assert box.x0 >= page.x0 and box.x1 <= page.x1 and box.y0 >= page.y0, words
        hidden = [texts[other].get_text() for other in range(number) if box.overlaps(boxes[other])]
        assert not hidden, (words, hidden)


def test_bars_are_the_counts(good):
    angles, ratios = good.figure.axes[:2]
    bars = [(bar.get_x(), bar.get_x() + bar.get_width(), bar.get_height()) for bar in angles.patches]
    heights = {angle: height for left, right, height in bars for angle in (45, 60, 90) if left < angle < right}
    assert heights == {45: 288, 60: 144, 90: 432} and sum(height for *_, height in bars) == 864
    assert not [bar for bar in bars if bar[2] and (bar[0] < 44.99 or bar[1] > 90.01)]
    tall = [(bar.get_x(), bar.get_height()) for bar in ratios.patches if bar.get_height()]
    assert tall == [(pytest.approx(0.7), good.report.num_tets)]
