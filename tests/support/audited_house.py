"""A house of known construction, solved by finite elements, drawn as cameras see it, trained, exported and audited."""

import dataclasses
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial import KDTree

from tests.support.audited_wall import Truth, photographed, radiant_c
from tests.support.heat_bodies import box_mesh, planes
from thermoxels_ns.audit.conditions import Conditions
from thermoxels_ns.mesh.tetrahedra import TetMesh
from thermoxels_ns.synthetic.appearance import Paint, SunLight, sky_rgb, sky_temperature_c
from thermoxels_ns.synthetic.random_plan import Plan, distance_to
from thermoxels_ns.synthetic.random_scene import painted_scene
from thermoxels_ns.synthetic.scene_truth import SyntheticScene, rings_around
from thermoxels_ns.synthetic.solids import Box

HOUSE: Box = ((0.0, 0.0, 0.0), (5.0, 4.0, 3.4))
ROOM: Box = ((0.3, 0.3, 0.3), (4.7, 3.7, 3.1))
GROUND: Box = ((-0.7, -1.2, -0.3), (5.7, 4.7, 0.0))
SLAB: Box = ((0.6, -0.7, 2.5), (2.4, 0.3, 2.7))
SLAB_LENGTH_M = SLAB[1][0] - SLAB[0][0]
DOOR: Box = ((0.8, 0.0, 0.3), (1.7, 0.3, 2.3))
RECESS_M, GLASS_M = 0.1, 0.05
WINDOWS: tuple[Box, ...] = (((2.6, 0.0, 1.0), (4.0, 0.3, 2.2)), ((4.7, 1.2, 1.0), (5.0, 2.4, 2.2)))
CONTACT_M = (4.4, 0.0, 2.6)  # Where a surface temperature is measured by contact
ELEMENTS = ("front", "side", "window", "side-window", "door")
_AIR_C, _SKY_DROP_K = 0.0, 20.0
_MARGIN_M = 0.12  # Elements end so far from edges and openings, where the mesh cannot tell what a triangle belongs to

_front, _side = WINDOWS
_RULES: tuple[tuple[str, Box, bool], ...] = (
    ("front", ((0.15, SLAB[0][1] - 0.15, 0.2), (4.85, 0.05, 3.25)), False),
    ("side", ((4.95, 0.15, 0.2), (5.05, 3.85, 3.25)), True),
    ("reveals", ((_front[0][0] - _MARGIN_M, -0.05, 1.0 - _MARGIN_M), (4.0 + _MARGIN_M, 0.25, 2.2 + _MARGIN_M)), False),
    ("reveals", ((4.75, 1.2 - _MARGIN_M, 1.0 - _MARGIN_M), (5.05, 2.4 + _MARGIN_M, 2.2 + _MARGIN_M)), False),
    ("reveals", ((0.8 - _MARGIN_M, -0.05, 0.0), (1.7 + _MARGIN_M, 0.05, 2.3 + _MARGIN_M)), True),
    ("window", ((2.6 + _MARGIN_M, 0.02, 1.0 + _MARGIN_M), (4.0 - _MARGIN_M, 0.18, 2.2 - _MARGIN_M)), True),
    ("side-window", ((4.82, 1.2 + _MARGIN_M, 1.0 + _MARGIN_M), (4.98, 2.4 - _MARGIN_M, 2.2 - _MARGIN_M)), True),
    ("door", ((0.8 + _MARGIN_M, -0.05, 0.3 + _MARGIN_M), (1.7 - _MARGIN_M, 0.05, 2.3 - _MARGIN_M)), True),
)
"""Name, box and whether the triangle must be upright, of each rule; of several that hold, the last one names it."""


def patches_yaml() -> str:
    """The rules as the patches file of an export."""
    lines = ["patches:"]
    for name, (low, high), upright in _RULES:
        facing = ", facing: side" if upright else ""
        lines.append(f"  - {{name: {name}, only: exterior{facing}, box: {{lower: {list(low)}, upper: {list(high)}}}}}")
    return "\n".join(lines) + "\n"


def _held(box: Box, points: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    return ((points > np.array(box[0])) & (points < np.array(box[1]))).all(axis=-1)


def _glass(window: Box) -> Box:
    """The pane of a window, between its reveals and the room."""
    (x0, y0, z0), (x1, y1, z1) = window
    if window is WINDOWS[0]:
        return (x0, y0 + RECESS_M, z0), (x1, y0 + RECESS_M + GLASS_M, z1)
    return (x1 - RECESS_M - GLASS_M, y0, z0), (x1 - RECESS_M, y1, z1)


def house_mesh(step: float = 0.1, slab: bool = True) -> TetMesh:
    """The house with a room in it; "cut" is its underside, through which no heat flows."""
    x = planes(0.0, 0.6, 0.8, 1.7, 2.4, 2.6, 4.0, 4.7, 4.85, 4.9, 5.0, step=step)
    y = planes(*([SLAB[0][1]] if slab else []), 0.0, 0.1, 0.15, 0.3, 1.2, 2.4, 3.7, 4.0, step=step)
    z = planes(0.0, 0.3, 1.0, 2.2, 2.3, 2.5, 2.7, 3.1, 3.4, step=step)
    panes = [_glass(window) for window in WINDOWS]

    def kept(p: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
        open_air = _held(ROOM, p)
        for window, pane in zip(WINDOWS, panes):
            open_air |= _held(window, p) & ~_held(pane, p)
        return (_held(HOUSE, p) & ~open_air) | (_held(SLAB, p) if slab else False)

    def named(name: str) -> Callable[..., npt.NDArray[np.bool_]]:
        def rule(c: npt.NDArray[np.float64], n: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
            upright = np.abs(n[:, 2]) < np.sqrt(0.5)
            held = [_held(box, c) & (upright | (not only)) for key, box, only in _RULES if key == name]
            return np.logical_or.reduce(held)

        return rule

    regions = {
        "wall": lambda p: np.ones(p.shape[:-1], bool),
        "glazing": lambda p: _held(panes[0], p) | _held(panes[1], p),
        "door": lambda p: _held(DOOR, p),
    }
    if slab:
        regions["slab"] = lambda p: _held(SLAB, p)
    inside = 0.01 + np.array(ROOM[1])

    def in_room(c: npt.NDArray[np.float64], n: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
        behind = (c > np.array(ROOM[0]) - 0.01).all(axis=1) & (c < inside).all(axis=1)
        for window, pane in zip(WINDOWS, panes):  # the pane's inner side, and the reveals between it and the room
            axis = 1 if window is WINDOWS[0] else 0
            depth = c[:, axis] > pane[1][1] - 1e-9 if axis else c[:, axis] < pane[0][0] + 1e-9
            behind |= _held((tuple(np.array(window[0]) - 0.01), tuple(np.array(window[1]) + 0.01)), c) & depth
        return behind

    patches = {"outside": lambda c, n: np.ones(len(c), bool), **{name: named(name) for name, *_ in _RULES}}
    patches |= {"room": in_room, "cut": lambda c, n: (c[:, 2] < 1e-9) & (n[:, 2] < -0.5)}
    mesh = box_mesh(x, y, z, regions=regions, patches=patches, keep=kept)
    names = mesh.boundary.patch_names
    seen = ~np.isin(mesh.boundary.patch, [names.index("room"), names.index("cut")])
    return dataclasses.replace(mesh, boundary=dataclasses.replace(mesh.boundary, seen=seen))


def house_scene(truth: Truth, conditions: Conditions) -> SyntheticScene:
    """The house as cameras see it: what they read of each place of the solved mesh, before noise and drift."""
    mesh = photographed(truth, conditions)
    axes = [np.unique(mesh.points_m[:, axis]) for axis in range(3)]
    index = tuple(np.searchsorted(axis, mesh.points_m[:, i]) for i, axis in enumerate(axes))
    every = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    assert mesh.observed is not None
    shown = mesh.points_m[mesh.observed]
    grid = mesh.temperature_c[mesh.observed][KDTree(shown).query(every.reshape(-1, 3))[1]].reshape(every.shape[:3])
    grid[index] = np.where(mesh.observed, mesh.temperature_c, grid[index])
    reading = RegularGridInterpolator(axes, grid)
    off = float(truth.draws["camera offset"][0])
    ground_c = float(radiant_c(conditions, truth.draws, np.array([[0.0, 0.0, -1.0]]))[0]) - off
    low, high = np.array([axis[0] for axis in axes]), np.array([axis[-1] for axis in axes])

    def temperature_c(points: npt.ArrayLike) -> npt.NDArray[np.float64]:
        points = np.asarray(points, dtype=np.float64)
        far = np.minimum(distance_to(HOUSE, points), distance_to(SLAB, points))
        house = reading(np.clip(points, low, high))
        return np.where(distance_to(GROUND, points) < far, ground_c, house)

    plan = Plan(np.random.default_rng(0), unit=GLASS_M)
    wall, grass, concrete, glass, wood = map(
        plan.add_paint,
        (
            Paint((0.74, 0.64, 0.47), 0.22),
            Paint((0.36, 0.42, 0.27), 0.24),
            Paint((0.58, 0.58, 0.57), 0.22),
            Paint((0.22, 0.30, 0.40), 0.16),
            Paint((0.42, 0.22, 0.14), 0.18),
        ),
    )
    plan.put(HOUSE, wall)
    plan.put(GROUND, grass)
    plan.put(SLAB, concrete)
    plan.put(DOOR, wood)
    (x0, _, z0), (x1, _, z1) = WINDOWS[0]
    plan.recess((1, -1, 0.0), (x0, x1), (z0, z1), RECESS_M, glass, 0.0)
    (_, y0, z0), (_, y1, z1) = WINDOWS[1]
    plan.recess((0, +1, HOUSE[1][0]), (y0, y1), (z0, z1), RECESS_M, glass, 0.0)
    return painted_scene(
        plan,
        texture_seed=7,
        light=SunLight(towards=(0.75, -0.45, 0.5)),
        name="audited-house",
        scene_box=((-0.9, -1.4, -0.5), (5.9, 4.9, 3.6)),
        temperature_bounds_c=(_AIR_C - _SKY_DROP_K - 5.0, 20.0),
        surface_temperature_c=temperature_c,
        background_rgb=sky_rgb,
        background_temperature_c=lambda directions: sky_temperature_c(directions, _AIR_C, _SKY_DROP_K),
        rings=rings_around(
            (2.5, 1.8), (1.4, 8.6, 1.5), (1.2, 8.8, 3.6), (0.9, 8.4, 6.4), start_deg=-145.0, span_deg=200.0
        ),
        focal_share=0.86,
    )
