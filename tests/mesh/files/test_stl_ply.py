from dataclasses import replace

import meshio
import numpy as np
import pytest
import trimesh

from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.files.content import surface_of
from thermoxels_ns.mesh.files.formats import write_mesh
from thermoxels_ns.mesh.files.surface import check_stl, write_ply, write_stl
from thermoxels_ns.mesh.quality.checks import facet_normals
from thermoxels_ns.mesh.quality.tet_shapes import signed_volumes


def colours(read: meshio.Mesh) -> np.ndarray:
    """Red, green, blue from 0 to 255; meshio reads bytes with a sign."""
    return np.stack([read.point_data[name].view(np.uint8) for name in ("red", "green", "blue")], axis=1).astype(float)


def test_stl_is_the_closed_surface(tmp_path, tagged_mesh):
    write_stl(tmp_path / "house.stl", tagged_mesh)
    read = trimesh.load_mesh(tmp_path / "house.stl")
    assert read.is_watertight
    assert read.volume == pytest.approx(signed_volumes(tagged_mesh.points_m, tagged_mesh.tets).sum(), rel=1e-5)
    assert read.triangles == pytest.approx(tagged_mesh.points_m[tagged_mesh.facets], abs=1e-6)
    # Behind the header, each triangle starts with its normal.
    raw = np.frombuffer((tmp_path / "house.stl").read_bytes(), dtype=np.uint8)[84:].reshape(-1, 50)
    normals = raw[:, :12].copy().view("<f4")
    assert normals == pytest.approx(facet_normals(tagged_mesh.points_m, tagged_mesh.facets), abs=1e-6)


def test_stl_far_from_the_origin_is_refused_and_ply_holds_it(tmp_path, tagged_mesh):
    """At five million metres single precision has steps of half a metre, wider than the triangles."""
    far = replace(tagged_mesh, points_m=tagged_mesh.points_m + np.array([450_000.3, 5_200_000.4, 300.0]))
    with pytest.raises(MeshError, match=r"\.stl: expected coordinates near the origin.*5\.2e\+06.*Write \.ply"):
        write_mesh(tmp_path / "far.stl", far)
    with pytest.raises(MeshError, match="near the origin"):
        check_stl(far)
    check_stl(tagged_mesh)
    assert not list(tmp_path.iterdir())
    write_ply(tmp_path / "far.ply", far)
    assert np.array_equal(meshio.read(tmp_path / "far.ply").points, surface_of(far.points_m, far.facets).points_m)


def test_ply_holds_colours_of_the_photographs_and_temperatures(tmp_path, tagged_mesh):
    write_ply(tmp_path / "house.ply", tagged_mesh)
    read = meshio.read(tmp_path / "house.ply")
    surface = surface_of(tagged_mesh.points_m, tagged_mesh.facets)
    assert np.array_equal(read.points, surface.points_m)
    assert np.array_equal(surface.nodes[read.cells_dict["triangle"]], tagged_mesh.facets)
    assert read.point_data["temperature_c"] == pytest.approx(tagged_mesh.temperature_c[surface.nodes], rel=1e-6)
    assert np.array_equal(read.point_data["observed"], tagged_mesh.observed[surface.nodes])
    rgb = colours(read)
    assert np.abs(rgb / 255.0 - tagged_mesh.colour[surface.nodes]).max() <= 0.5 / 255.0 + 1e-6
    assert b"comment colours: photographs\n" in (tmp_path / "house.ply").read_bytes()


def test_ply_without_photographs_is_coloured_by_temperature(tmp_path, box_mesh):
    write_ply(tmp_path / "box.ply", box_mesh)
    read = meshio.read(tmp_path / "box.ply")
    rgb = colours(read)
    # Inferno grows brighter from cold to hot throughout.
    brightness = rgb @ [0.2126, 0.7152, 0.0722]
    order = np.argsort(read.point_data["temperature_c"])
    assert np.all(np.diff(brightness[order]) > -1.0)
    assert brightness[order[-1]] > 4.0 * brightness[order[0]]
    comment = f"inferno from {box_mesh.temperature_c.min():.6g} to {box_mesh.temperature_c.max():.6g} degrees Celsius"
    assert comment.encode() in (tmp_path / "box.ply").read_bytes()
