"""Program that solves a heat problem with DOLFINx and PETSc in any number of processes; `dolfinx_engine` runs it.

The Python that runs it has DOLFINx and perhaps nothing of this package, so the program imports nothing of it. Each
process holds a part of the mesh. Conduction is assembled from the mesh; all else acts at nodes and comes as vectors.
"""

# pyright: reportMissingImports=false

import json
import sys
from pathlib import Path

import numpy as np
import ufl
from dolfinx import fem, io
from dolfinx.fem.petsc import assemble_matrix
from mpi4py import MPI
from petsc4py import PETSc

ZERO_CELSIUS_K = 273.15
MOST_NEWTON = 60  # Newton steps before the program gives up
BALANCED = 1e-9  # Newton's method ends if the unbalanced heat is at most this share of all heat that moves
ROUND_OFF = 1e-14  # It also ends at this share of the heat that all nodes would bring if their neighbours were level
TOLERANCE, MOST_ITERATIONS = 1e-11, 2000  # Relative tolerance of conjugate gradients, and most iterations


class Part:
    """What one process holds: rows of the nodes that it owns."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.comm = folder, MPI.COMM_WORLD
        self.given = json.loads((folder / "problem.json").read_text())
        with io.XDMFFile(self.comm, str(folder / "mesh.xdmf"), "r") as file:
            mesh = file.read_mesh(name="mesh")
            regions = file.read_meshtags(mesh, name="mesh")
        space_of = getattr(fem, "functionspace", fem.FunctionSpace)
        space, of_cells = space_of(mesh, ("CG", 1)), space_of(mesh, ("DG", 0))
        conductivity = fem.Function(of_cells)
        conductivity.x.array[regions.indices] = np.array(self.given["conductivity_w_mk"])[regions.values - 1]
        u, v = ufl.TrialFunction(space), ufl.TestFunction(space)
        self.stiffness = assemble_matrix(fem.form(conductivity * ufl.inner(ufl.grad(u), ufl.grad(v)) * ufl.dx))
        self.stiffness.assemble()
        self.diagonal = np.array(self.stiffness.getDiagonal().array)
        if space.dofmap.index_map.size_global != self.given["nodes"]:
            what = "the mesh hangs together by single nodes or edges, which DOLFINx tears between processes"
            raise SystemExit(f"{what}: pass --ranks 1, or leave --engine.")
        owned, ghosts = space.dofmap.index_map.size_local, space.dofmap.index_map.num_ghosts
        number, flat = np.empty(owned + ghosts, np.int64), lambda lists: np.ravel(getattr(lists, "array", lists))
        number[flat(space.dofmap.list)] = np.asarray(mesh.geometry.input_global_indices)[flat(mesh.geometry.dofmap)]
        self.node = number[:owned]  # Number, in the problem's files, of each row that this process owns
        self.solver, self.slope = PETSc.KSP().create(self.comm), np.full(owned, np.nan)

    def vector(self, name: str, step: int) -> np.ndarray:
        """Return a vector's entries at this process's nodes, from the file of the last step that has one, or else 0."""
        for number in range(step, -1, -1):
            path = self.folder / f"{name}-{number}.npy"
            if path.exists():
                return np.array(np.load(path, mmap_mode="r")[self.node])
        return np.zeros(len(self.node))

    def total(self, *vectors: np.ndarray) -> float:
        """Return the sum of the absolute values of vectors over all processes."""
        return self.comm.allreduce(float(sum(np.abs(one).sum() for one in vectors)))

    def solved(self, start: np.ndarray, step: int) -> tuple[np.ndarray, int]:
        """Return the temperatures at the end of a step, and the iterations of conjugate gradients, by Newton's method.

        The equation is stored (T - T0) + K T + convection T + emitted |Ta|^3 Ta = load, with the absolute temperature
        Ta; stored is the mass divided by the step's length, 0 in a steady state.
        """
        kinds = ("stored", "load", "convection", "emitted", "fixed", "is_fixed")
        stored, load, convection, emitted, fixed, is_fixed = (self.vector(kind, step) for kind in kinds)
        reference_k, held = self.given["reference_c"] + ZERO_CELSIUS_K, is_fixed > 0.0
        now, spent, flow = np.where(held, fixed, start), 0, self.stiffness.createVecLeft()
        for _ in range(MOST_NEWTON):
            kelvin = now + reference_k
            self.stiffness.mult(self.filled(now), flow)
            leaving = flow.array + convection * now + emitted * np.abs(kelvin) ** 3 * kelvin + stored * (now - start)
            rest = np.where(held, 0.0, load - leaving)
            moved = self.total(load, flow.array, convection * now, stored * (now - start))
            # A level temperature leaves nothing but round-off.
            sizes = self.total(load, (self.diagonal + convection + stored) * now, stored * start)
            if self.total(rest) <= max(BALANCED * moved, ROUND_OFF * sizes):
                return now, spent
            self.prepare(stored + convection + 4.0 * emitted * np.maximum(np.abs(kelvin), 1e-2) ** 3, held)
            change = self.stiffness.createVecRight()
            self.solver.solve(self.filled(rest), change)
            now, spent = now + change.array, spent + self.solver.getIterationNumber()
            if self.solver.getConvergedReason() <= 0:
                raise SystemExit(f"Conjugate gradients stopped after {MOST_ITERATIONS} iterations.")
        raise SystemExit(f"Newton's method did not end after {MOST_NEWTON} steps.")

    def filled(self, values: np.ndarray) -> PETSc.Vec:
        """Return a PETSc vector with these entries of this process."""
        vector = self.stiffness.createVecRight()
        vector.array[:] = values
        return vector

    def prepare(self, slope: np.ndarray, held: np.ndarray) -> None:
        """Let the solver solve with the stiffness plus the diagonal `slope`; rows of `held` nodes become those of 1."""
        if self.total(np.nan_to_num(slope - self.slope, nan=1.0)) == 0.0:
            return
        self.slope, matrix = slope, self.stiffness.copy()
        matrix.setDiagonal(self.filled(slope), addv=PETSc.InsertMode.ADD_VALUES)
        rows = self.stiffness.getOwnershipRange()[0] + np.flatnonzero(held)
        matrix.zeroRowsColumns(rows.astype(np.int32), diag=1.0)
        self.solver.setOperators(matrix)
        self.solver.setType("cg")
        self.solver.getPC().setType("gamg")
        self.solver.setTolerances(rtol=TOLERANCE, atol=1e-300, max_it=MOST_ITERATIONS)

    def run(self) -> None:
        """Follow all steps; process 0 writes the temperatures at their ends, a row each, and says how far it is."""
        steps, states, now = self.given["steps"], None, self.vector("start", 0)
        if self.comm.rank == 0:
            shape = (steps, self.given["nodes"])
            states = np.lib.format.open_memmap(self.folder / "states.npy", "w+", np.float64, shape)
        for step in range(steps):
            now, spent = self.solved(now, step)
            parts = self.comm.gather((self.node, now))
            if states is not None:
                for node, values in parts:
                    states[step, node] = values
                print(f"DOLFINx: step {step + 1} of {steps}, {spent} iterations", flush=True)
        status = Path("/proc/self/status").read_text()  # Debian's and Ubuntu's DOLFINx run on Linux
        largest_kb = self.comm.allreduce(int(status.split("VmHWM:")[1].split()[0]), MPI.MAX)
        if self.comm.rank == 0:
            print(f"DOLFINx: {self.comm.size} processes, each with at most {largest_kb / 1e6:.2f} GB", flush=True)


if __name__ == "__main__":
    if MPI.COMM_WORLD.size != int(sys.argv[2]):
        raise SystemExit(f"MPI started {MPI.COMM_WORLD.size} processes that know of each other, not {sys.argv[2]}.")
    Part(Path(sys.argv[1])).run()
