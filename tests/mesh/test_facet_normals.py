"""True normals of voxel surfaces, and the areas that follow from them, against shapes that are known exactly."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from thermoxels_ns.errors import MeshError
from thermoxels_ns.mesh.facet_normals import LEAST_AREA_FACTOR, area_factors, facet_normals_from_level
from thermoxels_ns.mesh.quality import facet_areas, facet_normals
from thermoxels_ns.mesh.tetrahedra import FACET_BOX
from thermoxels_ns.mesh.voxel_tets import boundary_tags, kuhn_tets, voxel_facets

ACROSS = 48
OFF_CENTRE = np.array([0.3, -0.21, 0.1])
"""Where shapes lie between voxels. At 45 degrees a whole layer of a slab, and the area of its rim, depend on it."""
LEVELS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "a voxel": lambda distance: np.clip(-distance, -1.0, 1.0),
    "half a voxel": lambda distance: np.clip(-2.0 * distance, -1.0, 1.0),
    "none": lambda distance: np.where(distance < 0.0, 1.0, -1.0),
}
"""Levels by the width over which they change on either side of the surface."""


def centres(n: int) -> np.ndarray:
    """Voxel centres around the middle of n^3 voxels, [voxels]."""
    return np.stack(np.meshgrid(*[np.arange(n) + 0.5] * 3, indexing="ij"), axis=-1) - 0.5 * n


def box_distance(points: np.ndarray, half: np.ndarray) -> np.ndarray:
    beyond = np.abs(points) - half
    return np.linalg.norm(np.maximum(beyond, 0.0), axis=-1) + np.minimum(beyond.max(axis=-1), 0.0)


def turn(axis: str, degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    matrix = {"y": [[c, 0, s], [0, 1, 0], [-s, 0, c]], "z": [[c, -s, 0], [s, c, 0], [0, 0, 1]]}[axis]
    return np.array(matrix, dtype=float)


@cache
def shape(name: str) -> tuple[np.ndarray, float]:
    """Signed distance at the voxel centres and exact area, [voxels] and [voxel faces]."""
    half = 0.5 * ACROSS
    points = centres(ACROSS + 6) - OFF_CENTRE
    radial = np.hypot(points[..., 0], points[..., 1])
    if name == "sphere":
        return np.linalg.norm(points, axis=-1) - half, 4.0 * np.pi * half**2
    if name == "torus":
        ring, tube = 2.0 * half / 3.0, half / 3.0
        return np.hypot(radial - ring, points[..., 2]) - tube, 4.0 * np.pi**2 * ring * tube
    if name == "cylinder":
        beyond = np.stack([radial - half, np.abs(points[..., 2]) - half])
        outside, inside = np.linalg.norm(np.maximum(beyond, 0.0), axis=0), np.minimum(beyond.max(axis=0), 0.0)
        return outside + inside, 2.0 * np.pi * half * (2.0 * half + half)
    kind, degrees = name.rsplit(" ", 1)
    sides = half * np.array({"box": [1.0, 0.75, 0.5], "slab": [1.0, 1.0, 0.25], "wall": [1.0, 1.0, 1.0 / ACROSS]}[kind])
    tilted = points if degrees == "0" else centres(ACROSS + ACROSS // 2) - OFF_CENTRE
    rotation = turn("z" if kind == "box" else "y", float(degrees))
    area = 8.0 * (sides[0] * sides[1] + sides[1] * sides[2] + sides[2] * sides[0])
    return box_distance(tilted @ rotation, sides), area


def surface(level: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corner indices of the nodes and boundary triangles of the voxel mesh of a level function."""
    return kuhn_tets(level > 0.0)[0], voxel_facets(level > 0.0)


def true_area(level: np.ndarray) -> float:
    points, facets = surface(level)
    factors = area_factors(points, facets, facet_normals_from_level(level, points, facets))
    return float(facet_areas(points.astype(float), facets) @ factors)


SMOOTH = ["sphere", "torus", "cylinder", "slab 30", "slab 45", "box 30", "box 45"]


@pytest.mark.parametrize("width", LEVELS)
@pytest.mark.parametrize("name", SMOOTH)
def test_area_is_within_two_percent(name: str, width: str) -> None:
    distance, exact = shape(name)
    level = LEVELS[width](distance).astype(np.float32)
    points, facets = surface(level)
    stairs = facet_areas(points.astype(float), facets).sum()
    assert stairs > 1.15 * exact  # what there is to correct
    assert true_area(level) == pytest.approx(exact, rel=0.02)


@pytest.mark.parametrize("width", LEVELS)
@pytest.mark.parametrize("name", ["box 0", "slab 0"])
def test_area_of_an_axis_aligned_box_is_that_of_its_voxels(name: str, width: str) -> None:
    """The edges stay sharp: the normals of two sides are not averaged."""
    level = LEVELS[width](shape(name)[0])
    points, facets = surface(level)
    assert true_area(level) == pytest.approx(facet_areas(points.astype(float), facets).sum(), rel=0.01)


@pytest.mark.parametrize("width", LEVELS)
@pytest.mark.parametrize("degrees", [0, 30, 45])
def test_area_of_a_wall_of_one_voxel(degrees: int, width: str) -> None:
    """Its two sides are a voxel apart and do not disturb each other."""
    distance, exact = shape(f"wall {degrees}")
    assert true_area(LEVELS[width](distance)) == pytest.approx(exact, rel=0.04)


@pytest.mark.parametrize("width", LEVELS)
def test_normals_of_a_sphere(width: str) -> None:
    level = LEVELS[width](shape("sphere")[0])
    points, facets = surface(level)
    normals = facet_normals_from_level(level, points, facets)
    exact = points[facets].mean(axis=1) - 0.5 * (ACROSS + 6) - OFF_CENTRE
    exact /= np.linalg.norm(exact, axis=1, keepdims=True)
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1.0, abs=1e-12)
    cosine = np.einsum("ij,ij->i", normals, exact)
    assert cosine.min() > np.cos(np.radians(9.0))
    assert np.degrees(np.arccos(cosine)).mean() < 3.0


@pytest.mark.parametrize("seed", range(5))
def test_a_plane_in_any_direction(seed: int) -> None:
    """Its steps have about the same normal, also where it leaves the lattice, and so about the exact area."""
    random = np.random.default_rng(seed)
    normal = random.normal(size=3)
    normal /= np.linalg.norm(normal)
    level = np.clip(-(centres(24) @ normal - random.uniform(-2.0, 2.0)), -1.0, 1.0)
    points, facets = surface(level)
    steps = boundary_tags(facets, points, (25, 25, 25)) != FACET_BOX
    found = facet_normals_from_level(level, points, facets)
    areas = facet_areas(points.astype(float), facets)[steps]
    exact = areas @ np.abs(facet_normals(points.astype(float), facets)[steps] @ normal)
    assert (found[steps] @ normal).min() > np.cos(np.radians(10.0))
    assert areas @ area_factors(points, facets, found)[steps] == pytest.approx(exact, rel=5e-3)


def test_a_level_that_is_linear_has_its_gradient_everywhere() -> None:
    """Also at the border of the lattice, where differences are one-sided."""
    normal = np.array([0.36, 0.48, -0.8])
    level = -0.005 * (centres(16) @ normal - 0.3)
    points, facets = surface(level)
    steps = boundary_tags(facets, points, (17, 17, 17)) != FACET_BOX
    found = facet_normals_from_level(level, points, facets)[steps]
    assert found == pytest.approx(np.tile(normal, (len(found), 1)), abs=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_a_common_error_of_the_normals_is_of_second_order_in_the_area(seed: int) -> None:
    """The sum of A_a |n_a| changes by cos(error); dividing by |nx| + |ny| + |nz| changes by the error itself."""
    random = np.random.default_rng(seed)
    normal = np.array([0.5, 0.6, np.sqrt(1.0 - 0.25 - 0.36)])
    across = np.cross(normal, random.normal(size=3))
    across /= np.linalg.norm(across)
    points, facets = surface(np.where(centres(16) @ normal < 0.3, 1.0, -1.0))
    steps = boundary_tags(facets, points, (17, 17, 17)) != FACET_BOX
    areas = facet_areas(points.astype(float), facets)[steps]

    def area(error: float) -> float:
        guess = np.cos(error) * normal + np.sin(error) * across
        return float(areas @ area_factors(points, facets[steps], np.tile(guess, (len(areas), 1))))

    per_axis = np.array([areas[np.ptp(points[facets[steps], k], axis=1) == 0].sum() for k in range(3)])
    exact = per_axis @ normal
    assert area(0.0) == pytest.approx(exact, rel=1e-12)
    for error in (0.05, 0.1):
        # A patch of the lattice is not a whole number of periods of the plane: its steps are off by a few percent.
        edge = abs(per_axis @ across) / exact
        assert edge < 0.1
        assert abs(area(error) / exact - np.cos(error)) <= 1.001 * edge * np.sin(error)


def test_a_mesh_that_follows_the_surface_needs_no_factor() -> None:
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.2, 0.1], [0.3, 1.0, -0.4], [0.2, 0.1, 1.0]])
    facets = np.array([[0, 1, 2], [0, 3, 1]])
    assert area_factors(points, facets, facet_normals(points, facets)) == pytest.approx([1.0, 1.0], abs=1e-15)


def test_no_facet_loses_all_its_area() -> None:
    points = np.array([[0, 0, 0], [0, 1, 0], [0, 1, 1]])
    normals = np.array([[0.0, 1.0, 0.0], [0.0, 0.6, 0.8], [-1.0, 0.0, 0.0]])
    factors = area_factors(points, np.array([[0, 1, 2]] * 3), normals)
    assert factors.tolist() == [LEAST_AREA_FACTOR, LEAST_AREA_FACTOR, 1.0]


@pytest.mark.parametrize("cells", ["single voxel", "full", "one layer"])
def test_faces_of_boxes_are_exact(cells: str) -> None:
    level = -np.ones((5, 5, 5))
    level[{"single voxel": (2, 2, 2), "full": (...,), "one layer": (slice(None), slice(None), 2)}[cells]] = 1.0
    points, facets = surface(level)
    normals = facet_normals_from_level(level, points, facets)
    assert normals == pytest.approx(facet_normals(points.astype(float), facets), abs=1e-15)
    assert area_factors(points, facets, normals) == pytest.approx(1.0, abs=1e-15)


def test_where_the_scene_box_cuts_the_normal_is_that_of_the_box() -> None:
    normal = np.array([0.6, 0.0, 0.8])
    level = np.clip(-(centres(12) @ normal), -1.0, 1.0)
    points, facets = surface(level)
    cut = boundary_tags(facets, points, (13, 13, 13)) == FACET_BOX
    assert np.count_nonzero(cut) > 100
    found = facet_normals_from_level(level, points, facets)[cut]
    assert np.array_equal(found, facet_normals(points.astype(float), facets)[cut])


def test_halves_of_a_face_agree_and_their_orientation_does_not_matter() -> None:
    level = LEVELS["a voxel"](np.linalg.norm(centres(14) - OFF_CENTRE, axis=-1) - 5.0)
    points, facets = surface(level)
    normals = facet_normals_from_level(level, points, facets)
    assert np.array_equal(normals[0::2], normals[1::2])  # the halves follow each other
    assert np.array_equal(facet_normals_from_level(level, points, facets[:, ::-1]), normals)
    shuffled = np.random.default_rng(0).permutation(len(facets))
    assert np.array_equal(facet_normals_from_level(level, points, facets[shuffled]), normals[shuffled])


def test_a_mirrored_level_has_mirrored_normals() -> None:
    random = np.random.default_rng(1)
    level = np.clip(3.0 - np.linalg.norm(centres(10) - OFF_CENTRE, axis=-1) + random.normal(size=(10, 10, 10)), -1, 1)
    points, facets = surface(level)
    mirrored = facet_normals_from_level(level[::-1], [10, 0, 0] + points * [-1, 1, 1], facets)
    expected = facet_normals_from_level(level, points, facets) * [-1.0, 1.0, 1.0]
    assert mirrored == pytest.approx(expected, abs=1e-12)


def test_checkerboard_noise_has_normals() -> None:
    level = np.where(np.indices((6, 6, 6)).sum(axis=0) % 2 == 0, 1e-6, -1.0)
    points, facets = surface(level)
    normals = facet_normals_from_level(level, points, facets)
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1.0, abs=1e-12)
    assert area_factors(points, facets, normals).min() >= LEAST_AREA_FACTOR


def test_nothing_in_nothing_out() -> None:
    none = np.zeros((0, 3), dtype=np.int64)
    assert facet_normals_from_level(np.ones((2, 2, 2)), none, none).shape == (0, 3)
    assert area_factors(np.zeros((0, 3)), none, np.zeros((0, 3))).shape == (0,)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        ([[1, 1, 1], [1, 2, 1], [1, 2, 2]], "expected voxel faces with level above 0 on one side only, got 1 others"),
        ([[1, 1, 1], [2, 2, 1], [1, 2, 2]], "expected halves of the faces of 4 x 4 x 4 voxels, got 1 other triangles"),
        ([[1, 1, 1], [1, 3, 1], [1, 3, 3]], "expected halves of the faces"),
        ([[1.5, 1, 1], [1.5, 2, 1], [1.5, 2, 2]], "expected halves of the faces"),
        ([[5, 1, 1], [5, 2, 1], [5, 2, 2]], "expected halves of the faces"),
        ([[-1, 1, 1], [-1, 2, 1], [-1, 2, 2]], "expected halves of the faces"),
    ],
)
def test_what_is_no_boundary_of_voxels_is_refused(points: list, message: str) -> None:
    with pytest.raises(MeshError, match=message):
        facet_normals_from_level(np.ones((4, 4, 4)), np.array(points), np.array([[0, 1, 2]]))


def test_a_level_with_nan_is_refused() -> None:
    level = np.full((3, 3, 3), np.nan)
    with pytest.raises(MeshError, match="level: expected finite numbers only, got 27 of 27"):
        facet_normals_from_level(level, np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
