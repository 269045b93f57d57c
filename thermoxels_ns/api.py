"""Thermoxels in Python: a trained run as arrays, its mesh as a pyvista object, heat through it; no files in between."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import BoolArray, FloatArray

if TYPE_CHECKING:
    import pyvista as pv

    from thermoxels_ns.commands.export import TrainedScene
    from thermoxels_ns.heat.run import HeatRun
    from thermoxels_ns.heat.scene import HeatScene
    from thermoxels_ns.mesh.files.vtu import AnyMesh

Say = Callable[[str], None]


@dataclass(frozen=True, repr=False, eq=False)
class Scene:
    """A trained run. All arrays are on the corners of its voxels, (nx, ny, nz) of them, in C order.

    Where the scale is known, lengths are metres and density is per metre; else both are in the unit of the input poses.
    """

    trained: TrainedScene  # What `thermoxels_ns.commands.export.load_trained_scene` read
    scene_file: Mapping[str, Any]  # Content of the scene's json; empty if the scene has none
    metres_per_unit: float | None  # Length of one unit of the input poses, [m]; None: not known

    def __repr__(self) -> str:
        shape, seen = self.trained.snapshot.lattice.shape, self.temperature_c[self.observed]
        range_c = f", {seen.min():.1f} to {seen.max():.1f} °C" if len(seen) else ""
        unit = "input units" if self.metres_per_unit is None else "m"
        return f"Scene({' x '.join(map(str, shape))} corners, {self.spacing:.3g} {unit} apart{range_c})"

    @property
    def to_coordinates(self) -> FloatArray:
        """Matrix from homogeneous coordinates of the trained scene to those of `points`, shape (4, 4)."""
        metres = self.metres_per_unit or 1.0
        return np.diag([metres, metres, metres, 1.0]) @ self.trained.world_to_input

    @property
    def spacing(self) -> float:
        """Distance of neighbouring corners."""
        return self.trained.snapshot.lattice.voxel_size * float(
            np.cbrt(abs(np.linalg.det(self.to_coordinates[:3, :3])))
        )

    @property
    def points(self) -> FloatArray:
        """Coordinates of the corners, shape (nx, ny, nz, 3), those of the input poses times the scale."""
        return (
            self.trained.snapshot.lattice.corner_positions() @ self.to_coordinates[:3, :3].T
            + self.to_coordinates[:3, 3]
        )

    @property
    def observed(self) -> BoolArray:
        """True where thermal rays measured the temperature, shape (nx, ny, nz)."""
        from thermoxels_ns.mesh.temperature import MIN_OBSERVED_WEIGHT

        return self.trained.snapshot.observed_weight >= MIN_OBSERVED_WEIGHT

    @property
    def temperature_c(self) -> npt.NDArray[np.float32]:
        """Temperature, [degrees Celsius], shape (nx, ny, nz); NaN where no thermal ray measured it."""
        return np.where(self.observed, self.trained.snapshot.temperature_c, np.float32(np.nan))

    @property
    def density(self) -> npt.NDArray[np.float32]:
        """Density: the share of light that is absorbed per length, shape (nx, ny, nz)."""
        return self.trained.snapshot.density * np.float32(self.trained.snapshot.lattice.voxel_size / self.spacing)

    @property
    def colour(self) -> npt.NDArray[np.float32] | None:
        """Red, green and blue in [0, 1], shape (nx, ny, nz, 3); None if the run has no colours."""
        return self.trained.snapshot.colour

    def mesh(self, *, support: bool = True, **options: Any) -> pv.MultiBlock:
        """Return a tetrahedral mesh of what is solid, the same that ``ns-export thermoxels-mesh`` writes.

        Args:
            support: Whether to count for each boundary triangle the photographs that support it, which takes longest.
            **options: Options of the export with underscores, such as ``interior="hollow"``, ``wall_thickness=0.3``,
                ``region="all"`` or ``metres_per_unit=1.0``; see `thermoxels_ns.commands.export.ExportOptions`.

        Returns:
            Two blocks. "body" is an UnstructuredGrid with `temperature_c` and `observed` (1: measured) per point and
            `region` per cell; "boundary" is a PolyData with `patch`, `area_m2`, `normal` and more per triangle.

        Raises:
            ThermoxelsError: An option is wrong, or nothing is solid.
        """
        from threadpoolctl import threadpool_limits

        from thermoxels_ns.commands import export
        from thermoxels_ns.mesh.files.pyvista_objects import blocks_of
        from thermoxels_ns.mesh.quality.report import check_mesh
        from thermoxels_ns.multiview.evidence import depths_of_dataset

        if "known_distance" not in options:
            options = {"metres_per_unit": self.metres_per_unit, **options}
        chosen = export.ExportOptions(**options)
        checked = export.check_options(chosen)
        scale = export.scale_of(chosen, checked, self.scene_file)
        metres, unit = (1.0, "input unit") if scale is None else (scale.metres_per_unit, "m")
        up, up_source = export.up_of(chosen, self.scene_file, self.trained.viewpoint)
        snapshot, to_mesh = self.trained.snapshot, np.diag([metres, metres, metres, 1.0]) @ self.trained.world_to_input
        # With more BLAS threads, the last bits of results would depend on the number of threads.
        with threadpool_limits(1, "blas"):
            box = snapshot.lattice.lo, snapshot.lattice.hi
            depths = depths_of_dataset(self.trained.dataset, 0.0, *box) if support else None
            built = export.built_mesh(snapshot, chosen, checked, to_mesh, metres, up, depths, self.trained.tracks)
            report = check_mesh(built.mesh, chosen.boundary, built.observed_range_c, length_unit=unit)
        about = {"up": up, "up_source": up_source, "length_unit": unit, "options": vars(chosen)}
        return blocks_of(built.mesh, about={**about, "mesh": {"volume": report.volume_m3, "area": report.area_m2}})


def load(run: Path | str, *, metres_per_unit: float | None = None) -> Scene:
    """Return a trained run: temperature and density as arrays, and `Scene.mesh`.

    Args:
        run: Folder of the training, such as ``outputs/house/thermoxels/2026-01-31_120000``, or the config.yml in it.
        metres_per_unit: Length of one unit of the input poses, [m]. Default: that in the scene's json, if there is one.

    Raises:
        CheckpointError: There is no such run, its checkpoint is missing or damaged, or another method trained it.
        SceneError: The photographs that it was trained on cannot be read.
    """
    from threadpoolctl import threadpool_limits

    from thermoxels_ns.commands.export import load_trained_scene, scene_json
    from thermoxels_ns.core.config_loader import check_run
    from thermoxels_ns.data.scene_scale import choose_scale, scale_from_option

    config = Path(run) if Path(run).suffix == ".yml" else Path(run) / "config.yml"
    if metres_per_unit is not None:
        scale_from_option(metres_per_unit)
    check_run(config)  # before nerfstudio is imported, which takes many seconds
    from nerfstudio.utils.rich_utils import CONSOLE

    loud, CONSOLE.quiet = CONSOLE.quiet, True
    try:
        # With more BLAS threads, the last bits of results would depend on the number of threads.
        with threadpool_limits(1, "blas"):
            trained = load_trained_scene(config)
    finally:
        CONSOLE.quiet = loud
    scene_file = scene_json(trained.scene_folder)
    scale = choose_scale(metres_per_unit, None, scene_file)
    return Scene(trained, scene_file, None if scale is None else scale.metres_per_unit)


def to_pyvista(mesh: AnyMesh, *, up: Sequence[float] | None = None) -> pv.MultiBlock:
    """Return any mesh as the blocks "body" and "boundary" that `Scene.mesh` describes.

    Args:
        mesh: What `solve` takes. A bare grid gets a boundary with the patches exterior-up, -side and -down and, around
            closed cavities, interior-up, -side and -down. To name patches of your own, set the cell array `patch` of
            the block "boundary" to names.
        up: Direction that points up; default: what the mesh says, or else z.

    Raises:
        ThermoxelsError: The mesh is not sound.
    """
    from thermoxels_ns.mesh.files.pyvista_objects import blocks_of
    from thermoxels_ns.mesh.files.vtu import any_mesh

    body, about = any_mesh(mesh, up)
    return blocks_of(body, about=about)


def solve(
    mesh: AnyMesh,
    scene: HeatScene | Mapping[str, Any] | Path | str,
    *,
    up: Sequence[float] | None = None,
    probes_m: npt.ArrayLike = (),
    tolerance_k: float | None = None,
    flow_tolerance: float | None = None,
    leave_out_below: float | None = None,
    memory_gb: float | None = 4.0,
    allow_unmet: bool = False,
    say: Say = lambda _: None,
) -> HeatRun:
    """Let heat flow through a mesh in a heat scene, as ``thermoxels heat`` does.

    Args:
        mesh: A mesh of `Scene.mesh` or `to_pyvista`; a pyvista UnstructuredGrid of tetrahedra with a point array
            `temperature_c`, in metres; or the path of the mesh.vtu of an export.
        scene: Name of a scene, such as ``"winter-night"``; path of its yaml file; the keys of one as a mapping; or a
            `thermoxels_ns.heat.scene.HeatScene`.
        up: Direction that points up in the coordinates of the mesh. Default: what the mesh says, or else z.
        probes_m: Points whose temperature is followed, shape (p, 3), [m].
        tolerance_k: Largest error that any temperature may have, [K]; None: mesh and steps are used as they are.
        flow_tolerance: Largest error of the heat flow of any effect, as a share of all heat; None: any error.
        leave_out_below: Effects that together bring less than this share of all heat are left out; None: 0.005.
        memory_gb: Most memory that solving may take, [GiB]; None: any amount.
        allow_unmet: If a tolerance cannot be met, return the best result that fits into memory, instead of an error.
        say: Called with lines of progress, such as `print`.

    Returns:
        The `HeatRun`: `results`, `wall` (U-value, f_Rsi), `warnings` and more; `to_frame()` and `to_pyvista()`.

    Raises:
        HeatError: The scene is wrong or does not fit the mesh, the solver failed, or a tolerance cannot be met.
        ThermoxelsError: The mesh is not sound or has no scale.
    """
    from threadpoolctl import threadpool_limits

    from thermoxels_ns.heat.run import run_scene
    from thermoxels_ns.heat.scene import HeatScene, load_heat_scene
    from thermoxels_ns.heat.solving import Goals
    from thermoxels_ns.mesh.files.vtu import any_mesh

    around = scene if isinstance(scene, HeatScene) else load_heat_scene(scene)
    goals = Goals(
        tolerance_k=tolerance_k,
        flow_tolerance=flow_tolerance,
        leave_out_below=leave_out_below,
        memory_gb=memory_gb,
        allow_unmet=allow_unmet,
    )
    goals.check_fits(around.time)
    body, about = any_mesh(mesh, up)
    # With more BLAS threads, the last bits of results would depend on the number of threads.
    with threadpool_limits(1, "blas"):
        return run_scene(around, body, goals, up=about.get("up"), probes_m=probes_m, export=about, say=say)
