import json
import shutil
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import pyvista
import tyro
from PIL import Image
from scipy.spatial import KDTree

from tests.support.looking_cameras import looking_at
from tests.support.unreadable import contents, files_end_after
from thermoxels_ns.commands.export import (
    ExportOptions,
    ExportThermoxelsMesh,
    TrainedScene,
    check_options,
    export_scene,
    joined_scene,
    viewpoint_of_cameras,
)
from thermoxels_ns.core.errors import CheckpointError, MeshError, OutputError, SceneError, ThermoxelsError
from thermoxels_ns.core.lattice import Lattice, input_from_world
from thermoxels_ns.core.snapshot import GridSnapshot
from thermoxels_ns.data.layouts import scene_json
from thermoxels_ns.mesh.boundary.patches import PatchRules
from thermoxels_ns.mesh.solid.voxels import SolidSelection
from thermoxels_ns.multiview.photographs import Photographs

UNSEEN = 0.35


@pytest.fixture(scope="module")
def ball() -> GridSnapshot:
    """A ball in a box of 12^3 voxels, 10 C on one side and 30 C on the other, its middle never observed."""
    lattice = Lattice((-0.6, -0.6, -0.6), 0.1, (13, 13, 13))
    points = lattice.corner_positions()
    radius = np.linalg.norm(points, axis=-1)
    density = (10.0 * np.maximum(0.0, 1.0 - radius)).astype(np.float32)  # the default keeps radius < 0.5
    temperature = (20.0 + 25.0 * points[..., 0]).astype(np.float32)
    return GridSnapshot(lattice, density, temperature, np.where(radius < UNSEEN, 0.0, 9.0).astype(np.float32))


SCALED = {"metres_per_unit": 1.0}
OPTIONS = {field.name for field in fields(ExportOptions)}


def trained(snapshot: GridSnapshot, **more) -> TrainedScene:
    """A trained field without photographs and without a scene's json."""
    known = {"world_to_input": np.eye(4), "up": (0.0, 0.0, 1.0), "up_source": "z", "view_direction": None}
    known |= {"scene_folder": Path("no/scene"), "dataset": None, "tracks": None, "corrections": {}}
    return TrainedScene(snapshot, **{**known, **more})


def read(folder: Path) -> dict:
    return json.loads((folder / "summary.json").read_text())


@pytest.fixture
def drawn(monkeypatch) -> list:
    """Plain pictures in place of those of meshes; what was asked of each: values and look."""
    asked = []

    def draw(mesh, values=None, **look):
        asked.append((values, look))
        return np.zeros((6, 8, 3), np.uint8)

    monkeypatch.setattr("thermoxels_ns.reports.mesh_pictures.image_of_mesh", draw)
    return asked


@pytest.fixture
def small(ball, tmp_path):
    """Gives a function that exports the ball, by default without pictures and in metres."""

    def export(say=lambda _: None, **more) -> dict:
        options = {**SCALED, "pictures": False, **{k: v for k, v in more.items() if k in OPTIONS}}
        run = trained(ball, **{k: v for k, v in more.items() if k not in OPTIONS})
        return export_scene(run, ExportOptions(**options), tmp_path, say)

    return export


@pytest.fixture
def truth(monkeypatch):
    """Gives a function that replaces the comparison with the exact scene."""
    return lambda compare: monkeypatch.setattr("thermoxels_ns.evaluation.truth_comparison.compare_with_truth", compare)


def test_full_export(ball, tmp_path) -> None:
    options = ExportOptions(metres_per_unit=2.0, density_percentile=80.0, boundary="voxel", interior="hollow")
    folder = tmp_path / "new" / "folder"
    export_scene(trained(ball), options, folder)
    summary = read(folder)
    assert set(contents(folder)) == set(summary["files"])
    assert {"mesh.vtu", "mesh.png", "summary.json"} <= set(contents(folder))
    grid = pyvista.read(folder / "mesh.vtu")
    assert (grid.n_points, grid.n_cells) == (summary["mesh"]["nodes"], summary["mesh"]["tets"])
    assert summary["mesh"]["tets"] == 6 * summary["mesh"]["voxels"]
    # 12^3 voxels of 0.2 m, a fifth of them solid.
    assert summary["mesh"]["volume"] == pytest.approx(summary["mesh"]["voxels"] * 0.2**3)
    assert summary["mesh"]["voxels"] == pytest.approx(0.2 * 12**3, rel=0.15)
    assert 0.0 < summary["mesh"]["share_of_nodes_observed"] < 1.0
    angles = summary["mesh"]["dihedral_angles_deg"]
    assert (angles["min"], angles["max"]) == (pytest.approx(45.0), pytest.approx(90.0))
    assert summary["length_unit"] == "m" and summary["options"]["boundary"] == "voxel"
    assert {"thermoxels", "python", "numpy", "torch", "nerfstudio", "pyvista", "scikit-fem"} <= set(summary["versions"])


def test_torch_s_compiler_still_loads_after_drawing() -> None:
    """Mesa's LLVM and triton's crash the process if pictures come first; what draws sees to the order."""
    code = """
import numpy as np
import pyvista as pv
from thermoxels_ns.mesh.files.vtu import any_mesh
from thermoxels_ns.reports.mesh_pictures import image_of_mesh
grid = pv.ImageData(dimensions=(2, 2, 2)).to_tetrahedra()
grid.point_data["temperature_c"] = np.arange(8.0)
image_of_mesh(any_mesh(grid)[0])
import torch._dynamo
print("alive")
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 0 and "alive" in result.stdout, (result.returncode, result.stderr)


def test_mesh_lies_at_the_input_poses(ball, tmp_path) -> None:
    """A marked corner of the trained scene lands where the dataparser took it from, times metres per unit."""
    rng = np.random.default_rng(5)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    shift, scale = rng.normal(size=3), 0.37
    camera = np.array([1.0, -2.0, 3.0])  # input coordinates
    there = scale * (rotation @ camera + shift)
    undo = input_from_world(np.column_stack([rotation, shift]), scale)
    np.testing.assert_allclose((undo @ [*there, 1.0])[:3], camera, atol=1e-12)

    options = ExportOptions(metres_per_unit=3.0, pictures=False, boundary="voxel")
    export_scene(trained(ball, world_to_input=undo), options, tmp_path)
    points = pyvista.read(tmp_path / "mesh.vtu").points / 3.0
    back = scale * (points @ rotation.T + shift)
    index = ball.lattice.world_to_index(back)
    np.testing.assert_allclose(index, np.round(index), atol=1e-9)  # nodes on lattice corners again


@pytest.mark.parametrize(
    ("transform", "scale"), [(np.eye(4)[:3] * 2.0, 1.0), (np.full((3, 4), np.nan), 1.0), (np.eye(4)[:3], 0.0)]
)
def test_impossible_dataparser_transforms_are_refused(transform, scale) -> None:
    with pytest.raises(CheckpointError, match="dataparser_transform"):
        input_from_world(transform, scale)


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"metres_per_unit": -1.0}, "metres_per_unit"),
        ({"metres_per_unit": 1.0, "known_distance": (0.0, 0.0, 0.0, 0.0, 3.0, 4.0, 10.0)}, "scale"),
        ({"metres_per_unit": 1.0, "known_distance_error": 0.1}, "known_distance_error"),
        ({"region": "some"}, "region"),
        ({"region_box": (0.0, 0.0, 0.0, 1.0, float("nan"), 1.0)}, "region_box entry 5"),
        ({"formats": ("vtu", "vtu")}, "formats"),
        ({"formats": ("inp",)}, "scale"),
        ({"wall_thickness": 0.3}, "scale"),
        ({"density_percentile": 101.0}, "density_percentile"),
        ({"density_threshold": -0.1}, "density_threshold"),
        ({"close_gaps": -1}, "close_gaps"),
        ({"region_box": (0.0, 0.0, 0.0, 1.0, 0.0, 1.0)}, "region_box"),
        ({"interior": "filled"}, "interior"),
        ({"wall_thickness": 0.0}, "wall_thickness"),
        ({"up": (0.0, 0.0, 0.0)}, "up"),
    ],
)
def test_wrong_options_are_refused_and_nothing_is_written(ball, tmp_path, options, name) -> None:
    with pytest.raises(ThermoxelsError, match=f"{name}: expected"):
        export_scene(trained(ball), ExportOptions(**options), tmp_path / "out")
    assert not any(path.is_file() for path in tmp_path.rglob("*"))


@pytest.mark.parametrize(
    ("words", "changed"),
    [
        ([], {}),
        (["--region-box", "-1", "-2.5", "-3e-5", "1", "2", "3"], {"region_box": (-1.0, -2.5, -3e-5, 1.0, 2.0, 3.0)}),
        (["--region-near", "-1", "0", "-3e-5", "2"], {"region_near": (-1.0, 0.0, -3e-5, 2.0)}),
        (["--region", "all"], {"region": "all"}),
    ],
)
def test_the_command_line_gives_the_preset_but_for_what_is_said(words, changed) -> None:
    options = tyro.cli(ExportThermoxelsMesh, args=["--load-config", "c", "--output-dir", "o", *words])
    assert check_options(options) == (SolidSelection(**changed), PatchRules(), None)


def test_a_region_is_exported_said_and_drawn(ball, tmp_path, drawn) -> None:
    """Half of the ball, in the coordinates of input poses that are twice as far apart."""
    lines: list[str] = []
    options = ExportOptions(metres_per_unit=0.5, region_box=(0.0, -2.0, -2.0, 2.0, 2.0, 2.0))
    summary = export_scene(trained(ball, world_to_input=np.diag([2.0, 2.0, 2.0, 1.0])), options, tmp_path, lines.append)
    region = summary["region"]
    assert region["asked_for"] == "a box" and region["share_of_solid_taken"] == pytest.approx(0.5)
    assert region["voxels_taken"] == region["voxels_left_out"] > 0
    assert region["size"] == pytest.approx([0.5, 1.0, 1.0], abs=0.15)
    assert sum(line.startswith("Region, a box: 0.") and "50.0% of the solid" in line for line in lines) == 1
    assert "region.png" in summary["files"] and summary["options"]["region_box"][3] == 2.0
    points, triangles = next(look for _, look in drawn if look["title"] == "Region")["ghost"]
    assert points[triangles].mean(axis=1)[:, 0].max() <= 1e-9 and len(triangles) > 0
    assert summary["mesh"]["patches"]["cut"] == pytest.approx(np.pi * 0.5**2, rel=0.2)


def test_truth_and_viewpoint_reach_the_summary_and_the_pictures(ball, tmp_path, drawn, truth) -> None:
    look = {"up": (0.0, 1.0, 0.0), "view_direction": (0.0, 0.0, -1.0)}
    options = ExportOptions(density_threshold=4.0)
    asked = []

    def compare(cells, lattice, world_to_truth, folder, mesh, metres, within):
        assert metres == 1.0 and lattice == ball.lattice and within.shape == cells.shape
        asked.append((int(cells.sum()), len(mesh.tets)))
        return {"fscore": 0.5}

    truth(compare)
    unscaled = export_scene(trained(ball, **look), options, tmp_path)
    assert not asked and "truth" not in unscaled  # a truth is in metres
    assert {(v["up"], v["view_direction"], v["length_unit"]) for _, v in drawn} == {(*look.values(), "input unit")}
    export_scene(trained(ball), ExportOptions(density_threshold=4.0, pictures=False, **SCALED), tmp_path)
    assert asked[0][0] > 0 and asked[0][1] > 6 * asked[0][0] and read(tmp_path)["truth"] == {"fscore": 0.5}


def test_a_failed_export_leaves_the_earlier_one_and_one_interrupted_while_writing_no_summary(
    ball, tmp_path, monkeypatch, drawn, truth
) -> None:
    """It fails at the last moment before files are written: json has no NaN. A folder with a summary is no mixture."""
    export_scene(trained(ball), ExportOptions(**SCALED), tmp_path)
    before = contents(tmp_path)
    truth(lambda *_, **__: {"fscore": float("nan")})
    with pytest.raises(ThermoxelsError):
        export_scene(trained(ball), ExportOptions(density_threshold=6.0, **SCALED), tmp_path)
    assert contents(tmp_path) == before
    truth(lambda *_, **__: {"fscore": 0.5})

    def interrupt(*_, **__) -> None:
        assert not (tmp_path / "summary.json").exists()
        raise KeyboardInterrupt

    monkeypatch.setattr("thermoxels_ns.mesh.files.formats.write_mesh", interrupt)
    with pytest.raises(KeyboardInterrupt):
        export_scene(trained(ball), ExportOptions(**SCALED), tmp_path)
    assert not (tmp_path / "summary.json").exists()


@pytest.fixture(scope="module")
def exported(ball, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("exported")
    export_scene(trained(ball), ExportOptions(**SCALED), folder)
    return folder


@pytest.mark.parametrize(
    ("size_bytes", "broken"), [(1000, "summary-unfinished.json"), (75_000, "mesh.vtu"), (120_000, r"mesh.*\.png")]
)
def test_a_full_disk_is_one_line_and_leaves_no_half_of_a_file(ball, exported, tmp_path, size_bytes, broken) -> None:
    shutil.copytree(exported, tmp_path, dirs_exist_ok=True)
    (tmp_path / "mine.txt").write_text("mine")
    before = contents(tmp_path)
    with files_end_after(size_bytes), pytest.raises(OutputError, match=rf"{broken}.*space") as caught:
        export_scene(trained(ball), ExportOptions(**SCALED), tmp_path)
    assert "\n" not in str(caught.value)
    after = contents(tmp_path)
    unfinished = after.pop("summary-unfinished.json", None)  # marks the folder as an export's
    assert ("summary.json" in after) == (unfinished is None) and after["mine.txt"] == before["mine.txt"]
    assert {name: before[name] for name in after} == after  # the same again, whether they are old or new


@pytest.mark.parametrize("name", ["mesh.vtu/", "summary.json/", "mesh.msh"])
def test_files_of_others_and_folders_in_the_place_of_files_are_found_first(ball, tmp_path, name) -> None:
    path = tmp_path / name
    path.mkdir() if name.endswith("/") else path.write_text("mine")
    with pytest.raises(OutputError, match=f"got {path.name}"):
        export_scene(trained(ball), ExportOptions(**SCALED), tmp_path)
    assert [one.name for one in tmp_path.rglob("*")] == [path.name] and (path.is_dir() or path.read_text() == "mine")


def test_truth_that_cannot_be_used_does_not_cost_the_export(small, tmp_path, truth) -> None:
    def compare(*_, **__):
        raise SceneError("transforms.json: expected a scene. Write it again.")

    truth(compare)
    lines: list[str] = []
    small(lines.append)
    assert read(tmp_path)["truth"] == {"error": "transforms.json: expected a scene. Write it again."}
    assert any("Not compared with the truth: transforms.json" in line for line in lines)


def test_the_scene_json_may_begin_with_the_mark_that_windows_editors_write(tmp_path) -> None:
    (tmp_path / "transforms.json").write_text('{"metres_per_unit": 2.0}', encoding="utf-8-sig")
    assert scene_json(tmp_path)[1] == scene_json(tmp_path / "transforms.json")[1] == {"metres_per_unit": 2.0}


def test_summary_says_how_much_of_the_surface_was_measured(ball, tmp_path) -> None:
    seen_half = np.where(ball.lattice.corner_positions()[..., 0] < 0.01, 9.0, 0.0).astype(np.float32)
    half = GridSnapshot(ball.lattice, ball.density, ball.temperature_c, seen_half)
    summary = export_scene(trained(half), ExportOptions(pictures=False, **SCALED), tmp_path)
    grid = pyvista.read(tmp_path / "mesh.vtu").extract_surface(algorithm=None).compute_cell_sizes()
    seen = grid.point_data["observed"][grid.regular_faces].all(axis=1)
    share = grid.cell_data["Area"][~seen].sum() / grid.area
    assert 0.4 < share < 0.6 and summary["mesh"]["share_of_area_not_fully_observed"] == pytest.approx(share)


def test_view_from_where_the_cameras_stood() -> None:
    """Cameras that look along +x with y of the picture along -z (an upside-down world): the picture does too."""
    pose = np.array([[0.0, 0.0, -1.0, -3.0], [1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0]])
    up, _, direction = viewpoint_of_cameras(np.stack([pose, pose]), np.diag([2.0, 2.0, 2.0, 1.0]))
    assert up == pytest.approx((0.0, 0.0, -1.0)) and direction is not None
    assert np.dot(direction, (1.0, 0.0, 0.0)) == pytest.approx(1.0) and direction[2] > 0
    turned = pose.copy()
    turned[:, [0, 2]] *= -1.0  # looks back along -x
    assert viewpoint_of_cameras(np.stack([pose, turned]), np.eye(4))[2] is None


def test_up_of_cameras_that_look_down_is_that_of_their_level_pictures() -> None:
    """A drone that looks 60 degrees down from half of the sky: the mean of the pictures' up would lean to one side."""
    poses = []
    for heading in np.radians([-40, -20, 0, 20, 40]):
        right = np.array([np.cos(heading), np.sin(heading), 0.0])
        ahead = np.array([-np.sin(heading), np.cos(heading), 0.0])
        back = -(0.5 * ahead - np.sqrt(0.75) * np.array([0.0, 0.0, 1.0]))
        poses.append(np.column_stack([right, np.cross(back, right), back, np.zeros(3)]))
    up, source, _ = viewpoint_of_cameras(np.stack(poses), np.eye(4))
    assert up == pytest.approx((0.0, 0.0, 1.0), abs=1e-9) and "held level" in source
    up, source, _ = viewpoint_of_cameras(np.stack(poses[2:3]), np.eye(4))
    assert up == pytest.approx((0.0, np.sqrt(0.75), 0.5)) and "the mean" in source


@pytest.mark.parametrize("text", ["just words", "", "# a comment", "a: [", "!!python/object:no.such.Thing {}"])
def test_garbage_config_file(tmp_path, text) -> None:
    (tmp_path / "config.yml").write_text(text)
    with pytest.raises(CheckpointError, match=r"^load_config: expected"):
        ExportThermoxelsMesh(load_config=tmp_path / "config.yml", output_dir=tmp_path / "out").main()


def test_every_format_is_written_and_leaves_with_the_next_export(ball, tmp_path) -> None:
    formats = ("vtu", "xdmf", "msh", "inp", "glb")
    summary = export_scene(trained(ball), ExportOptions(pictures=False, formats=formats, **SCALED), tmp_path)
    assert {f"mesh.{name}" for name in formats} | {"mesh.h5", "mesh-boundary.vtp"} < set(contents(tmp_path))
    assert set(contents(tmp_path)) == set(summary["files"])
    (tmp_path / "mine.png").touch()
    summary = export_scene(trained(ball), ExportOptions(pictures=False, formats=("glb",)), tmp_path)
    assert summary["files"] == ["mesh.glb", "summary.json"] and summary["length_unit"] == "input unit"
    assert set(contents(tmp_path)) == {*summary["files"], "mine.png"}


def test_scale_from_a_known_distance(small, tmp_path) -> None:
    known: dict = {"known_distance": (0.0, 0.0, 0.0, 0.0, 3.0, 4.0, 10.0), "metres_per_unit": None}
    summary = small(**known)
    assert summary["scale"]["metres_per_unit"] == pytest.approx(2.0)
    assert summary["length_unit"] == "m"
    extent = np.ptp(pyvista.read(tmp_path / "mesh.vtu").points, axis=0)
    assert extent == pytest.approx(np.full(3, 2.0), abs=0.25)  # a ball of radius 0.5 units
    mesh = small(known_distance_error=0.1, **known)["mesh"]
    assert mesh["volume_standard_error"] == pytest.approx(0.03 * mesh["volume"])


def test_scale_and_up_from_the_scene_file_unless_up_is_given(small, tmp_path, tmp_path_factory) -> None:
    scene = {"metres_per_unit": 0.5, "metres_per_unit_standard_error": 0.01, "up": [0.0, 2.0, 0.0], "frames": []}
    folder = tmp_path_factory.mktemp("scene")
    (folder / "transforms.json").write_text(json.dumps(scene))
    summary = small(metres_per_unit=None, scene_folder=folder)
    assert (summary["scale"]["metres_per_unit"], summary["up"]) == (0.5, (0.0, 1.0, 0.0))
    mesh = summary["mesh"]
    assert mesh["volume_standard_error"] == pytest.approx(3 * 0.02 * mesh["volume"])
    assert mesh["area_standard_error"] == pytest.approx(2 * 0.02 * mesh["area"])
    boundary = pyvista.read(tmp_path / "mesh-boundary.vtp")
    up = [str(name) for name in boundary.field_data["patch_names"]].index("exterior-up")
    assert boundary.cell_data["normal"][boundary.cell_data["patch"] == up + 1].mean(axis=0).argmax() == 1
    given = small(metres_per_unit=None, up=(0.0, 0.0, -2.0), scene_folder=folder)
    assert given["up"] == (0.0, 0.0, -1.0) and "--up" in given["up_source"] and "up" not in given["scale"]


def test_patches_of_the_user_reach_mesh_and_summary(small, tmp_path_factory) -> None:
    rules = tmp_path_factory.mktemp("rules") / "rules.yaml"
    rules.write_text(
        "patches:\n- name: left\n  plane: {point: [0, 0, 0], normal: [-1, 0, 0]}\n"
        "regions:\n- name: top\n  plane: {point: [0, 0, 0.1], normal: [0, 0, 1]}\n"
    )
    mesh = small(patches=rules)["mesh"]
    assert mesh["patches"]["left"] == pytest.approx(0.5 * mesh["area"], rel=0.1)
    assert mesh["regions"]["top"] + mesh["regions"]["solid"] == pytest.approx(mesh["volume"])
    rules.write_text("patches: 3")
    with pytest.raises(MeshError, match=r"rules\.yaml"):
        small(patches=rules)


def test_surfaces_that_photographs_do_not_support_say_so(ball, tmp_path, monkeypatch) -> None:
    """Grey photographs from one side see half of the ball and place nothing."""
    views = looking_at((0, 0, 0), [(2.0, y, 0.2) for y in (-0.6, 0.0, 0.6)], focal=60.0, size=40)
    grey = np.full((3 * 40 * 40, 3), 0.5, dtype=np.float32)
    centres = views.camera_to_world[:, :, 3]
    thermal = np.full(len(grey), np.nan, np.float32)
    photographs = Photographs(views.matrices(), centres, views.size, np.arange(3) * 1600, grey, thermal)
    lines: list[str] = []
    monkeypatch.setattr("thermoxels_ns.multiview.photographs.read_photographs", lambda dataset: dataset)
    summary = export_scene(trained(ball, dataset=photographs), ExportOptions(), tmp_path, lines.append)
    shares = summary["mesh"]["share_of_area_by_support"]
    assert shares["supported"] == shares["weak"] == 0.0
    assert shares["smooth"] + shares["filled"] == pytest.approx(1.0) and 0.3 < shares["smooth"] < 0.6
    assert any(line.startswith("0% of the surface is supported by three photographs or more") for line in lines)
    boundary = pyvista.read(tmp_path / "mesh-boundary.vtp")
    seen, supporting = (boundary.cell_data[f"photographs_{name}"] for name in ("seen", "supporting"))
    assert set(seen) == {0, 1, 2, 3} and not supporting.any()
    assert seen[boundary.cell_centers().points[:, 0] < -0.3].max() == 0
    with Image.open(tmp_path / "support.png") as picture:
        ahead = np.asarray(picture.convert("RGB"))[:, : picture.width // 2].astype(int)
    assert np.mean((ahead[..., 0] > 120) & (ahead[..., 1:].max(axis=2) < 40)) > 0.05  # red: seen, not placed

    assert export_scene(trained(ball), ExportOptions(), tmp_path)["mesh"]["share_of_area_by_support"] is None
    assert not (tmp_path / "support.png").exists()
    assert "photographs_seen" not in pyvista.read(tmp_path / "mesh-boundary.vtp").cell_data


def block_of(ball: GridSnapshot, low: int, high: int, photographs: Photographs | None = None) -> TrainedScene:
    """The voxels of the ball from `low` to before `high` along x, in a world whose origin is their middle."""
    x, y, z = ball.lattice.lo
    middle = x + 0.05 * (low + high)
    corners, world_to_input = slice(low, high + 1), np.eye(4)
    world_to_input[0, 3] = middle
    lattice = Lattice((x + 0.1 * low - middle, y, z), 0.1, (high - low + 1, 13, 13))
    arrays = [one[corners] for one in (ball.density, ball.temperature_c, ball.observed_weight)]
    dataset = None if photographs is None else photographs.moved(np.array([-middle, 0.0, 0.0]))
    return trained(GridSnapshot(lattice, *arrays), world_to_input=world_to_input, dataset=dataset)


def test_two_blocks_give_the_mesh_of_the_whole(ball, tmp_path, monkeypatch) -> None:
    """Each counts its own photographs: both blocks have the same, so that the counts are those of the whole."""
    views = looking_at((0, 0, 0), [(2.0, y, 0.2) for y in (-0.6, 0.0, 0.6)], focal=60.0, size=40)
    grey, thermal = np.full((3 * 1600, 3), 0.5, np.float32), np.full(3 * 1600, np.nan, np.float32)
    centres = views.camera_to_world[:, :, 3]
    photographs = Photographs(views.matrices(), centres, views.size, np.arange(3) * 1600, grey, thermal)
    monkeypatch.setattr("thermoxels_ns.multiview.photographs.read_photographs", lambda dataset: dataset)
    blocks = joined_scene([block_of(ball, 0, 8, photographs), block_of(ball, 5, 12, photographs)])
    whole = trained(ball, dataset=photographs)
    found = []
    for name, run in (("whole", whole), ("blocks", blocks)):
        export_scene(run, ExportOptions(pictures=False), tmp_path / name)
        body, boundary = (pyvista.read(tmp_path / name / part) for part in ("mesh.vtu", "mesh-boundary.vtp"))
        seen = boundary.cell_data["photographs_seen"]
        found.append((body.volume, boundary.area, boundary.cell_centers().points, seen))
    (volume, area, places, seen), (*sizes, others, again) = found
    assert sizes == pytest.approx([volume, area], rel=1e-5)
    off, same = KDTree(others).query(places)
    assert off.max() < 0.01 and seen.any(), "a tenth of a voxel: densities of centres are rounded"
    assert np.mean(again[same] == seen) > 0.97, "but for what is seen under a grazing angle"


def test_blocks_of_another_scale_are_refused(ball) -> None:
    first, second = block_of(ball, 0, 8), block_of(ball, 5, 12)
    with pytest.raises(MeshError, match=r"beside.*2 times as long"):
        joined_scene([first, replace(second, world_to_input=second.world_to_input @ np.diag([2.0, 2.0, 2.0, 1.0]))])
