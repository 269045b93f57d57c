"""Thermoxels in Python: a trained run as arrays, its mesh as a pyvista object, heat through it; no files in between."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import Float32Array, FloatArray
from thermoxels_ns.core.errors import ThermoxelsError as ThermoxelsError

if TYPE_CHECKING:
    import pyvista as pv

    from thermoxels_ns.commands.export import TrainedScene
    from thermoxels_ns.heat.run import HeatRun
    from thermoxels_ns.heat.scene import HeatScene
    from thermoxels_ns.mesh.files.vtu import AnyMesh


@dataclass(frozen=True, repr=False, eq=False)
class Scene:
    """A trained run, as arrays on the corners of its voxels; without a scale lengths are in units of input poses."""

    temperature_c: Float32Array  # Temperature, [degrees Celsius], shape (nx, ny, nz); NaN: no thermal ray measured it
    density: Float32Array  # Density, the share of light that is absorbed per length, shape (nx, ny, nz), [1 / m]
    colour: Float32Array | None  # Red, green, blue in [0, 1], shape (nx, ny, nz, 3); None for a run without colours
    spacing: float  # Distance of neighbouring corners, [m]
    metres_per_unit: float | None  # Length of one unit of the input poses, [m]; None: the scale is not known
    trained: TrainedScene  # The trained field as it was read, with its photographs

    def __repr__(self) -> str:
        shape, unit = " x ".join(map(str, self.density.shape)), "input units" if self.metres_per_unit is None else "m"
        known = self.temperature_c[np.isfinite(self.temperature_c)]
        degrees = f"{known.min():.1f} to {known.max():.1f} °C" if len(known) else "no temperatures"
        return f"Scene({shape} corners, {self.spacing:.3g} {unit} apart, {degrees})"

    @property
    def points(self) -> FloatArray:
        """Coordinates of the corners, shape (nx, ny, nz, 3), [m]: those of the input poses times the scale."""
        to_input = self.trained.world_to_input
        corners = self.trained.snapshot.lattice.corner_positions() @ to_input[:3, :3].T + to_input[:3, 3]
        return corners * (self.metres_per_unit or 1.0)

    def mesh(self, *, support: bool = True, **options: Any) -> pv.MultiBlock:
        """Return a tetrahedral mesh of what is solid, the same that ``ns-export thermoxels-mesh`` writes.

        Args:
            support: Whether to count for each boundary triangle the photographs that support it, which takes longest.
            **options: Options of the export with underscores, such as ``interior="hollow"``, ``wall_thickness=0.3`` or
                ``region="all"``; see `thermoxels_ns.commands.export.ExportOptions`.

        Returns two blocks: "body" is an UnstructuredGrid with `temperature_c` and `observed` (1: measured) per point
        and `region` per cell; "boundary" is a PolyData with `patch`, `area_m2`, `normal` and more per triangle. Raises
        `ThermoxelsError` if an option is wrong or nothing is solid.
        """
        from threadpoolctl import threadpool_limits

        from thermoxels_ns.commands.export import ExportOptions, mesh_of_scene
        from thermoxels_ns.mesh.files.vtu import blocks_of

        options.setdefault("metres_per_unit", None if "known_distance" in options else self.metres_per_unit)
        chosen = ExportOptions(**options)
        with threadpool_limits(1, "blas"):  # with more, the last bits would depend on the number of threads
            made = mesh_of_scene(self.trained if support else replace(self.trained, dataset=None), chosen)
        about = {"up": made.up, "up_source": made.up_source, "length_unit": made.unit, "options": vars(chosen)}
        size = {"volume": made.figures.volume_m3, "area": made.figures.area_m2}
        return blocks_of(made.built.mesh, {**about, "mesh": size})


def load(run: Path | str, *, metres_per_unit: float | None = None) -> Scene:
    """Return a trained run: temperature and density as arrays, and `Scene.mesh`.

    Args:
        run: Folder of the training, such as ``outputs/house/thermoxels/2026-01-31_120000``, or the config.yml in it.
        metres_per_unit: Length of one unit of the input poses, [m]. Default: that in the scene's json, if there is one.

    Raises `CheckpointError` if there is no such run, its checkpoint is missing or damaged, or another method trained
    it; `SceneError` if its photographs cannot be read.
    """
    from threadpoolctl import threadpool_limits

    from thermoxels_ns.commands.export import load_trained_scene
    from thermoxels_ns.core.config_loader import check_run
    from thermoxels_ns.data.layouts import scene_json
    from thermoxels_ns.data.scene_scale import choose_scale
    from thermoxels_ns.mesh.temperature import MIN_OBSERVED_WEIGHT

    config = Path(run) if Path(run).suffix == ".yml" else Path(run) / "config.yml"
    choose_scale(metres_per_unit)  # raises for a wrong one
    check_run(config)  # before nerfstudio is imported, which takes many seconds
    hook = sys.excepthook  # our plugin makes nerfstudio's commands print errors without a traceback, which Python keeps
    with threadpool_limits(1, "blas"), warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # of torch about nerfstudio, on which no user can act
        from nerfstudio.utils.rich_utils import CONSOLE

        loud, CONSOLE.quiet = CONSOLE.quiet, True
        try:
            trained = load_trained_scene(config)
        finally:
            CONSOLE.quiet, sys.excepthook = loud, hook
    scale, field = choose_scale(metres_per_unit, None, scene_json(trained.scene_folder)[1]), trained.snapshot
    metres = None if scale is None else scale.metres_per_unit
    units = (metres or 1.0) * float(np.cbrt(abs(np.linalg.det(trained.world_to_input[:3, :3]))))
    measured = field.observed_weight >= MIN_OBSERVED_WEIGHT
    known_c = np.float32(np.nan) if field.temperature_c is None else field.temperature_c  # photographs alone have none
    temperature_c = np.where(measured, known_c, np.float32(np.nan))
    density = field.density / np.float32(units)
    return Scene(temperature_c, density, field.colour, field.lattice.voxel_size * units, metres, trained)


def to_pyvista(mesh: AnyMesh, *, up: Sequence[float] | None = None) -> pv.MultiBlock:
    """Return any mesh that `solve` takes as two blocks, "body" and "boundary"; `Scene.mesh` describes them.

    A grid without a boundary gets one with the patches exterior-up, -side and -down and, around closed cavities,
    interior-up, -side and -down, by the direction `up`, z by default. To name patches yourself, set the cell array
    `patch` of the block "boundary" to names. Raises `ThermoxelsError` if the mesh is not sound.
    """
    from thermoxels_ns.mesh.files.vtu import any_mesh, blocks_of

    return blocks_of(*any_mesh(mesh, up))


def solve(
    mesh: AnyMesh,
    scene: HeatScene | Mapping[str, Any] | Path | str,
    *,
    up: Sequence[float] | None = None,
    probes_m: npt.ArrayLike = (),
    say: Callable[[str], None] = lambda _: None,
    **goals: Any,
) -> HeatRun:
    """Return the `HeatRun` of a mesh in a heat scene, as ``thermoxels heat`` computes it.

    It has `results`, `wall` (U-value, f_Rsi), `warnings` and more, `to_frame()` and `to_pyvista()`.

    Args:
        mesh: A mesh of `Scene.mesh` or `to_pyvista`; a pyvista UnstructuredGrid of tetrahedra with a point array
            `temperature_c`, in metres; or the path of the mesh.vtu of an export.
        scene: Name of a scene, such as ``"winter-night"``; path of its yaml file; the keys of one as a mapping; or a
            `thermoxels_ns.heat.scene.HeatScene`.
        up: Direction that points up in the coordinates of the mesh. Default: what the mesh says, or else z.
        probes_m: Points whose temperature is followed, shape (p, 3), [m].
        say: Function that receives lines of progress, such as `print`.
        **goals: Errors and memory allowed, such as ``tolerance_k=0.05``; see `thermoxels_ns.heat.solving.Goals`.

    Raises:
        HeatError: The scene is wrong or does not fit the mesh, the solver failed, or a tolerance cannot be met.
        ThermoxelsError: The mesh is not sound or has no scale.
    """
    from threadpoolctl import threadpool_limits

    from thermoxels_ns.heat.run import run_scene
    from thermoxels_ns.heat.scene import HeatScene, load_heat_scene
    from thermoxels_ns.heat.solving import Goals
    from thermoxels_ns.mesh.files.vtu import any_mesh

    around, allowed = scene if isinstance(scene, HeatScene) else load_heat_scene(scene), Goals(**goals)
    body, about = any_mesh(mesh, up)
    with threadpool_limits(1, "blas"):
        return run_scene(around, body, allowed, up=about.get("up"), probes_m=probes_m, export=about, say=say)
