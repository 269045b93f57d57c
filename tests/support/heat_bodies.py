"""Meshes and bodies for problems of heat flow: tetrahedra, voxels, boxes, shells, rooms and walls; their matrices."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy import sparse
from skfem import BilinearForm

from thermoxels_ns.fem.implicit_equation import LinearSolver
from thermoxels_ns.fem.linear_tets import lumped_mass, refine_mesh, stiffness_matrix
from thermoxels_ns.fem.problem import HeatProblem, TimeSteps, Varying
from thermoxels_ns.fem.selection import Places, Selection
from thermoxels_ns.fem.space import Space
from thermoxels_ns.heat.effects import Convection, FixedTemperature
from thermoxels_ns.heat.materials import Material
from thermoxels_ns.mesh.boundary.patches import PatchRules, with_patches
from thermoxels_ns.mesh.quality.checks import boundary_facets
from thermoxels_ns.mesh.tetrahedra import FACET_BOX, Boundary, TetMesh, facet_normals
from thermoxels_ns.mesh.voxel_tets import kuhn_tets

SIDES = ("x0", "x1", "y0", "y1", "z0", "z1")
"""Patches of a box: the lower and the upper end of each axis."""

Nodal = float | Callable[[npt.NDArray[np.float64]], npt.NDArray[np.float64]]


def mesh_from(
    points: npt.NDArray[np.float64], tets: npt.NDArray[np.int64], temperature_c: Nodal = 20.0, **fields: Any
) -> TetMesh:
    """A mesh of any tetrahedra with the boundary that they have, seen everywhere and of one region unless told."""
    facets = boundary_facets(tets)
    nodal = temperature_c(points) if callable(temperature_c) else np.full(len(points), float(temperature_c))
    seen, tags, region = np.ones(len(points), bool), np.zeros(len(facets), np.int64), np.zeros(len(tets), np.int64)
    return replace(TetMesh(points, tets, nodal, seen, facets, tags, region), **fields)


def planes(*knots: float, step: float) -> npt.NDArray[np.float64]:
    """Coordinates from knot to knot, all knots included, in parts of at most one step.

    >>> planes(0.0, 1.0, 1.5, step=0.5).tolist()
    [0.0, 0.5, 1.0, 1.5]
    """
    parts = [
        np.linspace(low, high, max(int(np.ceil((high - low) / step - 1e-9)), 1), endpoint=False)
        for low, high in pairwise(knots)
    ]
    return np.concatenate([*parts, knots[-1:]])


def graded(*knots: float, finest: float, growth: float, coarsest: float) -> npt.NDArray[np.float64]:
    """Coordinates from knot to knot, fine beside each knot and coarser between them.

    >>> graded(0.0, 6.0, finest=1.0, growth=2.0, coarsest=9.0).tolist()
    [0.0, 1.0, 3.0, 5.0, 6.0]
    """
    parts = []
    for low, high in pairwise(knots):
        half = [finest]
        while 2.0 * sum(half) < (high - low) * (1.0 - 1e-9):
            half.append(min(half[-1] * growth, coarsest))
        # The last one made it too long: leave it out if what is left is not much too coarse.
        if len(half) > 1 and 2.0 * sum(half[:-1]) > 0.8 * (high - low):
            half.pop()
        steps = np.array([*half, *half[::-1]])
        parts.append(low + np.concatenate([[0.0], np.cumsum(steps)[:-1]]) * ((high - low) / steps.sum()))
    return np.concatenate([*parts, knots[-1:]])


def box_mesh(
    x: Sequence[float] | npt.NDArray[np.float64],
    y: Sequence[float] | npt.NDArray[np.float64],
    z: Sequence[float] | npt.NDArray[np.float64],
    *,
    temperature_c: Nodal = 20.0,
    regions: dict[str, Callable[[npt.NDArray[np.float64]], npt.NDArray[np.bool_]]] | None = None,
    patches: dict[str, Callable[[npt.NDArray[np.float64], npt.NDArray[np.float64]], npt.NDArray[np.bool_]]]
    | None = None,
    keep: Callable[[npt.NDArray[np.float64]], npt.NDArray[np.bool_]] | None = None,
    keep_tets: Callable[[npt.NDArray[np.float64]], npt.NDArray[np.bool_]] | None = None,
) -> TetMesh:
    """Cut a box along planes into cells and each cell into six tetrahedra.

    Args:
        x: Coordinates of the planes across the first axis, ascending.
        y: Of the second.
        z: Of the third.
        temperature_c: Temperature of the nodes, or a function of their positions.
        regions: Rules by centroid of a cell; the last that holds names the cell. None: one region, "solid".
        patches: Rules by centroid and normal of a boundary triangle; the last that holds names it. Without any it has
            the name of its side, or "other" inside the box.
        keep: Which cells to keep, by centroid; None: all.
        keep_tets: Which of their tetrahedra to keep, by centroid; None: all. With x >= y and the same planes across
            both axes, one side of the diagonal: tetrahedra do not cross it.
    """
    axes = [np.asarray(axis, dtype=np.float64) for axis in (x, y, z)]
    middles = [0.5 * (axis[1:] + axis[:-1]) for axis in axes]
    centre = np.stack(np.meshgrid(*middles, indexing="ij"), axis=-1)
    cells = np.ones(centre.shape[:3], bool) if keep is None else keep(centre)
    corners, tets = kuhn_tets(cells)
    points = np.stack([axis[corners[:, i]] for i, axis in enumerate(axes)], axis=1)
    names, number = ("solid",), np.zeros(centre.shape[:3], np.int64)
    if regions:
        names, number = tuple(regions), np.full(centre.shape[:3], -1)
        for index, rule in enumerate(regions.values()):
            number[rule(centre)] = index
        assert (number[cells] >= 0).all(), "cells without a region"
    region = np.repeat(number[cells], 6)
    if keep_tets is not None:
        kept = keep_tets(points[tets].mean(axis=1))
        used, numbers = np.unique(tets[kept], return_inverse=True)
        points, tets, region = points[used], numbers.reshape(-1, 4), region[kept]
    mesh = mesh_from(points, tets, temperature_c, region=region, region_names=names)
    corner, normal, rules = points[mesh.facets], facet_normals(points, mesh.facets), patches or {}
    names = (*SIDES, "other", *(name for name in rules if name not in SIDES))
    patch = np.full(len(corner), names.index("other"))
    for side, (axis, end) in zip(SIDES, ((axis, end) for axis in range(3) for end in (0, -1))):
        patch[(corner[..., axis] == axes[axis][end]).all(axis=1)] = names.index(side)
    for name, rule in rules.items():
        patch[rule(corner.mean(axis=1), normal)] = names.index(name)
    return replace(mesh, boundary=Boundary(np.ones(len(corner), bool), patch, names))


CONCRETE = Material("concrete", 1.7, 2200.0, 880.0)
STEEL = Material("steel", 50.0, 7800.0, 450.0)


def make_body(cells: np.ndarray, voxel_m: float, temperature_c: Nodal = 20.0) -> TetMesh:
    corners, tets = kuhn_tets(cells)
    return mesh_from(corners * voxel_m, tets, temperature_c)


@pytest.fixture
def random_body() -> TetMesh:
    """A 6 x 5 x 4 block with a tunnel, a cavity and a bite out of its corner."""
    cells, rng = np.ones((6, 5, 4), dtype=bool), np.random.default_rng(7)
    cells[:, 2, 1] = False
    cells[3, 3, 2] = False
    cells[4:, :2, 2:] = False
    return make_body(cells, 0.05, lambda points: rng.uniform(-15.0, 45.0, len(points)))


def finer(problem: HeatProblem, times: int = 1) -> HeatProblem:
    for _ in range(times):
        problem = replace(problem, mesh=refine_mesh(problem.mesh), initial_temperature_c=None)
    return problem


def nafems_t3(parts: int = 10) -> HeatProblem:
    """The rod of NAFEMS T3, at 0 C: one end is kept there, the other at 100 sin(pi t / 40)."""
    mesh = box_mesh(np.linspace(0, 0.1, parts + 1), [0, 0.01], [0, 0.01], temperature_c=0.0)
    swing = Varying(lambda places, time_s: 100.0 * np.sin(np.pi * time_s / 40.0))
    effects = (FixedTemperature(("x0",), 0.0), FixedTemperature(("x1",), swing))
    return HeatProblem(mesh, Material("steel", 35.0, 7200.0, 440.5), effects=effects)


@BilinearForm
def storage(u, v, w):
    return w.heat_capacity * u * v


HeatMatrices = tuple[sparse.csr_matrix, sparse.csr_matrix]  # K [W / K] and M [J / K] of M dT/dt + K T = 0


def assemble(mesh: TetMesh, material: Material, *, lumped: bool = True) -> HeatMatrices:
    """The product's matrices, or with the consistent mass by scikit-fem, as other programs have it."""
    stiffness = stiffness_matrix(mesh.points_m, mesh.tets, np.full(len(mesh.tets), material.conductivity_w_mk))
    capacity = np.full(len(mesh.tets), material.heat_capacity_j_m3k)
    if lumped:
        return stiffness, sparse.diags(lumped_mass(mesh.points_m, mesh.tets, capacity), format="csr")
    return stiffness, Space(Selection(mesh)).assembled(storage, 2, heat_capacity=capacity)


def backward_euler(matrices: HeatMatrices, start_c: np.ndarray, time: TimeSteps) -> np.ndarray:
    """Steps with given matrices and our linear solver, shape (steps, n)."""
    (stiffness, mass), states = matrices, [start_c]
    solver = LinearSolver((mass / time.step_seconds + stiffness).tocsr())
    for _ in range(time.steps):
        change = solver.solve(-(stiffness @ states[-1]))
        assert change.converged
        states.append(states[-1] + change.x)
    return np.array(states[1:])


def shell_mesh(inner_m: float, outer_m: float, parts: int, layers: int, *, eighth: bool = False) -> TetMesh:
    """A spherical shell, its nodes on the spheres: a cubed sphere cut into cells, and each cell into six tetrahedra.

    Each of the six sides of the cube is made of four mirrored quarters, so that the diagonals of all of them meet.

    Args:
        inner_m: Radius of the inner sphere, [m].
        outer_m: Of the outer one.
        parts: Cells along half an edge of the cube.
        layers: Cells from sphere to sphere.
        eighth: Only what lies between the positive axes; nothing flows through its cuts.

    Returns:
        A mesh with the patches "inside" and "outside" (and "cut" of an eighth).
    """
    corners, tets = kuhn_tets(np.ones((parts, parts, layers), bool))
    u, v, w = (corners / [parts, parts, layers]).T
    ray = np.stack([np.tan(0.25 * np.pi * u), np.tan(0.25 * np.pi * v), np.ones_like(u)], axis=1)
    quarter = ray * ((inner_m + (outer_m - inner_m) * w) / np.linalg.norm(ray, axis=1))[:, None]
    points, blocks = [], []
    for axes in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        for signs in np.ndindex(*((1, 1, 1) if eighth else (2, 2, 2))):
            mirrored = quarter[:, axes] * (1.0 - 2.0 * np.array(signs))
            blocks.append((tets if sum(signs) % 2 == 0 else tets[:, [1, 0, 2, 3]]) + len(points) * len(quarter))
            points.append(mirrored)
    every = np.concatenate(points)
    _, first, number = np.unique(np.round(every / outer_m, 9) + 0.0, axis=0, return_index=True, return_inverse=True)
    nodes, tets = every[first], number.ravel()[np.concatenate(blocks)]
    mesh = mesh_from(nodes, tets)
    corner, facets = nodes[mesh.facets], mesh.facets
    radius = np.linalg.norm(corner, axis=2)
    patch = np.full(len(facets), 2)
    patch[np.all(np.abs(radius - inner_m) < 1e-9 * outer_m, axis=1)] = 0
    patch[np.all(np.abs(radius - outer_m) < 1e-9 * outer_m, axis=1)] = 1
    seen, names = np.ones(len(facets), bool), ("inside", "outside", "cut")
    return replace(mesh, boundary=Boundary(seen, patch, names))


Z_UP = (0.0, 0.0, 1.0)


def tagged_body(cells: np.ndarray, voxel_m: float, outside: np.ndarray, cut_below_x: float = 0.0) -> TetMesh:
    """A body of voxels at 15 C with the default patches and the regions solid and slab (empty).

    Args:
        cells: Which voxels are solid.
        voxel_m: Their size.
        outside: True for voxels beyond which photographs look, on a lattice two larger that starts one voxel earlier.
        cut_below_x: Facets whose middle has an x below it, in voxels, are cut by the box around the scene.
    """
    mesh = make_body(cells, voxel_m, 15.0)
    corners = np.rint(mesh.points_m / voxel_m)
    normals, middle = facet_normals(corners, mesh.facets), corners[mesh.facets].mean(axis=1)
    beyond = np.floor(middle + 0.5 * normals).astype(int) + 1
    cut = np.where(middle[:, 0] < cut_below_x, FACET_BOX, mesh.facet_tags)
    tagged, _ = with_patches(replace(mesh, facet_tags=cut), PatchRules(), Z_UP, outside[tuple(beyond.T)])
    return replace(tagged, region_names=("solid", "slab"), facet_tags=mesh.facet_tags)


def places_on(mesh: TetMesh, *patches: str) -> Places:
    """Where the boundary triangles of some patches are."""
    selection = Selection(mesh)
    return selection.facet_places(selection.facets(patches))


def room(from_within: bool = False) -> TetMesh:
    """A closed room of 4 m with walls, floor and ceiling of 1 m; its side at x = 0 is cut by the box.

    Or all of it, photographed from within.
    """
    cells = np.ones((4, 4, 4), dtype=bool)
    cells[1:3, 1:3, 1:3] = False
    outside = np.full((6, 6, 6), not from_within)
    outside[2:4, 2:4, 2:4] = from_within
    return tagged_body(cells, 1.0, outside, cut_below_x=0.0 if from_within else 1e-6)


def wall() -> TetMesh:
    """A wall of 0.2 m that fills the box: outside at its larger y, the room at y = 0, the rest is cut."""
    cells = np.ones((1, 4, 1), dtype=bool)
    outside = np.zeros((3, 6, 3), dtype=bool)
    outside[:, 5] = True
    mesh = tagged_body(cells, 0.05, outside)
    across = np.abs(facet_normals(mesh.points_m, mesh.facets)[:, 1]) < 0.5
    patch = np.where(across, mesh.boundary.patch_names.index("cut"), mesh.boundary.patch)
    return replace(mesh, boundary=replace(mesh.boundary, patch=patch))


LISTED_W = (46.09, 13.89, -59.98)
"""Heat flows into the body from the lower room, the upper room and outside."""
COLDEST_C = {"lower room": 11.32, "upper room": 11.11}
"""Lowest temperatures of the surfaces of the rooms."""


def building_corner(cut_up: Callable[..., npt.NDArray[np.float64]]) -> HeatProblem:
    """Pose the problem.

    Args:
        cut_up: Takes the coordinates of the planes between parts along one axis, [m], all multiples of 0.05; returns
            those of the mesh, such as `planes` or `graded` of heat_bodies with their options filled in.

    Returns:
        Its effects are convection in the lower room, in the upper room and outside, in this order.
    """
    x, y, z = (
        cut_up(*knots)
        for knots in ((-0.1, 0, 0.05, 0.2, 1.2), (-0.7, -0.1, 0, 0.05, 0.2, 1.2), (0, 1.0, 1.15, 1.2, 2.15))
    )

    def depth(p):
        return np.minimum(p[..., 0], p[..., 1])

    def slab(p):
        return (p[..., 0] > 0.05) & (p[..., 2] > 1.0) & (p[..., 2] < 1.15)

    regions = {
        "inner wall": lambda p: depth(p) > 0.05,
        "insulation": lambda p: (depth(p) > 0) & (depth(p) < 0.05),
        "outer wall": lambda p: depth(p) < 0,
        "floor": lambda p: (depth(p) > 0.2) & (p[..., 2] > 1.15),
        "slab": slab,
    }

    def solid(p):
        wall = (depth(p) > -0.1) & (depth(p) < 0.2)
        return wall | slab(p) | ((depth(p) > 0.2) & (p[..., 2] > 1.15) & (p[..., 2] < 1.2))

    def cut(c):
        return (c[:, :2] > 1.2 - 1e-9).any(axis=1) | (c[:, 2] < 1e-9) | (c[:, 2] > 2.15 - 1e-9)

    def room(c):
        return ~cut(c) & (depth(c) > 0.2 - 1e-9)

    patches = {
        "cut": lambda c, n: cut(c),
        "outside": lambda c, n: ~cut(c) & ~room(c),
        "lower room": lambda c, n: room(c) & (c[:, 2] < 1.0 + 1e-9),
        "upper room": lambda c, n: room(c) & (c[:, 2] > 1.15),
    }
    conductivity = {"inner wall": 0.7, "insulation": 0.04, "outer wall": 1.0, "floor": 1.0, "slab": 2.5}
    effects = (
        Convection(("lower room",), 5.0, 20.0),
        Convection(("upper room",), 5.0, 15.0),
        Convection(("outside",), 20.0, 0.0),
    )
    mesh = box_mesh(x, y, z, regions=regions, patches=patches, keep=solid)
    return HeatProblem(mesh, {n: Material(n, k, 1000.0, 1000.0) for n, k in conductivity.items()}, effects=effects)
