import json
from dataclasses import replace
from importlib.metadata import distribution
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from lxml import etree

from tests.support.demo_mesh import house_corner
from thermoxels_ns.audit.conditions import Limits, load_conditions
from thermoxels_ns.audit.envelope import Envelope, envelope_of, hbjson
from thermoxels_ns.audit.run import audit
from thermoxels_ns.core.yaml_records import configs_folder
from thermoxels_ns.mesh.boundary.patches import with_patches
from thermoxels_ns.mesh.boundary.planes import find_building, proposed_rules
from thermoxels_ns.reports.audit_page import gbxml

SCHEMA = json.loads((Path(__file__).parent / "honeybee-model-2.3.0.json").read_text())
GBXML = distribution("xgbxml").locate_file("xgbxml/schemas/GreenBuildingXML_Ver6.01.xsd")
NAMESPACE = "{http://www.gbxml.org/schema}"
POSITIVE = [f"{NAMESPACE}{tag}" for tag in ("Area", "Volume", "Height", "Width", "U-value")]


@pytest.fixture(scope="module")
def envelope() -> Envelope:
    """The demo's house; its western wall is left out of the audit."""
    up, north, mesh = (0.0, 0.0, 1.0), (0.0, 1.0, 0.0), house_corner()
    building = find_building(mesh, up, north)
    mesh, _ = with_patches(mesh, proposed_rules(building), up)
    stated = load_conditions(configs_folder() / "house-corner-conditions.yaml")
    stated = replace(stated, leave_out=("exterior-*", "wall-west"), limits=Limits())
    return envelope_of(audit(mesh, stated, up), building)


def test_elements_have_the_true_u_values_in_their_intervals(envelope) -> None:
    truth = {"wall": (2.0, 2.4), "window": (4.8, 5.8), "door": (3.6, 3.6)}  # the wall has a band of 3.2 in its middle
    measured = [one for one in envelope.building.every() if one.behind == "air" and one.kind in truth]
    for one in (one for one in measured if one.name != "wall-west"):
        u = envelope.u[one.name]
        assert u is not None and u.low < truth[one.kind][1] and u.high > truth[one.kind][0], one.name
        assert envelope.share[one.name] > 0.9
    assert envelope.u["wall-west"] is None and envelope.u["floor"] is None


def test_the_hbjson_is_valid_and_says_the_same(envelope) -> None:
    model = json.loads(json.dumps(hbjson(envelope, "A house")))
    jsonschema.validate(model, SCHEMA)
    (room,), energy = model["rooms"], model["properties"]["energy"]
    faces = {face["identifier"]: face for face in room["faces"]}
    layers = {one["identifier"]: one for one in energy["materials"]}
    u = envelope.u["wall-south"]
    assert u is not None and layers["wall-south-layer"]["r_value"] == pytest.approx(1.0 / u.value - 0.17)
    assert faces["wall-south"]["user_data"]["u_w_m2k"] == {"value": u.value, "low": u.low, "high": u.high}
    assert {one["boundary_condition"]["type"] for one in faces.values()} == {"Outdoors", "Ground", "Adiabatic"}
    assert len(faces["wall-south"]["apertures"]) == 4 and len(faces["wall-east"]["doors"]) == 1
    assert "construction" not in faces["wall-west"]["properties"]["energy"]
    used = {one["properties"]["energy"].get("construction") for one in faces.values()}
    assert used - {None} <= {one["identifier"] for one in energy["constructions"]}
    for face in faces.values():  # openings lie in the planes of their faces
        outline = np.array(face["geometry"]["boundary"])
        normal = np.cross(outline[1] - outline[0], outline[2] - outline[1])
        for hole in (*face["apertures"], *face["doors"]):
            apart = np.array(hole["geometry"]["boundary"]) - outline[0]
            assert np.abs(apart @ normal).max() < 1e-3 * np.linalg.norm(normal)


def test_the_gbxml_is_valid_and_says_the_same(envelope) -> None:
    root = etree.fromstring(gbxml(envelope, "A <house> & garden").encode())
    etree.XMLSchema(etree.parse(str(GBXML))).assertValid(root)
    assert root.get("version") == "6.01" and all(float(one.text) > 0.0 for one in root.iter(*POSITIVE))
    assert len([*root.iter(f"{NAMESPACE}Opening")]) == 8
    walls = {one.get("id"): one for one in root.iter(f"{NAMESPACE}Surface")}
    azimuth, tilt = (walls["wall-east"].find(f".//{NAMESPACE}{tag}") for tag in ("Azimuth", "Tilt"))
    assert azimuth is not None and float(azimuth.text or "") == pytest.approx(90.0, abs=2.0)
    assert tilt is not None and float(tilt.text or "") == pytest.approx(90.0, abs=2.0)
