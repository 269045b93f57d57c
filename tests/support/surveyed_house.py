"""A house of two boxes whose walls have known U-values, as two surveys of it see it."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from tests.support.heat_meshes import box_mesh, planes
from thermoxels_ns.audit.conditions import Camera, Conditions, Film, InsideAir, OutsideAir, Surface, Surroundings
from thermoxels_ns.audit.draws import draw, emissivity_name
from thermoxels_ns.core.measured import Measured
from thermoxels_ns.core.units import celsius_to_kelvin, kelvin_to_celsius
from thermoxels_ns.mesh.tetrahedra import TetMesh, facet_areas

BEFORE = Conditions(
    side="outside",
    inside=InsideAir(Measured(20.0, 0.5)),
    outside=OutsideAir(Measured(1.0, 0.5), wind=Measured(1.0, 0.3)),
    surroundings=Surroundings(reflected=Measured(0.0, 1.0)),
    film=Film("dallo", Measured(1.0, 0.2)),
    camera=Camera(offset=Measured(0.0, 0.2), repeatability=Measured(0.0, 0.1)),
    surfaces=(Surface(Measured(0.93, 0.03)),),
)
AFTER = replace(
    BEFORE, inside=InsideAir(Measured(21.0, 0.5)), outside=OutsideAir(Measured(-3.0, 0.5), wind=Measured(0.7, 0.3))
)
U = {"north": 1.5, "east": 1.5, "south": 1.5, "west": 1.5, "roof": 0.8}  # [W/(m2 K)]
BAND_U, BAND_M = 1.6, (1.4, 1.7)  # Of the bridge in the west wall, in addition, and between which heights it lies
_SIDES = {"east": (0, 1), "west": (0, -1), "north": (1, 1), "south": (1, -1), "roof": (2, 1), "ground": (2, -1)}


@dataclass(frozen=True)
class Drawn:
    """A mesh with readings, and the true U-value and area of each patch."""

    mesh: TetMesh
    u: dict[str, float]
    area_m2: dict[str, float]


def house(whole: bool, step: float = 0.3) -> TetMesh:
    """6 m by 5 m, 3 m high, without a corner of 2 m by 2 m if it is not `whole`; patches by direction."""
    x, y, z = planes(0.0, 4.0, 6.0, step=step), planes(0.0, 3.0, 5.0, step=step), planes(0.0, *BAND_M, 3.0, step=step)
    patches = {n: lambda c, normal, a=a, s=s: normal[:, a] * s > 0.5 for n, (a, s) in _SIDES.items()}
    return box_mesh(x, y, z, patches=patches, keep=lambda p: whole | (p[..., 0] < 4.0) | (p[..., 1] < 3.0))


def survey(
    conditions: Conditions, u: dict[str, float], bridge: bool, seed: int, second: bool, whole: bool = False
) -> Drawn:
    """The house on one evening: what both surveys share errs by `seed` alone, all else apart in the `second`."""
    shared, own = (draw(conditions, 1, number) for number in (seed, 1000 * (1 + second) + seed))
    common = ("film factor", emissivity_name(conditions, 0))
    value = {name: float((shared if name in common else own)[name][1]) for name in own.values}
    mesh = house(whole)
    tags = mesh.boundary
    names, facets = tags.patch_names, mesh.facets
    seen = tags.patch != names.index("ground")
    area, weight, nodal = facet_areas(mesh.points_m, facets), np.zeros(len(mesh.points_m)), np.zeros(len(mesh.points_m))
    of_facet = np.array([u.get(name, 0.0) for name in names])[tags.patch]
    for corner in facets[seen].T:  # U at nodes, so that temperatures are continuous
        np.add.at(weight, corner, area[seen])
        np.add.at(nodal, corner, (area * of_facet)[seen])
    nodal /= np.where(weight > 0.0, weight, 1.0)
    if bridge:
        low, high = BAND_M
        west = np.unique(facets[tags.patch == names.index("west")])
        west = west[(mesh.points_m[west, 2] > low - 1e-9) & (mesh.points_m[west, 2] < high + 1e-9)]
        nodal[west] += BAND_U
    film = value["film factor"] * (5.8 + 3.8054 * value["wind"])
    warm_c = value["outside air"] + nodal * (value["inside air"] - value["outside air"]) / film
    emissivity, around_k4 = value[common[1]], celsius_to_kelvin(value["reflected temperature"]) ** 4
    arrives = emissivity * celsius_to_kelvin(warm_c) ** 4 + (1.0 - emissivity) * around_k4
    reading = kelvin_to_celsius(arrives**0.25) - value["camera offset"]
    noise = np.random.default_rng((seed, second)).normal(0.0, 0.03, len(reading))
    of = {name: tags.patch == names.index(name) for name in u}
    mean = {name: float(np.average(nodal[facets[one]].mean(axis=1), weights=area[one])) for name, one in of.items()}
    drawn = replace(
        mesh,
        temperature_c=reading + noise,
        observed=np.ones(len(reading), dtype=bool),
        boundary=replace(tags, seen=seen),
    )
    return Drawn(drawn, mean, {name: float(area[one].sum()) for name, one in of.items()})


def turned(mesh: TetMesh, degrees: float, shift_m: tuple[float, float, float]) -> TetMesh:
    """The mesh, turned about the vertical and shifted."""
    turn = Rotation.from_euler("z", degrees, degrees=True)
    return replace(mesh, points_m=turn.apply(mesh.points_m) + np.array(shift_m))
