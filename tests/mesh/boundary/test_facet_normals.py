"""True normals of voxel surfaces, and the areas that follow from them, against shapes that are known exactly."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.boundary.facet_normals import LEAST_AREA_FACTOR, MOST_AREA_FACTOR, true_surface
from thermoxels_ns.mesh.quality.checks import facet_areas, facet_normals
from thermoxels_ns.mesh.solid.level_set import level_of
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
def shape(name: str, offset: tuple[float, ...] = tuple(OFF_CENTRE)) -> tuple[np.ndarray, float]:
    """Signed distance at the voxel centres and exact area, [voxels] and [voxel faces]."""
    half = 0.5 * ACROSS
    points = centres(ACROSS + 6) - offset
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
    tilted = points if degrees == "0" else centres(ACROSS + ACROSS // 2) - offset
    rotation = turn("z" if kind == "box" else "y", float(degrees))
    area = 8.0 * (sides[0] * sides[1] + sides[1] * sides[2] + sides[2] * sides[0])
    return box_distance(tilted @ rotation, sides), area


def surface(level: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corner indices of the nodes and boundary triangles of the voxel mesh of a level function."""
    return kuhn_tets(level > 0.0)[0], voxel_facets(level > 0.0)


def true_area(level: np.ndarray) -> float:
    points, facets = surface(level)
    return float(facet_areas(points.astype(float), facets) @ true_surface(level, points, facets)[1])


BODIES = ["sphere", "torus", "cylinder", "slab 30", "slab 45", "box 30", "box 45"]


def exported(distance: np.ndarray) -> np.ndarray:
    """The level that an export makes of an exact field."""
    density = np.exp(np.clip(-distance, -8.0, 8.0))
    return level_of(density, 1.0, density >= 1.0, density >= 1.0, makes_up_volume=False)


@pytest.mark.parametrize("width", LEVELS)
@pytest.mark.parametrize("name", BODIES)
def test_area_is_within_two_percent(name: str, width: str) -> None:
    distance, exact = shape(name)
    level = LEVELS[width](distance).astype(np.float32)
    points, facets = surface(level)
    stairs = facet_areas(points.astype(float), facets).sum()
    assert stairs > 1.15 * exact  # what there is to correct
    assert true_area(level) == pytest.approx(exact, rel=0.02)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", ["sphere", "torus", "cylinder", "slab 30", "slab 45"])
def test_area_does_not_depend_on_where_the_body_lies(name: str, seed: int) -> None:
    distance, exact = shape(name, tuple(np.random.default_rng(seed).uniform(-0.5, 0.5, 3)))
    assert true_area(exported(distance)) == pytest.approx(exact, rel=0.02)


@pytest.mark.parametrize("width", [*LEVELS, "exported"])
@pytest.mark.parametrize("name", ["box 0", "slab 0"])
def test_area_of_an_axis_aligned_box_is_that_of_its_voxels(name: str, width: str) -> None:
    """The edges stay sharp."""
    distance, exact = shape(name)
    level = exported(distance) if width == "exported" else LEVELS[width](distance)
    assert true_area(level) == pytest.approx(exact, rel=0.01)


@pytest.mark.parametrize("width", LEVELS)
@pytest.mark.parametrize("degrees", [0, 30, 45])
def test_area_of_a_wall_of_one_voxel(degrees: int, width: str) -> None:
    """Its two sides are a voxel apart and do not disturb each other; at its rim up to a voxel is lost."""
    distance, exact = shape(f"wall {degrees}")
    assert true_area(LEVELS[width](distance)) == pytest.approx(exact, rel=0.055)


@pytest.mark.parametrize("width", LEVELS)
def test_normals_of_a_sphere(width: str) -> None:
    level = LEVELS[width](shape("sphere")[0])
    points, facets = surface(level)
    normals, _ = true_surface(level, points, facets)
    exact = points[facets].mean(axis=1) - 0.5 * (ACROSS + 6) - OFF_CENTRE
    exact /= np.linalg.norm(exact, axis=1, keepdims=True)
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1.0, abs=1e-12)
    cosine = np.clip(np.einsum("ij,ij->i", normals, exact), -1.0, 1.0)
    assert np.degrees(np.arccos(cosine)).mean() < (3.0 if width == "none" else 1.5)
    assert cosine.min() > np.cos(np.radians(18.0 if width == "none" else 9.0))


@pytest.mark.parametrize("seed", range(5))
def test_a_plane_has_its_normal_and_its_area(seed: int) -> None:
    """At every face, up to where the plane leaves the lattice: the factor is the cosine of the face and the plane."""
    random = np.random.default_rng(seed)
    normal = random.normal(size=3)
    normal /= np.linalg.norm(normal)
    level = -0.02 * (centres(24) @ normal - random.uniform(-2.0, 2.0))
    points, facets = surface(level)
    steps = boundary_tags(facets, points, (25, 25, 25)) != FACET_BOX
    normals, factors = true_surface(level, points, facets)
    assert (normals[steps] @ normal).min() > np.cos(np.radians(3.0))
    inner = steps & np.all((points[facets] > 1) & (points[facets] < 23), axis=(1, 2))
    own = np.abs(facet_normals(points.astype(float), facets)[inner] @ normal)
    assert np.count_nonzero(inner) > 300
    assert factors[inner].sum() == pytest.approx(own.sum(), rel=0.05)


@pytest.mark.parametrize("cells", ["full", "one layer"])
def test_what_the_box_cuts_all_round_is_exact(cells: str) -> None:
    level = -np.ones((5, 5, 5))
    level[{"full": (...,), "one layer": (slice(None), slice(None), 2)}[cells]] = 1.0
    points, facets = surface(level)
    normals, factors = true_surface(level, points, facets)
    assert normals == pytest.approx(facet_normals(points.astype(float), facets), abs=1e-12)
    assert factors == pytest.approx(1.0, abs=1e-12)


def test_a_single_voxel_has_a_surface() -> None:
    level = -np.ones((5, 5, 5))
    level[2, 2, 2] = 1.0
    points, facets = surface(level)
    normals, factors = true_surface(level, points, facets)
    assert np.einsum("ij,ij->i", normals, facet_normals(points.astype(float), facets)).min() > 0.9
    assert np.ptp(factors) < 1e-12  # all six faces are alike
    assert 0.3 < factors[0] <= 1.0


def test_where_the_scene_box_cuts_the_normal_is_that_of_the_box() -> None:
    normal = np.array([0.6, 0.0, 0.8])
    level = np.clip(-(centres(12) @ normal), -1.0, 1.0)
    points, facets = surface(level)
    cut = boundary_tags(facets, points, (13, 13, 13)) == FACET_BOX
    assert np.count_nonzero(cut) > 100
    normals, factors = true_surface(level, points, facets)
    assert np.array_equal(normals[cut], facet_normals(points.astype(float), facets)[cut])
    assert np.all(factors[cut] == 1.0)


def test_halves_of_a_face_agree_and_their_orientation_does_not_matter() -> None:
    level = LEVELS["a voxel"](np.linalg.norm(centres(14) - OFF_CENTRE, axis=-1) - 5.0)
    points, facets = surface(level)
    normals, factors = true_surface(level, points, facets)
    assert np.array_equal(normals[0::2], normals[1::2])  # the halves follow each other
    assert np.array_equal(factors[0::2], factors[1::2])
    assert np.array_equal(true_surface(level, points, facets[:, ::-1])[1], factors)
    shuffled = np.random.default_rng(0).permutation(len(facets))
    other_normals, other_factors = true_surface(level, points, facets[shuffled])
    assert other_normals == pytest.approx(normals[shuffled], abs=1e-12)
    assert other_factors == pytest.approx(factors[shuffled], abs=1e-12)


def test_a_mirrored_level_has_a_mirrored_surface() -> None:
    level = LEVELS["a voxel"](np.linalg.norm(centres(14) - OFF_CENTRE, axis=-1) - 5.0)
    points, facets = surface(level)
    normals, factors = true_surface(level, points, facets)
    mirrored_normals, mirrored_factors = true_surface(level[::-1], [14, 0, 0] + points * [-1, 1, 1], facets)
    assert mirrored_normals == pytest.approx(normals * [-1.0, 1.0, 1.0], abs=1e-9)
    assert mirrored_factors == pytest.approx(factors, abs=1e-9)


@pytest.mark.parametrize("least", [1e-6, 0.02, 1.0])
@pytest.mark.parametrize("seed", range(3))
def test_noise_has_bounded_factors_and_normals_that_point_outwards(seed: int, least: float) -> None:
    random = np.random.default_rng(seed)
    level = np.where(random.random((9, 8, 7)) < 0.5, least, -1.0)
    level[::2, ::2, ::2], level[1::2, ::2, ::2] = least, -least
    points, facets = surface(level)
    normals, factors = true_surface(level, points, facets)
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1.0, abs=1e-9)
    assert np.einsum("ij,ij->i", normals, facet_normals(points.astype(float), facets)).min() > 0.0
    assert factors.min() >= LEAST_AREA_FACTOR and factors.max() <= MOST_AREA_FACTOR


def test_nothing_in_nothing_out() -> None:
    none = np.zeros((0, 3), dtype=np.int64)
    normals, factors = true_surface(np.ones((2, 2, 2)), none, none)
    assert normals.shape == (0, 3) and factors.shape == (0,)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        ([[1, 1, 1], [1, 2, 1], [1, 2, 2]], "expected both halves of every voxel face, got 1 faces of which"),
        ([[1, 1, 1], [2, 2, 1], [1, 2, 2]], "expected halves of the faces of 4 x 4 x 4 voxels, got 1 other triangles"),
        ([[1, 1, 1], [1, 3, 1], [1, 3, 3]], "expected halves of the faces"),
        ([[1.5, 1, 1], [1.5, 2, 1], [1.5, 2, 2]], "expected halves of the faces"),
        ([[5, 1, 1], [5, 2, 1], [5, 2, 2]], "expected halves of the faces"),
        ([[-1, 1, 1], [-1, 2, 1], [-1, 2, 2]], "expected halves of the faces"),
    ],
)
def test_what_is_no_boundary_of_voxels_is_refused(points: list, message: str) -> None:
    with pytest.raises(MeshError, match=message):
        true_surface(np.ones((4, 4, 4)), np.array(points), np.array([[0, 1, 2]]))


def test_a_level_with_nan_is_refused() -> None:
    level = np.full((3, 3, 3), np.nan)
    with pytest.raises(MeshError, match="level: expected finite numbers only, got 27 of 27"):
        true_surface(level, np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))


def test_a_face_between_two_solid_voxels_is_no_boundary() -> None:
    points = np.array([[1, 1, 1], [1, 2, 1], [1, 2, 2], [1, 1, 2]])
    with pytest.raises(MeshError, match="expected voxel faces with level above 0 on one side only, got 1 others"):
        true_surface(np.ones((4, 4, 4)), points, np.array([[0, 1, 2], [0, 2, 3]]))
