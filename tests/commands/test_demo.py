import base64
import json
import math
import re
from io import BytesIO
from pathlib import Path
from runpy import run_path

import pytest
import tyro
from PIL import Image

from thermoxels_ns import cli
from thermoxels_ns.audit.conditions import load_conditions
from thermoxels_ns.audit.run import check_survey
from thermoxels_ns.commands import demo
from thermoxels_ns.commands.audit import Audit
from thermoxels_ns.commands.demo_results import audit_target, compare, read_results, true_u_of_patches
from thermoxels_ns.commands.export import ExportThermoxelsMesh
from thermoxels_ns.commands.heat import Heat
from thermoxels_ns.core.errors import OutputError
from thermoxels_ns.core.yaml_records import configs_folder
from thermoxels_ns.synthetic.drawn_scenes import BRIDGE_PSI_W_MK
from thermoxels_ns.training.schedule import QUALITIES

PATCHES = configs_folder() / "house-corner-patches.yaml"
IMAGES = {"psnr": 28.0, "thermal_mae_c": 0.5}
SUMMARY = {"truth": {"tolerance_voxels": 1.5, "fscore": 0.9}}


def test_only_the_folder_of_a_demo_is_cleared_and_of_what_the_demo_wrote_only(tmp_path):
    folder = demo.prepare_folder(tmp_path / "demo")
    for name in ("scene/images/a.png", "export/mesh.vtu", "notes.txt"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("x")
    outside = tmp_path / "precious"
    outside.mkdir()
    (outside / "kept").write_text("x")
    (folder / "outputs").symlink_to(outside)
    demo.prepare_folder(folder)
    assert {path.name for path in folder.iterdir()} == {".thermoxels-demo", "notes.txt"}
    assert (outside / "kept").is_file()
    with pytest.raises(OutputError, match=r"^output_dir: expected"):  # no demo has marked it
        demo.prepare_folder(outside)
    assert (outside / "kept").is_file()


def test_the_commands_take_what_the_commands_before_them_wrote():
    commands = [*demo.demo_commands(Path("my demo")).values()]
    solid, audit, walls, night = (
        tyro.cli(cli.Commands, args=one[1:]) if one[0] == "thermoxels" else tyro.cli(ExportThermoxelsMesh, args=one[2:])
        for one in commands[3:]
    )
    assert solid.patches == walls.patches == Path("my demo/survey/patches.yaml") and walls.interior == "hollow"
    assert isinstance(night, Heat) and night.mesh == walls.output_dir / "mesh.vtu"
    assert (night.scene, night.from_audit) == ("winter-night", audit.output_dir / "answers.json")
    assert isinstance(audit, Audit) and audit.mesh == Path("my demo/export/mesh.vtu")
    assert (audit.conditions, audit.scene) == (Path("my demo/survey/conditions.yaml"), Path("my demo/scene"))


def test_the_tables_of_the_docs_name_the_sizes_and_the_targets_of_the_demo(tmp_path):
    (tmp_path / "eval.json").write_text(json.dumps({"results": IMAGES}))
    (tmp_path / "summary.json").write_text(json.dumps(SUMMARY))
    targets = read_results(tmp_path / "eval.json", tmp_path / "summary.json")
    tools = Path(__file__).parents[2] / "tools"
    stated = [
        row.target.split() for row in run_path(str(tools / "figures.py"))["ROWS"] if row.target not in ("", "all")
    ]
    assert [(float(words[0]), words[-1] == "more") for words in stated] == [(t.bound, t.at_least) for t in targets]
    pairs = f"{demo._TRAIN_VIEWS} training views of {demo._WIDTH} x {demo._HEIGHT}, {QUALITIES['standard'][0]} voxels"
    assert pairs in (tools.parent / "README.md").read_text(encoding="utf-8")


@pytest.fixture
def quick_demo(fake_command, monkeypatch):
    """A demo on a tiny scene whose commands write what the real ones would, without training."""
    for name, value in (("_TRAIN_VIEWS", 3), ("_HELD_OUT_VIEWS", 2), ("_WIDTH", 16), ("_HEIGHT", 12)):
        monkeypatch.setattr(demo, name, value)
    after = "def after(name): return sys.argv[sys.argv.index(name) + 1]\n"
    picture = "from PIL import Image\n"
    fake_command("ns-train", after + "assert os.path.isfile(after('--data') + '/transforms.json')")
    fake_command("ns-eval", after + f"json.dump({{'results': {IMAGES}}}, open(after('--output-path'), 'w'))")
    fake_command(
        "ns-render",
        after
        + picture
        + "for shade, output in enumerate(('gt-rgb', 'rgb', 'gt-thermal', 'thermal'), 1):\n"
        + "    folder = os.path.join(after('--output-path'), 'test', output)\n"
        + "    os.makedirs(folder)\n"
        + "    for n in (1, 2): Image.new('RGB', (16, 12), (shade, 0, 0)).save(f'{folder}/frame_eval_{n:05d}.png')",
    )

    def export(summary: dict) -> None:
        fake_command(
            "ns-export",
            after
            + picture
            + "folder = after('--output-dir')\nos.makedirs(folder)\n"
            + "for shade, name in ((10, 'mesh'), (20, 'mesh-measured')):\n"
            + "    Image.new('RGB', (8, 6), (0, 0, shade)).save(f'{folder}/{name}.png')\n"
            + f"nan = float('nan')\njson.dump({summary}, open(f'{{folder}}/summary.json', 'w'))",
        )

    true = true_u_of_patches(PATCHES)
    u = [{"name": name, "u_w_m2k": {"value": one, "low": 0.9 * one, "high": 1.1 * one}} for name, one in true.items()]
    psi = {"value": 0.7, "low": 0.6, "high": 0.9}
    bridge = {"kind": "line", "patch": "side-wall", "not_counted": "", "length_m": 4.0, "coefficient": psi}
    fake_command(
        "thermoxels",
        after
        + picture
        + "folder = after('--output-dir')\nos.makedirs(folder)\n"
        + f"json.dump({ {'patches': u, 'defects': [bridge]} }, open(f'{{folder}}/answers.json', 'w'))\n"
        + "Image.new('RGB', (8, 6), 'blue').save(f'{folder}/surface-end.png')",
    )
    export(SUMMARY)
    return export


def test_the_whole_demo_leaves_a_page(quick_demo, tmp_path, capfd):
    folder = tmp_path / "demo"
    assert cli.main(["demo", "--output-dir", str(folder)]) == 0
    out = capfd.readouterr().out
    positions = [out.index(f"{n}/9  ") for n in range(1, 10)]
    assert positions == sorted(positions)
    assert out.index("6/9  Audit the house") < out.index("8/9  Let a winter night") < out.index("9/9  Compare")
    for word in ("ns-train thermoxels", "ns-eval", "ns-render dataset", "ns-export thermoxels-mesh"):
        assert f"$ {word} " in out
    page = (folder / "index.html").read_text(encoding="utf-8")
    assert "Thermoxels demo: house-corner" in page
    pictures = [Image.open(BytesIO(base64.b64decode(one))) for one in re.findall(r"base64,([^\"]*)", page)]
    assert len(pictures) == 3 + 2 * 6 + 4 * 2 + 1 + 1
    shown = [picture.convert("RGB").getpixel((2, 2)) for picture in pictures]
    assert shown[2] == (0, 0, 10) and shown[15:] == [*[(n, 0, 0) for n in (1, 2, 3, 4)] * 2, (0, 0, 20), (0, 0, 255)]
    addresses = re.findall(r'(?:src|href)="([^"]*)"', page)
    files = ("scene/", "outputs/", "eval.json", "renders/", "export/", "logs/", "audit/", "survey/", "heat/")
    assert all(address.startswith(("data:", *files)) for address in addresses)
    assert not re.search(r"<script|https?:|@import|url\(|\bon\w+=", page)
    assert ">-20.0<" in page and ">15.0\xa0°C<" in page  # the bounds of the house's temperatures
    assert page.count(">yes<") == 4 + len(true_u_of_patches(PATCHES)) + 1 and ">no<" not in page
    assert page.index(">Result<") < page.index("Audit: the truth beside the answer") < page.index("What went in")
    assert (folder / "survey" / "conditions.yaml").is_file()
    assert f"ns-viewer --load-config {folder}/outputs/demo/thermoxels/run/config.yml" in page
    assert sorted(path.name for path in (folder / "logs").iterdir()) == [
        *("audit.log", "heat.log", "ns-eval.log", "ns-export-walls.log", "ns-export.log", "ns-render.log"),
        "ns-train.log",
    ]
    assert cli.main(["demo", "--output-dir", str(folder)]) == 0


def test_the_house_has_the_u_values_that_its_elements_were_drawn_with():
    """Panes and door are of one U-value each; the walls' means hold the band of the storey slab."""
    true = true_u_of_patches(PATCHES)
    drawn = {"window-1": 5.6, "window-2": 5.2, "balcony-door": 5.8, "window-3": 4.8, "door": 3.6}
    drawn |= {"window-4": 5.4, "window-5": 5.6, "window-6": 5.0}
    assert {name: true[name] for name in drawn} == pytest.approx(drawn)
    # Without openings the mean of the side wall, 4.65 m high, would be that of the wall and of its band.
    assert 2.0 + BRIDGE_PSI_W_MK / 4.65 < true["side-wall"] < 2.0 + BRIDGE_PSI_W_MK / 3.0
    assert pytest.approx(1.2 * 0.35 * math.sqrt(math.pi)) == BRIDGE_PSI_W_MK


def test_the_survey_of_the_house_is_off_by_less_than_it_says():
    stated = load_conditions(configs_folder() / "house-corner-conditions.yaml")
    wind = stated.outside.wind
    for one, true in ((stated.inside.air, 20.0), (stated.outside.air, 0.0), (wind, (8.0 - 5.8) / 3.8054)):
        assert one.value != true and one.low <= true <= one.high
    assert check_survey(stated).missing == () and check_survey(stated).forbidden == ()


def test_figures_of_the_audit_are_held_against_the_drawing(tmp_path):
    def interval(value, low, high):
        return {"value": value, "low": low, "high": high}

    bridge = {"kind": "line", "patch": "side-wall", "not_counted": "", "length_m": 4.0}
    answers = {
        "patches": [
            {"name": "window-1", "u_w_m2k": interval(5.7, 5.0, 6.0)},
            {"name": "door", "u_w_m2k": interval(4.0, 3.7, 4.2)},
        ],
        "defects": [
            bridge | {"coefficient": interval(0.8, 0.7, 0.9)},
            bridge | {"length_m": 1.0, "coefficient": interval(0.1, 0.0, 0.2)},
            bridge | {"length_m": 9.0, "patch": "front-wall", "coefficient": interval(0.1, 0.0, 0.2)},
        ],
    }
    path = tmp_path / "answers.json"
    path.write_text(json.dumps(answers))
    compared = compare(path, PATCHES)
    assert [(one.name, one.held) for one in compared] == [
        *(("window-1", True), ("door", False), ("thermal bridge in side-wall, psi", True))
    ]
    target = audit_target(compared)
    assert target.measured == pytest.approx(200 / 3) and not target.met
    path.write_text(json.dumps(answers | {"defects": []}))
    none = compare(path, PATCHES)[2]
    assert none.found is None and not none.held


@pytest.mark.parametrize(("fscore", "shown"), [(0.59, "0.590"), (math.nan, "not measured")])
def test_a_missed_target_is_shown_and_fails_after_the_page_is_written(quick_demo, tmp_path, capfd, fscore, shown):
    quick_demo(SUMMARY | {"truth": SUMMARY["truth"] | {"fscore": fscore}})
    assert cli.main(["demo", "--output-dir", str(tmp_path / "demo")]) == 2
    error = capfd.readouterr().err
    assert f"Surface F-score at 1.5 voxels {shown} (target ≥ 0.600)" in error
    assert "RGB PSNR" not in error
    assert ">no<" in (tmp_path / "demo" / "index.html").read_text(encoding="utf-8")


def test_a_failing_step_stops_the_demo(quick_demo, fake_command, tmp_path, capfd):
    fake_command("ns-eval", "sys.exit('checkpoint not found')")
    assert cli.main(["demo", "--output-dir", str(tmp_path / "demo")]) == 1
    shown_text = capfd.readouterr()
    assert "ns-eval: expected exit status 0, got 1" in shown_text.err
    assert "checkpoint not found" in shown_text.err
    assert "4/9" not in shown_text.out
    assert not (tmp_path / "demo" / "index.html").exists()
