from dataclasses import replace

import numpy as np
import pytest

from tests.support.demo_mesh import angled_house, demo_mesh, gable_house, house_corner
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.boundary.patches import load_patch_rules, with_patches, write_patch_rules
from thermoxels_ns.mesh.boundary.planes import find_building, proposed_rules
from thermoxels_ns.mesh.tetrahedra import facet_area_vectors

UP, NORTH = (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)
SLOPE = np.tan(np.radians(40.0))
GABLE = {
    **dict.fromkeys(("wall-north-east", "wall-south-west"), 6.0 * 3.0 + 9.0 * SLOPE),
    **dict.fromkeys(("wall-north-west", "wall-south-east"), 8.0 * 3.0),
    **dict.fromkeys(("roof-north-west", "roof-south-east"), 8.0 * 3.0 * np.hypot(1.0, SLOPE)),
    "floor": 8.0 * 6.0,
}
ANGLED = {
    **{"wall-south": 60.0, "wall-east": 30.0 + 4.5 * 3.5, "wall-west": 30.0, "wall-west-2": 4.5 * 3.5},
    **{"wall-north": 60.0 - 4.0 * 3.5, "wall-north-2": 4.0 * 3.5, "roof": 50.0, "roof-2": 18.0, "floor": 68.0},
}
CORNER = {"wall-north": 30.0, "wall-south": 30.0, "wall-east": 25.0, "wall-west": 25.0, "roof": 30.0, "floor": 30.0}
OPENINGS = {"wall-north": 0, "wall-south": 4, "wall-east": 4, "wall-west": 0}
AZIMUTH = {"north": 0.0, "north-east": 60.0, "east": 90.0, "south-east": 150.0, "south": 180.0, "south-west": 240.0}
AZIMUTH |= {"west": 270.0, "north-west": 330.0}


@pytest.mark.parametrize(
    ("mesh", "true", "tilt", "volume"),
    [(gable_house, GABLE, 40.0, 144.0 + 72.0 * SLOPE), (angled_house, ANGLED, 0.0, 363.0)],
)
def test_elements_have_the_true_areas_and_directions_and_close(mesh, true, tilt, volume) -> None:
    building = find_building(mesh(), UP, NORTH)
    assert {one.name: one.net_area_m2 for one in building.elements} == pytest.approx(true, rel=0.03)
    for one in building.elements:
        assert one.tilt_deg == pytest.approx({"roof": tilt, "floor": 180.0, "wall": 90.0}[one.kind], abs=2.0)
        towards = AZIMUTH.get(one.name.partition("-")[2].removesuffix("-2"), 0.0)
        assert abs((one.azimuth_deg - towards + 180.0) % 360.0 - 180.0) < 2.0
    assert building.volume_m3 == pytest.approx(volume, rel=0.03)
    # By the divergence theorem, the faces enclose this volume only if no gap is between them.
    enclosed = sum(one.outline_m[0] @ one.normal * one.flat().area for one in building.elements) / 3.0
    assert enclosed == pytest.approx(building.volume_m3, rel=1e-6)


def test_the_demo_house_has_its_walls_windows_and_door() -> None:
    corner = find_building(house_corner(), UP, NORTH)
    shown = {one.name: one for one in corner.elements if one.behind != "cover"}
    assert {name: one.flat().area for name, one in shown.items()} == pytest.approx(CORNER, rel=0.03)
    assert {name: len(shown[name].openings) for name in OPENINGS} == OPENINGS
    assert [one.kind for one in shown["wall-east"].openings].count("door") == 1
    found = sorted(one.net_area_m2 for wall in shown.values() for one in wall.openings)
    assert found == pytest.approx([0.99, 1.08, 1.32, 1.43, 1.54, 1.87, 2.16, 2.31], rel=0.12)
    assert all(one.flat().within(wall.flat().buffer(1e-6)) for wall in shown.values() for one in wall.openings)
    assert 0.0 < corner.left_out < 0.05  # overhang and balcony


def test_without_colours_recesses_of_another_temperature_are_found_and_bands_are_not() -> None:
    plain = find_building(replace(house_corner(), colour=None), UP, NORTH)
    found = {one.name: len(one.openings) for one in plain.elements if one.name in OPENINGS}
    assert found["wall-north"] == found["wall-west"] == 0 and min(found["wall-south"], found["wall-east"]) >= 3


@pytest.mark.parametrize("mesh", [gable_house, house_corner])
def test_the_proposed_rules_give_the_elements_back(mesh, tmp_path) -> None:
    tagged, building = mesh(), find_building(mesh(), UP, NORTH)
    write_patch_rules(tmp_path / "patches.yaml", proposed_rules(building), "proposed")
    tagged, idle = with_patches(tagged, load_patch_rules(tmp_path / "patches.yaml"), UP)
    assert idle == ()
    vectors = facet_area_vectors(tagged.points_m, tagged.facets)
    for one in (one for one in building.every() if len(one.facets)):
        mine = tagged.boundary.patch == tagged.boundary.patch_names.index(one.name)
        assert vectors[mine].sum(axis=0) @ one.normal == pytest.approx(
            vectors[one.facets].sum(axis=0) @ one.normal, rel=0.1
        )


@pytest.mark.parametrize(
    ("scene", "north", "name"),
    [
        ("sphere", NORTH, "mesh"),
        ("house-corner", (0.0, 0.0, -2.0), "north"),
        ("house-corner", (0.0, 0.0, 0.0), "north"),
    ],
)
def test_what_has_no_flat_walls_or_no_north_is_refused(scene, north, name) -> None:
    with pytest.raises(MeshError) as refused:
        find_building(demo_mesh(scene, 24), UP, north)
    assert str(refused.value).startswith(name)
