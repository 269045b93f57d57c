"""Which patches of a mesh the entries of a heat scene act on."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from fnmatch import fnmatchcase

import numpy as np
import yaml

from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.selection import Selection, matching_names
from thermoxels_ns.heat.scene_fields import Surface
from thermoxels_ns.mesh.tetrahedra import TetMesh

_SIDES = ("exterior-", "interior-")
_OF_THE_MESHER = ("cut",)


class ScenePatches:
    """The patches of a mesh by name, and how much surface each has."""

    def __init__(self, mesh: TetMesh) -> None:

        selection = Selection(mesh)
        area = np.bincount(selection.facet_patch, weights=selection.facet_area_m2, minlength=len(selection.patch_names))
        self.area_m2: dict[str, float] = dict(zip(selection.patch_names, area.tolist()))
        """True area of each patch by its name, [m2]."""

    def matching(self, name: str, patterns: Sequence[str]) -> set[str]:
        """Give the patches that match any pattern of the entry `name`; raises `HeatError` if one matches none."""
        found: set[str] = set()
        for pattern in patterns:
            matches = set(matching_names(self.area_m2, pattern))
            if not matches:
                expected = f"names or patterns of the patches {', '.join(self.area_m2)}"
                remedy = "Correct the name, or tag the mesh so that it has such a patch."
                raise HeatError(f"{name}: patches", expected=expected, got=repr(pattern), remedy=remedy)
            found |= matches
        return found

    def of_surfaces(
        self, surfaces: Sequence[Surface], value: Callable[[Surface], float | None], allowed: set[str] | None = None
    ) -> list[tuple[tuple[str, ...], float]]:
        """Group the patches, written as patterns, by a property of their surfaces; the last entry holds.

        `value` gives the property, None if a surface has none; only `allowed` patches count, None: all.
        """
        chosen: dict[str, float] = {}
        for number, surface in enumerate(surfaces, start=1):
            given = value(surface)
            if given is not None:
                chosen |= dict.fromkeys(self.matching(f"surfaces entry {number}", surface.patches), given)
        groups: dict[float, list[str]] = {}
        for patch in self.area_m2:
            if patch in chosen and (allowed is None or patch in allowed):
                groups.setdefault(chosen[patch], []).append(_as_pattern(patch))
        return [(tuple(names), number) for number, names in groups.items()]

    def check_all_named(self, acting: set[str], adiabatic: Sequence[str]) -> None:
        """Refuse a patch with area that a scene says nothing about: it would be insulated without a word."""
        whole = sum(self.area_m2.values())
        forgotten = [
            patch
            for patch, area in self.area_m2.items()
            if area > 0.0 and patch not in acting and not any(fnmatchcase(patch, pattern) for pattern in adiabatic)
        ]
        if forgotten:
            shares = (f"{patch} ({100.0 * self.area_m2[patch] / whole:.3g} % of the surface)" for patch in forgotten)
            expected, got = "something that acts on every patch, or the patch named adiabatic", ", ".join(shares)
            remedy = f"{_what_may_act(acting, forgotten)}, or write adiabatic: {_yaml_list((*adiabatic, *forgotten))}."
            raise HeatError("heat scene", expected=expected, got=f"nothing on {got}", remedy=remedy)


def check_disjoint(what: str, entries: Sequence[tuple[str, set[str]]], remedy: str) -> None:
    """Refuse entries, given by name and patches, of which two act on one patch."""
    taken: dict[str, str] = {}
    for second, elsewhere in entries:
        for first in sorted({taken[patch] for patch in elsewhere & taken.keys()})[:1]:
            both = sorted(patch for patch in elsewhere if taken.get(patch) == first)
            got = f"{second} on {', '.join(both)} as well"
            raise HeatError(first, expected=f"{what} once on each patch", got=got, remedy=remedy)
        taken |= dict.fromkeys(elsewhere, second)


def _what_may_act(acting: set[str], forgotten: Sequence[str]) -> str:
    """What to do about patches on which nothing acts; those with names of the user's own left exterior-... for them."""
    own = [name for name in forgotten if name not in _OF_THE_MESHER and not name.startswith(_SIDES)]
    if not own:
        return "Add what acts there"
    sides = [f"{side}*" for side in _SIDES if any(name.startswith(side) for name in acting)][:1]
    patches = _yaml_list((*sides, *(_as_pattern(name) for name in own)))
    return f"Name them in the entry that acts on them, such as patches: {patches}"


def _yaml_list(names: Sequence[str]) -> str:
    """Names as a list of a scene file; in quotes where yaml would read more into one."""
    return yaml.safe_dump([*names], default_flow_style=True, allow_unicode=True, width=math.inf).strip()


def _as_pattern(name: str) -> str:
    """Make a pattern that matches a name and nothing else."""
    return "".join(f"[{letter}]" if letter in "*?[" else letter for letter in name)
