"""The names of synthetic scenes, and the scene of each name."""

from __future__ import annotations

import dataclasses
import re
import zlib
from collections.abc import Callable
from functools import cache

from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.synthetic import drawn_scenes
from thermoxels_ns.synthetic.appearance import plain
from thermoxels_ns.synthetic.drawn_scenes import HOUSE
from thermoxels_ns.synthetic.random_scene import random_scene, random_seed, with_room, with_street
from thermoxels_ns.synthetic.scene_truth import SyntheticScene

_BUILDERS: dict[str, Callable[..., SyntheticScene]] = {
    "hot-object": drawn_scenes.hot_object,
    HOUSE: drawn_scenes.house_corner,
    "sphere": drawn_scenes.sphere,
    "courtyard": drawn_scenes.courtyard,
    "pipes": drawn_scenes.pipes,
    "wall-object": drawn_scenes.wall_object,
    "facade": drawn_scenes.facade,
    "street": drawn_scenes.street,
}
DEVELOPMENT_NAMES = ("wall-object", "facade", "street")  # names of hand-drawn scenes that are hard, for development
SCENE_NAMES = tuple(name for name in _BUILDERS if name not in DEVELOPMENT_NAMES)
"""Names of the other hand-drawn scenes; `make_scene` also knows `DEVELOPMENT_NAMES`, `random-N` and `wild-N`."""

VARIANTS = "+sky=R,G,B, +white, +street, +room"
"""Endings of a name, in any order: a sky of one colour (0 to 1); white plaster under a white sky (house-corner only);
houses and trees around the scene; a room around the scene. Street and room exclude each other."""
_SKY = re.compile(r"sky=((?:0?\.\d+|[01](?:\.0*)?)(?:,(?:0?\.\d+|[01](?:\.0*)?)){2})")


def check_scene_name(name: str) -> str:
    """Return `name` if `make_scene` knows it; raise a `SceneError` that lists the known names otherwise.

    >>> check_scene_name("random-17")
    'random-17'
    """
    base, *variants = name.split("+")
    kinds = {variant.split("=")[0] for variant in variants}
    known = base in _BUILDERS or random_seed(base) is not None
    known &= all(variant in ("white", "street", "room") or _SKY.fullmatch(variant) for variant in variants)
    if not known or len(kinds) < len(variants) or kinds >= {"street", "room"} or ("white" in kinds and base != HOUSE):
        every = ", ".join(_BUILDERS)
        expected = f"random-N or wild-N with a whole number N from 0 on, or one of {every}; with {VARIANTS} if you like"
        remedy = f"Choose one of these names, or write random-17 or {HOUSE}+sky=0.55,0.57,0.60."
        raise SceneError("synthetic scene", expected=expected, got=repr(name), remedy=remedy)
    return name


@cache
def make_scene(name: str) -> SyntheticScene:
    """Return the synthetic scene of a name.

    A name is one of `SCENE_NAMES` or `DEVELOPMENT_NAMES`, or ``random-`` or ``wild-`` and a seed without leading zeros.
    Some of `VARIANTS` may follow, such as ``sphere+sky=1,1,1`` or ``random-3+street``.

    Raises:
        SceneError: No scene has this name; the message lists the known names.

    >>> make_scene("sphere").temperature_bounds_c
    (10.0, 40.0)
    """
    base, *variants = check_scene_name(name).split("+")
    if base in _BUILDERS:
        scene = _BUILDERS[base](**({"white": True} if "white" in variants else {}))
    else:
        scene = random_scene(int(base.split("-")[1]), wild=base.startswith("wild"))
    for variant in sorted(variants):
        if sky := _SKY.fullmatch(variant):
            scene = dataclasses.replace(scene, background_rgb=plain([float(c) for c in sky[1].split(",")]))
        elif variant != "white":
            scene = (with_street if variant == "street" else with_room)(scene, seed=zlib.crc32(base.encode()))
    return dataclasses.replace(scene, name=name)
