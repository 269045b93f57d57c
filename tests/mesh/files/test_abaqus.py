"""Input files of CalculiX and Abaqus; CalculiX runs them in tests/external."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.files.solvers import HeatStep, write_inp
from thermoxels_ns.mesh.quality.checks import facet_areas

STEP = HeatStep(1.7, 2200.0, 880.0, steps=10, step_seconds=60.0)
# Nodes of the faces S1 to S4 of a linear tetrahedron, as the manuals of Abaqus and CalculiX list them.
FACE_NODES = {1: (1, 2, 3), 2: (1, 4, 2), 3: (2, 4, 3), 4: (3, 4, 1)}


def sections(path: Path) -> dict[str, list[list[str]]]:
    """Fields of the data lines under each keyword line."""
    found: dict[str, list[list[str]]] = {}
    lines: list[list[str]] = []
    for line in path.read_text(encoding="ascii").splitlines():
        if line.startswith("*"):
            lines = found.setdefault(line, [])
        else:
            lines.append([field.strip() for field in line.split(",")])
    return found


def numbers(lines: list[list[str]]) -> list[int]:
    return [int(field) for line in lines for field in line]


@pytest.fixture
def written(tmp_path, tagged_mesh) -> dict[str, list[list[str]]]:
    write_inp(tmp_path / "house.inp", tagged_mesh, STEP)
    return sections(tmp_path / "house.inp")


def test_nodes_and_elements_keep_their_numbers(written, tagged_mesh):
    nodes = np.array(written["*NODE, NSET=NALL"], dtype=float)
    assert np.array_equal(nodes[:, 0], np.arange(1, len(tagged_mesh.points_m) + 1))
    assert np.abs(nodes[:, 1:] - tagged_mesh.points_m).max() < 1e-11
    for number, name in enumerate(("WALLS", "FLOOR_SLAB")):
        rows = np.array(written[f"*ELEMENT, TYPE=DC3D4, ELSET=REGION-{name}"], dtype=int)
        assert np.array_equal(rows[:, 0] - 1, np.flatnonzero(tagged_mesh.region == number))
        assert np.array_equal(rows[:, 1:] - 1, tagged_mesh.tets[rows[:, 0] - 1])
    assert written["*ELSET, ELSET=EALL"] == [["REGION-WALLS"], ["REGION-FLOOR_SLAB"]]


def test_surfaces_are_the_faces_with_the_nodes_of_the_patch(written, tagged_mesh):
    surfaces = [lines for keyword, lines in written.items() if keyword.startswith("*SURFACE")]
    assert {face for lines in surfaces for _, face in lines} == {"S1", "S2", "S3", "S4"}
    for number, name in enumerate(("UP", "DOWN", "INSIDE", "FA_ADE_1")):
        facets = tagged_mesh.facets[tagged_mesh.boundary.patch == number]
        faces = [
            [tagged_mesh.tets[int(element) - 1][node - 1] for node in FACE_NODES[int(face.removeprefix("S"))]]
            for element, face in written[f"*SURFACE, NAME=PATCH-{name}, TYPE=ELEMENT"]
        ]
        assert np.array_equal(np.sort(faces, axis=1), np.sort(facets, axis=1))
        assert numbers(written[f"*NSET, NSET=PATCH-{name}"]) == (np.unique(facets) + 1).tolist()
    assert numbers(written["*NSET, NSET=OBSERVED"]) == (np.flatnonzero(tagged_mesh.observed) + 1).tolist()


def test_empty_parts_are_left_out(written):
    """An empty set stops a solver."""
    text = "\n".join(written)
    assert "ROOF" not in text
    assert "CUT_BY_THE_BOX" not in text
    for keyword, lines in written.items():
        if keyword.split(",")[0] in ("*NSET", "*ELSET", "*SURFACE", "*ELEMENT"):
            assert lines, keyword


def test_materials_temperatures_and_times(written, tagged_mesh):
    assert "*PHYSICAL CONSTANTS, ABSOLUTE ZERO=-273.15, STEFAN BOLTZMANN=5.670374419E-08" in written
    for keyword, value in (("*DENSITY", 2200.0), ("*CONDUCTIVITY", 1.7), ("*SPECIFIC HEAT", 880.0)):
        assert [float(line[0]) for line in written[keyword]] == [value, value], "one per region"
    for name in ("WALLS", "FLOOR_SLAB"):
        assert f"*MATERIAL, NAME=MATERIAL-{name}" in written
        assert f"*SOLID SECTION, ELSET=REGION-{name}, MATERIAL=MATERIAL-{name}" in written
    start = np.array(written["*INITIAL CONDITIONS, TYPE=TEMPERATURE"], dtype=float)
    assert np.array_equal(start[:, 0], np.arange(1, len(start) + 1))
    assert np.abs(start[:, 1] - tagged_mesh.temperature_c).max() < 1e-10
    assert "*STEP, INC=10" in written
    assert [float(field) for field in written["*HEAT TRANSFER"][0]] == [60.0, 600.0, 60.0, 60.0]
    assert written["*NODE PRINT, NSET=NALL"] == written["*NODE FILE"] == [["NT"]]
    assert list(written)[-1] == "*END STEP"


@pytest.mark.parametrize("names", [("wall a", "wall-a", "roof"), ("a", "A", "b"), ("a", "b", "c" * 61)])
def test_names_that_become_one_are_refused(tmp_path, tagged_mesh, names):
    with pytest.raises(MeshError, match="region_names: expected names that differ"):
        write_inp(tmp_path / "house.inp", dataclasses.replace(tagged_mesh, region_names=names), STEP)
    assert not list(tmp_path.iterdir())


def test_surfaces_say_how_large_they_truly_are(written, tagged_mesh):
    areas = facet_areas(tagged_mesh.points_m, tagged_mesh.facets)
    for number, name in enumerate(("UP", "DOWN", "INSIDE", "FA_ADE_1")):
        patch = tagged_mesh.boundary.patch == number
        true = areas[patch] @ tagged_mesh.boundary.area_factor[patch]
        said = [line for line in written if line.startswith("**") and f"PATCH-{name}" in line]
        numbers_said = [float(word) for line in said for word in line.split() if word.replace(".", "").isdigit()]
        assert numbers_said == pytest.approx([true, areas[patch].sum(), true / areas[patch].sum()], rel=1e-8)
