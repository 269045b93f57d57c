"""What the report of a heat computation says about its error."""

from __future__ import annotations

from typing import Any

from thermoxels_ns.fem.problem import AdaptiveSteps, TimeSteps
from thermoxels_ns.heat.solving import Accuracy
from thermoxels_ns.reports.heat_pictures import in_words
from thermoxels_ns.reports.heat_report import Section, Table


def accuracy_sections(accuracy: Accuracy | None) -> list[Section]:
    """Say what the error is, what was chosen, and all solutions on the way; nothing without a tolerance.

    Args:
        accuracy: What is known of the error; None if no tolerance was given.
    """
    if accuracy is None:
        return []
    words = [f"{'Met' if accuracy.met else 'Not met'}: {_asked(accuracy)}. {accuracy.status}"]
    if accuracy.left_out_k > 0.0:
        words.append(
            f"Of the error, {accuracy.left_out_k:.2g} K at most are what is left out; the solver had the rest of the "
            "tolerance."
        )
    if accuracy.order == 2:
        words.append(
            "Tetrahedra are quadratic, with a temperature in the middle of every edge. Files, pictures and extremes "
            "show those too, on the mesh with all edges halved; heat flows are those of the quadratic tetrahedra."
        )
    words.append(
        "The estimate is of the error in solving the heat equation in the body as the mesh describes it, usually right "
        "to a factor of three. How far the mesh, its materials and the scene are from the real thing is not in it."
    )
    columns = ("Solution", "unknowns", "error K", "error of heat flow %", "s")
    note = "Estimated errors. The last one is the result."
    return [Section("Accuracy", words=tuple(words), tables=(Table(columns, _rows(accuracy), note=note),))]


def accuracy_card(accuracy: Accuracy | None) -> list[tuple[str, str]]:
    """Give the figure for the top of the page: value with unit, and what it is; nothing without a tolerance."""
    if accuracy is None:
        return []
    met = "within the tolerance" if accuracy.met else "NOT within the tolerance"
    if accuracy.tolerance_k is None:
        return [(f"{100.0 * accuracy.estimated_flow:.2g} %", f"estimated error of the heat flow, {met}")]
    return [(f"{accuracy.estimated_k:.2g} K", f"estimated error of temperatures, {met}")]


def how_time_was_followed(time: TimeSteps | AdaptiveSteps | None, accuracy: Accuracy | None) -> str:
    """Say in words how a body was followed, by the scene's own steps or to a tolerance."""
    if time is None:
        return "the steady state"
    if accuracy is not None:
        duration = in_words(float(time.times_s[-1]))
        return f"{duration} in steps chosen by the tolerance (they may err by {accuracy.step_tolerance_k:.2g} K)"
    if isinstance(time, TimeSteps):
        return f"{time.steps} steps of {time.step_seconds:g} s"
    return f"{in_words(time.duration_s)} in steps that keep within {time.tolerance_k:g} K"


def _asked(accuracy: Accuracy) -> str:
    parts = [] if accuracy.tolerance_k is None else [f"{accuracy.tolerance_k:g} K"]
    parts += [] if accuracy.flow_tolerance is None else [f"{100.0 * accuracy.flow_tolerance:g} % of the heat flow"]
    return f"a tolerance of {' and '.join(parts)}"


def _rows(accuracy: Accuracy) -> tuple[tuple[str, ...], ...]:
    return tuple(_row(level) for level in accuracy.levels)


def _row(level: dict[str, Any]) -> tuple[str, ...]:
    kind = "linear tetrahedra" if level["order"] == 1 else "quadratic tetrahedra"
    mesh = "given mesh" if level["refinements"] == 0 else f"mesh size halved {level['refinements']}x"
    steps = "" if level["step_tolerance_k"] is None else f", steps to {level['step_tolerance_k']:.2g} K"
    error = level["error"]
    return (
        f"{kind}, {mesh}{steps}",
        f"{level['num_nodes']:,}",
        f"{error['temperature_k']:.2g}",
        f"{100.0 * error['heat_flow']:.2g}",
        f"{level['seconds']:.2f}",
    )
