import dataclasses
from pathlib import Path

import numpy as np
import pytest

from thermoxels_ns.core.errors import MeshError, OutputError
from thermoxels_ns.mesh.files.content import checked_mesh
from thermoxels_ns.mesh.files.formats import MESH_FORMATS, mesh_file_paths, write_mesh
from thermoxels_ns.mesh.files.solvers import HeatStep

STEP = HeatStep(1.7, 2200.0, 880.0, steps=10, step_seconds=60.0)
SUFFIXES = sorted(MESH_FORMATS)


def changed(array: np.ndarray, value: float) -> np.ndarray:
    copy = array.copy()
    copy.flat[0] = value
    return copy


@pytest.mark.parametrize(
    ("field", "change", "message"),
    [
        ("points_m", lambda a: changed(a, np.nan), "points_m: expected finite"),
        ("tets", lambda a: changed(a, len(a) * 9), "tets: expected whole numbers from 0"),
        ("tets", lambda a: a.astype(float), "tets: expected whole numbers"),
        ("tets", lambda a: a[:0], "tets: expected at least one"),
        ("facet_tags", lambda a: a[1:], "facet_tags: expected shape"),
        ("temperature_c", lambda a: a[1:], "temperature_c: expected shape"),
        ("region", lambda a: changed(a, 3), "region: expected whole numbers from 0 to 2"),
        ("region_names", lambda a: ("a", "b", "a"), "region_names: expected at least one name, all different"),
        ("region_names", lambda a: ("a", "b", 'say "c"'), "region_names: expected at least one name"),
        ("colour", lambda a: a[:, :2], "colour: expected shape"),
    ],
)
def test_a_damaged_mesh_is_refused(tagged_mesh, field, change, message):
    damaged = dataclasses.replace(tagged_mesh, **{field: change(getattr(tagged_mesh, field))})
    with pytest.raises(MeshError, match=message):
        checked_mesh(damaged)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_every_format_writes_the_files_that_it_names_and_the_same_bytes_again(tmp_path, tagged_mesh, suffix):
    path, again = (tmp_path / folder / f"house{suffix}" for folder in ("new folder", "another"))
    assert write_mesh(path, tagged_mesh, heat_step=STEP) == mesh_file_paths(path)
    assert {path, *mesh_file_paths(path)} == set(path.parent.iterdir())
    assert all(file.stat().st_size for file in mesh_file_paths(path))
    for first, second in zip(mesh_file_paths(path), write_mesh(again, tagged_mesh, heat_step=STEP)):
        assert first.read_bytes() == second.read_bytes()


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_every_format_writes_a_mesh_without_tags_and_colours(tmp_path, box_mesh, suffix):
    path = tmp_path / f"box{suffix}"
    assert write_mesh(path, box_mesh, heat_step=STEP)[0] == path and path.is_file()


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_mesh_that_is_refused_leaves_the_old_files(tmp_path, tagged_mesh, suffix):
    path = tmp_path / f"house{suffix}"
    for file in mesh_file_paths(path):
        file.write_text("old")
    damaged = dataclasses.replace(tagged_mesh, points_m=changed(tagged_mesh.points_m, np.nan))
    with pytest.raises(MeshError, match="points_m"):
        write_mesh(path, damaged, heat_step=STEP)
    assert {file.read_text() for file in tmp_path.iterdir()} == {"old"}
    assert set(tmp_path.iterdir()) == set(mesh_file_paths(path))


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_place_that_cannot_be_written_is_named(tmp_path, tagged_mesh, suffix):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="output folder"):
        write_mesh(tmp_path / "file" / f"house{suffix}", tagged_mesh, heat_step=STEP)
    (tmp_path / f"house{suffix}").mkdir()
    with pytest.raises(OutputError, match=f"house{suffix}"):
        write_mesh(tmp_path / f"house{suffix}", tagged_mesh, heat_step=STEP)
    assert not [path for path in tmp_path.iterdir() if ".part" in path.name]


def test_formats_are_found_by_their_ending():
    assert set(MESH_FORMATS) == {".vtu", ".xdmf", ".msh", ".inp", ".stl", ".ply", ".glb"}
    assert mesh_file_paths("a.b.msh") == [Path("a.b.msh")]
    with pytest.raises(OutputError, match=r"one of \.vtu, .*got house\.obj"):
        mesh_file_paths("house.obj")


def test_an_input_file_needs_material_and_times(tmp_path, tagged_mesh):
    with pytest.raises(MeshError, match="heat_step: expected material and times"):
        write_mesh(tmp_path / "house.inp", tagged_mesh)
    assert not list(tmp_path.iterdir())
