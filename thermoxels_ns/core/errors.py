"""Errors a user can act on: name, expected, got and remedy."""

import unicodedata

_UNPRINTED = ("Cc", "Cs")  # kinds of characters that break a line or a terminal, or are bytes that no encoding explains


class ThermoxelsError(Exception):
    """Base of all errors that are the input's, not the program's: what is wrong, or the whole sentence alone."""

    def __init__(self, what: str, *, expected: str | None = None, got: object = None, remedy: str = "") -> None:
        super().__init__(what if expected is None else explain(what, expected=expected, got=got, remedy=remedy))


class RecordError(ThermoxelsError, ValueError):
    """An entry of a file or a record is wrong."""


class SceneError(ThermoxelsError, ValueError):
    """A scene folder, its json, its images or its cameras cannot be used."""


class ThermalFileError(SceneError):
    """A thermal file cannot be read as temperatures."""


class CheckpointError(ThermoxelsError, ValueError):
    """A checkpoint does not fit the model that is asked to load it."""


class PruningError(ThermoxelsError, RuntimeError):
    """Pruning would remove a part of the scene that rays see."""


class MemoryBudgetError(ThermoxelsError, MemoryError):
    """A lattice needs more memory than the budget allows."""


class MeshError(ThermoxelsError, ValueError):
    """No valid mesh can be cut from the density field."""


class HeatError(ThermoxelsError, ValueError):
    """A heat problem is not well posed or its solver did not converge."""


class AuditError(ThermoxelsError, ValueError):
    """The conditions of a survey, or its mesh, do not give the answers that are asked for."""


class OutputError(ThermoxelsError, OSError):
    """A result cannot be written where it was asked for."""


def explain(name: str, *, expected: str, got: object, remedy: str) -> str:
    """Put the four parts of an error message into one sentence order.

    >>> explain("metres_per_unit", expected="a number above 0", got=-1, remedy="Pass --metres-per-unit 1.")
    'metres_per_unit: expected a number above 0, got -1. Pass --metres-per-unit 1.'
    """
    return f"{printable(name)}: expected {expected}, got {printable(str(got))}. {remedy}"


def printable(text: str) -> str:
    """Escape what is no letter in any alphabet: line breaks, control characters, bytes of no encoding.

    >>> printable("two\\nlines.jpg")
    'two\\\\nlines.jpg'
    """
    return "".join(
        each.encode("unicode_escape").decode("ascii") if unicodedata.category(each) in _UNPRINTED else each
        for each in text
    )
