"""A user's rules for patches and regions; ``configs/patches-example.yaml`` explains every key."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.core.yaml_records import as_record, raising, read_yaml, wrong

FACINGS = ("up", "side", "down")  # Where a surface may face
DEFAULT_PATCHES = (*(f"{where}-{facing}" for where in ("exterior", "interior") for facing in FACINGS), "cut")
"""Names of the patches that every mesh has, in this order."""
DEFAULT_REGION = "solid"  # Name of region 0

Vector = tuple[float, float, float]

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,39}")


@dataclass(frozen=True)
class Rule:
    """What belongs to a patch or to a region: everything that meets all conditions that are given."""

    name: str  # Name of the patch or region; rules of the same name add up
    box: tuple[Vector, Vector] | None = None  # Lower and upper corner of an axis-aligned box around the centroid, [m]
    plane: tuple[Vector, Vector] | None = None
    """Point [m] and unit normal of a plane; the centroid is on the side that the normal points to."""
    colour: Vector | None = None
    """Red, green, blue in [0, 1]; of all rules that have one and whose other conditions hold, the closest wins."""
    max_colour_distance: float = math.inf
    """Longest distance to `colour`, root of the sum of the squared differences of red, green and blue in [0, 1]."""
    only: str = "all"  # Part of the boundary: exterior, interior, cut or all
    facing: str = "any"  # Where the normal points: up, side, down or any


@dataclass(frozen=True)
class PatchRules:
    """A user's patches and regions, in the order of the file: later rules win."""

    patches: tuple[Rule, ...] = ()  # Rules for boundary triangles
    regions: tuple[Rule, ...] = ()  # Rules for tetrahedra


@dataclass(frozen=True)
class _Box:
    """Two corners in a file."""

    lower: Vector
    upper: Vector

    def __post_init__(self) -> None:
        if not all(low < high for low, high in zip(self.lower, self.upper)):
            got = f"{[*self.lower]} and {[*self.upper]}"
            raise wrong("corners", "each number of lower below that of upper", got, "Correct them.")


@dataclass(frozen=True)
class _Plane:
    """A plane in a file."""

    point: Vector
    normal: Vector

    def __post_init__(self) -> None:
        if not (all(map(math.isfinite, self.point)) and 0.0 < math.hypot(*self.normal) < math.inf):
            got = f"{[*self.point]} and {[*self.normal]}"
            raise wrong("point and normal", "finite numbers, and a normal that is not 0", got, "Correct them.")


@dataclass(frozen=True)
class _Colour:
    """A colour in a file, in whole numbers to 255 or in decimals to 1.0."""

    rgb: tuple[int | float, int | float, int | float]
    max_distance: float = math.inf

    def __post_init__(self) -> None:
        if not all(0.0 <= float(part) <= 255.0 for part in self.rgb):
            raise wrong("rgb", "three numbers from 0 to 255, or from 0.0 to 1.0", [*self.rgb])
        if self.whole and max(map(float, self.rgb)) == 1.0:
            bright, dark = [float(part) for part in self.rgb], [round(float(part) / 255.0, 4) for part in self.rgb]
            raise wrong(
                "rgb",
                "whole numbers up to 255 or decimals up to 1.0",
                f"{[*self.rgb]}, which may be either",
                f"Write {bright} for a bright colour or {dark} for a dark one.",
            )
        if not self.max_distance > 0.0:
            raise wrong("max_distance", "a number above 0, on the scale of rgb", self.max_distance)

    @property
    def whole(self) -> bool:
        """Whether it is written in whole numbers."""
        return all(isinstance(part, int) for part in self.rgb)

    @property
    def scale(self) -> float:
        """What its numbers are divided by to lie in [0, 1]."""
        return 255.0 if self.whole or max(map(float, self.rgb)) > 1.0 else 1.0


@dataclass(frozen=True)
class _RegionEntry:
    """What a file says of a region."""

    name: str
    box: _Box | None = None
    plane: _Plane | None = None
    nearest_colour: _Colour | None = None

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name):
            expected = "up to 40 letters, digits, - and _ that start with a letter"
            raise wrong("name", expected, repr(self.name), "Rename it.")
        conditions = [*vars(self)][1:]
        if all(getattr(self, key) is None for key in conditions):
            raise wrong(self.name, f"at least one of {', '.join(conditions)}", "only a name")

    def rule(self) -> Rule:
        """Make the rule."""
        conditions = dict(vars(self))  # of a patch more than of a region
        box, plane, colour = (conditions.pop(key) for key in ("box", "plane", "nearest_colour"))
        if box is not None:
            conditions["box"] = (box.lower, box.upper)
        if plane is not None:
            length = math.hypot(*plane.normal)
            conditions["plane"] = (plane.point, tuple(part / length for part in plane.normal))
        if colour is not None:
            conditions["colour"] = tuple(float(part) / colour.scale for part in colour.rgb)
            conditions["max_colour_distance"] = colour.max_distance / colour.scale
        return Rule(**{key: value for key, value in conditions.items() if value is not None})


@dataclass(frozen=True)
class _PatchEntry(_RegionEntry):
    """What a file says of a patch."""

    only: Literal["exterior", "interior", "cut", "all"] | None = None
    facing: Literal["up", "side", "down", "any"] | None = None


@dataclass(frozen=True)
class _File:
    """A file of patches and regions."""

    patches: tuple[_PatchEntry, ...] = ()
    regions: tuple[_RegionEntry, ...] = ()


@raising(MeshError)
def load_patch_rules(path: Path | str) -> PatchRules:
    """Read a user's patches and regions from a yaml file.

    Raises:
        MeshError: No such file, no yaml, or an entry that cannot be understood; the message says which.
    """
    path = Path(path)
    file = as_record(path.name, read_yaml(path), _File)
    _check_names(f"{path.name}: patches", file.patches, DEFAULT_PATCHES)
    _check_names(f"{path.name}: regions", file.regions, (DEFAULT_REGION,))
    return PatchRules(*(tuple(entry.rule() for entry in entries) for entries in (file.patches, file.regions)))


def _check_names(where: str, entries: tuple[_RegionEntry, ...], taken: tuple[str, ...]) -> None:
    """Refuse names of the mesher's own, and names that differ in capitals alone."""
    known = {name.lower(): name for name in taken}
    for number, entry in enumerate(entries, start=1):
        before = known.setdefault(entry.name.lower(), entry.name)
        if before in taken or before != entry.name:
            expected = f"a name other than {', '.join(taken)}" if before in taken else f"{before}, as above, or another"
            remedy = "Choose another name; solvers do not tell capitals from small letters."
            raise wrong(f"{where} entry {number}: name", expected, entry.name, remedy)
