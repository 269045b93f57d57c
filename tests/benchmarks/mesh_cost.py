"""What accuracy costs in meshing: resolution against errors, tetrahedra, seconds and memory, for both boundary modes.

    python tests/benchmarks/mesh_cost.py --plot docs/mesh-cost.png
    python tests/benchmarks/mesh_cost.py --bodies hot-object --modes voxel --resolutions 128

The fields are exact: at voxel centres the logarithm of the density is the signed distance to a body whose area and
volume are known. Each case runs in a process of its own, so that its peak memory is its own; the seconds are those of
`build_mesh` with all tags, 40 cameras on a sphere around the body, the median of `--repeats` runs.
"""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import tyro
from measuring import in_own_process, logarithmic_panels, peak_memory_bytes, print_head, print_row, save
from trimesh import Trimesh
from trimesh.sample import sample_surface

from tests.support.demo_mesh import exact_snapshot
from tests.support.looking_cameras import looking_at
from tests.support.stuffed_shapes import SHAPES
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.core.snapshot import GridSnapshot
from thermoxels_ns.mesh.build import build_mesh
from thermoxels_ns.mesh.quality.checks import check_mesh
from thermoxels_ns.mesh.quality.tet_shapes import signed_volumes
from thermoxels_ns.mesh.solid.voxels import SolidSelection
from thermoxels_ns.synthetic.scene_folder import make_scene

Vector = npt.NDArray[np.float64]
MODES = ("conforming", "voxel")
BODIES = ("sphere", "slab at 30 degrees", "torus", "house-corner", "hot-object")


@dataclass(frozen=True)
class Body:
    """A body whose size is known exactly, in a box around it."""

    signed_distance: Callable[[Vector], Vector]
    area: float
    volume: float
    box: Any


def body_named(name: str) -> Body:
    """One of the known shapes, or the exact solid of a synthetic scene."""
    if name in SHAPES:
        shape = SHAPES[name]
        return Body(shape.distance, shape.area, shape.volume, ((-0.88, -0.88, -0.88), (0.88, 0.88, 0.88)))
    scene = make_scene(name)
    return Body(scene.solid.signed_distance, scene.solid.area, scene.solid.volume, scene.scene_box)


def snapshot_of(body: Body, voxels: int) -> GridSnapshot:
    """A field of the exact body, seen by 40 cameras on a sphere around it, which look at its middle."""
    low, high = np.array(body.box)
    height = 1.0 - 2.0 * (np.arange(40) + 0.5) / 40
    around, ring = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(40), np.sqrt(1.0 - height**2)
    outward = np.stack([ring * np.cos(around), ring * np.sin(around), height], axis=1)
    middle = 0.5 * (low + high)
    views = looking_at(middle, middle + 1.5 * np.linalg.norm(high - low) * outward, focal=500.0, size=640)
    return exact_snapshot(body.signed_distance, Lattice.covering(*body.box, voxels), views=views)


def measure(name: str, voxels: int, mode: Any, repeats: int) -> dict[str, Any]:
    """One case."""
    body = body_named(name)
    snapshot = snapshot_of(body, voxels)
    before = peak_memory_bytes()
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        selection = SolidSelection(density_threshold=1.0, close_gaps=0)
        built = build_mesh(snapshot, selection, np.eye(4), mode)
        seconds.append(time.perf_counter() - start)
    peak = peak_memory_bytes() - before
    mesh, quality = built.mesh, check_mesh(built.mesh)
    drawn, _ = sample_surface(Trimesh(mesh.points_m, mesh.facets, process=False), 50_000, seed=0)
    distance = np.abs(body.signed_distance(np.asarray(drawn, np.float64)))
    # Volume of the mesh inside the body, from 35 points evenly spread over each tetrahedron.
    volumes = signed_volumes(mesh.points_m, mesh.tets)
    parts = np.array([s for s in np.ndindex(5, 5, 5, 5) if sum(s) == 4])
    inside = 0.0
    for share in (parts + 0.25) / 5.0:
        points = np.einsum("c,tcd->td", share, mesh.points_m[mesh.tets])
        inside += float(volumes[body.signed_distance(points) <= 0.0].sum()) / len(parts)
    inside = min(inside, quality.volume_m3, body.volume)
    return {
        "body": name,
        "voxels": voxels,
        "mode": mode,
        "tets": len(mesh.tets),
        "seconds": statistics.median(seconds),
        "peak_mb": peak / 2**20,
        "area_error": quality.area_m2 / body.area - 1.0,
        "volume_error": quality.volume_m3 / body.volume - 1.0,
        "hausdorff_voxels": float(distance.max()) / snapshot.lattice.voxel_size,
        "iou": inside / (quality.volume_m3 + body.volume - inside),
    }


def plot(rows: list[dict[str, Any]], path: Path) -> None:
    names = list(dict.fromkeys(row["body"] for row in rows))
    figure, panels = logarithmic_panels(2, len(names), figsize=(3.1 * len(names), 5.6), sharex=True, sharey="row")
    for (line, key), (column, name) in product(enumerate(("area_error", "volume_error")), enumerate(names)):
        panel = panels[line][column]
        for mode, colour, marker in (("conforming", "#b5367a", "o"), ("voxel", "#31688e", "s")):
            chosen = [row for row in rows if row["body"] == name and row["mode"] == mode]
            dots = [(row["seconds"], abs(100 * row[key])) for row in chosen]
            panel.plot(*zip(*dots), color=colour, marker=marker, label=mode) if dots else None
            for row, dot in zip(chosen, dots):
                panel.annotate(str(row["voxels"]), dot, xytext=(4, 4), textcoords="offset points", fontsize=7)
        panel.margins(x=0.2)
        panels[0][column].set_title(name)
        panels[1][column].set_xlabel("seconds")
        panels[line][0].set_ylabel(f"{key.replace('_', ' ')} [%]")
    panels[0][0].legend(fontsize=7, loc="upper right")
    save(figure, path)


@dataclass
class MeshCost:
    resolutions: tuple[int, ...] = (16, 32, 64, 128)
    """Voxels along the longest side."""
    bodies: tuple[str, ...] = BODIES
    """Bodies."""
    modes: tuple[Literal["conforming", "voxel"], ...] = MODES
    """Boundaries."""
    repeats: int = 5
    """Runs per median."""
    plot: Path | None = None
    """Where the picture goes."""

    def main(self) -> None:
        rows = []
        print_head("body", "voxels", "boundary", "tets", "s", "MB", "area", "volume", "Hausdorff", "IoU")
        for case in product(self.bodies, self.resolutions, self.modes):
            rows.append(row := in_own_process(measure, *case, self.repeats))
            print_row(
                *(*case, f"{row['tets']:,}", f"{row['seconds']:.2f}", f"{row['peak_mb']:.0f}"),
                *(f"{100 * row[name]:+.2f} %" for name in ("area_error", "volume_error")),
                *(f"{row['hausdorff_voxels']:.2f}", f"{row['iou']:.4f}"),
            )
        if self.plot:
            plot(rows, self.plot)


if __name__ == "__main__":
    tyro.cli(MeshCost).main()
