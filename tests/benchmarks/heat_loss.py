"""How far the heat loss of a reconstruction is off that of the exact body, by kind of mesh.

    python tests/benchmarks/heat_loss.py outputs/hot-object/thermoxels/TIME/config.yml ...

A body of concrete starts at 20 C in air of 0 C that takes heat from all of its surface with 25 W/(m2 K); the heat it
has lost after `--hours` (ten equal steps) is compared with that of the exact body, a conforming mesh of the scene's
signed distance on a lattice `--finer` times as fine. Reconstructions are meshed as an export does by default: voxels
with the plain area of their faces, voxels with the area factor, and conforming. Scenes with a known truth only.
"""

import argparse
from pathlib import Path

import measuring  # noqa: F401 - makes tests.support importable
import numpy as np

from tests.support.demo_mesh import exact_snapshot
from tests.support.heat_bodies import CONCRETE
from thermoxels_ns.commands.export import load_trained_scene
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.evaluation.truth_comparison import load_known_truth
from thermoxels_ns.fem.problem import HeatProblem, TimeSteps
from thermoxels_ns.fem.time_loop import solve_heat
from thermoxels_ns.heat.effects import Convection
from thermoxels_ns.mesh.build import MeshOptions, build_mesh
from thermoxels_ns.mesh.quality.tet_shapes import signed_volumes
from thermoxels_ns.mesh.solid.voxels import SolidSelection
from thermoxels_ns.mesh.tetrahedra import TetMesh, facet_areas


def exact_mesh(scene, voxels: int) -> TetMesh:
    snapshot = exact_snapshot(scene.solid.signed_distance, Lattice.covering(*scene.scene_box, voxels))
    return build_mesh(snapshot, SolidSelection(density_threshold=1.0, close_gaps=0), np.eye(4)).mesh


def heat_lost_j(mesh: TetMesh, hours: float) -> float:
    start = np.full(len(mesh.points_m), 20.0)
    problem = HeatProblem(mesh, CONCRETE, start, effects=(Convection(("*",), 25.0, 0.0),))
    solution = solve_heat(problem, TimeSteps(10, 360.0 * hours))
    return float(solution.heat_content_j[0] - solution.heat_content_j[-1])


def size(mesh: TetMesh) -> tuple[float, float]:
    return float(facet_areas(mesh.points_m, mesh.facets).sum()), float(signed_volumes(mesh.points_m, mesh.tets).sum())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("configs", type=Path, nargs="+")
    parser.add_argument("--hours", type=float, default=1.0)
    parser.add_argument("--finer", type=float, default=1.5)
    arguments = parser.parse_args()
    rows = []
    for config in arguments.configs:
        trained = load_trained_scene(config)
        known = load_known_truth(trained.scene_folder)
        if known is None:
            raise SystemExit(f"{config}: the exact shape of this scene is not known")
        exact = exact_mesh(known.scene, round(arguments.finer * max(trained.snapshot.lattice.cell_shape)))
        truth = heat_lost_j(exact, arguments.hours)
        area, volume = size(exact)
        rows.append(
            f"| {known.scene.name} | exact shape, meshed | {100 * (area / known.scene.solid.area - 1):+.1f} % "
            f"| {100 * (volume / known.scene.solid.volume - 1):+.1f} % | {truth / 3.6e6:.4g} kWh |"
        )
        for mode in ("voxel", "conforming"):
            mesh = build_mesh(trained.snapshot, SolidSelection(), trained.world_to_input, MeshOptions(mode)).mesh
            area, volume = size(mesh)
            lost = heat_lost_j(mesh, arguments.hours)
            rows.append(
                f"| {known.scene.name} | {mode} | {100 * (area / known.scene.solid.area - 1):+.1f} % "
                f"| {100 * (volume / known.scene.solid.volume - 1):+.1f} % | {100 * (lost / truth - 1):+.1f} % |"
            )
    print("\n| scene | mesh | area | volume | heat lost |\n|---|---|---:|---:|---:|")
    print("\n".join(rows))


if __name__ == "__main__":
    main()
