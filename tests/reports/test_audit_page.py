import base64
import gzip
import json
import re
import shutil
import subprocess
from copy import copy
from dataclasses import replace

import numpy as np
import pytest

from tests.support.audited_wall import STATED, audited_wall, photographed, solve_wall, true_draws
from thermoxels_ns.audit.run import asked_of_survey, audit
from thermoxels_ns.reports import audit_page
from thermoxels_ns.reports.audit_page import thinned, view_data
from thermoxels_ns.reports.page import Report, image_file

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
PNG = image_file(np.zeros((8, 8, 3), dtype=np.uint8), "PNG")


@pytest.fixture(scope="module")
def found():
    mesh = photographed(solve_wall(audited_wall(), STATED, true_draws(STATED, None)), STATED, 2)
    return audit(mesh, STATED)


def page_of(found, **more) -> str:
    pictures = {"temperature": [PNG], "u_value": [PNG], "misfit": []}
    report = Report("0-0-0", "1", (("mesh.vtu", "ab" * 32),))
    return audit_page.audit_page(found, pictures, {}, "mesh.vtu", "thermoxels audit", [], report, **more)


def unpacked(text: str):
    return json.loads(gzip.decompress(base64.b64decode(text)))


def test_a_view_holds_the_values_of_every_triangle_that_counts(found) -> None:
    mesh = found.surface.mesh
    names = ("a<b>", *mesh.boundary.patch_names[1:])
    hostile = copy(found.surface.selection)
    hostile.patch_names = names
    view = unpacked(view_data(replace(found, surface=replace(found.surface, selection=hostile)), np.array([1.0, 0, 0])))
    counted = found.surface.counted
    temperature, u, flow = (one["values"] for one in view["quantities"])
    assert np.allclose(temperature, found.triangle_surface_c[counted], atol=0.006)
    assert np.allclose(u, found.triangle_u[counted], atol=0.006)
    assert np.allclose(flow, found.triangle_flow_w_m2[counted], atol=0.006)
    assert len(view["counted"][0]) == counted.sum() and len(view["others"][0]) == (~counted).sum()
    corners = np.array(view["points"]).T[np.array(view["counted"]).T] / 1e3
    assert np.allclose(corners, mesh.points_m[mesh.facets[counted]], atol=0.6e-3)
    assert "a&lt;b&gt;" in view["patches"] and len(view["bridges"]) == 1


def test_a_large_surface_is_thinned_where_nothing_counts_first() -> None:
    side = 60
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(side), np.arange(side), indexing="ij"))
    points = np.stack([x, y, np.zeros(side * side)], axis=1).astype(float)
    first = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    squares = [np.stack(corners, axis=1) for corners in ((first, first + side, first + 1),)]
    squares.append(np.stack([first + side, first + side + 1, first + 1], axis=1))
    facets = np.concatenate(squares)
    counted = points[facets].mean(axis=1)[:, 0] < 10
    same, triangles, which = thinned(points, facets, counted, len(facets))
    assert np.array_equal(same[triangles], points[facets]) and len(which) == len(facets)
    fewer, triangles, which = thinned(points, facets, counted, len(facets) // 3)
    assert len(which) == len(triangles) <= len(facets) // 3
    assert counted[which].sum() == counted.sum() and (~counted[which]).sum() > 10
    assert np.abs(fewer[triangles].mean(axis=1) - points[facets[which]].mean(axis=1)).max() < 8.0
    assert len(thinned(points, facets, counted, 50)[2]) <= 50  # then also where triangles count


def test_paper_has_pictures_alone(found) -> None:
    with_view, paper = page_of(found), page_of(found, paper=True)
    assert "id=view " in with_view and "<script" not in paper and len(paper) < 0.1 * len(with_view)
    assert "a view" not in paper.lower() and paper.count("data:image/png") == with_view.count("data:image/png") == 2
    assert not re.search(r'(?:src|href)="(?!data:|#)', with_view)
    for number in re.findall(r'href="#(bridge-\d+)"', with_view):
        assert f'id="{number}"' in with_view


def test_findings_are_consistent_with_causes_and_prove_none(found) -> None:
    page = page_of(found, paper=True)
    table = page[page.index("<h2>Findings</h2>") : page.index("<h2>The envelope, element by element</h2>")]
    cells = re.findall(r"<td>(.*?)</td>", table, flags=re.S)
    assert len(cells) % 3 == 0 and "consistent with" in table
    line = next(row for row in range(0, len(cells), 3) if cells[row].startswith("1: line of"))
    assert "thermal bridge" in cells[line + 1] and "50 Pa" in cells[line + 2]
    assert not re.search(r"\bprove", page)


@pytest.mark.parametrize(
    ("change", "what", "verdict"),
    [
        ({"least_difference_24h": None}, "air inside warmer than outside, all the last 24 hours", "not stated"),
        ({"hours_dry": 20.0}, "time since the surface was wet", "not met"),
        ({"hours_dry": 24.0}, "time since the surface was wet", "met"),
        ({"certificate": "7, level 2"}, "operator", "met"),
        ({}, "operator", "not stated"),
    ],
)
def test_conditions_of_the_standards_are_met_or_not(change, what, verdict) -> None:
    values = {
        name: value if name == "certificate" else value and type(STATED.inside.air)(value)
        for name, value in change.items()
    }
    asked = {one.what: one for one in asked_of_survey(replace(STATED.survey, **values), STATED)}
    assert asked[what].verdict == verdict and asked["wind"].verdict == "met" and len(asked) == 6


@pytest.mark.external
@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed")
def test_a_browser_draws_the_view_and_its_choice_changes_the_colours(found, tmp_path) -> None:
    watch = """<script>setInterval(async () => {
      const box = document.getElementById("view-drawn");
      if (!document.querySelector(".live") || window.began) return;
      window.began = true;
      const choice = document.getElementById("view-quantity"), told = [];
      for (const n of [0, 1, 2]) {
        choice.value = n;
        choice.dispatchEvent(new Event("change"));
        await new Promise(done => setTimeout(done, 100));
        const picture = await Plotly.toImage(box, {format: "png", width: 300, height: 300});
        told.push([box.data[0].cmin, box.data[0].colorbar.title.text, picture]);
      }
      document.querySelector("[data-turn]").click();
      await new Promise(done => setTimeout(done, 100));
      told.push(box.layout.scene.camera.eye);
      document.body.innerHTML = `<output>${JSON.stringify(told)}</output>`;
    }, 100);</script>"""
    (tmp_path / "page.html").write_text(page_of(found).replace("</body>", watch + "</body>"))
    options = ("--headless=new", "--no-sandbox", "--enable-unsafe-swiftshader", "--use-gl=angle", "--dump-dom")
    more = ("--use-angle=swiftshader", "--virtual-time-budget=5000", f"--user-data-dir={tmp_path / 'profile'}")
    command = [str(CHROMIUM), *options, *more, (tmp_path / "page.html").as_uri()]
    shown = subprocess.run(command, capture_output=True, text=True, timeout=400, check=True).stdout
    first, second, third, eye = json.loads(shown.partition("<output>")[2].partition("</output>")[0])
    view = unpacked(view_data(found, np.array([1.0, 0.0, 0.0])))
    for drawn, one in zip((first, second, third), view["quantities"]):
        assert drawn[:2] == [one["low"], f"{one['name']} [{one['unit']}]"] and len(drawn[2]) > 2000
    assert len({first[2], second[2], third[2]}) == 3
    before = audit_page._views(found)[0]
    assert np.linalg.norm([*eye.values()] + 1.9 * before / np.linalg.norm(before)) > 0.3
