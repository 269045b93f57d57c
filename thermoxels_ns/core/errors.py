"""Errors that a user can act on, with four parts: name, expected, got and remedy."""

import unicodedata

BAD_DATA, LACK_OF_MEMORY, CRASH = 2, 3, 1
"""Exit statuses of commands: wrong input or options; too little memory; an error in the program."""
_UNPRINTED = ("Cc", "Cs")  # categories of control characters, which break lines or terminals, and undecodable bytes


class ThermoxelsError(Exception):
    """Base of all errors caused by the input. `what` names the wrong entry; without `expected`, it is the message."""

    def __init__(self, what: str, *, expected: str | None = None, got: object = None, remedy: str = "") -> None:
        super().__init__(what if expected is None else explain(what, expected=expected, got=got, remedy=remedy))


class RecordError(ThermoxelsError, ValueError):
    """An entry of a file, or a field of a record, has a wrong value."""


class SceneError(ThermoxelsError, ValueError):
    """A scene folder, its json, its images or its cameras cannot be used."""


class ThermalFileError(SceneError):
    """A thermal file cannot be read as temperatures."""


class CheckpointError(ThermoxelsError, ValueError):
    """A checkpoint or its config.yml is damaged or unsafe, or does not fit the model that loads it."""


class PruningError(ThermoxelsError, RuntimeError):
    """Pruning was refused because it would remove surfaces on which too many rays end."""


class MemoryBudgetError(ThermoxelsError, MemoryError):
    """A lattice needs more memory than the budget allows."""


class MeshError(ThermoxelsError, ValueError):
    """No valid mesh can be made, read or written with these options or this input."""


class HeatError(ThermoxelsError, ValueError):
    """A heat scene is wrong or does not fit its mesh, or the solver failed."""


class HeatMemoryError(HeatError, MemoryError):
    """A heat problem needs more memory than is allowed."""


class AuditError(ThermoxelsError, ValueError):
    """The audit cannot give the answers asked for with these survey conditions or this mesh."""


class OutputError(ThermoxelsError, OSError):
    """A result cannot be written to the place that was asked for."""


def exit_status(problem: BaseException) -> int:
    """Return the exit status of a command that ends with `problem`; for a failed step, the exit status of the step."""
    if isinstance(problem, MemoryError) or type(problem).__name__ == "OutOfMemoryError":  # torch's
        return LACK_OF_MEMORY
    if hasattr(problem, "exit_status"):  # of a command that failed
        return problem.exit_status  # type: ignore[attr-defined]
    return BAD_DATA if isinstance(problem, ThermoxelsError) else CRASH


def explain(name: str, *, expected: str, got: object, remedy: str) -> str:
    """Return the message of an error, made of its four parts.

    >>> explain("metres_per_unit", expected="a number above 0", got=-1, remedy="Pass --metres-per-unit 1.")
    'metres_per_unit: expected a number above 0, got -1. Pass --metres-per-unit 1.'
    """
    return f"{printable(name)}: expected {expected}, got {printable(str(got))}. {remedy}"


def printable(text: str) -> str:
    """Return a text with line breaks, control characters and undecodable bytes written as escapes.

    >>> printable("two\\nlines.jpg")
    'two\\\\nlines.jpg'
    """
    return "".join(
        each.encode("unicode_escape").decode("ascii") if unicodedata.category(each) in _UNPRINTED else each
        for each in text
    )
