"""Metres per unit of a scene, how well that is known, and which way is up."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.checks import check_finite, check_positive, check_shape, is_number
from thermoxels_ns.core.errors import SceneError, ThermoxelsError

Vector = tuple[float, float, float]

_FILE = "transforms.json"
_KEY, _ERROR_KEY, _UP_KEY = "metres_per_unit", "metres_per_unit_standard_error", "up"


@dataclass(frozen=True)
class SceneScale:
    """Metres per unit of the scene's coordinates, with its standard error."""

    metres_per_unit: float  # Length of one input unit, above 0, [m]
    standard_error: float | None  # Standard error of `metres_per_unit`, at least 0, [m]; None where nobody knows it
    source: str  # Where the scale comes from: a sentence

    @property
    def relative_standard_error(self) -> float | None:
        """Standard error over scale; None where it is not known."""
        return None if self.standard_error is None else self.standard_error / self.metres_per_unit

    def area_standard_error(self, area_m2: float) -> float | None:
        """What the scale's error makes of an area, twice its relative error, [m^2]; None where it is not known."""
        return self._share(2, area_m2)

    def volume_standard_error(self, volume_m3: float) -> float | None:
        """What the scale's error makes of a volume, three times its relative error, [m^3]; None where it is not known.

        >>> SceneScale(2.0, 0.02, "").volume_standard_error(10.0)
        0.3
        """
        return self._share(3, volume_m3)

    def as_mapping(self) -> dict[str, Any]:
        """The scale as json can hold it."""
        return asdict(self)

    def _share(self, power: int, size: float) -> float | None:
        """Standard error of a quantity that grows with a power of the scale, to first order."""
        relative = self.relative_standard_error
        return None if relative is None else power * relative * abs(size)


def scale_from_option(metres_per_unit: float) -> SceneScale:
    """Take the scale as the user gives it, or raise `ThermoxelsError`; its error is not known."""
    check_positive(_KEY, metres_per_unit, "Pass the length of one input unit in metres, such as 1.")
    return SceneScale(float(metres_per_unit), None, f"Given by the user: {metres_per_unit:g} m per unit.")


def scale_from_known_distance(
    point_a: npt.ArrayLike, point_b: npt.ArrayLike, distance_m: float, standard_error_m: float | None = None
) -> SceneScale:
    """Find the scale from two points of the scene whose distance was measured, [input units] and [m].

    scale = D / d with the measured distance D and the distance d between the points; its relative standard
    error is that of D, which includes how far the points may lie from the ends of what was measured. None:
    nobody knows. Raises `ThermoxelsError` if a number is out of range, or the points coincide.

    >>> scale_from_known_distance((0, 0, 0), (0, 3, 4), 10.0, standard_error_m=0.1).standard_error
    0.02
    """
    a, b = _point("point_a", point_a), _point("point_b", point_b)
    check_positive("distance_m", distance_m, "Pass the measured distance between the points in metres.")
    if standard_error_m is not None:
        remedy = "Pass it in metres, or leave it out."
        _check_not_negative("standard_error_m", standard_error_m, remedy, ThermoxelsError)
    apart = float(np.linalg.norm(b - a))
    if not apart > 1e-12 * max(float(np.abs(a).max()), float(np.abs(b).max())):
        remedy = "Pass two points far from each other, in the coordinates of transforms.json."
        got = f"{_in_words(a)} and {_in_words(b)}"
        raise ThermoxelsError("known distance", expected="two different points", got=got, remedy=remedy)
    error = None if standard_error_m is None else standard_error_m / apart
    source = f"From {distance_m:g} m measured between {_in_words(a)} and {_in_words(b)}, {apart:.6g} units apart."
    return SceneScale(float(distance_m) / apart, error, source)


def scale_from_scene_file(meta: Mapping[str, Any]) -> SceneScale | None:
    """Read scale and standard error from a scene's json, None if it has none; raises `SceneError` for wrong values."""
    value, error = meta.get(_KEY), meta.get(_ERROR_KEY)
    if value is None:
        if error is not None:
            remedy = f"Add '{_KEY}' or remove '{_ERROR_KEY}'."
            raise SceneError(f"{_FILE}: {_ERROR_KEY}", expected=f"'{_KEY}' beside it", got="none", remedy=remedy)
        return None
    check_positive(f"{_FILE}: {_KEY}", value, "Correct the json, or remove the key.", SceneError)
    if error is not None:
        _check_not_negative(f"{_FILE}: {_ERROR_KEY}", error, "Correct the json, or remove the key.", SceneError)
    return SceneScale(float(value), None if error is None else float(error), f"From {_FILE}: {value:g} m per unit.")


def up_from_scene_file(meta: Mapping[str, Any]) -> Vector | None:
    """Read the unit vector that is up from a scene's json, None if it has none; raises `SceneError` for a wrong one.

    >>> up_from_scene_file({"up": [0, 0, 2]})
    (0.0, 0.0, 1.0)
    """
    value = meta.get(_UP_KEY)
    if value is None:
        return None
    numbers = isinstance(value, list | tuple) and all(is_number(v) and math.isfinite(v) for v in value)
    length = math.hypot(*value) if numbers else 0.0
    if not numbers or len(value) != 3 or not 0.0 < length < math.inf:
        remedy = "Correct the json, for instance to [0, 0, 1], or remove the key."
        got = repr(value)
        raise SceneError(f"{_FILE}: {_UP_KEY}", expected="three finite numbers, not all 0", got=got, remedy=remedy)
    x, y, z = (float(v) / length for v in value)
    return (x, y, z)


def choose_scale(
    option: float | None = None, known_distance: SceneScale | None = None, scene_file: Mapping[str, Any] | None = None
) -> SceneScale | None:
    """Choose between what the user gives and what the scene's json says; the user goes before the json.

    Returns the scale, whose source says what it was preferred to, None if nobody gives one; raises `ThermoxelsError` if
    the user gives both a scale and a distance.
    """
    if option is not None and known_distance is not None:
        remedy = "Leave one of them out."
        got = f"both: {option} m per unit, and {known_distance.metres_per_unit:g} from the distance"
        raise ThermoxelsError("scale", expected="metres per unit or a known distance", got=got, remedy=remedy)
    in_file = scale_from_scene_file(scene_file or {})
    given = known_distance if option is None else scale_from_option(option)
    if given is None:
        return in_file
    if in_file is not None:
        beside = f"It goes before the {in_file.metres_per_unit:g} m per unit of {_FILE}."
        return replace(given, source=f"{given.source} {beside}")
    return given


def _point(name: str, value: npt.ArrayLike) -> npt.NDArray[np.float64]:
    remedy = "Pass three finite numbers in the coordinates of transforms.json."
    try:
        point = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as problem:
        raise ThermoxelsError(name, expected="three numbers", got=repr(value), remedy=remedy) from problem
    return check_finite(name, check_shape(name, point, (3,), remedy), remedy)


def _check_not_negative(name: str, value: object, remedy: str, error: type[ThermoxelsError]) -> None:
    if not (isinstance(value, int | float) and is_number(value) and math.isfinite(value) and value >= 0.0):
        raise error(name, expected="a finite number of at least 0", got=repr(value), remedy=remedy)


def _in_words(point: npt.NDArray[np.float64]) -> str:
    return "(" + ", ".join(f"{float(x):.6g}" for x in point) + ")"
