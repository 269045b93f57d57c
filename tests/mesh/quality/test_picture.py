from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from tests.support.heat_meshes import mesh_from
from thermoxels_ns.mesh.quality.report import picture_of_quality, quality_report
from thermoxels_ns.mesh.voxel_tets import kuhn_tets


@pytest.mark.parametrize("damaged", [False, True])
def test_the_picture_says_what_is_met_and_nothing_overlaps(tmp_path, monkeypatch, damaged):
    corners, tets = kuhn_tets(np.ones((3, 4, 2), dtype=bool))
    mesh = mesh_from(corners * 0.5, tets)
    report = quality_report(mesh, "voxel")
    if damaged:  # three criteria of five are missed, in numbers that take much room
        moved = mesh.points_m + np.random.default_rng(0).normal(size=mesh.points_m.shape) * 0.4
        mesh = replace(mesh, points_m=moved, facets=mesh.facets[:-9], facet_tags=mesh.facet_tags[:-9])
        report = quality_report(mesh, "conforming", length_unit="input unit")
        report = replace(report, num_nodes=12_345_678, num_tets=71_234_567, num_facets=1_234_567)
    drawn, save = [], Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda self, *a, **k: (drawn.append(self), save(self, *a, **k))[1])
    picture_of_quality(tmp_path / "new" / "quality.png", report)
    with Image.open(tmp_path / "new" / "quality.png") as picture:
        assert picture.format == "PNG" and picture.size[0] > 1000
    assert [file.name for file in (tmp_path / "new").iterdir()] == ["quality.png"]
    texts = [text for axis in drawn[0].axes for text in axis.texts if text.get_text()]
    words, boxes = [text.get_text() for text in texts], [text.get_window_extent() for text in texts]
    assert words.count("no") == len(report.unmet) == (3 if damaged else 0)
    assert words.count("yes") == len(report.criteria) - len(report.unmet)
    assert ("164.8°" if damaged else "45°") in words
    for number, box in enumerate(boxes):
        assert box.x0 >= drawn[0].bbox.x0 and box.x1 <= drawn[0].bbox.x1, words[number]
        assert not any(box.overlaps(other) for other in boxes[:number]), words[number]
    heights = [bar.get_height() for bar in drawn[0].axes[0].patches]
    assert heights == list(report.dihedral_counts)
