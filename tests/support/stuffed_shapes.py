"""Known bodies for isosurface stuffing and what their meshes must be; and bodies of them with patches and regions."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import skfem
from scipy import sparse
from skfem.models.poisson import laplace

from tests.support.heat_bodies import CONCRETE, Nodal, box_mesh, mesh_from
from thermoxels_ns.fem.solution import HeatSolution
from thermoxels_ns.fem.steady import OVERSHOOT_K
from thermoxels_ns.mesh.quality.checks import component_of, dihedral_range_deg
from thermoxels_ns.mesh.stuffing.isosurface import StuffedSolid, stuff
from thermoxels_ns.mesh.tetrahedra import FACET_BOX, FACET_SURFACE, Boundary, TetMesh

ANGLE_BOUNDS_DEG = (10.7, 164.8)
"""What Labelle and Shewchuk (2007) promise."""


def tet_mesh(solid: StuffedSolid, voxel_size: float = 1.0) -> TetMesh:
    tags = np.where(solid.on_box, FACET_BOX, FACET_SURFACE)
    return mesh_from(solid.points * voxel_size, solid.tets, 0.0, facets=solid.facets, facet_tags=tags)


def on_surface(solid: StuffedSolid) -> np.ndarray:
    """True for nodes of boundary triangles, shape (n,)."""
    return np.isin(np.arange(len(solid.points)), solid.facets)


def num_bodies(solid: StuffedSolid) -> int:
    """Parts of the mesh that share no node."""
    return len(np.unique(component_of(len(solid.points), solid.tets[:, :3].ravel(), solid.tets[:, 1:].ravel())))


def euler_characteristic(solid: StuffedSolid) -> int:
    """Vertices - edges + triangles of the boundary: 2 for a ball, 2 less for every hole through it."""
    sides = np.sort(solid.facets[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    return len(np.unique(solid.facets)) - len(np.unique(sides, axis=0)) + len(solid.facets)


def stiffness(points: np.ndarray, tets: np.ndarray) -> sparse.csr_array:
    """Stiffness matrix of linear elements for a conductivity of 1."""
    return sparse.csr_array(laplace.assemble(skfem.Basis(skfem.MeshTet(points.T, tets.T), skfem.ElementTetP1())))


def turn(degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def random_turn(seed: int) -> np.ndarray:
    """A rotation about an axis in any direction."""
    axes = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    return axes * np.linalg.det(axes)


def box_distance(points: np.ndarray, half: np.ndarray) -> np.ndarray:
    beyond = np.abs(points) - half
    return np.linalg.norm(np.maximum(beyond, 0.0), axis=-1) + np.minimum(beyond.max(axis=-1), 0.0)


def centres(*shape: int) -> np.ndarray:
    """Voxel centres, in voxels from the middle of the lattice."""
    axes = [np.arange(n) + 0.5 - 0.5 * n for n in shape]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


SHIFT = np.array([0.0137, -0.0071, 0.0043])
"""Where the middle of a shape is, so that there is no symmetry between it and the lattice."""


@dataclass(frozen=True)
class Shape:
    """A body in a box of side 2 with its exact measures."""

    distance: Callable[[np.ndarray], np.ndarray]
    """Signed distance, negative inside."""
    volume: float
    area: float
    sharp_edges: float = 0.0
    """Total length of its edges of 90 degrees."""

    def level(self, cells: int, voxels_to_one: float = 1.5) -> np.ndarray:
        """Levels on `cells`^3 voxels that reach 1 so many voxels from the surface."""
        size = 2.0 / cells
        points = centres(cells, cells, cells) * size - SHIFT
        return np.clip(-self.distance(points) / (voxels_to_one * size), -1.0, 1.0)


def _torus(p: np.ndarray) -> np.ndarray:
    return np.hypot(np.hypot(p[..., 0], p[..., 1]) - 0.6, p[..., 2]) - 0.25


def _cylinder(p: np.ndarray) -> np.ndarray:
    return box_distance(np.stack([np.hypot(p[..., 0], p[..., 1]), p[..., 2]], axis=-1), np.array([0.5, 0.7]))


def turned_box(half: tuple[float, float, float], rotation: np.ndarray) -> Shape:
    a, b, c = half
    area, edges = 8 * (a * b + b * c + a * c), 8 * (a + b + c)
    return Shape(lambda p: box_distance(p @ rotation, np.array(half)), 8 * a * b * c, area, edges)


SHAPES: dict[str, Shape] = {
    "sphere": Shape(lambda p: np.linalg.norm(p, axis=-1) - 0.8, 4 / 3 * np.pi * 0.8**3, 4 * np.pi * 0.8**2),
    "torus": Shape(_torus, 2 * np.pi**2 * 0.6 * 0.25**2, 4 * np.pi**2 * 0.6 * 0.25),
    "cylinder": Shape(_cylinder, np.pi * 0.25 * 1.4, 2 * np.pi * 0.5 * (1.4 + 0.5), 4 * np.pi * 0.5),
    **{f"slab at {degrees} degrees": turned_box((0.7, 0.25, 0.5), turn(degrees)) for degrees in (0, 30, 45)},
}


H = 0.05
"""Size of a voxel, [m]."""
STEP_S = H**2 / CONCRETE.diffusivity_m2_s
"""Time in which heat crosses a voxel, [s]."""


def dressed(mesh: TetMesh, temperature_c: Nodal = 20.0, regions: bool = False) -> TetMesh:
    """Give any mesh these patches and regions."""
    corner = mesh.points_m[mesh.facets]
    middle = mesh.points_m.mean(axis=0)
    patch = (corner.mean(axis=1)[:, 0] > middle[0]).astype(np.int64)
    boundary = Boundary(np.ones(len(patch), bool), patch, ("x0", "x1"))
    nodal = temperature_c(mesh.points_m) if callable(temperature_c) else np.full(len(mesh.points_m), temperature_c)
    mesh = replace(mesh, temperature_c=nodal, boundary=boundary)
    if regions:
        odd = np.floor(mesh.points_m[mesh.tets].mean(axis=1) / H).sum(axis=1) % 2
        mesh = replace(mesh, region=odd.astype(np.int64), region_names=("even", "odd"))
    return mesh


AT_THE_BOUNDS = "at the angle bounds"
"""Name of a body whose angles are as bad as is promised."""
MOST_OVERSHOOT = 0.5
"""Share of the range by which single hot nodes may leave it where angles are as bad as is promised."""
NEAR_THE_BOUNDS_DEG = 0.1
"""How far inside the promised range its worst angles are."""


BLOCKS = ("regular", "carved", "shaken")
"""Names of blocks of cells: whole, with a third taken out, and with nodes moved so that angles are obtuse."""


def body(
    shape: str = "slab at 30 degrees", temperature_c: Nodal = 20.0, regions: bool = False, size: int = 6
) -> TetMesh:
    """One of the known shapes, 8 voxels wide, `AT_THE_BOUNDS`, or one of `BLOCKS`, `size` voxels wide."""
    if shape in BLOCKS:
        keep = (lambda p: np.random.default_rng(5).random(p.shape[:3]) < 0.65) if shape == "carved" else None
        mesh = box_mesh(*[np.arange(size + 1) * H] * 3, keep=keep)
        if shape == "shaken":
            moves = np.random.default_rng(6).uniform(-0.1 * H, 0.1 * H, mesh.points_m.shape)
            mesh = replace(mesh, points_m=mesh.points_m + moves)
    else:
        mesh = at_the_angle_bounds() if shape == AT_THE_BOUNDS else tet_mesh(stuff(SHAPES[shape].level(8)), H)
    return dressed(mesh, temperature_c, regions)


@lru_cache(maxsize=1)
def at_the_angle_bounds() -> TetMesh:
    """A sphere whose every node was moved in some direction until an angle beside it came to a bound.

    Meshes of random levels come to 10.95 and 156 degrees by themselves.
    """
    mesh = tet_mesh(stuff(SHAPES["sphere"].level(6)), H)
    points, rng = mesh.points_m.copy(), np.random.default_rng(4)
    low, high = ANGLE_BOUNDS_DEG[0] + NEAR_THE_BOUNDS_DEG, ANGLE_BOUNDS_DEG[1] - NEAR_THE_BOUNDS_DEG
    for node in rng.permutation(len(points)):
        tets = mesh.tets[(mesh.tets == node).any(axis=1)]
        direction = rng.normal(size=3)
        direction *= H / np.linalg.norm(direction)
        step = 0.1
        # Onwards as long as all angles keep within the bounds, with ever shorter steps.
        for _ in range(26):
            before = points[node].copy()
            points[node] = before + step * direction
            least, most = dihedral_range_deg(points, tets)
            corner = points[tets]
            if least < low or most > high or np.linalg.det(corner[:, 1:] - corner[:, :1]).min() <= 0.0:
                points[node], step = before, 0.5 * step
    return replace(mesh, points_m=points)


def spots(points: np.ndarray) -> np.ndarray:
    """Single hot and cold nodes in an even body."""
    return np.random.default_rng(1).choice([-30.0, 20.0, 90.0], len(points))


def faults(solution: HeatSolution, low: float, high: float, shape: str = "shaken") -> list[str]:
    """What is wrong: not finite, not balanced, or out of range without a word or by too much.

    Without obtuse angles, in the first two of `BLOCKS`, no temperature leaves its range but by round-off.
    """
    temperature_c = solution.temperature_c
    most_k = (1e-8 if shape in BLOCKS[:2] else MOST_OVERSHOOT) * (high - low)
    beyond_k = max(low - float(temperature_c.min()), float(temperature_c.max()) - high)
    found = {
        "not finite": not np.isfinite(temperature_c).all(),
        f"energy {solution.energy_residual:.1e}": not solution.energy_residual < 1e-9,
        f"beyond by {beyond_k:.1e} K": not beyond_k <= most_k,
        f"silent about {beyond_k:.1e} K": beyond_k > OVERSHOOT_K and "left its range" not in solution.status,
    }
    return [f"{name}: {solution.status}" for name, wrong in found.items() if wrong]
