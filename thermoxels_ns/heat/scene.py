"""Heat scenes (materials, surroundings and time), made in code or read from yaml files, and their problem on a mesh.

``configs/scene-all-effects.yaml`` explains every key of a file.
"""

from __future__ import annotations

import glob
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from copy import deepcopy
from dataclasses import fields, make_dataclass, replace
from fnmatch import fnmatchcase
from functools import cache, partial
from itertools import combinations
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_type_hints

import numpy as np
import yaml
from pydantic import Discriminator, Field, Tag

from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.core.measured import read_measured
from thermoxels_ns.core.yaml_records import as_record, configs_folder, raising, read_yaml, record, wrong
from thermoxels_ns.fem.problem import AdaptiveSteps, HeatProblem, Quantity, TimeSteps, Varying
from thermoxels_ns.fem.selection import Places, Selection, chosen_names, matching_names
from thermoxels_ns.heat.effects import (
    AbsorbedSolar,
    Celsius,
    Convection,
    Effect,
    FixedTemperature,
    GroundContact,
    HeatFlux,
    InternalHeat,
    Radiation,
)
from thermoxels_ns.heat.materials import Material, material, with_names
from thermoxels_ns.heat.scene_fields import (
    INSIDE,
    OUTSIDE,
    WITH_RADIATION,
    Direction,
    Ground,
    InsideAir,
    OutsideAir,
    Sky,
    Sun,
    Surface,
    unclear,
)
from thermoxels_ns.heat.sky import Vector, outdoor_radiation, swinbank_sky_c
from thermoxels_ns.mesh.boundary.patches import DEFAULT_PATCHES
from thermoxels_ns.mesh.tetrahedra import TetMesh

Section = TypeVar("Section", InsideAir | None, OutsideAir | None, Surface, Sun | None, Radiation, AbsorbedSolar)
Shining = TypeVar("Shining", Radiation, AbsorbedSolar)

DEFAULTS = (INSIDE, OUTSIDE)  # Default patches of sections

_Z_UP: Vector = (0.0, 0.0, 1.0)
_ANY_START_C = 10.0  # initial temperature of a steady solver's iterations on a mesh without one, [degrees Celsius]
_PATCHES_OF_THEIR_OWN = "Give each of the two its own patches: [names]."


@record(HeatError)
class HeatScene:
    """A heat scene: materials, surroundings and time. Only effects that the scene names act on the body."""

    materials: Annotated[Mapping[str, Material], Field(min_length=1)]
    """Materials by name or pattern of the mesh's regions; if several patterns match a region, the last one holds."""
    time: TimeSteps | AdaptiveSteps | None = None
    """Time steps in which the body is followed; None: the steady state is asked for."""
    initial_c: Celsius | None = None
    """Temperature of the whole body at the start, [degrees Celsius]; None: the temperatures of the mesh."""
    up: Direction | None = None  # Up direction in the mesh's coordinates; None: the argument `up` of `problem`
    inside_air: InsideAir | None = None  # The air of a room
    outside_air: OutsideAir | None = None  # The open air and its wind
    surfaces: tuple[Surface, ...] = ()  # Emissivity and absorptivity of patches; the last entry for a patch holds
    sky: Sky | None = None  # The sky that surfaces radiate to
    ground: Ground | None = None  # The ground that surfaces see
    sun: Sun | None = None  # The sun
    fixed_temperature: tuple[FixedTemperature, ...] = ()  # Surfaces kept at a temperature
    heat_flux: tuple[HeatFlux, ...] = ()  # Given heat fluxes, positive into the body
    convection: tuple[Convection, ...] = ()  # Further air, such as a second room, with given coefficients
    radiation: tuple[Radiation, ...] = ()  # Long-wave exchange with surroundings of one temperature
    absorbed_solar: tuple[AbsorbedSolar, ...] = ()  # Sunlight of given strength, for any direction of the surfaces
    ground_contact: tuple[GroundContact, ...] = ()  # Surfaces that touch the ground
    internal_heat: tuple[InternalHeat, ...] = ()  # Heat released inside
    adiabatic: tuple[str, ...] = ("cut",)
    """Patches that no heat crosses, by name or pattern. A patch with area must be named here or have an effect."""
    description: str = ""  # Description of the scene, for reports

    def __post_init__(self) -> None:
        if self.sky is not None and self.sky.temperature_c is None and self.outside_air is None:
            remedy = "Add outside_air, or give the sky's temperature_c."
            raise unclear("sky", "outside_air beside it, whose temperature it follows", "none", remedy)
        for key, air in (("inside_air", self.inside_air), ("outside_air", self.outside_air)):
            if self.steady and air is not None and air.air_series is not None:
                remedy = "Add time: {duration_s: 86400}, or remove air_series."
                raise unclear(f"{key}: air_series", "time beside it", "steady", remedy)
        radiates = self.sky is not None or (self.ground is not None and self.ground.surface_c is not None)
        for key, source, there in (
            ("emissivity", "sky, or ground with surface_c", radiates),
            ("absorptivity", "sun", self.sun is not None),
        ):
            has = any(getattr(surface, key) is not None for surface in self.surfaces)
            if there and not has:
                remedy = f"Add surfaces: [{{{key}: 0.6}}], for example."
                raise unclear(f"surfaces: {key}", f"a number beside {source}", "none", remedy)
            if has and not there:
                raise unclear(f"surfaces: {key}", f"{source} beside it", "none", f"Add it, or remove {key}.")
        if self.ground is not None and self.ground.reflectance is not None and self.sun is None:
            raise unclear("ground: reflectance", "a sun to reflect", "none", "Add sun, or remove reflectance.")

    @property
    def steady(self) -> bool:
        """True if the steady state is asked for, because `time` is None."""
        return self.time is None

    def on(self, mesh: TetMesh) -> HeatScene:
        """Return the scene with the mesh's named patches added to all sections that have default patches.

        A named patch is added to outside sections (``exterior-*``) if photographs show most of its area, else to inside
        sections. It is not added if another entry of the scene names it.
        """
        area, tags = Selection(mesh).facet_area_m2, mesh.boundary
        whole, seen = (np.bincount(tags.patch, area * part, len(tags.patch_names)) for part in (1.0, tags.seen))
        own = [n for n, name in enumerate(tags.patch_names) if name not in DEFAULT_PATCHES and whole[n] > 0.0]
        airs = [air.patches for air in (self.inside_air, self.outside_air) if air and air.patches not in DEFAULTS]
        contacts = (*self.convection, *self.ground_contact, *self.fixed_temperature, *self.heat_flux)

        def widened(section: Section, *others: tuple[str, ...]) -> Section:
            if section is None or section.patches not in DEFAULTS:
                return section
            taken = {name for one in others for pattern in one for name in matching_names(tags.patch_names, pattern)}
            chosen = [n for n in own if (seen[n] > 0.5 * whole[n]) == (section.patches == OUTSIDE)]
            names = [glob.escape(tags.patch_names[n]) for n in chosen if tags.patch_names[n] not in taken]
            return replace(section, patches=(*section.patches, *names))  # type: ignore[type-var]

        named = [*airs, *(effect.patches for effect in contacts), self.adiabatic]

        def all_widened(entries: tuple[Shining, ...]) -> tuple[Shining, ...]:
            return tuple(widened(one, *(other.patches for other in entries if other is not one)) for one in entries)

        return replace(
            self,
            inside_air=widened(self.inside_air, *named),
            outside_air=widened(self.outside_air, *named),
            surfaces=tuple(widened(surface) for surface in self.surfaces),  # the last one holds, property by property
            radiation=all_widened(self.radiation),
            absorbed_solar=all_widened(self.absorbed_solar),
            sun=widened(self.sun, self.adiabatic),
        )

    def problem(self, mesh: TetMesh, *, up: Vector | None = None) -> HeatProblem:
        """Return the problem on a mesh; `up` is used if the scene has none (None: z). Raises errors as `effects`."""
        with raising(HeatError):
            mesh.check()
        start_c = self.initial_c
        if start_c is None and self.steady and not mesh.has_temperatures:
            start_c = _ANY_START_C
        initial = None if start_c is None else np.full(len(mesh.points_m), start_c)
        return HeatProblem(mesh, self.material(mesh), initial, self.effects(mesh), self.up or up or _Z_UP)

    def effects(self, mesh: TetMesh) -> tuple[Effect, ...]:
        """Return the effects of the scene on a mesh.

        Raises `HeatError` if the mesh lacks a patch that the scene names, a patch has no effect and is not named
        adiabatic, or two entries count the same exchange of heat.
        """
        selection = Selection(mesh)
        named = self.on(mesh)._named_effects(selection)
        where = [(name, _patches(selection, name, effect.where)) for name, effect in named]
        self._check_counted_once(where)
        self._check_none_forgotten(selection.patch_area_m2, set().union(*(chosen for _, chosen in where)))
        return (*(effect for _, effect in named), *self.internal_heat)

    def _named_effects(self, selection: Selection) -> list[tuple[str, Effect]]:
        """Return pairs of an entry's name in the scene and an effect on the surface that it causes."""
        airs = ("inside_air", self.inside_air), ("outside_air", self.outside_air)
        named: list[tuple[str, Effect]] = [(name, air.convection()) for name, air in airs if air is not None]
        named += [("sky and ground", effect) for effect in self._sky_and_ground(selection)]
        named += [("sun", effect) for effect in self._sunlight(selection)]
        for key in (field.name for field in fields(self) if field.name != "internal_heat"):
            entries = getattr(self, key)
            if isinstance(entries, tuple):
                listed = [(f"{key} entry {number}", entry) for number, entry in enumerate(entries, start=1)]
                named += [(entry_name, entry) for entry_name, entry in listed if isinstance(entry, Effect)]
        return named

    def material(self, mesh: TetMesh) -> dict[str, Material]:
        """Return the material of each region of a mesh by name; regions that no pattern matches are missing."""
        chosen: dict[str, Material] = {}
        for pattern, made_of in self.materials.items():
            matching = chosen_names("materials", mesh.region_names, (pattern,), "regions")
            chosen |= dict.fromkeys(matching, made_of)
        return chosen

    def _sky_and_ground(self, selection: Selection) -> list[Radiation]:
        sky_c = None if self.sky is None else self._sky_c(self.sky)
        ground_c = None if self.ground is None else self.ground.surface_c
        if sky_c is None and ground_c is None:
            return []
        return [
            Radiation(where, *outdoor_radiation(emissivity, sky_c=sky_c, ground_c=ground_c))
            for where, emissivity in self._of_surfaces(selection, "emissivity")
        ]

    def _sunlight(self, selection: Selection) -> list[AbsorbedSolar]:
        if self.sun is None:
            return []
        reflectance = self.ground.reflectance if self.ground is not None and self.ground.reflectance else 0.0
        irradiance = self.sun.irradiance(reflectance)
        lit = self._of_surfaces(selection, "absorptivity", _patches(selection, "sun", self.sun.patches))
        return [AbsorbedSolar(where, absorptivity, irradiance) for where, absorptivity in lit]

    def _sky_c(self, sky: Sky) -> Quantity:
        if sky.temperature_c is not None:
            return sky.temperature_c
        assert self.outside_air is not None, "checked when the scene was made"
        air, below_k = self.outside_air.temperature, sky.below_air_k
        if not isinstance(air, Varying):
            return _above(air, below_k)
        return replace(air, function=partial(_sky_above, air, below_k))

    def _of_surfaces(
        self, selection: Selection, key: Literal["emissivity", "absorptivity"], allowed: set[str] | None = None
    ) -> list[tuple[tuple[str, ...], float]]:
        """Return groups of patches with one value of `key` in `surfaces`: names, escaped for patterns, and the value.
        The last entry for a patch holds. Patches that are not in `allowed` are left out; None: all are allowed."""
        chosen: dict[str, float] = {}
        for number, surface in enumerate(self.surfaces, start=1):
            given: float | None = getattr(surface, key)
            if given is not None:
                chosen |= dict.fromkeys(_patches(selection, f"surfaces entry {number}", surface.patches), given)
        groups: dict[float, list[str]] = {}
        for patch in selection.patch_names:
            if patch in chosen and (allowed is None or patch in allowed):
                groups.setdefault(chosen[patch], []).append(glob.escape(patch))
        return [(tuple(names), number) for number, names in groups.items()]

    def _check_none_forgotten(self, area_m2: dict[str, float], acting: set[str]) -> None:
        """Raise `HeatError` if a patch with area is neither adiabatic nor in `acting`, the patches with an effect."""
        forgotten = [
            patch
            for patch, area in area_m2.items()
            if area > 0.0 and patch not in acting and not any(fnmatchcase(patch, pattern) for pattern in self.adiabatic)
        ]
        if forgotten:
            whole = sum(area_m2.values())
            shares = (f"{patch} ({100.0 * area_m2[patch] / whole:.3g} % of the surface)" for patch in forgotten)
            expected, got = "something that acts on every patch, or the patch named adiabatic", ", ".join(shares)
            written = yaml.safe_dump(
                [*self.adiabatic, *forgotten], default_flow_style=True, allow_unicode=True, width=math.inf
            )
            remedy = f"Name them in an entry that acts on them, or write adiabatic: {written.strip()}."
            raise HeatError("heat scene", expected=expected, got=f"nothing on {got}", remedy=remedy)

    def _check_counted_once(self, where: list[tuple[str, set[str]]]) -> None:
        """Raise `HeatError` if a patch has two contacts with air or ground, or if its radiation is counted twice.
        `where` holds the names of entries and the patches on which they act."""
        airs = {"inside_air": self.inside_air, "outside_air": self.outside_air}
        whole = {name for name, air in airs.items() if air is not None and air.coefficient in WITH_RADIATION}
        if self.sky is not None and self.ground is not None and self.ground.surface_c is not None:
            whole.add("sky and ground")  # like a film with radiation, this leaves nothing else to radiate to
        numbers: dict[str, list[int]] = {}
        for number, (_, patches) in enumerate(where):
            for patch in patches:
                numbers.setdefault(patch, []).append(number)
        for pair in sorted({pair for on_patch in numbers.values() for pair in combinations(on_patch, 2)}):
            (first, patches), (second, elsewhere) = (where[number] for number in pair)
            names, shared, remedy = (first, second), sorted(patches & elsewhere), _PATCHES_OF_THEIR_OWN
            if all(name.startswith((*airs, "convection", "ground_contact")) for name in names):
                what = "contact with air or ground"
            elif second.startswith("ground_contact") and first.startswith(("sky and ground", "radiation", "sun")):
                what = "contact with the ground alone"
            elif first in whole and second.startswith(("sky and ground", "radiation")):
                what, remedy = "radiation", "Remove one of the two, or name other patches."
                if first in airs:
                    remedy = f"Set coefficient: iso-6946-convection in {first}, which leaves radiation out."
            else:
                continue
            got = f"{second} on {', '.join(shared)} as well"
            raise HeatError(first, expected=f"{what} once on each patch", got=got, remedy=remedy)


def _patches(selection: Selection, name: str, patterns: Sequence[str]) -> set[str]:
    """Return the patches that match a pattern of the entry `name`; raise `HeatError` if a pattern matches none."""
    return chosen_names(f"{name}: patches", selection.patch_names, patterns)


def _steps(content: Any) -> str:
    return "equal" if isinstance(content, dict) and {"steps", "step_seconds"} & set(content) else "adaptive"


_Time = Annotated[Annotated[TimeSteps, Tag("equal")] | Annotated[AdaptiveSteps, Tag("adaptive")], Discriminator(_steps)]


@cache
def _file_record() -> type:
    """Return the record class of a file's keys: fields of `HeatScene`, with the differences in `load_heat_scene`."""
    hints = get_type_hints(HeatScene, include_extras=True)
    own = [(one.name, hints[one.name], one) for one in fields(HeatScene)]
    return make_dataclass("Scene", [
        ("materials", dict[str, str | Material]),
        ("initial", Literal["photographs"] | dict[Literal["temperature_c"], Celsius], "photographs"),
        ("steady", bool, False),
        ("time", _Time | None, None),
        *(one for one in own if one[0] not in ("materials", "initial_c", "time")),
    ])  # fmt: skip


def heat_scene_names() -> list[str]:
    """Return the names, sorted, of the package's scenes for `load_heat_scene`."""
    return sorted(path.stem.removeprefix("scene-") for path in configs_folder().glob("scene-*.yaml"))


@raising(HeatError)
def load_heat_scene(name: Path | str | Mapping[str, Any]) -> HeatScene:
    """Return a heat scene from a yaml file, from the package by a name such as ``winter-night``, or from a mapping.

    The keys of a file are the fields of `HeatScene`, with three differences. A material is a name of the table or three
    figures. The initial temperature is ``initial: photographs`` or ``initial: {temperature_c: 15}``. A scene has either
    ``steady: true`` or ``time:`` with the fields of `TimeSteps` or of `AdaptiveSteps`. Raises `HeatError` if the name
    is not known or the content is wrong.
    """
    path = Path("scene" if isinstance(name, Mapping) else name)
    if path.suffix not in (".yaml", ".yml") and not isinstance(name, Mapping):
        path = configs_folder() / f"scene-{name}.yaml"
        if not path.is_file():
            expected = f"one of {', '.join(heat_scene_names())}, or the path of a yaml file"
            raise wrong("heat scene", expected, repr(str(name)), "Correct the name.")
    content = deepcopy(dict(name)) if isinstance(name, Mapping) else read_yaml(path)
    with suppress(RecursionError):  # an entry that contains itself, which the check below names
        content = _without_units(path.name, content)
    for air in (content.get("inside_air"), content.get("outside_air")):
        if isinstance(air, dict) and isinstance(air.get("air_series"), str):
            air["air_series"] = str(path.parent / air["air_series"])
    if "materials" in content:
        content["materials"] = with_names(content["materials"])
    found = vars(as_record(path.name, content, _file_record()))
    initial, steady = found.pop("initial"), found.pop("steady")
    if steady == (found["time"] is not None):
        got = "both" if steady else "neither"
        remedy = "Remove one of the two." if steady else "Add time: {steps: 10, step_seconds: 60}, for example."
        raise wrong(path.name, "either steady: true or time", got, remedy)
    found["initial_c"] = None if initial == "photographs" else initial["temperature_c"]
    with raising(HeatError, f"{path.name}: "):
        found["materials"] = {
            region: material(one) if isinstance(one, str) else one for region, one in found["materials"].items()
        }
        return HeatScene(**found)


_UNIT_OF_KEY = {
    **{"_w_m2k": "W/(m2 K)", "_m2k_w": "m2 K/W", "_w_mk": "W/(m K)", "_w_m2": "W/m2", "_w_m3": "W/m3", "_m_s": "m/s"},
    **{"_kg_m3": "kg/m3", "_j_kgk": "J/(kg K)", "_seconds": "s", "_s": "s", "_c": "C", "_k": "K", "_deg": "degrees"},
    **dict.fromkeys(("emissivity", "absorptivity", "reflectance"), "1"),
}
"""Unit of a number by the end of its key; the first end that matches holds."""


def unit_of(key: str) -> str | None:
    """Return the unit of the number under a key, such as W/m2 for ``flux_w_m2``; None if the key ends in no unit."""
    return next((unit for end, unit in _UNIT_OF_KEY.items() if key.endswith(end)), None)


def _without_units(name: str, content: Any) -> Any:
    """Return a file's content with texts such as ``20.5 C`` or ``24 h`` converted to numbers in their keys' units."""
    if isinstance(content, list):
        return [_without_units(f"{name} entry {number}", one) for number, one in enumerate(content, start=1)]
    if not isinstance(content, dict):
        return content
    found = {}
    for key, value in content.items():
        unit = unit_of(key)
        found[key] = value = _without_units(f"{name}: {key}", value)
        if unit is not None and isinstance(value, str) and value.lstrip(" +-.,\N{MINUS SIGN}")[:1].isdigit():
            measured = read_measured(f"{name}: {key}", value, unit, bare=True)
            if measured.off_by:
                remedy = f"Write {measured.value:g} {'' if unit == '1' else unit}".rstrip() + "."
                raise wrong(f"{name}: {key}", "a number without a range", repr(value), remedy)
            found[key] = measured.value
    return found


def _above(air_c: float, below_k: float | None) -> float:
    return swinbank_sky_c(air_c) if below_k is None else air_c - below_k


def _sky_above(air: Varying, below_k: float | None, places: Places, time_s: float) -> float:
    return _above(float(np.max(air.function(places, time_s))), below_k)
