import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.files.content import surface_of
from thermoxels_ns.mesh.files.surface import write_glb
from thermoxels_ns.mesh.quality.tet_shapes import signed_volumes

TYPES = {5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


def read_glb(path: Path) -> tuple[dict, dict[str, np.ndarray]]:
    """The scene and its arrays by attribute name."""
    raw = path.read_bytes()
    magic, version, length, json_length, json_kind = np.frombuffer(raw, "<u4", 5)
    assert (magic, version, length, json_kind) == (0x46546C67, 2, len(raw), 0x4E4F534A)
    assert json_length % 4 == 0
    scene = json.loads(raw[20 : 20 + json_length])
    data_length, data_kind = np.frombuffer(raw, "<u4", 2, offset=20 + json_length)
    assert (data_kind, len(raw)) == (0x004E4942, 28 + json_length + data_length)
    data = raw[28 + json_length :]
    primitive = scene["meshes"][0]["primitives"][0]
    arrays = {}
    for name, number in {**primitive["attributes"], "indices": primitive["indices"]}.items():
        accessor = scene["accessors"][number]
        view = scene["bufferViews"][accessor["bufferView"]]
        kind, width = np.dtype(TYPES[accessor["componentType"]]), WIDTHS[accessor["type"]]
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        assert start % 4 == 0
        values = np.frombuffer(data, kind, accessor["count"] * width, offset=start)
        arrays[name] = values.reshape(-1, width) if width > 1 else values
    return scene, arrays


def placed_by(scene: dict) -> np.ndarray:
    """The matrix (4, 4) of the one node that has a mesh."""
    (node,) = (node for node in scene["nodes"] if "mesh" in node)
    return np.reshape(node["matrix"], (4, 4)).T if "matrix" in node else np.eye(4)


def test_trimesh_reads_a_closed_body_that_stands_upright(tmp_path, tagged_mesh):
    write_glb(tmp_path / "house.glb", tagged_mesh)
    read = trimesh.load_scene(tmp_path / "house.glb").to_geometry()
    assert read.is_watertight
    assert read.volume == pytest.approx(signed_volumes(tagged_mesh.points_m, tagged_mesh.tets).sum(), rel=1e-5)
    surface = surface_of(tagged_mesh.points_m, tagged_mesh.facets)
    x, y, z = surface.points_m.T
    assert read.bounds == pytest.approx(
        np.array([[x.min(), z.min(), -y.max()], [x.max(), z.max(), -y.min()]]), abs=1e-5
    )


def test_arrays_are_the_surface_with_its_temperatures(tmp_path, tagged_mesh):
    write_glb(tmp_path / "house.glb", tagged_mesh)
    scene, arrays = read_glb(tmp_path / "house.glb")
    surface = surface_of(tagged_mesh.points_m, tagged_mesh.facets)
    assert np.array_equal(arrays["POSITION"], surface.points_m.astype("<f4"))
    assert np.array_equal(arrays["indices"].reshape(-1, 3), surface.triangles)
    temperature = tagged_mesh.temperature_c[surface.nodes]
    assert np.array_equal(arrays["_TEMPERATURE_C"], temperature.astype("<f4"))
    position = scene["accessors"][scene["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
    assert position["min"] == arrays["POSITION"].min(axis=0).tolist()
    assert position["max"] == arrays["POSITION"].max(axis=0).tolist()
    extras = scene["meshes"][0]["extras"]
    assert extras == {"colours": "temperature", "lowest_c": temperature.min(), "highest_c": temperature.max()}


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0), (0, -1, 0), (1, 0, 0), (0.3, -0.9, 0.4), (0, -3, 1e-3)])
def test_any_direction_can_be_up(tmp_path, tagged_mesh, up):
    write_glb(tmp_path / "house.glb", tagged_mesh, up=up)
    scene, _ = read_glb(tmp_path / "house.glb")
    turn = placed_by(scene)[:3, :3]
    assert np.linalg.det(turn) == pytest.approx(1.0)
    assert turn.T @ turn == pytest.approx(np.eye(3), abs=1e-12)
    assert turn @ np.array(up) / np.linalg.norm(up) == pytest.approx(np.array([0.0, 1.0, 0.0]), abs=1e-6)


@pytest.mark.parametrize("up", [(0, 0, 1), (0.3, -0.9, 0.4)])
def test_far_from_the_origin_the_shape_stays_whole(tmp_path, tagged_mesh, up):
    """In national coordinates single precision has steps of half a metre; a translation holds what is beyond it."""
    shift = np.array([450_000.3, 5_200_000.4, 300.0])
    moved = replace(tagged_mesh, points_m=tagged_mesh.points_m + shift)
    write_glb(tmp_path / "far.glb", moved, up=up)
    write_glb(tmp_path / "near.glb", tagged_mesh, up=up)
    scene, arrays = read_glb(tmp_path / "far.glb")
    turn = placed_by(scene)[:3, :3]
    placed = arrays["POSITION"].astype(np.float64) @ turn.T + placed_by(scene)[:3, 3]
    surface = surface_of(moved.points_m, moved.facets)
    assert placed == pytest.approx(surface.points_m @ turn.T, rel=0, abs=1e-6)
    assert not placed_by(read_glb(tmp_path / "near.glb")[0])[:3, 3].any()


@pytest.mark.parametrize("up", [(0.0, 0.0, 0.0), (0.0, float("nan"), 1.0), (0.0, 1.0)])
def test_no_direction_is_refused(tmp_path, tagged_mesh, up):
    with pytest.raises(MeshError, match="up: expected three finite numbers"):
        write_glb(tmp_path / "house.glb", tagged_mesh, up=up)
    assert not list(tmp_path.iterdir())
