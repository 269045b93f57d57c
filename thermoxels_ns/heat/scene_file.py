"""Heat scenes from yaml files; ``configs/scene-all-effects.yaml`` explains every key."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, get_type_hints

from thermoxels_ns.core.errors import HeatError, ThermoxelsError
from thermoxels_ns.core.yaml_records import (
    as_mapping,
    as_record,
    as_value,
    check_keys,
    configs_folder,
    raising,
    read_yaml,
    shown,
    wrong,
)
from thermoxels_ns.fem.problem import AdaptiveSteps, TimeSteps
from thermoxels_ns.heat.materials import Material, MaterialFigures, material
from thermoxels_ns.heat.scene import HeatScene

_OWN_KEYS = ("materials", "initial", "steady", "time")
_FIELDS = tuple(
    field.name for field in dataclasses.fields(HeatScene) if field.name not in ("materials", "initial_c", "time")
)


@dataclasses.dataclass(frozen=True)
class _Uniform:
    """One temperature for the whole body."""

    temperature_c: float


def heat_scene_names() -> list[str]:
    """List the names that `load_heat_scene` knows."""
    return sorted(path.stem.removeprefix("scene-") for path in configs_folder().glob("scene-*.yaml"))


@raising(HeatError)
def load_heat_scene(name: Path | str) -> HeatScene:
    """Read a heat scene from a yaml file, or by the name of one that the package brings, such as ``winter-night``.

    A file has the fields of `HeatScene` as keys, with three differences: materials are names of the table or
    three figures, the start is ``initial: photographs`` or ``initial: {temperature_c: 15}``, and a scene has
    either ``steady: true`` or ``time:`` with the fields of `TimeSteps` or of `AdaptiveSteps`. Raises `HeatError` for
    what is wrong in it.
    """
    path = Path(name)
    if path.suffix not in (".yaml", ".yml"):
        path = configs_folder() / f"scene-{name}.yaml"
        if not path.is_file():
            expected = f"one of {', '.join(heat_scene_names())}, or the path of a yaml file"
            raise wrong("heat scene", expected, repr(str(name)), "Correct the name.")
    content = read_yaml(path)
    check_keys(path.name, content, (*_OWN_KEYS, *_FIELDS))
    for air in (content.get("inside_air"), content.get("outside_air")):
        if isinstance(air, dict) and isinstance(air.get("air_series"), str):
            air["air_series"] = str(path.parent / air["air_series"])
    hints = get_type_hints(HeatScene)
    values = {
        key: as_value(f"{path.name}: {key}", value, hints[key])
        for key, value in content.items()
        if key not in _OWN_KEYS
    }
    values["materials"] = _materials(path.name, content)
    values["initial_c"] = _initial(f"{path.name}: initial", content.get("initial", "photographs"))
    values["time"] = _time(path.name, content)
    try:
        return HeatScene(**values)
    except HeatError as problem:
        raise HeatError(f"{path.name}: {problem}") from problem


def _materials(file: str, content: dict[str, Any]) -> dict[str, Material]:
    if "materials" not in content:
        raise wrong(file, "the key materials", ", ".join(content), 'Add materials: {"*": concrete}, for example.')
    name = f"{file}: materials"
    made_of: dict[str, Material] = {}
    for region, entry in as_mapping(name, content["materials"]).items():
        try:
            if isinstance(entry, str):
                made_of[region] = material(entry)
                continue
            made_of[region] = as_record(region, entry, MaterialFigures).named(region)
        except ThermoxelsError as problem:
            raise HeatError(f"{name}: {problem}") from problem
    return made_of


def _initial(name: str, content: object) -> float | None:
    if content == "photographs":
        return None
    if not isinstance(content, dict):
        remedy = "Write initial: {temperature_c: 15}, for example."
        raise wrong(name, "photographs, or a mapping with temperature_c", shown(content), remedy)
    return as_record(name, content, _Uniform).temperature_c


def _time(file: str, content: dict[str, Any]) -> TimeSteps | AdaptiveSteps | None:
    steady = as_value(f"{file}: steady", content.get("steady", False), bool)
    if steady == ("time" in content):
        got = "both" if steady else "neither"
        remedy = "Remove one of the two." if steady else "Add time: {steps: 10, step_seconds: 60}, for example."
        raise wrong(file, "either steady: true or time", got, remedy)
    if steady:
        return None
    name = f"{file}: time"
    keys = as_mapping(name, content["time"])
    own = {field.name for kind in (TimeSteps, AdaptiveSteps) for field in dataclasses.fields(kind)}
    check_keys(name, keys, tuple(sorted(own)))
    fixed = any(field.name in keys for field in dataclasses.fields(TimeSteps))
    return as_record(name, keys, TimeSteps if fixed else AdaptiveSteps)
