"""What accuracy costs in meshing: resolution against errors, tetrahedra, seconds and memory, for both boundary modes.

    python tests/benchmarks/mesh_cost.py --csv mesh-cost.csv --plot docs/mesh-cost.png
    python tests/benchmarks/mesh_cost.py --bodies hot-object --modes voxel --resolutions 128 --csv mesh-cost.csv
    python tests/benchmarks/mesh_cost.py --bodies --csv mesh-cost.csv --plot docs/mesh-cost.png
    python tests/benchmarks/mesh_cost.py --speed

The fields are exact: at voxel centres the logarithm of the density is the signed distance to a body whose area and
volume are known. Each case runs in a process of its own, so that its peak memory is its own; the seconds are those of
`build_mesh` with all tags, 40 cameras on a sphere around the body, the median of `--repeats` runs.

Every case is put into the csv file as soon as it is measured, in the place of an earlier one of the same body, lattice
and boundary, and the plot shows all that the file holds: parts can be measured apart (second line), or nothing (third).

`--speed` times a lattice of 128^3 voxels, 5 % of them solid, beside a plain Python loop over the same voxels.
"""

import csv
import json
import multiprocessing
import resource
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
from measuring import logarithmic_panels, save, write_rows

from tests.support.demo_mesh import exact_snapshot
from thermoxels_ns.core.lattice import CORNER_OFFSETS, Lattice
from thermoxels_ns.core.snapshot import GridSnapshot, Views
from thermoxels_ns.evaluation.truth_comparison import sample_facets
from thermoxels_ns.mesh.build import BuiltMesh, MeshOptions, build_mesh
from thermoxels_ns.mesh.quality.checks import facet_areas
from thermoxels_ns.mesh.quality.report import check_mesh
from thermoxels_ns.mesh.quality.tet_shapes import signed_volumes
from thermoxels_ns.mesh.solid.voxels import SolidSelection, select_solid
from thermoxels_ns.mesh.voxel_tets import KUHN_PATTERN
from thermoxels_ns.synthetic.camera_rings import look_at
from thermoxels_ns.synthetic.scene_folder import make_scene

Vector = npt.NDArray[np.float64]
Mode = Literal["conforming", "voxel"]
BodyName = Literal["sphere", "slab at 30 degrees", "torus", "house-corner", "hot-object"]
MODES: tuple[Mode, ...] = ("conforming", "voxel")
BODIES: tuple[BodyName, ...] = ("sphere", "slab at 30 degrees", "torus", "house-corner", "hot-object")


@dataclass(frozen=True)
class Body:
    """A body whose size is known exactly, in a box around it."""

    signed_distance: Callable[[Vector], Vector]
    area: float
    volume: float
    box: Any = ((-1.1, -1.1, -1.1), (1.1, 1.1, 1.1))


def body_named(name: str) -> Body:
    """A unit sphere, a torus around z, a box turned about y, or the exact solid of a synthetic scene."""
    pi = np.pi
    if name == "sphere":
        return Body(lambda p: np.linalg.norm(p, axis=1) - 1.0, 4 * pi, 4 / 3 * pi)
    if name == "torus":
        large, small = 0.7, 0.3
        return Body(
            lambda p: np.hypot(np.hypot(p[:, 0], p[:, 1]) - large, p[:, 2]) - small,
            4 * pi**2 * large * small,
            2 * pi**2 * large * small**2,
        )
    if name == "slab at 30 degrees":
        (a, b, c), angle = (1.6, 1.4, 0.5), np.radians(30.0)
        turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])

        def distance(points: Vector) -> Vector:
            q = np.abs(points @ turn) - np.array((a, b, c)) / 2
            return np.linalg.norm(np.maximum(q, 0.0), axis=1) + np.minimum(q.max(axis=1), 0.0)

        return Body(distance, 2 * (a * b + b * c + a * c), a * b * c)
    scene = make_scene(name)
    return Body(scene.solid.signed_distance, scene.solid.area, scene.solid.volume, scene.scene_box)


def snapshot_of(body: Body, voxels: int) -> GridSnapshot:
    """A field of the exact body, seen from all sides."""
    low, high = np.array(body.box)
    views = cameras_around(0.5 * (low + high), 1.5 * float(np.linalg.norm(high - low)), 40)
    return exact_snapshot(body.signed_distance, Lattice.covering(*body.box, voxels), views=views)


def cameras_around(centre: Vector, reach: float, count: int) -> Views:
    """Cameras spread over a sphere, all looking at its middle."""
    height = 1.0 - 2.0 * (np.arange(count) + 0.5) / count
    around = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    ring = np.sqrt(1.0 - height**2)
    back = np.stack([ring * np.cos(around), ring * np.sin(around), height], axis=1)
    poses = np.stack([look_at(centre + reach * one, centre)[:3] for one in back])
    return Views(poses, np.full((count, 2), 500.0), np.full((count, 2), 320.0), np.full((count, 2), 640))


def timed_build(snapshot: GridSnapshot, selection: SolidSelection, mode: Mode, repeats: int) -> tuple[BuiltMesh, float]:
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        built = build_mesh(snapshot, selection, np.eye(4), MeshOptions(mode))
        seconds.append(time.perf_counter() - start)
    return built, statistics.median(seconds)


def measure(name: str, voxels: int, mode: Mode, repeats: int) -> dict[str, Any]:
    """One case; runs in a process of its own."""
    body = body_named(name)
    snapshot = snapshot_of(body, voxels)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    built, seconds = timed_build(snapshot, SolidSelection(density_threshold=1.0, close_gaps=0), mode, repeats)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    mesh, quality = built.mesh, check_mesh(built.mesh)
    assert mesh.boundary is not None
    area = float((facet_areas(mesh.points_m, mesh.facets) * mesh.boundary.area_factor).sum())
    distance = np.abs(body.signed_distance(sample_facets(mesh.points_m, mesh.facets, 50_000)))
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
        "tets": quality.num_tets,
        "seconds": seconds,
        "peak_mb": peak / 1024,
        "area_error": area / body.area - 1.0,
        "area_error_of_triangles": quality.area_m2 / body.area - 1.0,
        "volume_error": quality.volume_m3 / body.volume - 1.0,
        "mean_distance_voxels": float(distance.mean()) / snapshot.lattice.voxel_size,
        "hausdorff_voxels": float(distance.max()) / snapshot.lattice.voxel_size,
        "iou": inside / (quality.volume_m3 + body.volume - inside),
        "dihedral_min": quality.dihedral_range_deg[0],
        "dihedral_max": quality.dihedral_range_deg[1],
    }


def plain_loop(cells: npt.NDArray[np.bool_]) -> list[list[int]]:
    """Six tetrahedra per voxel in plain Python, as one would write it down; no tags, no temperatures."""
    offsets, pattern = CORNER_OFFSETS.tolist(), KUHN_PATTERN.tolist()
    numbers: dict[tuple[int, int, int], int] = {}
    tets = []
    nx, ny, nz = cells.shape
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                if cells[i, j, k]:
                    corners = [numbers.setdefault((i + x, j + y, k + z), len(numbers)) for x, y, z in offsets]
                    tets.extend([corners[c] for c in tet] for tet in pattern)
    return tets


def speed(repeats: int) -> None:
    """Seconds for a spherical shell of 5 % of 128^3 voxels, as trained fields have it, and as many of 256^3."""
    selection = SolidSelection(density_threshold=1.0, close_gaps=0, interior="hollow")
    for voxels, share in ((128, 0.05), (256, 0.05 / 8)):
        middle, thickness = 0.5 * voxels, 3.0
        radius = float(np.sqrt(share * voxels**3 / (4.0 * np.pi * thickness)))
        shell = Body(
            lambda p, m=middle, r=radius, t=thickness: np.abs(np.linalg.norm(p - m, axis=1) - r) - 0.5 * t,
            0.0,
            0.0,
            ((0.0, 0.0, 0.0), (float(voxels),) * 3),
        )
        snapshot = snapshot_of(shell, voxels)
        cells = select_solid(snapshot, selection).cells
        start = time.perf_counter()
        tets = plain_loop(cells)
        loop = time.perf_counter() - start
        print(f"{voxels}^3, {cells.mean():.2%} solid: plain loop {loop:.2f} s, {len(tets)} tetrahedra")
        for mode in MODES:
            built, median = timed_build(snapshot, selection, mode, repeats)
            print(f"  {mode}: {median:.2f} s with tags, {len(built.mesh.tets)} tetrahedra, {median / loop:.2f} x loop")


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
            if chosen and key == "area_error" and mode == "voxel":
                stairs = [(row["seconds"], abs(100 * row["area_error_of_triangles"])) for row in chosen]
                panel.plot(*zip(*stairs), color=colour, marker="s", ls=":", alpha=0.6, label="voxel, plain area")
        panel.margins(x=0.2)
        panels[0][column].set_title(name)
        panels[1][column].set_xlabel("seconds")
        panels[line][0].set_ylabel(f"{key.replace('_', ' ')} [%]")
    panels[0][0].legend(fontsize=7, loc="upper right")
    save(figure, path, dpi=130)


def read_rows(path: Path | None) -> list[dict[str, Any]]:
    """What an earlier run measured; nothing without a file."""
    if path is None or not path.is_file():
        return []
    kinds = {"body": str, "mode": str, "voxels": int, "tets": int}
    with path.open(newline="", encoding="utf-8") as file:
        return [{key: kinds.get(key, float)(value) for key, value in row.items()} for row in csv.DictReader(file)]


@dataclass
class MeshCost:
    resolutions: tuple[int, ...] = (16, 32, 64, 128)
    """Voxels along the longest side."""
    bodies: tuple[BodyName, ...] = BODIES
    """Bodies; none: only plot what the csv file holds."""
    modes: tuple[Mode, ...] = MODES
    """Boundaries."""
    repeats: int = 5
    """Runs per median."""
    csv: Path | None = None
    """File of all cases."""
    plot: Path | None = None
    """Where the picture goes."""
    speed: bool = False
    """Only time 128^3 and 256^3 voxels beside a plain loop."""

    def main(self) -> None:
        if self.speed:
            speed(self.repeats)
            return
        rows = {(row["body"], row["voxels"], row["mode"]): row for row in read_rows(self.csv)}
        spawn = multiprocessing.get_context("spawn")
        print("| body | voxels | boundary | tets | s | MB | area | volume | Hausdorff | IoU |")
        print("|---|---:|---|---:|---:|---:|---:|---:|---:|---:|")
        for case in product(self.bodies, self.resolutions, self.modes):
            with spawn.Pool(1) as pool:
                row = rows[case] = pool.apply(measure, (*case, self.repeats))
            rows = dict(sorted(rows.items(), key=lambda r: (BODIES.index(r[0][0]), r[0][1], MODES.index(r[0][2]))))
            if self.csv:
                write_rows(self.csv, list(rows.values()))
            print(
                f"| {row['body']} | {row['voxels']} | {row['mode']} | {row['tets']:,} | {row['seconds']:.2f} "
                f"| {row['peak_mb']:.0f} | {100 * row['area_error']:+.2f} % | {100 * row['volume_error']:+.2f} % "
                f"| {row['hausdorff_voxels']:.2f} | {row['iou']:.4f} |",
                flush=True,
            )
        if not rows:
            raise SystemExit("nothing was measured and the csv file holds nothing: name --bodies or a --csv")
        if self.plot:
            plot(list(rows.values()), self.plot)
        angles = [[row[f"dihedral_{end}"] for row in rows.values()] for end in ("min", "max")]
        print(json.dumps({"worst_angles": [min(angles[0]), max(angles[1])]}))


if __name__ == "__main__":
    tyro.cli(MeshCost).main()
