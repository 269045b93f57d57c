"""Patches of boundary triangles and regions of tetrahedra, default ones and a user's."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import BoolArray, FloatArray, IntArray
from thermoxels_ns.core.checks import check_direction, check_finite, check_shape
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.boundary.patch_rules import DEFAULT_PATCHES, DEFAULT_REGION, FACINGS, PatchRules, Rule

_COS_45 = math.sqrt(0.5) + 1e-9
"""A little above the cosine of 45 degrees, so that a roof of exactly 45 degrees is a side whatever its rounding."""


class Applied(NamedTuple):
    """What rules make of some elements."""

    number: IntArray  # Index of each element's patch or region, shape (n,)
    names: tuple[str, ...]  # Names of all patches or regions
    idle: tuple[str, ...]
    """Rules that no element follows, such as "patch roof (entry 2)": none meets their conditions, or later rules take
    all that do."""


def facing(normals: FloatArray, up: npt.ArrayLike) -> IntArray:
    """Where unit normals (f, 3) point: index into `FACINGS`, shape (f,).

    Up is less than 45 degrees off the up direction, down more than 135 degrees, all else is side.

    Raises:
        MeshError: `up` is no direction.

    >>> facing(np.array([[0, 0, 1.0], [1, 0, 0], [0, 0.6, -0.8]]), up=(0, 0, 2)).tolist()
    [0, 1, 2]
    """
    direction = check_direction("up", up, "Pass the direction away from the ground.", MeshError)
    cosine = np.asarray(normals) @ (direction / float(np.linalg.norm(direction)))
    return np.where(cosine > _COS_45, 0, np.where(cosine < -_COS_45, 2, 1)).astype(np.int64)


def default_patches(
    normals: FloatArray, up: npt.ArrayLike, seen: BoolArray, on_box: BoolArray
) -> tuple[IntArray, tuple[str, ...]]:
    """Patches that need no rules: cut by the scene box, else exterior (seen) or interior, facing up, sideways or down.

    Arguments are those of `apply_patches`; also the names of all patches, `DEFAULT_PATCHES`.
    """
    patch = np.where(seen, 0, len(FACINGS)) + facing(normals, up)
    return np.where(on_box, DEFAULT_PATCHES.index("cut"), patch).astype(np.int64), DEFAULT_PATCHES


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
    """Each triangle's patch: default patches with a user's rules over them; the default names come first.

    Args:
        rules: The user's rules; without any, the default patches come back.
        centroids_m: Middle of each boundary triangle, shape (f, 3), [m].
        normals: Outward unit normals of the true surface in the same axes, shape (f, 3).
        up: Up direction in the same axes.
        seen: True where some camera sees the triangle, shape (f,).
        on_box: True where the scene box cuts the solid, shape (f,).
        colours: Red, green, blue in [0, 1] of each triangle, shape (f, 3); None if not known.

    Raises:
        MeshError: A rule asks for colours and there are none, `up` is no direction, or shapes do not fit.
    """
    patch, names = default_patches(normals, up, seen, on_box)
    direction = facing(normals, up)
    surfaces = {
        "exterior": ~on_box & seen,
        "interior": ~on_box & ~seen,
        "cut": on_box,
        "all": np.ones(len(patch), dtype=bool),
    }
    allowed = [
        surfaces[rule.only] & (True if rule.facing == "any" else direction == FACINGS.index(rule.facing))
        for rule in rules.patches
    ]
    owner = _rule_of_each(rules.patches, "patch", allowed, len(patch), centroids_m, colours)
    return _applied(rules.patches, "patch", owner, patch, names)


def apply_regions(rules: PatchRules, tet_centroids: FloatArray, tet_colours: npt.NDArray | None = None) -> Applied:
    """Regions of tetrahedra by a user's rules; what no rule claims is region 0, "solid".

    Centroids (t, 3) are in metres, colours (t, 3) red, green, blue in [0, 1]; None if not known.

    Raises:
        MeshError: A rule asks for colours and there are none, or shapes do not fit.
    """
    count = len(tet_centroids)
    allowed = [np.ones(count, dtype=bool)] * len(rules.regions)
    owner = _rule_of_each(rules.regions, "region", allowed, count, tet_centroids, tet_colours)
    return _applied(rules.regions, "region", owner, np.zeros(count, dtype=np.int64), (DEFAULT_REGION,))


def _applied(rules: Sequence[Rule], kind: str, owner: IntArray, start: IntArray, names: tuple[str, ...]) -> Applied:
    """Overwrite `start` where a rule owns the element, and append the rules' names."""
    all_names = tuple(dict.fromkeys((*names, *(rule.name for rule in rules))))
    number = np.array([all_names.index(rule.name) for rule in rules], dtype=np.int64)
    index = start.copy()
    owned = owner >= 0
    index[owned] = number[owner[owned]]
    followed = np.bincount(owner[owned], minlength=len(rules)) > 0
    idle = (f"{kind} {rule.name} (entry {n})" for n, rule in enumerate(rules, start=1) if not followed[n - 1])
    return Applied(index, all_names, tuple(idle))


def _rule_of_each(
    rules: Sequence[Rule],
    kind: str,
    allowed: Sequence[BoolArray],
    count: int,
    centroids: FloatArray,
    colours: npt.NDArray | None,
) -> IntArray:
    """Number of the rule that each of `count` elements follows, -1 for none, shape (count,).

    `allowed` says for each rule where `only` and `facing` hold.
    """
    remedy = f"Pass one centroid and one colour per element that gets a {kind}."
    check_shape("centroids", centroids, (count, 3), remedy, MeshError)
    check_finite("centroids", centroids, remedy, MeshError)
    matches = []
    for rule, mask in zip(rules, allowed):  # the borders of boxes and planes belong to them
        inside = mask.copy()
        if rule.box is not None:
            lower, upper = rule.box
            inside &= np.all((centroids >= lower) & (centroids <= upper), axis=1)
        if rule.plane is not None:
            point, normal = rule.plane
            inside &= (centroids - point) @ np.array(normal) >= 0.0
        matches.append(inside)

    coloured = [number for number, rule in enumerate(rules) if rule.colour is not None]
    if coloured:
        if colours is None:
            raise MeshError(
                f"{kind} {rules[coloured[0]].name}",
                expected="a mesh with colours, because its rule is by nearest_colour",
                got="a mesh without",
                remedy="Use box or plane, or a model that was trained on colour photographs.",
            )
        check_shape("colours", colours, (count, 3), remedy, MeshError)
        closest = np.full(count, np.inf)
        winner = np.full(count, -1)
        for number in coloured:
            rule = rules[number]
            distance = np.linalg.norm(colours - rule.colour, axis=1)
            wins = matches[number] & (distance <= rule.max_colour_distance) & (distance <= closest)
            closest[wins], winner[wins] = distance[wins], number
        for number in coloured:
            matches[number] = winner == number

    owner = np.full(count, -1, dtype=np.int64)
    for number, match in enumerate(matches):
        owner[match] = number
    return owner
