"""A street of six houses, cut into blocks, trained block by block and joined: does the seam show?

    python tests/benchmarks/street_blocks.py --output RUNS --blocks 3

A terrace of six houses, 37 m long, with windows, doors and different walls is photographed from the street, written as
one scene, and goes the way of a user: `thermoxels split`, `ns-train` per block, `ns-export --beside`, `thermoxels heat`
with air along the street. Distances of the mesh's seen surface to the truth, errors of its temperature, and the heat
flow per area are printed for the places within half a metre of a seam and for all others. What is there is not made
again.
"""

import json
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from measuring import print_head, print_row, run_of, run_quietly, trained

HOUSE_M, HOUSES = (6.0, 5.0, 5.2), 6
NEAR_M = 0.5
AIR_C, FILM_W_M2K = 0.0, 15.0


def street():
    """The terrace: houses of two to three storeys' height side by side, a pavement before them, a sky above."""
    from thermoxels_ns.synthetic.appearance import Paint, SunLight, sky_rgb, sky_temperature_c
    from thermoxels_ns.synthetic.random_plan import Plan
    from thermoxels_ns.synthetic.random_scene import painted_scene
    from thermoxels_ns.synthetic.scene_truth import CameraWalk
    from thermoxels_ns.synthetic.solids import distance_to_box

    plan, random = Plan(np.random.default_rng(0), unit=0.05), np.random.default_rng(1)
    width, depth, high = HOUSE_M
    length = HOUSES * width
    ground = ((-0.5, -3.0, -0.4), (length + 0.5, depth + 0.3, 0.0))
    plan.put(ground, plan.add_paint(Paint((0.45, 0.44, 0.42), 0.24)))
    for number in range(HOUSES):
        x, top = number * width, high + 0.5 * random.integers(0, 3)
        base = np.clip(np.array([0.7, 0.6, 0.5]) + random.uniform(-0.15, 0.15, 3), 0.2, 0.9)
        plan.put(((x, 0.0, 0.0), (x + width, depth, top)), plan.add_paint(Paint(tuple(base.tolist()), 0.22)))
        for low in (0.9, 3.0):
            for left in (0.8, 3.6):
                if low > 1.0 or left < 1.0:
                    pane = plan.add_paint(Paint((0.22, 0.30, 0.40), 0.16))
                    plan.recess((1, -1, 0.0), (x + left, x + left + 1.3), (low, low + 1.3), 0.25, pane, 11.0)
        door = plan.add_paint(Paint((0.42, 0.22, 0.14), 0.18))
        plan.recess((1, -1, 0.0), (x + 4.0, x + 5.0), (0.0, 2.1), 0.25, door, 8.0)

    def temperature_c(points):
        points = np.asarray(points, dtype=np.float64)
        warm = 4.0 + 1.5 * np.sin(points[:, 0] / 5.0) + 0.2 * points[:, 2]
        plan.add_glows(warm, points)
        house = distance_to_box(points, (0.0, 0.0, 0.0), (length, depth, 7.0))
        return np.where(house > 1e-6, 1.5 + 2.0 * np.exp(-np.maximum(house, 0.0)), warm)

    walks = [
        CameraWalk(((-3.0, -9.0, height), (length + 3.0, -9.0, height)), ((aim, 0.0, 2.2), (length + aim, 0.0, 2.2)))
        for height, aim in ((1.7, 0.0), (1.7, -4.0), (1.7, 4.0), (5.5, 0.0))
    ]
    return painted_scene(
        plan,
        texture_seed=3,
        light=SunLight(towards=(0.4, -0.8, 0.5)),
        name="terrace",
        scene_box=((-0.8, -3.2, -0.6), (length + 0.8, depth + 0.5, 7.0)),
        temperature_bounds_c=(-20.0, 15.0),
        surface_temperature_c=temperature_c,
        background_rgb=sky_rgb,
        background_temperature_c=lambda directions: sky_temperature_c(directions, AIR_C, 20.0),
        rings=tuple(walks),
        focal_share=0.75,
    )


@dataclass
class StreetBlocks:
    """Split, train, join and compare."""

    output: Path
    """Folder for scene, blocks, logs and the joined mesh."""
    blocks: int = 3
    """Blocks into which the street is cut."""
    quality: Literal["draft", "standard"] = "standard"
    """Quality of the trainings."""
    views: int = 112
    """Photographs that train."""

    def main(self) -> None:
        from thermoxels_ns.synthetic.scene_folder import TRUTH, write_scene

        scene, folder = street(), self.output / "scene"
        if not (folder / "transforms.json").is_file():
            write_scene(scene, folder, self.views, 12, progress=False)
            (folder / TRUTH).unlink()  # no command knows a scene of this name
        blocks = self.output / "blocks"
        command = ["thermoxels", "split", str(folder), "--blocks", str(self.blocks), "--output-dir", str(blocks)]
        run_quietly(command, self.output / "split.log")
        configs, seconds = [], []
        for number in range(self.blocks):
            run = self.output / f"block-{number + 1}"
            configs.append(run_of(run) / "config.yml")
            if not configs[-1].is_file():
                seconds.append(trained(blocks / run.name, run, ["--quality", self.quality]))
        mesh, others = self.output / "export" / "mesh.vtu", map(str, configs[1:])
        command = ["ns-export", "thermoxels-mesh", "--load-config", str(configs[0]), "--beside", *others]
        export = run_quietly([*command, "--output-dir", str(mesh.parent)], self.output / "export.log")
        air = {"patches": ["*"], "air_c": AIR_C, "coefficient_w_m2k": FILM_W_M2K}
        stone = {"conductivity_w_mk": 1.7, "density_kg_m3": 2200, "specific_heat_j_kgk": 880}
        time = {"steps": 6, "step_seconds": 600}
        path = self.output / "scene.yaml"
        path.write_text(json.dumps({"materials": {"*": stone}, "outside_air": air, "time": time}), encoding="utf-8")
        command = ["thermoxels", "heat", str(mesh), "--scene", str(path), "--output-dir", str(self.output / "heat")]
        run_quietly([*command, "--memory-gb", "12"], self.output / "heat.log")
        cost = f"{export.seconds:.0f} s, {export.peak_memory_gb:.1f} GB"
        print(f"Trainings {[round(one) for one in seconds]} s, export {cost}\n")
        written = [blocks / f"block-{number + 1}" / "transforms.json" for number in range(self.blocks)]
        boxes = [json.loads(one.read_text(encoding="utf-8"))["scene_box"] for one in written]
        seams = [0.5 * (before[1][0] + after[0][0]) for before, after in pairwise(boxes)]
        compare(mesh, scene, seams)


def compare(path: Path, scene, seams_m: list[float]) -> None:
    """Print the errors of the seen surface beside the seams, and elsewhere on the houses' fronts."""
    from thermoxels_ns.mesh.files.vtu import read_mesh
    from thermoxels_ns.mesh.quality.checks import check_mesh

    mesh = read_mesh(path)
    figures, nodes = check_mesh(mesh), np.unique(mesh.facets[mesh.boundary.seen])
    points = mesh.points_m[nodes]
    x, y, _ = points.T
    seen = mesh.observed[nodes] & (y < 0.5)
    away = np.min([np.abs(x - seam) for seam in seams_m], axis=0)
    distance = np.abs(scene.solid.signed_distance(points))
    off_k = np.abs(mesh.temperature_c[nodes] - scene.surface_temperature_c(points))
    print(
        f"{len(mesh.tets):,} tetrahedra, {figures.num_non_manifold_edges} edges that are not manifold; seams at "
        f"x = {', '.join(f'{seam:.2f}' for seam in seams_m)} m\n"
    )
    print_head("where", "nodes", "distance, median", "distance, 95 %", "temperature, median", "temperature, 95 %")
    for name, chosen in ((f"within {NEAR_M} m of a seam", away <= NEAR_M), ("elsewhere", away > NEAR_M)):
        chosen = chosen & seen
        spread = [
            f"{np.quantile(values[chosen], q):.3f} {unit}"
            for values, unit in ((distance, "m"), (off_k, "K"))
            for q in (0.5, 0.95)
        ]
        print_row(name, int(chosen.sum()), *spread)


if __name__ == "__main__":
    tyro.cli(StreetBlocks).main()
