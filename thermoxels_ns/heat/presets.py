"""Heat settings from a yaml file: material and time steps.

The files are the only place where these numbers stand; no default in the code repeats them.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import yaml

from thermoxels_ns.core.configs_folder import configs_folder
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.fem.problem import TimeSteps
from thermoxels_ns.heat.materials import Material


@dataclass(frozen=True)
class HeatPreset:
    """A material and the time steps that suit it."""

    material: Material
    """What the body is made of."""
    time: TimeSteps
    """How long it is followed."""

    def as_mapping(self) -> dict[str, dict[str, Any]]:
        """Return the content of the yaml file that this preset would be read from."""
        return asdict(self)


def heat_preset_names() -> list[str]:
    """List the names that `load_heat_preset` knows."""
    return sorted(path.stem.removeprefix("heat-") for path in configs_folder().glob("heat-*.yaml"))


def load_heat_preset(name: str) -> HeatPreset:
    """Read heat settings.

    Args:
        name: A preset's name, such as ``concrete`` for ``configs/heat-concrete.yaml``, or the path of a yaml file
            (recognised by its suffix).

    Returns:
        The validated settings.

    Raises:
        HeatError: If there is no such preset or file, or if a key is missing, unknown or out of range.
    """
    path = Path(name) if Path(name).suffix in (".yaml", ".yml") else configs_folder() / f"heat-{name}.yaml"
    if not path.is_file():
        raise HeatError(
            "heat preset",
            expected=f"one of {', '.join(heat_preset_names())}, or the path of a yaml file",
            got=repr(name),
            remedy="Correct --heat-preset.",
        )
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as problem:
        raise HeatError(path.name, expected="a yaml file", got=str(problem), remedy="Correct the file.") from problem
    content = _keys(path.name, content, HeatPreset)
    material = _keys(f"{path.name}: material", content["material"], Material)
    time = _keys(f"{path.name}: time", content["time"], TimeSteps)
    for key, value in [*material.items(), *time.items()]:
        _check_not_text(f"{path.name}: {key}", value, is_name=key == "name")
    return HeatPreset(Material(**material), TimeSteps(**time))


def _check_not_text(name: str, value: object, *, is_name: bool) -> None:
    """Refuse text that looks like a number: yaml takes 1e0 and 1.0e0 for text, and only 1.0e+0 for a number."""
    if is_name or not isinstance(value, str):
        return
    try:
        number = float(value)
    except ValueError:
        return
    if not math.isfinite(number):
        return
    written = f"{number:.15g}"
    mantissa, _, exponent = written.partition("e")
    if exponent:
        written = f"{mantissa if '.' in mantissa else mantissa + '.0'}e{exponent}"
    raise HeatError(
        name,
        expected="a number",
        got=f"the text {value!r}",
        remedy=f"Write {written}, without quotes; a power of ten needs a point and a sign in yaml, as in 1.0e+0.",
    )


def _keys(name: str, content: object, target: type) -> dict[str, Any]:
    """Return `content` if it is a mapping with exactly the fields of a dataclass."""
    wanted = [field.name for field in fields(target)]
    if not isinstance(content, dict) or set(content) != set(wanted):
        got = ", ".join(map(str, content)) if isinstance(content, dict) else repr(content)
        raise HeatError(name, expected=f"the keys {', '.join(wanted)}", got=got or "none", remedy="Correct the file.")
    return content
