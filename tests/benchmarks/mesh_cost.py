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

from __future__ import annotations

import argparse
import csv
import json
import multiprocessing
import resource
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.checks import replace_when_done
from thermoxels_ns.core.lattice import CORNER_OFFSETS, Lattice
from thermoxels_ns.core.snapshot import GridSnapshot, Views

Vector = npt.NDArray[np.float64]
MODES = ("conforming", "voxel")


@dataclass(frozen=True)
class Body:
    """A body whose size is known exactly, in a box around it."""

    signed_distance: Callable[[Vector], Vector]
    area: float
    volume: float
    box: tuple[tuple[float, float, float], tuple[float, float, float]]


def sphere() -> Body:
    """Radius 1."""
    return Body(
        lambda p: np.linalg.norm(p, axis=1) - 1.0, 4 * np.pi, 4 / 3 * np.pi, ((-1.1, -1.1, -1.1), (1.1, 1.1, 1.1))
    )


def torus(large: float = 0.7, small: float = 0.3) -> Body:
    """Around z."""
    return Body(
        lambda p: np.hypot(np.hypot(p[:, 0], p[:, 1]) - large, p[:, 2]) - small,
        4 * np.pi**2 * large * small,
        2 * np.pi**2 * large * small**2,
        ((-1.1, -1.1, -1.1), (1.1, 1.1, 1.1)),
    )


def tilted_slab(degrees: float = 30.0, size: tuple[float, float, float] = (1.6, 1.4, 0.5)) -> Body:
    """A box turned about y."""
    angle = np.radians(degrees)
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    half = np.array(size) / 2

    def distance(points: Vector) -> Vector:
        q = np.abs(points @ turn) - half
        return np.linalg.norm(np.maximum(q, 0.0), axis=1) + np.minimum(q.max(axis=1), 0.0)

    a, b, c = size
    return Body(distance, 2 * (a * b + b * c + a * c), a * b * c, ((-1.1, -1.1, -1.1), (1.1, 1.1, 1.1)))


def demo_scene(name: str) -> Body:
    """The exact solid of a synthetic scene."""
    from thermoxels_ns.synthetic.scene_folder import make_scene

    scene = make_scene(name)  # type: ignore[arg-type]
    low, high = scene.scene_box
    box = tuple(float(v) for v in low), tuple(float(v) for v in high)
    return Body(scene.signed_distance, scene.area_m2, scene.volume_m3, box)  # type: ignore[arg-type]


BODIES: dict[str, Callable[[], Body]] = {
    "sphere": sphere,
    "slab at 30 degrees": tilted_slab,
    "torus": torus,
    "house-corner": lambda: demo_scene("house-corner"),
    "hot-object": lambda: demo_scene("hot-object"),
}


def exact_snapshot(body: Body, voxels: int) -> GridSnapshot:
    """A field whose density is 1 on the surface and grows e-fold per voxel inwards, seen from all sides."""
    lattice = Lattice.covering(*body.box, voxels)
    h = lattice.voxel_size

    def density(points: Vector) -> npt.NDArray[np.float32]:
        return np.exp(np.clip(-body.signed_distance(points.reshape(-1, 3)) / h, -8.0, 8.0)).astype(np.float32)

    corners = lattice.corner_positions()
    at_corners = density(corners).reshape(lattice.shape)
    centre = 0.5 * (np.array(body.box[0]) + np.array(body.box[1]))
    reach = 1.5 * float(np.linalg.norm(np.array(body.box[1]) - np.array(body.box[0])))
    return GridSnapshot(
        lattice,
        at_corners,
        np.full(lattice.shape, 20.0, np.float32),
        (np.abs(np.log(at_corners)) < 1.5).astype(np.float32),
        density(lattice.cell_centres()).reshape(lattice.cell_shape),
        views=ring_of_views(centre, reach, 40),
    )


def ring_of_views(centre: Vector, reach: float, count: int) -> Views:
    """Cameras spread over a sphere, all looking at its middle."""
    height = 1.0 - 2.0 * (np.arange(count) + 0.5) / count
    around = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    ring = np.sqrt(1.0 - height**2)
    back = np.stack([ring * np.cos(around), ring * np.sin(around), height], axis=1)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    poses = np.stack([right, np.cross(back, right), back, centre + reach * back], axis=2)
    return Views(poses, np.full((count, 2), 500.0), np.full((count, 2), 320.0), np.full((count, 2), 640))


def measure(name: str, voxels: int, mode: str, repeats: int) -> dict:
    """One case; runs in a process of its own."""
    from thermoxels_ns.evaluation.truth_comparison import sample_facets
    from thermoxels_ns.mesh.build import MeshOptions, build_mesh
    from thermoxels_ns.mesh.quality.checks import check_mesh, facet_areas
    from thermoxels_ns.mesh.quality.tet_shapes import signed_volumes
    from thermoxels_ns.mesh.solid.voxels import SolidSelection

    body = BODIES[name]()
    snapshot = exact_snapshot(body, voxels)
    selection = SolidSelection(density_threshold=1.0, close_gaps=0)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        mesh = build_mesh(snapshot, selection, np.eye(4), MeshOptions(mode)).mesh  # type: ignore[arg-type]
        seconds.append(time.perf_counter() - start)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    quality = check_mesh(mesh)
    assert mesh.boundary is not None
    triangles = facet_areas(mesh.points_m, mesh.facets)
    area = float((triangles * mesh.boundary.area_factor).sum())
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
        "seconds": statistics.median(seconds),
        "peak_mb": peak / 1024,
        "area_error": area / body.area - 1.0,
        "area_error_of_triangles": quality.area_m2 / body.area - 1.0,
        "volume_error": quality.volume_m3 / body.volume - 1.0,
        "mean_distance_voxels": float(distance.mean()) / snapshot.lattice.voxel_size,
        "hausdorff_voxels": float(distance.max()) / snapshot.lattice.voxel_size,
        "iou": inside / (quality.volume_m3 + body.volume - inside),
        "dihedral_min": quality.min_dihedral_deg,
        "dihedral_max": quality.max_dihedral_deg,
    }


def shell_snapshot(voxels: int = 128, share: float = 0.05) -> GridSnapshot:
    """A spherical shell with this share of the lattice's voxels, as a trained field has it."""
    middle, thickness = 0.5 * voxels, 3.0
    radius = float(np.sqrt(share * voxels**3 / (4.0 * np.pi * thickness)))
    assert radius + thickness < middle, "the shell does not fit the lattice"
    body = Body(
        lambda p: np.abs(np.linalg.norm(p - middle, axis=1) - radius) - 0.5 * thickness,
        0.0,
        0.0,
        ((0.0, 0.0, 0.0), (float(voxels), float(voxels), float(voxels))),
    )
    return exact_snapshot(body, voxels)


def plain_loop(cells: npt.NDArray[np.bool_]) -> tuple[list, list]:
    """Six tetrahedra per voxel in plain Python, as one would write it down; no tags, no temperatures."""
    from thermoxels_ns.mesh.voxel_tets import KUHN_PATTERN

    offsets, pattern = CORNER_OFFSETS.tolist(), KUHN_PATTERN.tolist()
    numbers: dict[tuple[int, int, int], int] = {}
    nodes, tets = [], []
    nx, ny, nz = cells.shape
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                if not cells[i, j, k]:
                    continue
                corners = []
                for dx, dy, dz in offsets:
                    key = (i + dx, j + dy, k + dz)
                    if key not in numbers:
                        numbers[key] = len(nodes)
                        nodes.append(key)
                    corners.append(numbers[key])
                tets.extend([corners[c] for c in tet] for tet in pattern)
    return nodes, tets


def speed(repeats: int) -> None:
    """Seconds for 128^3 voxels with 5 % solid, and for 256^3 with as many solid voxels."""
    from thermoxels_ns.mesh.build import MeshOptions, build_mesh
    from thermoxels_ns.mesh.solid.voxels import SolidSelection, select_solid

    selection = SolidSelection(density_threshold=1.0, close_gaps=0, interior="hollow")
    for voxels, share in ((128, 0.05), (256, 0.05 / 8)):
        snapshot = shell_snapshot(voxels, share)
        cells = select_solid(snapshot, selection).cells
        start = time.perf_counter()
        _, tets = plain_loop(cells)
        loop = time.perf_counter() - start
        print(f"{voxels}^3, {cells.mean():.2%} solid: plain loop {loop:.2f} s, {len(tets)} tetrahedra")
        for mode in MODES:
            seconds = []
            for _ in range(repeats):
                start = time.perf_counter()
                built = build_mesh(snapshot, selection, np.eye(4), MeshOptions(mode))  # type: ignore[arg-type]
                seconds.append(time.perf_counter() - start)
            median = statistics.median(seconds)
            print(f"  {mode}: {median:.2f} s with tags, {len(built.mesh.tets)} tetrahedra, {median / loop:.2f} x loop")


def plot(rows: Sequence[dict], path: Path) -> None:
    """Errors against seconds, one column per body."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib import ticker

    names = list(dict.fromkeys(row["body"] for row in rows))
    figure, axes = plt.subplots(
        2, len(names), figsize=(3.1 * len(names), 5.6), sharex=True, sharey="row", squeeze=False
    )
    looks = {"conforming": ("#b5367a", "o"), "voxel": ("#31688e", "s")}
    for column, name in enumerate(names):
        for line, (key, title) in enumerate((("area_error", "area error"), ("volume_error", "volume error"))):
            panel = axes[line][column]
            for mode, (colour, marker) in looks.items():
                chosen = [row for row in rows if row["body"] == name and row["mode"] == mode]
                seconds = [row["seconds"] for row in chosen]
                panel.loglog(seconds, [abs(100 * row[key]) for row in chosen], color=colour, marker=marker, label=mode)
                for row, x in zip(chosen, seconds):
                    panel.annotate(
                        str(row["voxels"]),
                        (x, abs(100 * row[key])),
                        xytext=(4, 4),
                        textcoords="offset points",
                        fontsize=7,
                    )
                if (
                    chosen
                    and key == "area_error"
                    and mode == "voxel"
                    and np.isfinite(chosen[0]["area_error_of_triangles"])
                ):
                    stairs = [abs(100 * row["area_error_of_triangles"]) for row in chosen]
                    panel.loglog(
                        seconds, stairs, color=colour, marker="s", ls=":", alpha=0.6, label="voxel, plain area"
                    )
            panel.grid(True, which="major", alpha=0.3)
            panel.margins(x=0.2)
            panel.xaxis.set_major_locator(ticker.LogLocator(subs=(1.0, 3.0)))
            panel.xaxis.set_major_formatter(ticker.FormatStrFormatter("%g"))
            panel.xaxis.set_minor_formatter(ticker.NullFormatter())
            if column == 0:
                panel.set_ylabel(f"{title} [%]")
            if line == 0:
                panel.set_title(name)
            else:
                panel.set_xlabel("seconds")
    axes[0][0].legend(fontsize=7, loc="upper right")
    figure.tight_layout()
    figure.savefig(path, dpi=130)


def read_rows(path: Path | None) -> list[dict]:
    """What an earlier run measured; nothing without a file."""
    if path is None or not path.is_file():
        return []
    with path.open(newline="") as file:
        rows: list[dict] = list(csv.DictReader(file))
    whole = ("voxels", "tets")
    words = ("body", "mode")
    return [
        {name: value if name in words else (int if name in whole else float)(value) for name, value in row.items()}
        for row in rows
    ]


def with_row(rows: Sequence[dict], new: dict) -> list[dict]:
    """The rows with a new one, in the place of that of the same case, bodies in their order and lattices by size."""

    def case(row: dict) -> tuple:
        return row["body"], row["voxels"], row["mode"]

    order = list(BODIES)
    kept = [row for row in rows if case(row) != case(new)]
    return sorted([*kept, new], key=lambda row: (order.index(row["body"]), row["voxels"], MODES.index(row["mode"])))


def write_rows(path: Path, rows: Sequence[dict]) -> None:
    """Write the csv file, whole or not at all."""
    with replace_when_done(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--resolutions", type=int, nargs="+", default=[16, 32, 64, 128])
    parser.add_argument("--bodies", nargs="*", default=list(BODIES), choices=list(BODIES))
    parser.add_argument("--modes", nargs="+", default=list(MODES), choices=list(MODES))
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--csv", type=Path)
    parser.add_argument("--plot", type=Path)
    parser.add_argument("--speed", action="store_true")
    arguments = parser.parse_args()
    if arguments.speed:
        speed(arguments.repeats)
        return
    rows = read_rows(arguments.csv)
    spawn = multiprocessing.get_context("spawn")
    print("| body | voxels | boundary | tets | s | MB | area | volume | Hausdorff | IoU |")
    print("|---|---:|---|---:|---:|---:|---:|---:|---:|---:|")
    for name, voxels, mode in product(arguments.bodies, arguments.resolutions, arguments.modes):
        with spawn.Pool(1) as pool:
            row = pool.apply(measure, (name, voxels, mode, arguments.repeats))
        rows = with_row(rows, row)
        if arguments.csv:
            write_rows(arguments.csv, rows)
        print(
            f"| {name} | {voxels} | {mode} | {row['tets']:,} | {row['seconds']:.2f} | {row['peak_mb']:.0f} "
            f"| {100 * row['area_error']:+.2f} % | {100 * row['volume_error']:+.2f} % "
            f"| {row['hausdorff_voxels']:.2f} | {row['iou']:.4f} |",
            flush=True,
        )
    if not rows:
        parser.error("nothing was measured and the csv file holds nothing: name --bodies, or a --csv that exists")
    if arguments.plot:
        plot(rows, arguments.plot)
    print(json.dumps({"worst_angles": [min(r["dihedral_min"] for r in rows), max(r["dihedral_max"] for r in rows)]}))


if __name__ == "__main__":
    main()
