"""Patches of boundary triangles and regions of tetrahedra, by default and by a user's rules.

``configs/patches-example.yaml`` explains every key of a user's file.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import yaml
from pydantic import Field

from thermoxels_ns.core.arrays import BoolArray, FloatArray, IntArray
from thermoxels_ns.core.checks import check_direction, replace_when_done
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.core.yaml_records import as_record, raising, read_yaml, wrong
from thermoxels_ns.mesh.tetrahedra import FACET_BOX, TetMesh, facet_normals

FACINGS = ("up", "side", "down")  # Classes of the direction of a normal, see the function `facing`
DEFAULT_PATCHES = (*(f"{where}-{facing}" for where in ("exterior", "interior") for facing in FACINGS), "cut")
"""Names of the patches that every mesh has, from exterior-up to cut; the index of a name is the patch's number."""
DEFAULT_REGION = "solid"  # Name of region 0

Vector = tuple[float, float, float]
_Byte = Annotated[int, Field(ge=0, le=255)]

_NAME = re.compile(r"[a-z][a-z0-9_-]{0,39}")  # solvers do not tell capitals from small letters
_COS_45 = math.sqrt(0.5) + 1e-9
"""A little above the cosine of 45 degrees: a roof of exactly 45 degrees is then a "side" in spite of rounding."""


@dataclass(frozen=True)
class Box:
    """Condition of a rule: the element's centroid lies in an axis-aligned box or on its border."""

    lower: Vector  # Corner with the smallest x, y and z, [m]
    upper: Vector  # Corner with the largest x, y and z, [m]

    def __post_init__(self) -> None:
        if not all(low < high for low, high in zip(self.lower, self.upper)):
            got = f"{[*self.lower]} and {[*self.upper]}"
            raise wrong("corners", "each number of lower below that of upper", got, "Correct them.")


@dataclass(frozen=True)
class Plane:
    """Condition of a rule: the element's centroid lies on a plane, or on the side to which `normal` points."""

    point: Vector  # Any point of the plane, [m]
    normal: Vector  # Direction across the plane, of any length above 0
    depth: Annotated[float, Field(gt=0)] = math.inf  # Largest distance of the centroid from the plane, [m]

    def __post_init__(self) -> None:
        if not (all(map(math.isfinite, self.point)) and 0.0 < math.hypot(*self.normal) < math.inf):
            got = f"{[*self.point]} and {[*self.normal]}"
            raise wrong("point and normal", "finite numbers, and a normal that is not 0", got, "Correct them.")


@dataclass(frozen=True)
class Colour:
    """Condition of a rule: the element's colour is at most `max_distance` from `rgb`."""

    rgb: tuple[_Byte, _Byte, _Byte]  # Red, green and blue, whole numbers from 0 to 255
    max_distance: Annotated[float, Field(gt=0)]  # Largest Euclidean distance to `rgb`, on the same scale


@dataclass(frozen=True)
class RegionRule:
    """A user's rule for a region: a tetrahedron meets the rule if it meets all conditions that are not None."""

    name: str  # Name of the patch or region; several rules may share a name
    box: Box | None = None
    plane: Plane | None = None
    colour: Colour | None = None

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name):
            expected = "up to 40 small letters, digits, - and _ that start with a letter"
            raise wrong("name", expected, repr(self.name), "Rename it.")
        conditions = [*vars(self)][1:]
        if all(getattr(self, key) is None for key in conditions):
            raise wrong(self.name, f"at least one of {', '.join(conditions)}", "only a name")


@dataclass(frozen=True)
class PatchRule(RegionRule):
    """A user's rule for a patch of boundary triangles, with two more conditions than a rule for a region."""

    only: Literal["exterior", "interior", "cut", "all"] | None = None  # Part that the rule applies to; None: all
    facing: Literal["up", "side", "down", "any"] | Vector | None = None
    """Class of the outward normal, see the function `facing`, or a vector less than 45 degrees from it; None: any."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if isinstance(self.facing, tuple) and not 0.0 < math.hypot(*self.facing) < math.inf:
            raise wrong("facing", "up, side, down, any, or a direction that is not 0", [*self.facing])


@dataclass(frozen=True)
class PatchRules:
    """A user's rules for patches and regions, in the order of the file. An element follows the last rule it meets."""

    patches: tuple[PatchRule, ...] = ()  # Rules for boundary triangles
    regions: tuple[RegionRule, ...] = ()  # Rules for tetrahedra


@raising(MeshError)
def load_patch_rules(path: Path | str) -> PatchRules:
    """Read a user's rules for patches and regions from a yaml file.

    Raises `MeshError` if the file does not exist or is no yaml, or if an entry is not valid (the message names it).
    """
    path = Path(path)
    rules = as_record(path.name, read_yaml(path), PatchRules)
    for kind, entries, taken in (
        ("patches", rules.patches, DEFAULT_PATCHES),
        ("regions", rules.regions, (DEFAULT_REGION,)),
    ):
        for number, entry in enumerate(entries, start=1):
            if entry.name in taken:
                name, expected = f"{path.name}: {kind} entry {number}: name", f"a name other than {', '.join(taken)}"
                raise wrong(name, expected, entry.name, "Choose another name.")
    return rules


class Applied(NamedTuple):
    """The patches of triangles, or the regions of tetrahedra, after all rules were applied."""

    number: IntArray  # Index in `names` of each element's patch or region, shape (n,)
    names: tuple[str, ...]  # Names of all patches or regions
    idle: tuple[str, ...]
    """Rules such as "patch roof (entry 2)" that no element follows: none meets it, or these meet later rules too."""


def facing(normals: FloatArray, up: npt.ArrayLike) -> IntArray:
    """Return the class of the direction of each unit normal (f, 3), as indices into `FACINGS`, shape (f,).

    A normal at less than 45 degrees to `up` is "up", at more than 135 degrees "down", else "side".

    Raises:
        MeshError: `up` is not three finite numbers, or is zero.

    >>> facing(np.array([[0, 0, 1.0], [1, 0, 0], [0, 0.6, -0.8]]), up=(0, 0, 2)).tolist()
    [0, 1, 2]
    """
    cosine = np.asarray(normals) @ check_direction("up", up, "Pass the direction away from the ground.", MeshError)
    return np.where(cosine > _COS_45, 0, np.where(cosine < -_COS_45, 2, 1)).astype(np.int64)


def apply_patches(
    rules: PatchRules,
    *,
    centroids_m: FloatArray,
    normals: FloatArray,
    up: npt.ArrayLike,
    seen: BoolArray,
    on_box: BoolArray,
    colours: npt.NDArray | None = None,
) -> Applied:
    """Return the patch of each boundary triangle: that of the last rule it meets, or else one of `DEFAULT_PATCHES`.

    The default patch of a triangle with `on_box` is "cut". The names of the others are "exterior" if `seen` is True, or
    "interior" if it is False, and then the class of the normal by `facing`, as in "exterior-up".

    Args:
        rules: The user's rules.
        centroids_m: Centroid of each boundary triangle, shape (f, 3), [m].
        normals: Outward unit normals in the axes of the centroids, shape (f, 3).
        up: Up direction in the axes of the centroids.
        seen: True for triangles that count as exterior, such as those that some camera sees, shape (f,).
        on_box: True for triangles at which the scene box or the region of an export cuts the solid, shape (f,).
        colours: Red, green, blue in [0, 1] of each triangle, shape (f, 3); None if not known.

    Raises:
        MeshError: A rule has a colour but `colours` is None, or `up` is no direction.
    """
    direction = facing(normals, up)
    patch = np.where(on_box, DEFAULT_PATCHES.index("cut"), np.where(seen, 0, len(FACINGS)) + direction)
    everywhere = np.ones(len(patch), dtype=bool)
    parts = {"exterior": ~on_box & seen, "interior": ~on_box & ~seen, "cut": on_box}
    facings = {name: direction == number for number, name in enumerate(FACINGS)}

    def faces(rule: PatchRule) -> BoolArray:
        if isinstance(rule.facing, tuple):
            return normals @ (np.array(rule.facing) / math.hypot(*rule.facing)) > _COS_45
        return facings.get(rule.facing or "any", everywhere)

    allowed = [parts.get(rule.only or "all", everywhere) & faces(rule) for rule in rules.patches]
    return _applied(rules.patches, "patch", allowed, patch, DEFAULT_PATCHES, centroids_m, colours)


def with_patches(
    mesh: TetMesh, rules: PatchRules, up: npt.ArrayLike, outside: BoolArray | None = None
) -> tuple[TetMesh, tuple[str, ...]]:
    """Return a copy of a mesh whose patches follow a user's rules, and the rules that no triangle follows.

    `outside`, shape (f,), is True for triangles that count as exterior. If it is None, they are all that cameras see.
    """
    patch, names, idle = apply_patches(
        rules,
        centroids_m=mesh.points_m[mesh.facets].mean(axis=1),
        normals=facet_normals(mesh.points_m, mesh.facets),
        up=up,
        seen=mesh.boundary.seen if outside is None else outside,
        on_box=mesh.facet_tags == FACET_BOX,
        colours=None if mesh.colour is None else mesh.colour[mesh.facets].mean(axis=1),
    )
    return replace(mesh, boundary=replace(mesh.boundary, patch=patch, patch_names=names)), idle


def write_patch_rules(path: Path, rules: PatchRules, heading: str) -> None:
    """Write rules for patches as a yaml file that `load_patch_rules` reads, below a comment of one line."""
    plain = [asdict(rule, dict_factory=_told) for rule in rules.patches]
    lines = (yaml.safe_dump(one, default_flow_style=True, sort_keys=False, width=10_000) for one in plain)
    with replace_when_done(path) as temporary:
        temporary.write_text(f"# {heading}\npatches:\n" + "".join(f"  - {line}" for line in lines), encoding="utf-8")


def _told(fields: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return the fields of a rule as a dictionary without None and infinite values, which set no condition."""
    return {name: value for name, value in fields if value is not None and value != math.inf}


def apply_regions(rules: PatchRules, tet_centroids: FloatArray, tet_colours: npt.NDArray | None = None) -> Applied:
    """Return the regions of tetrahedra by a user's rules; tetrahedra that follow no rule are in region 0, "solid".

    Centroids (t, 3) are in [m], colours (t, 3) in [0, 1]. Raises `MeshError` if colours are None but a rule has one.
    """
    count = len(tet_centroids)
    allowed = [np.ones(count, dtype=bool)] * len(rules.regions)
    start = np.zeros(count, dtype=np.int64)
    return _applied(rules.regions, "region", allowed, start, (DEFAULT_REGION,), tet_centroids, tet_colours)


def _applied(
    rules: Sequence[RegionRule],
    kind: str,
    allowed: Sequence[BoolArray],
    start: IntArray,
    names: tuple[str, ...],
    centroids: FloatArray,
    colours: npt.NDArray | None,
) -> Applied:
    """Return the patches or regions by rules; an element that meets none keeps its default `start` (n,), an index into
    `names`. Rule k needs True in the mask `allowed[k]` (n,); box, plane and colour are checked here."""
    owner = np.full(len(start), -1, dtype=np.int64)
    for number, (rule, mask) in enumerate(zip(rules, allowed)):
        inside = mask.copy()
        if rule.box is not None:
            inside &= np.all((centroids >= rule.box.lower) & (centroids <= rule.box.upper), axis=1)
        if rule.plane is not None:
            distance = (centroids - rule.plane.point) @ np.array(rule.plane.normal)
            inside &= (distance >= 0.0) & (distance <= rule.plane.depth * math.hypot(*rule.plane.normal))
        if rule.colour is not None:
            if colours is None:
                expected = "a mesh with colours, because its rule is by colour"
                remedy = "Use box or plane, or a model that was trained on colour photographs."
                raise MeshError(f"{kind} {rule.name}", expected=expected, got="a mesh without", remedy=remedy)
            away = np.linalg.norm(255.0 * colours - np.array(rule.colour.rgb), axis=1)
            inside &= away <= rule.colour.max_distance
        owner[inside] = number

    all_names = tuple(dict.fromkeys((*names, *(rule.name for rule in rules))))
    index = np.append([all_names.index(rule.name) for rule in rules], 0).astype(np.int64)[owner]
    followed = np.bincount(owner[owner >= 0], minlength=len(rules)) > 0
    idle = (f"{kind} {rule.name} (entry {n})" for n, rule in enumerate(rules, start=1) if not followed[n - 1])
    return Applied(np.where(owner >= 0, index, start), all_names, tuple(idle))
