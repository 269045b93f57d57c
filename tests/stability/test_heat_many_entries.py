"""Scenes with hundreds of entries: the work grows with their number, not with its square."""

import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.heat_bodies import CONCRETE
from tests.support.heat_meshes import box_mesh, planes
from thermoxels_ns.fem.problem import HeatProblem, TimeSteps, effect_labels
from thermoxels_ns.fem.system import HeatSystem
from thermoxels_ns.heat.effects import Convection, HeatFlux
from thermoxels_ns.heat.scene import load_heat_scene
from thermoxels_ns.heat.solving import _weak
from thermoxels_ns.mesh.tetrahedra import TetMesh

MOST_RATIO = 2.6
"""Twice the entries may take this many times as long: quadratic work comes to 4, linear work to 2."""


def many_patches(count: int) -> TetMesh:
    """A box whose surface is divided into patches p0, p1, ..."""
    mesh = box_mesh(*(planes(0.0, 1.0, step=0.125) for _ in range(3)))
    names = tuple(f"p{number}" for number in range(count))
    return replace(mesh, boundary=replace(mesh.boundary, patch=np.arange(len(mesh.facets)) % count, patch_names=names))


def lines_run(work: Callable[[], Any]) -> int:
    """Lines of our code that run, those of loops and comprehensions every time."""
    count = 0

    def trace(frame, event, argument):
        nonlocal count
        if "thermoxels_ns" not in frame.f_code.co_filename:
            return None
        count += event == "line"
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        work()
    finally:
        sys.settrace(before)
    return count


def problem(count: int, alike: bool = False) -> HeatProblem:
    """Convection and a flux on each of many patches, or on all of them every time."""
    names = [("*",) if alike else (f"p{number}",) for number in range(count)]
    airs = [Convection(name, 5.0, 5.0 + number % 2) for number, name in enumerate(names)]
    fluxes = [HeatFlux(name, 1e-9) for name in names]
    return HeatProblem(many_patches(count), CONCRETE, effects=(*airs, *fluxes))


def from_file(folder: Path, count: int) -> Callable[[], Any]:
    path, rows = folder / f"{count}.yaml", [f"  - {{patches: [p{n}], flux_w_m2: {n}.5}}" for n in range(count)]
    air = "convection: [{patches: ['*'], air_c: 5.0, coefficient_w_m2k: 5.0}]"
    path.write_text("\n".join(['materials: {"*": concrete}', "steady: true", air, "heat_flux:", *rows]))
    mesh = many_patches(count)
    return lambda: load_heat_scene(path).problem(mesh)


WORK: dict[str, Callable[[Path, int], Callable[[], Any]]] = {
    "labels of effects alike": lambda _, count: partial(effect_labels, problem(count, alike=True)),
    "assembling": lambda _, count: partial(HeatSystem, problem(count)),
    "leaving out": lambda _, count: partial(_weak, problem(count), TimeSteps(2, 60.0), 0.01),
    "file": from_file,
}


@pytest.mark.parametrize("name", WORK)
def test_twice_the_entries_are_about_twice_the_work(name, tmp_path) -> None:
    few, many = (lines_run(WORK[name](tmp_path, count)) for count in (60, 120))
    assert many < MOST_RATIO * few, (few, many)


def test_effects_of_one_name_are_numbered_whatever_others_are_called() -> None:
    flux, odd = HeatFlux(("p0",), 1.0), HeatFlux(("p0 (2)",), 1.0)
    mesh = many_patches(2)
    problem = HeatProblem(mesh, CONCRETE, effects=(flux, odd, flux, odd, flux, flux))
    labels = ("", " (2)", " (3)", " (2) (2)", " (4)", " (5)")
    assert effect_labels(problem) == tuple(f"heat flux on p0{label}" for label in labels)
