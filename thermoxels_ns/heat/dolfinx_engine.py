"""Temperatures of a heat problem computed by DOLFINx and PETSc in processes of their own, for large meshes."""

from __future__ import annotations

import json
import math
import os
import shutil
import subprocess
import tempfile
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from thermoxels_ns.core.arrays import FloatArray
from thermoxels_ns.core.checks import plain_os_errors
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.core.units import ZERO_CELSIUS_K
from thermoxels_ns.fem.system import HeatSystem
from thermoxels_ns.mesh.files.formats import write_xdmf

PYTHON = "THERMOXELS_FENICSX_PYTHON"  # Environment variable that names the Python that has DOLFINx
_PROGRAM = Path(__file__).with_name("dolfinx_program.py")
_NOT_FOR_OTHERS = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")  # Variables that lead to this environment's packages
_LINES_SHOWN = 12  # Last lines of a failed command that an error shows


@dataclass(frozen=True)
class DolfinxEngine:
    """The engine: call it with a system and the ends of its steps to get the temperatures there."""

    ranks: int = 1  # Number of MPI processes
    say: Callable[[str], None] = print  # Called with lines of progress

    def __post_init__(self) -> None:
        if self.ranks < 1:
            raise HeatError("ranks", expected="at least 1", got=self.ranks, remedy="Pass --ranks 2, for example.")

    @cached_property
    def command(self) -> list[str]:
        """Words that start Python in all processes; raises `HeatError` if DOLFINx or mpirun is not there."""
        python = os.environ.get(PYTHON, "/usr/bin/python3")
        remedy = f"Install python3-dolfinx (Debian, Ubuntu), let {PYTHON} name a Python that has it, or leave --engine."
        if shutil.which(python) is None:
            raise HeatError("engine", expected="a Python that has DOLFINx", got=f"no {python}", remedy=remedy)
        status, said = self._run([python, "-c", "import dolfinx, petsc4py, mpi4py"])
        if status:
            raise HeatError("engine", expected=f"DOLFINx for {python}", got=said or f"status {status}", remedy=remedy)
        beside = Path(python).with_name("mpirun")
        mpirun = str(beside) if beside.is_file() else shutil.which("mpirun")
        if self.ranks > 1 and mpirun is None:
            raise HeatError("ranks", expected="mpirun on the path", got="none", remedy="Leave --ranks, or install MPI.")
        return [python] if mpirun is None or self.ranks == 1 else [mpirun, "-n", str(self.ranks), python]

    def __call__(self, system: HeatSystem, times_s: FloatArray) -> FloatArray:
        """Return the temperatures minus `system.reference_c` at the ends of the steps, shape (s, n), [K].

        The steps of backward Euler lead from one of `times_s` (s + 1,), [s], to the next, from the initial temperature;
        the one time 0 asks for the steady state instead. Raises `HeatError` if DOLFINx is not there or fails.
        """
        command = self.command
        with (
            plain_os_errors("files for DOLFINx", remedy="Free space, or let TMPDIR name a folder with more."),
            tempfile.TemporaryDirectory(prefix="thermoxels-dolfinx-") as folder,
        ):
            write_problem(Path(folder), system, times_s)
            # mpi4py ends all processes if one fails.
            status, said = self._run([*command, "-m", "mpi4py", str(_PROGRAM), folder, str(self.ranks)])
            if status:
                remedy = "Leave --engine, or pass fewer --ranks if there are fewer processors or memory ran out."
                raise HeatError("engine dolfinx", expected="an answer", got=said or f"status {status}", remedy=remedy)
            return np.load(Path(folder) / "states.npy")

    def _run(self, command: list[str]) -> tuple[int, str]:
        """Run a command outside of this Python's environment; return its status and its last lines on faults."""
        own = {key: value for key, value in os.environ.items() if key not in _NOT_FOR_OTHERS}
        # Containers run as root, which Open MPI refuses without being told twice.
        own |= {"OMP_NUM_THREADS": "1", "OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"}
        lines = deque[str](maxlen=_LINES_SHOWN)
        pipes: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
        with subprocess.Popen(command, env=own, text=True, **pipes) as process:
            assert process.stdout is not None
            for line in map(str.strip, process.stdout):
                if line.startswith("DOLFINx:"):
                    self.say(line)
                elif line and not line.startswith(("---", "MPI_ABORT", "with errorcode", "NOTE: invoking")):
                    lines.append(line)
        return process.returncode, " / ".join(lines)


def write_problem(folder: Path, system: HeatSystem, times_s: FloatArray) -> None:
    """Write a problem of linear tetrahedra for the program: mesh, materials, and vectors with an entry per node.

    With lumped integrals, effects act node by node: the heat into a node is load - convection T - emitted |Ta|^3 Ta
    with the temperature T minus the reference and the absolute one Ta. A vector has a file of each step at which it is
    another than before.
    """
    problem, steps_s = system.problem, np.diff(times_s)
    level, absolute_k = np.zeros(system.num_nodes), system.reference_c + ZERO_CELSIUS_K

    last: dict[str, FloatArray] = {}

    def write(name: str, step: int, vector: FloatArray) -> None:
        if name not in last or not np.array_equal(vector, last[name]):
            np.save(folder / f"{name}-{step}.npy", vector)
            last[name] = vector

    write("start", 0, system.start_k)
    for step, step_s in enumerate(steps_s):
        if step == 0 or not math.isclose(step_s, steps_s[0], rel_tol=1e-12):
            write("stored", step, system.nodal_mass_j_k / step_s)
    changing = any(effect.changing for effect in problem.effects)
    for step, time_s in enumerate(map(float, times_s[len(steps_s) > 0 :])):
        if step and not changing:
            break
        convection, load_w = system.convection_matrix(time_s), sum(system.exchange_parts(level, time_s), level)
        if convection is not None:
            write("convection", step, convection.diagonal())
        if system.nonlinear:
            emitted = system.radiation_slope(level, time_s).diagonal() / (4.0 * absolute_k**3)
            write("emitted", step, emitted)
            load_w = load_w + emitted * absolute_k**4
        write("load", step, load_w)
        if len(system.fixed.nodes):
            given = level.copy()
            given[system.fixed.nodes] = system.fixed.temperature_k(time_s)
            write("fixed", step, given)
    write("is_fixed", 0, np.bincount(system.fixed.nodes, minlength=system.num_nodes).astype(np.float64))
    write_xdmf(folder / "mesh.xdmf", problem.mesh)
    made_of = [problem.materials.get(name) for name in problem.mesh.region_names]
    given = {
        "conductivity_w_mk": [1.0 if one is None else one.conductivity_w_mk for one in made_of],
        "reference_c": system.reference_c,
        "nodes": system.num_nodes,
        "steps": max(1, len(steps_s)),
    }
    (folder / "problem.json").write_text(json.dumps(given), encoding="utf-8")
