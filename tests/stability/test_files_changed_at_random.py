"""Valid files changed at random: each run ends with a right result or with one error that a user can act on."""

import copy
import json
import multiprocessing
import os
import re
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from tests.support.audited_wall import STATED, audited_wall, photographed, solve_wall, true_draws
from tests.support.heat_bodies import CONCRETE, box_mesh
from thermoxels_ns.audit.conditions import load_conditions
from thermoxels_ns.audit.run import audit
from thermoxels_ns.commands.audit import Audit, answers_of
from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.core.json_values import plain_values
from thermoxels_ns.core.yaml_records import configs_folder
from thermoxels_ns.data.dataparser import ThermalDataParserConfig
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.heat.run import run_scene
from thermoxels_ns.heat.scene import load_heat_scene
from thermoxels_ns.heat.solving import Goals
from thermoxels_ns.mesh.boundary.patches import load_patch_rules
from thermoxels_ns.mesh.files.formats import write_mesh
from thermoxels_ns.mesh.files.vtu import read_mesh
from thermoxels_ns.mesh.tetrahedra import TetMesh
from thermoxels_ns.reports.audit_page import audit_page
from thermoxels_ns.reports.page import Report

NIGHTLY = "NIGHTLY" in os.environ
EXAMPLES = settings(
    max_examples=2000 if NIGHTLY else 100,
    derandomize=not NIGHTLY,
    deadline=None,
    database=None,
    suppress_health_check=list(HealthCheck),
)
LONGEST = 50  # Times of a scene that is also solved
HOSTILE: list[Any] = [
    None, True, False, 0, -1, 1, 3, 0.5, -2.5, 1e-300, 1e30, 1e308, 10**400, float("nan"), float("inf"), "", " ", "x",
    "1", "nan", "x" * 300, "../../etc/passwd", "ü\0", [], {}, [[]], [0, 0, 0], {"a": 1}, "*", "[", "exterior-*",
]  # fmt: skip


def places(tree: Any, path: tuple = ()) -> list[tuple]:
    """All places in nested lists and mappings."""
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    return [path] * bool(path) + [place for key, value in items for place in places(value, (*path, key))]


@st.composite
def changed_trees(draw, tree: Any) -> Any:
    """One to three changes: a value replaced, scaled, nested, doubled or removed, a key renamed."""
    tree = copy.deepcopy(tree)
    for _ in range(draw(st.integers(1, 3))):
        place = draw(st.sampled_from(places(tree)))
        inside = tree
        for key in place[:-1]:
            inside = inside[key]
        key, what = place[-1], draw(st.sampled_from(["replace", "replace", "scale", "nest", "remove", "rename"]))
        value = inside[key]
        number = isinstance(value, (int, float)) and not isinstance(value, bool) and not abs(value) > 1e300
        if what == "scale" and number:
            inside[key] = value * draw(st.sampled_from([-1.0, 0.0, 1e-9, 1e-3, 1e3, 1e9, 1.0000001]))
        elif what == "nest":
            inside[key] = [value, value] if draw(st.booleans()) else {"x": value}
        elif what == "remove":
            del inside[key]
        elif what == "rename" and isinstance(inside, dict):
            inside[draw(st.sampled_from([f"{key}s", "x", ""]))] = inside.pop(key)
        else:
            inside[key] = copy.deepcopy(draw(st.sampled_from(HOSTILE)))
        if not places(tree):
            break
    return tree


@st.composite
def changed_bytes(draw, content: bytes) -> bytes:
    """Some bytes replaced, cut out or doubled."""
    for _ in range(draw(st.integers(1, 3))):
        start = draw(st.integers(0, max(len(content) - 1, 0)))
        length = draw(st.sampled_from([0, 1, 1, 4, 50, len(content)]))
        new = draw(st.sampled_from([b"", b"\0", b"9", b"-", b"e9", b"\xff", b"{", b"]", b":", b"\n", content[:40]]))
        content = content[:start] + new + content[start + length :]
    return content


def either(tree: Any, write: Callable[[Any], str]) -> st.SearchStrategy[bytes]:
    """Content changed as a tree or as bytes."""
    text = write(tree).encode()
    return changed_trees(tree).map(lambda changed: write(changed).encode("utf-8", "replace")) | changed_bytes(text)


def ends_well(run: Callable[[], Any]) -> bool:
    """Whether it had a result; a refusal is one line with a remedy, or one for each mistake."""
    try:
        run()
    except ThermoxelsError as problem:
        said = str(problem)
        lines = said.split("\n")
        assert min(map(len, lines)) > 20 and len(said) < 6000, said
        assert len(lines) == 1 or all(": expected " in line and line[-1] in ".?" for line in lines), said
        return False
    return True


def to_yaml(tree: Any) -> str:
    return yaml.safe_dump(tree, allow_unicode=True)


def building() -> TetMesh:
    """A box of 27 nodes whose sides have the names of an export's patches."""
    names = ("exterior-up", "exterior-side", "exterior-down", "interior-up", "interior-side", "interior-down", "cut")
    side = np.linspace(0.0, 1.0, 3)
    mesh = box_mesh(side, side, side)
    boundary = mesh.boundary
    patch = np.arange(len(boundary.patch)) % len(names)
    return replace(mesh, boundary=replace(boundary, patch=patch, patch_names=names))


def config(name: str) -> Any:
    return yaml.safe_load((configs_folder() / name).read_text(encoding="utf-8"))


def read_scene(path: Path) -> None:
    parser = ThermalDataParserConfig(data=path.parent).setup()
    for split in ("train", "val"):
        found = parser.get_dataparser_outputs(split)
        cameras = found.cameras
        assert len(found.image_filenames) == len(found.metadata["thermal_filenames"]) == len(cameras) > 0
        assert all(path.is_file() for path in (*found.image_filenames, *found.metadata["thermal_filenames"]))
        for values in (cameras.camera_to_worlds, cameras.fx, cameras.fy, cameras.cx, found.scene_box.aabb):
            assert bool(np.isfinite(values.numpy()).all())
        assert bool((cameras.fx > 0).all()) and bool((found.scene_box.aabb[1] > found.scene_box.aabb[0]).all())


def solve_scene(path: Path, mesh: TetMesh) -> None:
    scene = load_heat_scene(path)
    if scene.time is not None and len(scene.time.times_s) > LONGEST:
        return
    found = run_scene(scene, mesh, Goals(memory_gb=1.0))
    assert np.isfinite(found.nodes.states_c).all()
    assert found.solution.energy_residual < 1e-9
    assert all(np.isfinite(effect.heat_w) for effect in found.results.effects)


def answer(path: Path, mesh: TetMesh) -> None:
    """Down to the page."""
    found = audit(mesh, load_conditions(path))
    plain_values(answers_of(Audit(path.with_name("mesh.vtu"), path), found))
    assert found.whole.u_w_m2k.low <= found.whole.u_w_m2k.high
    page = audit_page(found, None, {}, "mesh.vtu", "thermoxels audit", (), Report("0", "0", ()))
    if b"nan" not in path.read_bytes().lower():  # as the name of a client, say
        assert "nan" not in re.sub(r"[a-z]nan|nan[a-z]", "", page.lower())


def format_of(kind: str, make_scene: Any) -> tuple[Any, Callable[[Any], str], str, Callable[[Path], Any]]:
    """A valid tree, its writer, the file's name and its reader."""
    if kind == "scene folder":
        scene = make_scene(frames=5)
        camera = dict.fromkeys(("k1", "k2", "p1", "p2"), 0.001)
        further = {"test_filenames": [scene.meta["frames"][2]["file_path"]], "metres_per_unit": 1.0}
        return {**scene.meta, **camera, **further}, json.dumps, "scene/transforms.json", read_scene
    if kind == "heat scene":  # every effect that a scene may name
        tree, mesh = config("scene-all-effects.yaml"), building()
        tree["time"] = {"steps": 3, "step_seconds": 600.0}
        tree["materials"] = {"*": {"conductivity_w_mk": 1.7, "density_kg_m3": 2200.0, "specific_heat_j_kgk": 880.0}}
        return tree, to_yaml, "scene.yaml", lambda path: solve_scene(path, mesh)
    if kind == "audit conditions":
        tree = config("conditions-example.yaml")
        tree["references"] = [{"at": [1.0, 0.0, 1.2], "temperature": "1.4 +- 0.2 C"}]
        tree["leave_out"] = ["cut"]
        wall = photographed(solve_wall(audited_wall(0.2), STATED, true_draws(STATED, None)), STATED, 1)
        return tree, to_yaml, "conditions.yaml", lambda path: answer(path, wall)
    return config("patches-example.yaml"), to_yaml, "patches.yaml", load_patch_rules


@pytest.mark.parametrize("kind", ["scene folder", "heat scene", "audit conditions", "patches"])
def test_text_files(tmp_path, scene_folder, kind) -> None:
    tree, write, name, read = format_of(kind, scene_folder)
    solved = [0, 0]

    @EXAMPLES
    @example(write(tree).encode())
    @given(either(tree, write))
    def check(content: bytes) -> None:
        (tmp_path / name).write_bytes(content)
        solved[ends_well(lambda: read(tmp_path / name))] += 1

    check()
    assert min(solved) > 0, "some are refused, the unchanged one at least is read"


def read_changed(folder: Path, name: str, content: bytes) -> bool:
    """Whether the mesh has a result with one file changed, which is whole again after it."""
    whole = (folder / name).read_bytes()
    (folder / name).write_bytes(content)
    try:
        return ends_well(lambda: HeatProblem(read_mesh(folder / "mesh.vtu"), CONCRETE))
    finally:
        (folder / name).write_bytes(whole)


def test_mesh_files(tmp_path) -> None:
    """In a process of its own: VTK may end it."""
    write_mesh(tmp_path / "mesh.vtu", building())
    examples: list[tuple[str, bytes]] = []

    @EXAMPLES
    @given(st.data())
    def collect(data) -> None:
        name = data.draw(st.sampled_from(["mesh.vtu", "mesh-boundary.vtp"]))
        examples.append((name, data.draw(changed_bytes((tmp_path / name).read_bytes()))))

    collect()
    read: list[bool] = []
    with ProcessPoolExecutor(1, multiprocessing.get_context("fork")) as pool:
        for example in examples:
            try:
                read.append(pool.submit(read_changed, tmp_path, *example).result(300.0))
            except BrokenProcessPool:
                pytest.fail(f"the process ended in {example}")
    assert 0 < sum(read) < len(examples)
