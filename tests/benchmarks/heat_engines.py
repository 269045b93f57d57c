"""What a steady state costs with our own solver and with DOLFINx, from 0.4 to 8 million tetrahedra: seconds and memory.

Run it on an otherwise idle machine that has DOLFINx (`tools/install-external.sh`):

    python tests/benchmarks/heat_engines.py --ranks 1 2

A concrete cube of 1 m, cut into N^3 voxels of six tetrahedra, has air of 20 C on one side and of 0 C on the other. Each
answer is made in a process of its own, from the mesh to the heat flow of each effect. Seconds are those of one run
without imports; DOLFINx's include what goes through files. Memory is the peak of our process and, beside it, of the
largest process of DOLFINx.
"""

import time
from dataclasses import dataclass

import numpy as np
import tyro
from measuring import in_own_process, peak_memory_bytes, print_head, print_row


@dataclass
class HeatEngines:
    voxels: tuple[int, ...] = (40, 64, 88, 110)
    """Voxels along a side, N; the mesh has 6 N^3 tetrahedra."""
    ranks: tuple[int, ...] = (1, 2)
    """Numbers of processes of DOLFINx; none: our own solver alone."""

    def main(self) -> None:
        print_head("tetrahedra", "solved by", "seconds", "peak memory", "largest process of DOLFINx", "heat flow")
        for voxels in self.voxels:
            for ranks in (0, *self.ranks):
                seconds, own_gb, theirs, flow_w = in_own_process(cost, voxels, ranks)
                name = f"DOLFINx, {ranks}" if ranks else "our own solver"
                print_row(f"{6 * voxels**3:,}", name, f"{seconds:.1f}", f"{own_gb:.2f} GB", theirs, f"{flow_w:.6f} W")


def cost(voxels: int, ranks: int) -> tuple[float, float, str, float]:
    """Return seconds, our peak of memory, [GB], the last words of DOLFINx about its own, and the heat flow, [W]."""
    from tests.support.heat_bodies import CONCRETE, SIDES
    from thermoxels_ns.fem.problem import HeatProblem
    from thermoxels_ns.fem.steady import solve_steady
    from thermoxels_ns.heat.dolfinx_engine import DolfinxEngine
    from thermoxels_ns.heat.effects import Convection
    from thermoxels_ns.mesh.quality.checks import boundary_facets
    from thermoxels_ns.mesh.tetrahedra import Boundary, TetMesh
    from thermoxels_ns.mesh.voxel_tets import kuhn_tets

    corners, tets = kuhn_tets(np.ones((voxels, voxels, voxels), bool))
    points, facets = corners / voxels, boundary_facets(tets)
    x = points[facets, 0]
    patch = np.select([(x == 0.0).all(axis=1), (x == 1.0).all(axis=1)], [0, 1], default=2)
    boundary = Boundary(np.ones(len(facets), bool), patch, SIDES[:3])
    nodal, seen, region = np.full(len(points), 10.0), np.ones(len(points), bool), np.zeros(len(tets), np.int64)
    mesh = TetMesh(points, tets, nodal, seen, facets, np.zeros(len(facets), np.int64), region, boundary=boundary)
    begin = time.perf_counter()
    effects = Convection((SIDES[0],), 7.7, 20.0), Convection((SIDES[1],), 25.0, 0.0)
    said = [""]
    engine = DolfinxEngine(ranks, said.append) if ranks else None
    found = solve_steady(HeatProblem(mesh, CONCRETE, effects=effects), engine=engine)
    seconds = time.perf_counter() - begin
    return seconds, peak_memory_bytes() / 1e9, said[-1].rpartition("at most ")[2], float(found.effects[0].heat_w[0])


if __name__ == "__main__":
    tyro.cli(HeatEngines).main()
