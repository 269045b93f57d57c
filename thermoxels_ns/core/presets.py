"""Presets: small yaml files that hold only what differs from a base configuration."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, TypeVar

from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.core.yaml_records import configs_folder, read_yaml

Config = TypeVar("Config")

_PATTERNS = ("plenoxels*.yaml", "thermoxels*.yaml")
"""The presets among the files of the folder, which also holds materials and heat scenes."""


def read_preset(name: str) -> dict[str, Any]:
    """Read ``configs/<name>.yaml``.

    Raises:
        ThermoxelsError: There is no such preset, or it is not a mapping.
    """
    path = configs_folder() / f"{name}.yaml"
    if not path.is_file():
        known = ", ".join(sorted(p.stem for pattern in _PATTERNS for p in configs_folder().glob(pattern))) or "none"
        raise ThermoxelsError("preset", expected=f"one of {known}", got=name, remedy="Correct the name.")
    return read_yaml(path)


def with_overrides(config: Config, overrides: Mapping[str, Any], name: str = "preset") -> Config:
    """A copy of a (nested) dataclass with some fields replaced; the original is not touched.

    Args:
        config: A dataclass instance, or a dict of such.
        overrides: Nested mapping of field names to values. Lists replace tuples as tuples.
        name: Where the overrides come from, for messages.

    Raises:
        ThermoxelsError: A name that the configuration does not have, or a value of another kind.
    """
    if isinstance(config, Mapping):
        fields = dict(config)
    elif dataclasses.is_dataclass(config) and not isinstance(config, type):
        fields = {f.name: getattr(config, f.name) for f in dataclasses.fields(config)}
    else:
        raise ThermoxelsError(name, expected="a single value", got="a mapping", remedy="Remove the nested keys.")
    changed = {}
    for key, value in overrides.items():
        if key not in fields:
            raise ThermoxelsError(
                f"{name}.{key}", expected=f"one of {', '.join(sorted(fields))}", got=key, remedy="Correct it."
            )
        old = fields[key]
        if isinstance(value, Mapping) and (dataclasses.is_dataclass(old) or (isinstance(old, Mapping) and old)):
            changed[key] = with_overrides(old, value, f"{name}.{key}")
        else:
            changed[key] = tuple(value) if isinstance(old, tuple) and isinstance(value, list) else value
    if isinstance(config, Mapping):
        return {**fields, **changed}  # type: ignore[return-value]
    return dataclasses.replace(config, **changed)  # type: ignore[type-var]
