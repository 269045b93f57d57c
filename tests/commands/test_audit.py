import base64
import gzip
import hashlib
import io
import json
import re
import sys
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import pyvista as pv
from PIL import Image, ImageFile

from tests.support.audited_wall import INSIDE, STATED, UP, audited_wall, photographed, solve_wall, true_draws
from tests.support.demo_mesh import house_corner
from tests.support.heat_bodies import box_mesh, planes
from thermoxels_ns import cli
from thermoxels_ns.audit.compare import earlier_conditions
from thermoxels_ns.audit.run import audit
from thermoxels_ns.commands.audit import Audit, run_audit
from thermoxels_ns.commands.audit_photographs import photographs_of_defects
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.core.errors import AuditError
from thermoxels_ns.core.yaml_records import configs_folder
from thermoxels_ns.data.scene_file import read_scene_file
from thermoxels_ns.mesh.files.formats import write_mesh
from thermoxels_ns.reports.audit_page import draw_audit, view_data


@pytest.fixture(scope="module")
def export(tmp_path_factory) -> Path:
    """A wall with a balcony slab, as exported, with conditions beside it."""
    folder = tmp_path_factory.mktemp("audit")
    mesh = photographed(solve_wall(audited_wall(), STATED, true_draws(STATED, None)), STATED, 2)
    write_mesh(folder / "mesh.vtu", mesh)
    text = (configs_folder() / "conditions-example.yaml").read_text()
    text = text.replace("title: Example house, north side", "title: A <script>house</script> & garden")
    (folder / "conditions.yaml").write_text(text.replace("offset: 0.0 +- 1.0 K", "offset: 0.0 +- 0.2 K"))
    return folder


def audited(mesh: Path, conditions: Path, output: Path, *words: str) -> tuple[dict, str]:
    """Answers and page of the command."""
    given = ["audit", str(mesh), "--conditions", str(conditions), "--output-dir", str(output), *words]
    assert cli.main(given) == 0
    return json.loads((output / "answers.json").read_text()), (output / "audit.html").read_text()


@pytest.fixture(scope="module")
def done(export) -> Path:
    """Results of the command with pictures."""
    audited(export / "mesh.vtu", export / "conditions.yaml", export / "out")
    return export / "out"


def test_the_command_writes_answers_page_and_surface(done) -> None:
    assert sorted(path.name for path in done.iterdir()) == ["answers.json", "audit.html", "surface.vtp"]
    answers = json.loads((done / "answers.json").read_text())
    assert {one["name"] for one in answers["patches"]} == {"facade", "window"}
    assert [one["kind"] for one in answers["defects"]] == ["line"]
    loss = answers["whole"]["loss_w"]
    assert loss["low"] < loss["value"] < loss["high"]
    assert answers["missing_for_en_13187"] == [] and answers["conditions"]["survey"]["date"].startswith("2026-01-15")
    surface = pv.read(done / "surface.vtp")
    counted = surface.cell_data["counted"] == 1
    assert (
        np.isfinite(surface.cell_data["u_w_m2k"][counted]).all()
        and np.isnan(surface.cell_data["u_w_m2k"][~counted]).all()
    )
    assert set(np.unique(surface.cell_data["defect"])) == {0, 1}
    page = (done / "audit.html").read_text()  # it is complete in itself and escapes what users write
    assert "<h1>A &lt;script&gt;house&lt;/script&gt; &amp; garden</h1>" in page
    assert not re.search(r'(?:src|href)="(?!data:|#)', page) and "<script>house" not in page
    headings = re.findall(r"<h2>(.*?)</h2>", page)
    assert headings == [
        *("What was asked for", "What was seen", "Findings", "The envelope, element by element"),
        "A year: heat, money, carbon dioxide",
        *("Thermal bridges and defects", "Conditions", "The survey", "How sure this is", "Method and its limits"),
        *("How it was made", "For the file"),
    ]
    assert page.count("<article") == len(answers["defects"]) and page.count("data:image/png") == 2
    assert "EN 13187 also says" not in page and "lose " in page


def test_a_calibration_stands_on_the_page_in_the_answers_and_on_the_mesh(export, tmp_path) -> None:
    asked = """
calibrate:
  conductivity: {wall: 0.9 W/(m K), glazing: 0.36 W/(m K), slab: 2.3 +- 0.2 W/(m K)}
  behind: [room]
  unknown: [{property: conductivity, of: wall}]
"""
    (tmp_path / "c.yaml").write_text((export / "conditions.yaml").read_text() + asked)
    answers, page = audited(export / "mesh.vtu", tmp_path / "c.yaml", tmp_path / "out")
    found = answers["calibration"]
    ends = found["found"]["conductivity of wall"]
    assert ends["low"] < 0.3 and (ends["high"] is None or ends["high"] > 0.3) and found["refused"] == ""
    surface = pv.read(tmp_path / "out" / "surface.vtp")
    off = surface.cell_data["measured_minus_computed_k"]
    assert np.array_equal(np.isfinite(off), surface.cell_data["counted"] == 1)
    assert page.index("element by element") < page.index("<h2>Calibration</h2>") < page.index("Thermal bridges and")
    assert "conductivity of slab 2.3 ± 0.2 W/(m\N{NO-BREAK SPACE}K)" in page and page.count("data:image/png") == 3


def test_pictures_of_a_room_look_into_it() -> None:
    """A closed box that was seen from within: both views show colours, not its grey outside."""
    x = planes(0.0, 0.5, 3.5, 4.0, step=0.25)
    hollow = {"keep": lambda p: ~((p > 0.5) & (p < 3.5)).all(axis=-1)}
    mesh = box_mesh(x, x, x, temperature_c=lambda p: 17.0 + 0.5 * p[:, 2], **hollow)
    middle = mesh.points_m[mesh.facets].mean(axis=1)
    seen = ((middle > 0.4) & (middle < 3.6)).all(axis=1)
    room = replace(mesh, boundary=replace(mesh.boundary, seen=seen))
    found = audit(room, INSIDE)
    view = json.loads(gzip.decompress(base64.b64decode(view_data(found, np.array([1.0, 0.0, 0.0])))))
    assert view["inside"] and len(view["counted"][0]) == found.surface.counted.sum() and not view["others"][0]
    pictures = draw_audit(found)
    assert len(pictures["temperature"]) == 2
    for png in pictures["temperature"]:
        drawn = np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)[150:750, 50:900]
        coloured = np.ptp(drawn, axis=2) > 40
        assert coloured.mean() > 0.2


def test_the_page_of_a_room_says_what_it_cannot_say(tmp_path) -> None:
    """Seen from inside, the air outside not known: heat flow is told, and why there is no U-value."""
    room = audited_wall(slab=False, window=False, side="inside")
    write_mesh(tmp_path / "mesh.vtu", photographed(solve_wall(room, INSIDE, true_draws(INSIDE, None)), INSIDE))
    (tmp_path / "c.yaml").write_text(ROOM)
    answers, page = audited(tmp_path / "mesh.vtu", tmp_path / "c.yaml", tmp_path / "out")
    assert answers["whole"]["u_w_m2k"] == {"value": None, "low": None, "high": None}
    assert answers["whole"]["loss_w"]["low"] > 0.0 and answers["conditions"]["outside"]["air"]["value"] is None
    assert "No U-value, psi or temperature factor can be told, because the air outside is not known." in page
    assert "outside not known" in page and "Heat flow by the stated values" in page and not re.search(r"\bnan\b", page)


def test_what_forbids_a_survey_stands_first(export, tmp_path) -> None:
    text = (export / "conditions.yaml").read_text().replace("wind: 1.0 +- 0.5 m/s", "wind: 7.0 +- 0.5 m/s")
    (tmp_path / "c.yaml").write_text(re.sub(r"  client:.*\n", "", text))
    _, page = audited(export / "mesh.vtu", tmp_path / "c.yaml", tmp_path / "out", "--pictures", "False")
    assert page.index("Look at this first") < page.index("Wind: 7 m/s") < page.index('class="cards')
    assert "this one does not know: client." in page and "data:image/png" not in page


def test_the_page_is_printed_as_a_document_where_weasyprint_is(export, tmp_path, capsys, monkeypatch) -> None:
    words = ("--pictures", "False", "--pdf", "True")
    audited(export / "mesh.vtu", export / "conditions.yaml", tmp_path / "out", *words)
    document = (tmp_path / "out" / "audit.pdf").read_bytes()
    assert document.startswith(b"%PDF-") and document.rstrip().endswith(b"%%EOF")
    packed = re.findall(rb"/Type /ObjStm.*?stream\r?\n(.*?)endstream", document, flags=re.S)
    objects = b"".join(zlib.decompressobj().decompress(one) for one in packed)
    assert len(re.findall(rb"/Type /Page\b", objects)) in range(3, 9)
    (corners,) = set(re.findall(rb"/MediaBox ?\[([^\]]*)\]", objects))
    assert np.allclose([float(one) for one in corners.split()], [0, 0, 595.28, 841.89], atol=0.01)  # A4
    capsys.readouterr()
    monkeypatch.setitem(sys.modules, "weasyprint", None)
    _, page = audited(export / "mesh.vtu", export / "conditions.yaml", tmp_path / "out", *words)
    assert "pip install weasyprint" in capsys.readouterr().out and "audit.pdf" not in page.partition("answers.json")[2]
    assert not (tmp_path / "out" / "audit.pdf").exists()


@pytest.mark.parametrize(("name", "begins"), [("a.html", b"<!doctype html>"), ("a.pdf", b"%PDF-")])
def test_an_agreement_is_written_before_a_survey(tmp_path, name, begins) -> None:
    (tmp_path / "c.yaml").write_text("title: A <b>house\nsurvey: {client: C. Lient, purpose: to find leaks}\n")
    words = ["audit", "--write-agreement", str(tmp_path / "new" / name), "--conditions", str(tmp_path / "c.yaml")]
    assert cli.main(words) == 0
    written = (tmp_path / "new" / name).read_bytes()
    assert written.startswith(begins)
    assert not ImageFile.LOAD_TRUNCATED_IMAGES, "half a photograph is still damaged"
    if name == "a.html":
        page = written.decode()
        assert "A &lt;b&gt;house" in page and "<td>C. Lient</td>" in page and "<td>to find leaks</td>" in page
        assert page.count('class="blank') == 10 and "at least 10 K" in page and "air leakage is not in it" in page
    with pytest.raises(AuditError, match="--write-agreement"):
        run_audit(Audit(write_agreement=tmp_path / "new" / name))  # is there
    with pytest.raises(AuditError, match="--write-agreement"):
        run_audit(Audit(write_agreement=tmp_path / "a.doc"))
    (tmp_path / "c.yaml").write_text("survey: {cleint: C}\n")
    with pytest.raises(AuditError, match="cleint"):
        run_audit(Audit(write_agreement=tmp_path / "b.html", conditions=tmp_path / "c.yaml"))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["c.yaml", "new"]


def test_an_example_of_conditions_is_written_and_read(export, tmp_path, capsys) -> None:
    assert cli.main(["audit", "--write-conditions", str(tmp_path / "c.yaml")]) == 0
    assert "pass it with --conditions" in capsys.readouterr().out
    options = Audit(export / "mesh.vtu", tmp_path / "c.yaml", tmp_path / "out", pictures=False)
    found = run_audit(options)
    assert found is not None and found.conditions.title == "Example house, north side"
    written = (tmp_path / "out" / "answers.json").read_bytes()
    run_audit(options)
    assert (tmp_path / "out" / "answers.json").read_bytes() == written  # the same input gives the same answers


def test_the_up_of_the_export_counts(export, tmp_path) -> None:
    for name in ("mesh.vtu", "mesh-boundary.vtp"):
        (tmp_path / name).write_bytes((export / name).read_bytes())
    (tmp_path / "summary.json").write_text(json.dumps({"length_unit": "m", "up": [0.0, -3.0, 0.0]}))
    options = Audit(tmp_path / "mesh.vtu", export / "conditions.yaml", tmp_path / "out", pictures=False)
    found = run_audit(options)
    assert found is not None and found.surface.selection.up == (0.0, -1.0, 0.0)


ROOM = """
side: inside
inside: {air: 20 +- 0.5 C}
surroundings: {reflected: 19.6 +- 0.3 C}
film: {model: iso-6946, factor: 1.0 +- 0.2}
camera: {offset: 0 +- 0.2 K, repeatability: 0 +- 0.2 K}
surfaces: [{emissivity: 0.93 +- 0.02}]
"""


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "mesh: expected"),
        (["mesh.vtu"], "conditions: expected"),
        (["mesh.vtu", "--conditions", "conditions.yaml", "--output-dir", "export"], "output folder: expected"),
        (["mesh.vtu", "--conditions", "conditions.yaml", "--least-bridge-w", "-1"], "--least-bridge-w: expected"),
        (["mesh.vtu", "--conditions", "room.yaml", "--envelope", "gbxml"], "envelope: expected"),
        (["mesh.vtu", "--conditions", "conditions.yaml", "--scene", "export"], "expected transforms.json"),
        (["mesh.vtu", "--conditions", "conditions.yaml", "--scene", "export", "--layout", "colmap"], "expected"),
        (["mesh.vtu", "--conditions", "conditions.yaml", "--compare", "none.json"], "none.json"),
        (["mesh.vtu", "--conditions", "conditions.yaml", "--compare", "room.json"], "without conditions and up"),
        (["mesh.vtu", "--conditions", "conditions.yaml", "--compare", "no-up.json"], "without up"),
    ],
)
def test_what_cannot_be_used_is_refused_before_the_audit(export, tmp_path, capsys, monkeypatch, words, said) -> None:
    monkeypatch.setattr("thermoxels_ns.audit.run.audit", lambda *_: pytest.fail("too late"))
    monkeypatch.chdir(tmp_path)
    for name in ("mesh.vtu", "mesh-boundary.vtp", "conditions.yaml"):
        (tmp_path / name).symlink_to(export / name)
    (tmp_path / "export").mkdir()
    (tmp_path / "export" / "answers.json").write_text("{}")  # results of another command are not replaced
    (tmp_path / "room.yaml").write_text(ROOM)
    (tmp_path / "room.json").write_text("{}")
    (tmp_path / "no-up.json").write_text(json.dumps({"conditions": {}, "up": ["x", "y", "z"]}))
    assert cli.main(["audit", *words]) == 2 and said in capsys.readouterr().err
    assert not [*tmp_path.glob("audit/*")]


def test_a_page_says_what_a_client_asks(export, tmp_path) -> None:
    """Limits only where there are some, values that no wall could have, words in place of names, and whose report."""
    text = (export / "conditions.yaml").read_text().replace('u: {"*": 0.50', 'u: {"facade": 0.50')
    text = text.replace("model: balance\n", "model: iso-6946-combined\n").replace("offset: 0.0", "offset: 6.0")
    (tmp_path / "c.yaml").write_text(text)
    options = ("--pictures", "False")
    answers, page = audited(export / "mesh.vtu", tmp_path / "c.yaml", tmp_path / "out", *options)
    said = " ".join(answers["impossible"])
    assert "window" in said and "ISO 6946" in said and "outside air and camera offset" in said
    assert "No limit was set for the U-value of window." in page and "impossible" in page
    assert "of the 2 limits that were set" in page and "entry 1" not in page and "I_tb" not in page
    again, _ = audited(export / "mesh.vtu", tmp_path / "c.yaml", tmp_path / "again", *options)
    other, _ = audited(export / "mesh.vtu", export / "conditions.yaml", tmp_path / "other", *options)
    assert again["report"] == answers["report"] != other["report"]
    number, inputs = answers["report"]["number"], dict(answers["report"]["inputs"])
    assert page.count(number) >= 3 and all(digest in page for digest in inputs.values())
    assert inputs["c.yaml"] == hashlib.sha256((tmp_path / "c.yaml").read_bytes()).hexdigest()


def test_bridges_below_a_bound_are_listed_but_count_for_nothing(export, done, tmp_path) -> None:
    (bridge,) = json.loads((done / "answers.json").read_text())["defects"]
    for least, counted in ((0.5 * bridge["extra_w"]["value"], True), (2.0 * bridge["extra_w"]["value"], False)):
        words = ("--pictures", "False", "--least-bridge-w", str(least))
        answers, page = audited(export / "mesh.vtu", export / "conditions.yaml", tmp_path / str(counted), *words)
        assert (answers["defects"][0]["not_counted"] == "") == counted == ("<article" in page)
        assert any("psi" in one["name"] for one in answers["limits"]) == counted


def test_patches_are_proposed_taken_and_written_as_an_envelope(tmp_path, capsys) -> None:
    """The demo's house, turned: its names of walls are other ones. The wall in the south is left out of the audit."""
    write_mesh(tmp_path / "mesh.vtu", house_corner())
    patches, picture = tmp_path / "new" / "patches.yaml", tmp_path / "new" / "patches.png"
    propose = ["audit", str(tmp_path / "mesh.vtu"), "--write-patches", str(patches), "--north", "1", "0", "0"]
    assert cli.main(propose) == 0
    assert "window-east-4" in capsys.readouterr().out and np.ptp(np.asarray(Image.open(picture))) > 100
    assert cli.main(propose) == 2 and "write_patches" in capsys.readouterr().err
    text = (configs_folder() / "house-corner-conditions.yaml").read_text()
    (tmp_path / "c.yaml").write_text(text.replace(", reveals]", "]").replace('"*-wall"', '"wall-*"'))
    words = ("--patches", str(patches), "--envelope", "hbjson", "gbxml", *propose[-4:], "--pictures", "False")
    answers, _ = audited(tmp_path / "mesh.vtu", tmp_path / "c.yaml", tmp_path / "out", *words)
    assert {"wall-east", "roof", "ground", "door-north-1"} <= {one["name"] for one in answers["patches"]}
    assert answers["envelope"]["wall-east"]["azimuth_deg"] == pytest.approx(90.0, abs=2.0)
    assert json.loads((tmp_path / "out" / "envelope.hbjson").read_text())["type"] == "Model"
    assert (tmp_path / "out" / "envelope-gbxml.xml").read_bytes().startswith(b"<?xml")


def test_an_earlier_audit_is_compared_on_the_page_and_in_the_answers(export, done, tmp_path, capsys) -> None:
    """The same wall, of which nothing changed: the mesh keeps its coordinates, and no change is significant."""
    words = ("--pictures", "False", "--compare", str(done / "answers.json"), "--compare-difference", "10")
    answers, page = audited(export / "mesh.vtu", export / "conditions.yaml", tmp_path / "out", *words)
    compared = answers["compared"]
    assert {one["name"] for one in compared["elements"]} == {"facade", "window"} and not compared["moved"]
    assert [one["state"] for one in compared["bridges"]] == ["in both"] and compared["difference_k"] == 10.0
    assert all(abs(one["change"]["value"]) < 1e-9 and not one["significant"] for one in compared["elements"])
    assert page.index("element by element") < page.index("What changed since") < page.index("Thermal bridges and")
    assert "earlier survey: none" in capsys.readouterr().out and "answers.json" in dict(answers["report"]["inputs"])
    stated = answers["conditions"]
    old = earlier_conditions("answers.json", stated | {"storeys": {"ground floor": []}})  # older audits have them
    assert old == earlier_conditions("answers.json", stated)
    with pytest.raises(AuditError, match="colour"):
        earlier_conditions("answers.json", stated | {"colour": 1.0})
    given = ["audit", str(export / "mesh.vtu"), "--conditions", str(export / "conditions.yaml"), "--compare"]
    before = (done / "answers.json").read_bytes()
    assert cli.main([*given, str(done / "answers.json"), "--output-dir", str(done)]) == 2
    assert "output folder: expected" in capsys.readouterr().err and (done / "answers.json").read_bytes() == before


SCALE = 2.0  # Metres in a unit of the poses
CAMERA = Camera(160, 120, 100.0, 100.0, 80.0, 60.0)


@pytest.fixture(scope="module")
def found():
    """A plate of 3 m by 3 m, seen from y < 0, with a warm strip at a height of 1.5 m."""
    mesh = box_mesh(planes(0, 3, step=0.05), [0.0, 0.2], planes(0, 3, step=0.05), temperature_c=2.0)
    strip = (np.abs(mesh.points_m[:, 2] - 1.5) < 0.06) & (np.abs(mesh.points_m[:, 0] - 1.5) < 1.1)
    front = mesh.boundary.patch == mesh.boundary.patch_names.index("y0")
    seen = replace(mesh, boundary=replace(mesh.boundary, seen=front), temperature_c=np.where(strip, 4.0, 2.0))
    return audit(seen, STATED, UP)


def pose(y_m: float) -> np.ndarray:
    """A camera in front of the plate (y < 0) or behind it, which looks at its middle."""
    ahead = 1.0 if y_m < 0.0 else -1.0
    matrix = np.eye(4)
    matrix[:3, 0], matrix[:3, 1], matrix[:3, 2] = (ahead, 0, 0), (0, 0, 1), (0, -ahead, 0)
    matrix[:3, 3] = np.array([1.5, y_m, 1.5]) / SCALE
    return matrix


def photograph(folder: Path, number: int, y_m: float, shade: int) -> dict:
    """Paint what a camera sees: the strip red, all else grey; 4 and 2 degrees."""
    rays = CAMERA.directions(pose(y_m))[:, :, 0]
    at = pose(y_m)[:3, 3] * SCALE - rays * (y_m / rays[..., 1:2])
    strip = (np.abs(at[..., 2] - 1.5) < 0.1) & (np.abs(at[..., 0] - 1.5) < 1.1)
    picture = np.where(strip[..., None], [200, 0, 0], [shade, shade, shade]).astype(np.uint8)
    Image.fromarray(picture).save(folder / "images" / f"{number}.png")
    np.save(folder / "thermal" / f"{number}.npy", np.where(strip, 4.0, 2.0))
    return {"file_path": f"images/{number}.png", "transform_matrix": pose(y_m).tolist()}


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    """Photographs from behind, from near and from far."""
    folder = tmp_path_factory.mktemp("scene")
    (folder / "images").mkdir()
    (folder / "thermal").mkdir()
    frames = [photograph(folder, n, y, 60 + 20 * n) for n, y in enumerate((1.5, -3.0, -9.0))]
    lens = {"w": 160, "h": 120, "fl_x": 100.0, "fl_y": 100.0, "cx": 80.0, "cy": 60.0}
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    return folder


def pictures_of(scene: Path, found) -> dict:
    return photographs_of_defects(read_scene_file(scene), SCALE, found)


def shown(image: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(image))).astype(int)


def test_a_defect_is_cut_out_of_the_view_that_shows_it_largest(found, scene) -> None:
    ((number, ((photo, caption), (thermogram, _))),) = pictures_of(scene, found).items()
    assert (number, caption) == (0, "1.png")
    red, _, blue = shown(photo).transpose(2, 0, 1)
    strip = red - blue > 100
    rows = np.flatnonzero(strip.mean(axis=1) > 0.3)
    assert len(rows) and abs(rows.mean() - strip.shape[0] / 2) < 0.05 * strip.shape[0]
    # The same place is bright in the thermal image, and all else is dark; the frame is white in both.
    bright = shown(thermogram).sum(axis=2) > 500
    assert bright[strip].mean() > 0.8 and bright[~strip].mean() < 0.2


def test_what_stands_before_a_defect_hides_it(found, scene) -> None:
    """A screen half-way to the camera."""
    surface = found.surface
    count = np.count_nonzero(surface.counted)
    screen = surface.centroid_m.copy()
    screen[np.flatnonzero(~surface.counted)[:count]] = surface.centroid_m[surface.counted] * (1, 0, 1) - (0, 1.0, 0)
    hidden = replace(found, surface=replace(surface, centroid_m=screen))
    assert pictures_of(scene, hidden) == {}
