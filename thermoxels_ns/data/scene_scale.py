"""Scale of a scene, metres per unit, with its standard error, and the direction that is up."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any, TypeAlias

import numpy as np
from pydantic import Field

from thermoxels_ns.core.errors import SceneError, ThermoxelsError
from thermoxels_ns.core.yaml_records import as_record, raising, record

Vector = tuple[float, float, float]
Length: TypeAlias = Annotated[float, Field(gt=0.0)]
StandardError: TypeAlias = Annotated[float, Field(ge=0.0)]

_FILE = "transforms.json"


@record(ThermoxelsError)
class SceneScale:
    """Metres per unit of the scene's coordinates, with standard error and source."""

    metres_per_unit: Length  # Length of one input unit, [m]
    standard_error: StandardError | None  # Standard error of `metres_per_unit`, [m]; None: not known
    source: str  # Source of the scale, as a sentence

    def standard_error_of(self, size: float, power: int) -> float | None:
        """Return the first-order standard error of an area `size` [m2] (`power` 2) or volume [m3] (3); None: unknown.

        >>> SceneScale(2.0, 0.02, "").standard_error_of(10.0, 3)
        0.3
        """
        return None if self.standard_error is None else power * (self.standard_error / self.metres_per_unit) * abs(size)


@record(ThermoxelsError)
class _KnownDistance:
    point_a: Vector
    point_b: Vector
    distance_m: Length
    standard_error_m: StandardError | None


@record(SceneError)
class _InFile:
    """Scale and up in a scene's json."""

    metres_per_unit: Length | None = None
    metres_per_unit_standard_error: StandardError | None = None
    up: Vector | None = None

    def __post_init__(self) -> None:
        if self.metres_per_unit is None and self.metres_per_unit_standard_error is not None:
            remedy = "Add 'metres_per_unit', or remove it."
            raise SceneError(
                "metres_per_unit_standard_error", expected="'metres_per_unit' beside it", got="none", remedy=remedy
            )
        if self.up is not None and not 0.0 < math.hypot(*self.up) < math.inf:
            remedy = "Correct the json, for instance to [0, 0, 1], or remove the key."
            raise SceneError("up", expected="three finite numbers, not all 0", got=[*self.up], remedy=remedy)


def scale_from_known_distance(
    point_a: Vector, point_b: Vector, distance_m: float, standard_error_m: float | None = None
) -> SceneScale:
    """Return the scale from two points of the scene [input units] and their measured distance [m].

    The scale is the measured distance over the distance of the points. Its relative standard error is that of the
    measured distance; `standard_error_m` (None: unknown) should include how far the points may be from its ends.
    Raises `ThermoxelsError` if a number is out of range, or if the points coincide.

    >>> scale_from_known_distance((0, 0, 0), (0, 3, 4), 10.0, standard_error_m=0.1).standard_error
    0.02
    """
    known = _KnownDistance(point_a, point_b, distance_m, standard_error_m)
    a, b = np.array(known.point_a), np.array(known.point_b)
    apart = float(np.linalg.norm(b - a))
    words = [f"({', '.join(f'{x:.6g}' for x in point.tolist())})" for point in (a, b)]
    if not apart > 1e-12 * max(float(np.abs(a).max()), float(np.abs(b).max())):
        remedy = "Pass two points far from each other, in the coordinates of transforms.json."
        got = " and ".join(words)
        raise ThermoxelsError("known distance", expected="two different points", got=got, remedy=remedy)
    error = None if standard_error_m is None else standard_error_m / apart
    source = f"From {distance_m:g} m measured between {words[0]} and {words[1]}, {apart:.6g} units apart."
    return SceneScale(known.distance_m / apart, error, source)


def scale_from_scene_file(meta: Mapping[str, Any]) -> SceneScale | None:
    """Return the scale in a json's content `meta`, None if it has none. Raises `SceneError` for wrong values."""
    found = _in_file(meta)
    value = found.metres_per_unit
    if value is None:
        return None
    return SceneScale(value, found.metres_per_unit_standard_error, f"From {_FILE}: {value:g} m per unit.")


def up_from_scene_file(meta: Mapping[str, Any]) -> Vector | None:
    """Return the unit vector ``up`` of a json's content `meta`, None if it has none. Raises `SceneError` if it is bad.

    >>> up_from_scene_file({"up": [0, 0, 2]})
    (0.0, 0.0, 1.0)
    """
    up = _in_file(meta).up
    if up is None:
        return None
    x, y, z = (part / math.hypot(*up) for part in up)
    return (x, y, z)


@raising(SceneError)
def _in_file(meta: Mapping[str, Any]) -> _InFile:
    keys = ("metres_per_unit", "metres_per_unit_standard_error", "up")
    return as_record(_FILE, {key: meta[key] for key in keys if meta.get(key) is not None}, _InFile)


def choose_scale(
    option: float | None = None, known_distance: SceneScale | None = None, scene_file: Mapping[str, Any] | None = None
) -> SceneScale | None:
    """Return the user's scale, else the scale in the json's content `scene_file`; None if there is neither.

    The user's scale is `option` [metres per unit] or `known_distance`. Raises `ThermoxelsError` if both are given, or
    if `option` is not above 0. If the json has a scale too, the text `source` says that the user's replaces it.
    """
    if option is not None and known_distance is not None:
        remedy = "Leave one of them out."
        got = f"both: {option} m per unit, and {known_distance.metres_per_unit:g} from the distance"
        raise ThermoxelsError("scale", expected="metres per unit or a known distance", got=got, remedy=remedy)
    in_file, given = scale_from_scene_file(scene_file or {}), known_distance
    if option is not None:
        given = replace(SceneScale(option, None, ""), source=f"Given by the user: {option:g} m per unit.")
    if given is None or in_file is None:
        return given or in_file
    beside = f"It goes before the {in_file.metres_per_unit:g} m per unit of {_FILE}."
    return replace(given, source=f"{given.source} {beside}")
