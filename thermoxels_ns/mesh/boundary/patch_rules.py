"""A user's rules for patches and regions, and the yaml file that they stand in.

``configs/patches-example.yaml`` explains every key.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from thermoxels_ns.core.errors import MeshError

FACINGS = ("up", "side", "down")
"""Where a surface may face."""
DEFAULT_PATCHES = (*(f"{where}-{facing}" for where in ("exterior", "interior") for facing in FACINGS), "cut")
"""Names of the patches that every mesh has, in this order."""
DEFAULT_REGION = "solid"
"""Name of region 0."""

Vector = tuple[float, float, float]

_ONLY = ("exterior", "interior", "cut", "all")
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,39}")


@dataclass(frozen=True)
class Rule:
    """What belongs to a patch or to a region: everything that meets all conditions that are given."""

    name: str
    """Name of the patch or region; rules of the same name add up."""
    box: tuple[Vector, Vector] | None = None
    """Lower and upper corner of an axis-aligned box around the centroid, [m]."""
    plane: tuple[Vector, Vector] | None = None
    """Point [m] and unit normal of a plane; the centroid is on the side that the normal points to."""
    colour: Vector | None = None
    """Red, green, blue in [0, 1]; of all rules that have one and whose other conditions hold, the closest wins."""
    max_colour_distance: float = math.inf
    """Longest distance to `colour`, root of the sum of the squared differences of red, green and blue in [0, 1]."""
    only: str = "all"
    """Part of the boundary: exterior, interior, cut or all."""
    facing: str = "any"
    """Where the normal points: up, side, down or any."""


@dataclass(frozen=True)
class PatchRules:
    """A user's patches and regions, in the order of the file: later rules win."""

    patches: tuple[Rule, ...] = ()
    """Rules for boundary triangles."""
    regions: tuple[Rule, ...] = ()
    """Rules for tetrahedra."""


def load_patch_rules(path: Path | str) -> PatchRules:
    """Read a user's patches and regions from a yaml file.

    Raises:
        MeshError: No such file, no yaml, or an entry that cannot be understood; the message says which.
    """
    path = Path(path)
    try:
        content = yaml.load(path.read_text(encoding="utf-8"), Loader=_UniqueKeyLoader)
    except OSError as problem:
        raise _wrong(str(path), "a yaml file with patches and regions", problem.strerror or problem) from problem
    except (yaml.YAMLError, UnicodeDecodeError) as problem:
        raise _wrong(path.name, "a yaml file", problem) from problem
    lists = _mapping(path.name, content, ("patches", "regions"))
    patches = _rules(f"{path.name}: patches", lists.get("patches", []), DEFAULT_PATCHES, ("only", "facing"))
    return PatchRules(patches, _rules(f"{path.name}: regions", lists.get("regions", []), (DEFAULT_REGION,), ()))


class _UniqueKeyLoader(yaml.SafeLoader):
    """Refuses a key that stands twice in one mapping, where yaml forgets the first."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = [key.value for key, _ in node.value]
        twice = next((key for number, (key, _) in enumerate(node.value) if key.value in keys[:number]), None)
        if twice is not None:
            raise yaml.constructor.ConstructorError(None, None, f"the key {twice.value} twice", twice.start_mark)
        return super().construct_mapping(node, deep)


def _rules(name: str, content: object, taken: tuple[str, ...], restrictions: tuple[str, ...]) -> tuple[Rule, ...]:
    if not isinstance(content, list):
        raise _wrong(name, "a list of entries, each with a dash before its name", _shown(content))
    known = {known.lower(): known for known in taken}
    rules = []
    for number, entry in enumerate(content, start=1):
        rule = _rule(f"{name} entry {number}", entry, restrictions)
        before = known.setdefault(rule.name.lower(), rule.name)
        if before in taken or before != rule.name:
            raise _wrong(
                f"{name} entry {number}: name",
                f"a name other than {', '.join(taken)}" if before in taken else f"{before}, as above, or another name",
                rule.name,
                "Choose another name; solvers do not tell capitals from small letters.",
            )
        rules.append(rule)
    return tuple(rules)


def _rule(name: str, content: object, restrictions: tuple[str, ...]) -> Rule:
    conditions = ("box", "plane", "nearest_colour", *restrictions)
    entry = _mapping(name, content, ("name", *conditions), needed=("name",))
    label = entry["name"]
    if not isinstance(label, str) or not _NAME.fullmatch(label):
        raise _wrong(
            f"{name}: name", "up to 40 letters, digits, - and _ that start with a letter", _shown(label), "Rename it."
        )
    if len(entry) == 1:
        raise _wrong(f"{name} ({label})", f"at least one of {', '.join(conditions)}", "only a name")
    name = f"{name} ({label})"
    rule: dict[str, Any] = {"name": label}
    if "box" in entry:
        rule["box"] = _box(f"{name}: box", entry["box"])
    if "plane" in entry:
        rule["plane"] = _plane(f"{name}: plane", entry["plane"])
    if "nearest_colour" in entry:
        rule["colour"], rule["max_colour_distance"] = _colour(f"{name}: nearest_colour", entry["nearest_colour"])
    for key, choices in (("only", _ONLY), ("facing", (*FACINGS, "any"))):
        if key in entry:
            if entry[key] not in choices:
                raise _wrong(f"{name}: {key}", f"one of {', '.join(choices)}", _shown(entry[key]))
            rule[key] = entry[key]
    return Rule(**rule)


def _box(name: str, content: object) -> tuple[Vector, Vector]:
    entry = _mapping(name, content, ("lower", "upper"), needed=("lower", "upper"))
    lower, upper = (_three(f"{name}.{key}", entry[key], finite=False) for key in ("lower", "upper"))
    if not all(low < high for low, high in zip(lower, upper)):
        raise _wrong(name, "each number of lower below that of upper", f"{[*lower]} and {[*upper]}", "Correct them.")
    return lower, upper


def _plane(name: str, content: object) -> tuple[Vector, Vector]:
    entry = _mapping(name, content, ("point", "normal"), needed=("point", "normal"))
    point, normal = (_three(f"{name}.{key}", entry[key]) for key in ("point", "normal"))
    length = math.hypot(*normal)
    if not 0.0 < length < math.inf:
        raise _wrong(f"{name}.normal", "three numbers that are not all 0", [*normal])
    x, y, z = normal
    return point, (x / length, y / length, z / length)


def _colour(name: str, content: object) -> tuple[Vector, float]:
    entry = _mapping(name, content, ("rgb", "max_distance"), needed=("rgb",))
    red, green, blue = rgb = _three(f"{name}.rgb", entry["rgb"])
    if min(rgb) < 0.0 or max(rgb) > 255.0:
        raise _wrong(f"{name}.rgb", "three numbers from 0 to 255, or from 0.0 to 1.0", entry["rgb"])
    whole = all(isinstance(value, int) for value in entry["rgb"])
    if whole and max(rgb) == 1.0:
        raise _wrong(
            f"{name}.rgb",
            "whole numbers up to 255 or decimals up to 1.0",
            f"{entry['rgb']}, which may be either",
            f"Write {[*rgb]} for a bright colour or {[round(value / 255.0, 4) for value in rgb]} for a dark one.",
        )
    scale = 255.0 if whole or max(rgb) > 1.0 else 1.0
    most = math.inf
    if "max_distance" in entry:
        most = _number(f"{name}.max_distance", entry["max_distance"])
        if not most > 0.0:
            raise _wrong(f"{name}.max_distance", "a number above 0, on the scale of rgb", most)
    return (red / scale, green / scale, blue / scale), most / scale


def _three(name: str, content: object, *, finite: bool = True) -> Vector:
    if not isinstance(content, list) or len(content) != 3:
        raise _wrong(name, "three numbers in square brackets", _shown(content))
    x, y, z = (_number(name, value, finite=finite) for value in content)
    return x, y, z


def _number(name: str, content: object, *, finite: bool = True) -> float:
    if isinstance(content, (int, float)) and not isinstance(content, bool):
        number = float(content)
        if math.isfinite(number) or (math.isinf(number) and not finite):
            return number
    raise _wrong(
        name,
        "a finite number" if finite else "a number",
        _shown(content),
        "Write it without quotes and without a unit, with a point and a sign in a power of ten, as in 1.0e-3.",
    )


def _mapping(name: str, content: object, known: Sequence[str], needed: Sequence[str] = ()) -> dict[str, Any]:
    """Return `content` if it is a mapping with keys out of `known`, all of `needed` among them."""
    if not isinstance(content, dict) or not content:
        raise _wrong(name, f"the keys {', '.join(known)}", _shown(content))
    for key in content:
        if key not in known:
            raise _wrong(name, f"keys out of {', '.join(known)}", _shown(key), "Correct or remove that key.")
    for key in needed:
        if key not in content:
            raise _wrong(name, f"the key {key}", ", ".join(content), f"Add {key}.")
    return content


def _shown(content: object) -> str:
    return "nothing" if content is None else repr(content)


def _wrong(
    name: str, expected: str, got: object, remedy: str = "Correct the file; configs/patches-example.yaml explains it."
) -> MeshError:
    return MeshError(name, expected=expected, got=got, remedy=remedy)
