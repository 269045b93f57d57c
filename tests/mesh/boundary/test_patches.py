from pathlib import Path

import numpy as np
import pytest

from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.boundary.patches import (
    Box,
    PatchRule,
    PatchRules,
    RegionRule,
    apply_patches,
    apply_regions,
    facing,
    load_patch_rules,
)

EXAMPLE = Path(__file__).resolve().parents[3] / "configs" / "patches-example.yaml"
UP = (0.0, 0.0, 1.0)


def tilted(degrees: float) -> np.ndarray:
    """A normal that many degrees off the vertical."""
    return np.array([np.sin(np.radians(degrees)), 0.0, np.cos(np.radians(degrees))])


def rules_of(tmp_path: Path, text: str) -> PatchRules:
    path = tmp_path / "mine.yaml"
    path.write_text(text, encoding="utf-8")
    return load_patch_rules(path)


@pytest.mark.parametrize(
    ("degrees", "expected"),
    [(0, "up"), (44.9, "up"), (45, "side"), (90, "side"), (135, "side"), (135.1, "down"), (180, "down")],
)
@pytest.mark.parametrize("length", [0.1, 1.0, 9.81])
def test_facing_changes_at_45_and_135_degrees(degrees: float, expected: str, length: float) -> None:
    assert facing(tilted(degrees)[None], np.array(UP) * length).tolist() == [["up", "side", "down"].index(expected)]


FACETS = {
    "centroids_m": np.array([[0.5, 0.5, 2], [0.5, 0.5, 0], [2.0, 0.5, 1], [0.1, 0.2, 1], [0.9, 0.9, 1.0], [5, 5, 5]]),
    "normals": np.array([tilted(d) for d in (0, 180, 90, 90, 90, 0)]),
    "up": UP,
    "seen": np.array([True, False, True, True, False, True]),
    "on_box": np.array([False, False, False, False, False, True]),
}
"""A roof, a floor inside, three walls of which one inside, and a cut that faces up."""
BEFORE = ["exterior-up", "interior-down", "exterior-side", "exterior-side", "interior-side", "cut"]


def named(rules: PatchRules, colours: np.ndarray | None = None) -> list[str]:
    patch, names, _ = apply_patches(rules, **FACETS, colours=colours)
    return [names[p] for p in patch]


@pytest.mark.parametrize(
    ("rule", "changed"),
    [
        ("box: {lower: [0, 0, 0], upper: [1, 1, 1]}", [1, 3, 4]),
        ("box: {lower: [-.inf, -.inf, 1.5], upper: [.inf, .inf, .inf]}", [0, 5]),
        ("plane: {point: [0, 0, 1], normal: [0, 0, 7]}", [0, 2, 3, 4, 5]),
        ("plane: {point: [0, 0, 1], normal: [0, 0, -1]}", [1, 2, 3, 4]),
        ("plane: {point: [1, 0, 0], normal: [1, 0, 0]}", [2, 5]),
        ("only: exterior", [0, 2, 3]),
        ("only: interior", [1, 4]),
        ("only: cut", [5]),
        ("plane: {point: [0, 0, 0.5], normal: [0, 0, 2], depth: 1}", [2, 3, 4]),
        ("facing: [2, 0, 1]", [2, 3, 4]),
        ("facing: [-1, 0, 0]", []),
        ("facing: up", [0, 5]),
        ("facing: side", [2, 3, 4]),
        ("facing: down", [1]),
        ("only: exterior, facing: side, box: {lower: [0, 0, 0], upper: [1, 1, 3]}", [3]),
        ("box: {lower: [0, 0, 0], upper: [1, 1, 3]}, plane: {point: [0, 0, 1.5], normal: [0, 0, 1]}", [0]),
        ("only: interior, facing: up", []),
    ],
)
def test_all_conditions_of_a_rule_hold(tmp_path: Path, rule: str, changed: list[int]) -> None:
    names = named(rules_of(tmp_path, f"patches: [{{name: mine, {rule}}}]"))
    assert [n for n, name in enumerate(names) if name == "mine"] == changed
    assert [n for n, name in enumerate(names) if name == BEFORE[n]] == [n for n in range(6) if n not in changed]


COLOURS = np.array([[1.0, 0, 0], [0.9, 0, 0], [0.5, 0, 0], [0.1, 0, 0], [0.0, 0, 0], [0.4, 0.3, 0.0]])


def test_a_colour_is_met_up_to_its_distance(tmp_path: Path) -> None:
    rule = "patches: [{name: red, colour: {rgb: [204, 0, 0], max_distance: 51.5}}]"
    names = named(rules_of(tmp_path, rule), COLOURS)
    assert names == ["red", "red", *BEFORE[2:]]


def test_regions_go_by_box_plane_and_colour(tmp_path: Path) -> None:
    rules = rules_of(
        tmp_path,
        """
regions:
  - {name: slab, box: {lower: [-.inf, -.inf, -.inf], upper: [.inf, .inf, 0.3]}}
  - {name: east, plane: {point: [2, 0, 0], normal: [1, 0, 0]}}
  - {name: brick, colour: {rgb: [255, 0, 0], max_distance: 30}}
  - {name: slab, box: {lower: [9, 9, 9], upper: [10, 10, 10]}}
""",
    )
    centroids = np.array([[0, 0, 0.2], [0, 0, 0.4], [3, 0, 0.2], [0, 0, 1.0], [9.5, 9.5, 9.5]])
    colours = np.array([[0, 0, 0], [0, 0, 0], [0, 0, 0], [0.95, 0, 0], [1.0, 0, 0]], dtype=np.float32)
    region, names, _ = apply_regions(rules, centroids, colours)
    assert names == ("solid", "slab", "east", "brick")
    assert [names[r] for r in region] == ["slab", "solid", "east", "brick", "slab"]
    assert apply_regions(PatchRules(), centroids)[0].tolist() == [0] * 5
    assert apply_regions(PatchRules(), centroids)[1] == ("solid",)


def test_the_example_is_read_and_does_what_its_comments_say() -> None:
    rules = load_patch_rules(EXAMPLE)
    assert [rule.name for rule in rules.patches] == ["window", "window", "roof", "brick", "plaster"]
    assert [rule.name for rule in rules.regions] == ["slab"]
    facets = {
        "centroids_m": np.array([[2.0, 0, 1.5], [4.0, 0, 1.5], [2.0, 0, 1.5], [1, 1, 3.2], [1, 1, 2.0], [1, 0, 2.5]]),
        "normals": np.array([tilted(d) for d in (90, 90, 90, 30, 30, 90)]),
        "up": UP,
        "seen": np.array([True, True, False, True, True, True]),
        "on_box": np.zeros(6, dtype=bool),
        "colours": np.array([[0.2, 0.2, 0.3]] * 5 + [[0.6, 0.3, 0.25]]),
    }
    patch, names, _ = apply_patches(rules, **facets)
    assert [names[p] for p in patch] == ["window", "window", "interior-side", "roof", "exterior-up", "brick"]
    region, regions, _ = apply_regions(rules, np.array([[0, 0, 0.29], [0, 0, 0.31]]))
    assert [regions[r] for r in region] == ["slab", "solid"]


@pytest.mark.parametrize(
    ("text", "where"),
    [
        ("", "mine.yaml"),
        ("patch: []", "mine.yaml"),
        ("patches: {name: a}", "patches"),
        ("patches: [{facing: up}]", "patches entry 1"),
        ("patches: [{name: a, facing: up}, {name: b}]", "patches entry 2: b"),
        ("patches: [{name: a b, facing: up}]", "patches entry 1: name"),
        ("patches: [{name: exterior-up, facing: up}]", "patches entry 1: name"),
        ("patches: [{name: wall, facing: up}, {name: Wall, facing: side}]", "patches entry 2: name"),
        ("regions: [{name: a, facing: up}]", "regions entry 1"),
        ("patches: [{name: a, facing: north}]", "patches entry 1: facing"),
        ("patches: [{name: a, box: {lower: [0, 0, 1], upper: [1, 1, 1]}}]", "box: corners"),
        ("patches: [{name: a, plane: {point: [0, 0, 0], normal: [0, 0, 0]}}]", "plane: point and normal"),
        ("patches: [{name: a, plane: {point: [0, 0, 0], normal: [0, 0, 1], depth: 0}}]", "plane: depth"),
        ("patches: [{name: a, facing: [0, 0, 0]}]", "facing"),
        ("patches: [{name: a, colour: {rgb: [0, 0, 256], max_distance: 9}}]", "rgb"),
        ("patches: [{name: a, colour: {rgb: [0.5, 0, 0], max_distance: 9}}]", "rgb"),
        ("patches: [{name: a, colour: {rgb: [9, 0, 0], max_distance: 0}}]", "max_distance"),
        ("patches: [{name: a, colour: {rgb: [9, 0, 0]}}]", "colour"),
    ],
)
def test_wrong_files_are_refused(tmp_path: Path, text: str, where: str) -> None:
    with pytest.raises(MeshError) as caught:
        rules_of(tmp_path, text)
    assert where in str(caught.value).partition(" expected ")[0]


def test_rules_that_nothing_follows_are_named() -> None:
    far, everywhere = Box((50.0, 50.0, 50.0), (51.0, 51.0, 51.0)), Box((-9.0, -9.0, -9.0), (99.0, 99.0, 99.0))
    rules = [PatchRule("wall", box=everywhere), PatchRule("wall", box=far), PatchRule("roof", facing="up")]
    regions = (RegionRule("brick", box=everywhere), RegionRule("pipe", box=far))
    assert apply_patches(PatchRules(tuple(rules)), **FACETS).idle == ("patch wall (entry 2)",)
    rules.append(PatchRule("window", box=everywhere))  # takes all triangles from the rules before
    taken = ("patch wall (entry 1)", "patch wall (entry 2)", "patch roof (entry 3)")
    assert apply_patches(PatchRules(tuple(rules)), **FACETS).idle == taken
    assert apply_regions(PatchRules(regions=regions), np.zeros((2, 3))).idle == ("region pipe (entry 2)",)
