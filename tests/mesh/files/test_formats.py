import dataclasses
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.files.formats import MESH_FORMATS, mesh_file_paths, write_glb, write_mesh
from thermoxels_ns.mesh.quality.tet_shapes import signed_volumes
from thermoxels_ns.mesh.tetrahedra import nodes_and_triangles

SUFFIXES = sorted(MESH_FORMATS)


def changed(array: np.ndarray, value: float) -> np.ndarray:
    copy = array.copy()
    copy.flat[0] = value
    return copy


@pytest.mark.parametrize(
    ("field", "change"),
    [
        ("points_m", lambda a: changed(a, np.nan)),
        ("tets", lambda a: changed(a, len(a) * 9)),
        ("tets", lambda a: a.astype(float)),
        ("tets", lambda a: a[:0]),
        ("facet_tags", lambda a: a[1:]),
        ("temperature_c", lambda a: a[1:]),
        ("region", lambda a: changed(a, 3)),
        ("region_names", lambda a: ("a", "b", "a")),
        ("region_names", lambda a: ("a", "b", 'say "c"')),
        ("colour", lambda a: a[:, :2]),
    ],
)
def test_a_damaged_mesh_is_refused(tagged_mesh, field, change):
    damaged = dataclasses.replace(tagged_mesh, **{field: change(getattr(tagged_mesh, field))})
    with pytest.raises(MeshError, match=f"^mesh {field}: expected"):
        damaged.check()


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_every_format_writes_the_files_that_it_names_and_the_same_bytes_again(tmp_path, tagged_mesh, suffix):
    path, again = (tmp_path / folder / f"house{suffix}" for folder in ("new folder", "another"))
    for file in (path, again):
        write_mesh(file, tagged_mesh)
    assert {path, *mesh_file_paths(path)} == set(path.parent.iterdir())
    assert all(file.stat().st_size for file in mesh_file_paths(path))
    for first, second in zip(mesh_file_paths(path), mesh_file_paths(again)):
        assert first.read_bytes() == second.read_bytes()


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_mesh_that_is_refused_leaves_the_old_files(tmp_path, tagged_mesh, suffix):
    path = tmp_path / f"house{suffix}"
    for file in mesh_file_paths(path):
        file.write_text("old")
    damaged = dataclasses.replace(tagged_mesh, points_m=changed(tagged_mesh.points_m, np.nan))
    with pytest.raises(MeshError, match="points_m"):
        write_mesh(path, damaged)
    assert {file.read_text() for file in tmp_path.iterdir()} == {"old"}
    assert set(tmp_path.iterdir()) == set(mesh_file_paths(path))


def read_glb(path: Path) -> tuple[trimesh.Trimesh, np.ndarray]:
    """Return the surface as it is stored, and the matrix (4, 4) that places it."""
    scene = trimesh.load_scene(path)
    (stored,) = scene.geometry.values()
    return stored, scene.graph.get("surface")[0]


def test_trimesh_reads_a_closed_body_that_stands_upright_with_its_temperatures(tmp_path, tagged_mesh):
    write_glb(tmp_path / "house.glb", tagged_mesh)
    stored, matrix = read_glb(tmp_path / "house.glb")
    nodes, triangles = nodes_and_triangles(tagged_mesh.facets)
    assert np.array_equal(stored.vertices, tagged_mesh.points_m[nodes].astype("<f4"))
    assert np.array_equal(stored.faces, triangles)
    temperature = tagged_mesh.temperature_c[nodes]
    assert np.array_equal(stored.vertex_attributes["_TEMPERATURE_C"].ravel(), temperature.astype("<f4"))
    extras = {"colours": "temperature", "lowest_c": temperature.min(), "highest_c": temperature.max()}
    assert extras.items() <= stored.metadata.items()
    placed = stored.copy().apply_transform(matrix)
    assert placed.is_watertight
    assert placed.volume == pytest.approx(signed_volumes(tagged_mesh.points_m, tagged_mesh.tets).sum(), rel=1e-5)
    x, y, z = tagged_mesh.points_m[nodes].T
    assert placed.vertices == pytest.approx(np.column_stack([x, z, -y]), abs=1e-5)


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0), (0, -1, 0), (1, 0, 0), (0.3, -0.9, 0.4), (0, -3, 1e-3)])
def test_any_direction_can_be_up(tmp_path, tagged_mesh, up):
    write_glb(tmp_path / "house.glb", tagged_mesh, up=up)
    turn = read_glb(tmp_path / "house.glb")[1][:3, :3]
    assert np.linalg.det(turn) == pytest.approx(1.0)
    assert turn.T @ turn == pytest.approx(np.eye(3), abs=1e-12)
    assert turn @ np.array(up) / np.linalg.norm(up) == pytest.approx(np.array([0.0, 1.0, 0.0]), abs=1e-6)


def test_far_from_the_origin_the_shape_stays_whole(tmp_path, tagged_mesh):
    """In national coordinates single precision has steps of half a metre; a translation holds what is beyond it."""
    up, shift = (0.3, -0.9, 0.4), np.array([450_000.3, 5_200_000.4, 300.0])
    write_glb(tmp_path / "far.glb", replace(tagged_mesh, points_m=tagged_mesh.points_m + shift), up=up)
    write_glb(tmp_path / "near.glb", tagged_mesh, up=up)
    (far, matrix), (near, turn) = (read_glb(tmp_path / name) for name in ("far.glb", "near.glb"))
    assert not turn[:3, 3].any()
    expected = trimesh.transform_points(near.vertices + shift, turn)
    assert trimesh.transform_points(far.vertices, matrix) == pytest.approx(expected, rel=0, abs=2e-6)


@pytest.mark.parametrize("up", [(0.0, 0.0, 0.0), (0.0, float("nan"), 1.0), (0.0, 1.0)])
def test_no_direction_is_refused(tmp_path, tagged_mesh, up):
    with pytest.raises(MeshError, match=r"^up: expected"):
        write_glb(tmp_path / "house.glb", tagged_mesh, up=up)
    assert not list(tmp_path.iterdir())
