import meshio
import numpy as np
import pytest

from tests.support.docs_code import code_in
from thermoxels_ns.mesh.files.formats import write_msh

pytestmark = pytest.mark.external


def groups(file: meshio.Mesh) -> dict[tuple[str, int], int]:
    """Number of elements by name and dimension of their physical group."""
    numbers = {(number, dimension): name for name, (number, dimension) in file.field_data.items()}
    found: dict[tuple[str, int], int] = {}
    for block, tags in zip(file.cells, file.cell_data["gmsh:physical"]):
        for tag, count in zip(*np.unique(tags, return_counts=True)):
            key = (numbers[tag, block.dim], block.dim)
            found[key] = found.get(key, 0) + int(count)
    return found


def test_gmsh_finds_no_fault(tmp_path, solid_mesh, program, run_in):
    write_msh(tmp_path / "house.msh", solid_mesh)
    said = run_in(tmp_path, [program("gmsh", "gmsh"), "-check", "house.msh"])
    assert f"{len(solid_mesh.points_m)} nodes" in said
    assert f"{len(solid_mesh.tets) + len(solid_mesh.facets)} elements" in said
    assert "Done checking mesh coherence" in said
    assert "Error" not in said and "Warning" not in said, said


def test_the_script_of_the_docs_runs(tmp_path, solid_mesh, program, run_in):
    write_msh(tmp_path / "mesh.msh", solid_mesh)
    (tmp_path / "look.geo").write_text(code_in("export.md", "geo")[0])
    said = run_in(tmp_path, [program("gmsh", "gmsh"), "-parse_and_exit", "look.geo"])
    used = np.unique(solid_mesh.boundary.patch) + 1
    counts = f"{len(solid_mesh.points_m)} nodes, {len(solid_mesh.tets)} tetrahedra"
    assert f"{counts}, patches {used[0]} to {used[-1]}" in said and "rror" not in said, said


def test_gmsh_keeps_the_physical_groups_when_it_saves_what_it_read(tmp_path, solid_mesh, program, run_in):
    write_msh(tmp_path / "house.msh", solid_mesh)
    text = ["-format", "msh41", "-setnumber", "Mesh.Binary", "0"]
    run_in(tmp_path, [program("gmsh", "gmsh"), "house.msh", "-save", *text, "-o", "again.msh"])
    again = meshio.read(tmp_path / "again.msh")
    boundary = solid_mesh.boundary
    expected = {
        (name, 2): int(np.count_nonzero(boundary.patch == number)) for number, name in enumerate(boundary.patch_names)
    } | {
        (name, 3): int(np.count_nonzero(solid_mesh.region == number))
        for number, name in enumerate(solid_mesh.region_names)
    }
    assert groups(again) == {key: count for key, count in expected.items() if count}
    tets = np.concatenate([block.data for block in again.cells if block.dim == 3])
    order = np.argsort(solid_mesh.region, kind="stable")
    ours = solid_mesh.points_m[solid_mesh.tets[order]]
    assert np.abs(again.points[tets] - ours).max() < 1e-14


def test_gmsh_shows_the_temperatures(tmp_path, solid_mesh, program, run_in):
    write_msh(tmp_path / "house.msh", solid_mesh)
    # The extremes become views of their own, behind those of the file.
    (tmp_path / "show.geo").write_text(
        'Merge "house.msh";\nlast = PostProcessing.NbViews;\nPlugin(MinMax).View = 0;\nPlugin(MinMax).Run;\n'
        'Save View[0] "view.pos";\nSave View[last] "min.txt";\nSave View[last + 1] "max.txt";\n'
    )
    run_in(tmp_path, [program("gmsh", "gmsh"), "-parse_and_exit", "show.geo"])
    assert (tmp_path / "view.pos").read_text().startswith('View "temperature_c"')
    extremes = [float((tmp_path / f"{name}.txt").read_text().split()[-1]) for name in ("min", "max")]
    assert extremes == pytest.approx([solid_mesh.temperature_c.min(), solid_mesh.temperature_c.max()], abs=1e-6)
