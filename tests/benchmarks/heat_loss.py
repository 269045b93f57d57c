"""How far the heat loss of a reconstruction is off that of the exact body, by kind of mesh.

    python tests/benchmarks/heat_loss.py outputs/hot-object/thermoxels/TIME/config.yml ...

A body of concrete starts at 20 C in air of 0 C that takes heat from all of its surface with 25 W/(m2 K); the heat it
has lost after an hour (ten equal steps) is compared with that of the exact body, a conforming mesh of the scene's
signed distance on a lattice 1.5 times as fine. Reconstructions are meshed as an export does by default, and as voxels.
Scenes with a known truth only.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from measuring import print_head, print_row

from tests.support.demo_mesh import demo_mesh
from tests.support.heat_bodies import CONCRETE
from thermoxels_ns.commands.export import load_trained_scene
from thermoxels_ns.evaluation.truth_comparison import load_known_truth
from thermoxels_ns.fem.problem import HeatProblem, TimeSteps
from thermoxels_ns.fem.time_loop import solve_heat
from thermoxels_ns.heat.effects import Convection
from thermoxels_ns.mesh.build import build_mesh
from thermoxels_ns.mesh.quality.tet_shapes import signed_volumes
from thermoxels_ns.mesh.solid.voxels import SolidSelection
from thermoxels_ns.mesh.tetrahedra import TetMesh, facet_areas

FINER = 1.5  # Lattice of the exact body against that of the reconstruction


def heat_lost_j(mesh: TetMesh) -> float:
    start = np.full(len(mesh.points_m), 20.0)
    problem = HeatProblem(mesh, CONCRETE, start, effects=(Convection(("*",), 25.0, 0.0),))
    solution = solve_heat(problem, TimeSteps(10, 360.0))
    return float(solution.heat_content_j[0] - solution.heat_content_j[-1])


def size(mesh: TetMesh) -> tuple[float, float]:
    return float(facet_areas(mesh.points_m, mesh.facets).sum()), float(signed_volumes(mesh.points_m, mesh.tets).sum())


@dataclass
class HeatLoss:
    configs: tyro.conf.Positional[tuple[Path, ...]]
    """config.yml of trainings on scenes whose truth is known."""

    def main(self) -> None:
        print_head("scene", "mesh", "area", "volume", "heat lost")
        for config in self.configs:
            trained = load_trained_scene(config)
            known = load_known_truth(trained.scene_folder)
            if known is None:
                raise SystemExit(f"{config}: the exact shape of this scene is not known")
            meshes = {
                "exact shape": demo_mesh(known.scene.name, round(FINER * max(trained.snapshot.lattice.cell_shape)))
            }
            for mode in ("voxel", "conforming"):
                built = build_mesh(trained.snapshot, SolidSelection(), trained.world_to_input, mode)
                meshes[mode] = built.mesh
            truth, true = heat_lost_j(meshes["exact shape"]), known.scene.solid
            for name, mesh in meshes.items():
                area, volume = size(mesh)
                off = (area / true.area - 1.0, volume / true.volume - 1.0, heat_lost_j(mesh) / truth - 1.0)
                print_row(known.scene.name, name, *(f"{100 * error:+.1f} %" for error in off))


if __name__ == "__main__":
    tyro.cli(HeatLoss).main()
