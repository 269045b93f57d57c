"""The command ``ns-export thermoxels-mesh``: a trained model to a mesh and its heat."""

from __future__ import annotations

# Only light imports at the top: nerfstudio's exporter reads this module for ``--help`` of every subcommand.
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from thermoxels_ns.commands.export_options import ExportOptions, Viewpoint, check_options, scale_of, up_of
from thermoxels_ns.core.errors import CheckpointError, SceneError, ThermoxelsError
from thermoxels_ns.core.json_values import read_json_object
from thermoxels_ns.core.lattice import input_from_world

if TYPE_CHECKING:
    from nerfstudio.engine.trainer import TrainerConfig

    from thermoxels_ns.core.feature_rays import FeatureRays
    from thermoxels_ns.core.snapshot import GridSnapshot
    from thermoxels_ns.mesh.solid.voxels import SolidCells
    from thermoxels_ns.mesh.tetrahedra import TetMesh


@dataclass(frozen=True)
class TrainedScene:
    """A trained field, where it lies, and the folder of its photographs."""

    snapshot: GridSnapshot
    world_to_input: npt.NDArray[np.float64]
    """Takes homogeneous column vectors of the trained scene to the coordinates of the input poses, shape (4, 4)."""
    viewpoint: Viewpoint
    """From where pictures show most of what the cameras saw."""
    scene_folder: Path
    dataset: Any
    """The training photographs, a `ThermalDataset`."""
    tracks: FeatureRays | None
    """Lines from photographs to points that they see, in the trained scene; None: it has no tracks."""
    corrections: dict[str, Any]
    """What training corrected in its photographs, see `ThermoxelsPipeline.corrections`."""


@dataclass(kw_only=True)
class ExportThermoxelsMesh(ExportOptions):
    """Export a tetrahedral mesh with temperatures from a trained Thermoxels model, and let heat flow through it."""

    load_config: Path
    """The config.yml that ns-train wrote."""
    output_dir: Path
    """Folder for the results; it is made if it does not exist."""

    def main(self) -> None:
        """Run the export; an error of the input is printed as one sentence and the exit status is 1."""
        from nerfstudio.utils.rich_utils import CONSOLE
        from rich.markup import escape

        try:
            # The last bits of a product of long vectors depend on how many threads BLAS has.
            with threadpool_limits(1, "blas"):
                self.run(lambda line: CONSOLE.print(escape(line)))
        except ThermoxelsError as problem:
            CONSOLE.print(f"[bold red]Error:[/bold red] {escape(str(problem))}")
            raise SystemExit(1) from None

    def run(self, say: Any = print) -> dict[str, Any]:
        """Run the export and return the summary that summary.json holds, or raise `ThermoxelsError`."""
        from thermoxels_ns.commands.export_snapshot import export_snapshot, prepare_folder

        checked = check_options(self)
        prepare_folder(self.output_dir)
        say(f"Loading {self.load_config}")

        def check_scale(scene_folder: Path) -> None:
            """Refuse a wrong scale or up, and what needs a scale, before photographs and checkpoint are loaded."""
            try:
                content = scene_json(scene_folder)
            except SceneError:
                return  # whoever reads the scene says what is wrong with it
            if content or scene_folder.is_dir():
                scale_of(self, checked, content)
                up_of(self, content, Viewpoint())

        scene = load_trained_scene(self.load_config, check_scale)
        from thermoxels_ns.multiview.evidence import depths_of_dataset

        def compare(solid: SolidCells, mesh: TetMesh, scale: float) -> dict[str, Any] | None:
            from thermoxels_ns.evaluation.truth_comparison import compare_with_truth

            lattice = scene.snapshot.lattice
            truth = scene.world_to_input, scene.scene_folder
            return compare_with_truth(solid.cells, lattice, *truth, mesh, scale, within=solid.within)

        return export_snapshot(
            scene.snapshot,
            scene.world_to_input,
            self,
            self.output_dir,
            say,
            scene.viewpoint,
            compare,
            scene_json(scene.scene_folder),
            depths_of_dataset(scene.dataset, 0.0, scene.snapshot.lattice.lo, scene.snapshot.lattice.hi),
            scene.tracks,
            scene.corrections,
        )


def scene_json(scene_folder: Path) -> dict[str, Any]:
    """The scene's json as it is, for what it says about scale and up; empty if the scene has none (COLMAP)."""
    from thermoxels_ns.data.scene_file import JSON_NAMES

    folder = scene_folder if scene_folder.is_dir() else scene_folder.parent
    names = [scene_folder] if scene_folder.is_file() else [folder / name for name in JSON_NAMES]
    for path in names:
        if path.is_file():
            return read_json_object(path, "Write the file again.", SceneError)
    return {}


def load_trained_scene(load_config: Path, check_scene: Callable[[Path], object] = lambda _: None) -> TrainedScene:
    """Load a trained Thermoxels model through nerfstudio; raises `CheckpointError` for what is none.

    `check_scene` is called with the photographs' folder before anything slow; what it raises is raised.
    """
    if not load_config.is_file():
        remedy = "Pass --load-config outputs/<scene>/thermoxels/<time>/config.yml."
        got = f"no file at {load_config}"
        raise CheckpointError("load_config", expected="the config.yml of a training run", got=got, remedy=remedy)
    import yaml
    from nerfstudio.utils.eval_utils import eval_setup

    def check(config: TrainerConfig) -> TrainerConfig:
        _check_config(config)
        check_scene(_scene_folder(config))
        return config

    try:
        _, pipeline, _, _ = eval_setup(load_config, test_mode="test", update_config_callback=check)
    except ThermoxelsError:
        raise
    except (yaml.YAMLError, AssertionError, KeyError, UnicodeDecodeError) as problem:
        expected = "a config.yml that ns-train of this installation wrote"
        got = f"{load_config}, which cannot be read ({_reason(load_config, problem)})"
        remedy = "Pass the config.yml of the training run."
        raise CheckpointError("load_config", expected=expected, got=got, remedy=remedy) from problem
    except RuntimeError as problem:
        expected = "the parameters of the model that config.yml describes"
        got = f"{type(problem).__name__}: {problem}"
        remedy = "Use the config.yml and the checkpoint of one and the same training run."
        raise CheckpointError("checkpoint", expected=expected, got=got, remedy=remedy) from problem
    pipeline_of_ours: Any = pipeline
    outputs = pipeline_of_ours.datamanager.train_dataparser_outputs
    world_to_input = input_from_world(outputs.dataparser_transform.numpy(), float(outputs.dataparser_scale))
    return TrainedScene(
        pipeline_of_ours.grid_snapshot(),
        world_to_input,
        viewpoint_of_cameras(outputs.cameras.camera_to_worlds.numpy(), world_to_input),
        Path(pipeline_of_ours.datamanager.get_datapath()),
        pipeline_of_ours.datamanager.train_dataset,
        outputs.metadata["feature_rays"],
        pipeline_of_ours.corrections(),
    )


def _reason(load_config: Path, problem: Exception) -> str:
    """Why nerfstudio refused a config.yml; its own checks have no message."""
    if load_config.stat().st_size == 0:
        return "the file is empty"
    if str(problem):
        return f"{type(problem).__name__}: {problem}"
    check = (traceback.extract_tb(problem.__traceback__)[-1].line or "").strip()
    if "TrainerConfig" in check:
        return "it holds no TrainerConfig of nerfstudio"
    return f"{type(problem).__name__} at: {check}"


def viewpoint_of_cameras(camera_to_worlds: npt.ArrayLike, world_to_input: npt.ArrayLike) -> Viewpoint:
    """Choose a view for pictures: up as the photographer held the camera, from the side the cameras stood on.

    Takes poses in the trained scene (x right, y up, z back), shape (n, 3, 4) or (n, 4, 4). If the cameras stood all
    around, the view is the usual one, obliquely from above.
    """
    rotation = np.asarray(world_to_input, np.float64)[:3, :3]
    axes = np.einsum("ij,njk->nik", rotation / np.cbrt(np.linalg.det(rotation)), np.asarray(camera_to_worlds)[:, :, :3])
    up = axes[:, :, 1].mean(axis=0)
    if np.linalg.norm(up) < 0.1:  # cameras held every way round
        return Viewpoint()
    up /= np.linalg.norm(up)
    source = "The mean of what was up in the photographs; cameras that all look down or up tilt it."
    # People hold pictures level: up is at right angles to the pictures' horizontal axes, if these span a plane.
    spread, directions = np.linalg.eigh(np.einsum("ni,nj->ij", axes[:, :, 0], axes[:, :, 0]) / len(axes))
    level = directions[:, 0] * np.sign(directions[:, 0] @ up)
    if spread[1] > 0.05 and spread[0] < 0.2 * spread[1] and level @ up > 0.3:
        up, source = level, "At right angles to the horizontal axes of the photographs."
    forward = -axes[:, :, 2].mean(axis=0)
    level = forward - (forward @ up) * up
    direction = None
    if np.linalg.norm(level) > 0.3:
        level /= np.linalg.norm(level)
        direction = tuple(float(v) for v in level + 0.35 * np.cross(up, level) - 0.35 * up)
    return Viewpoint(tuple(float(v) for v in up), source, direction)  # type: ignore[arg-type]


def _scene_folder(config: TrainerConfig) -> Path:
    """Where the photographs are: what ns-train was told with --data, else with the dataparser's own --data."""
    manager: Any = config.pipeline.datamanager
    return Path(manager.dataparser.data if getattr(manager, "data", None) is None else manager.data)


def _check_config(config: TrainerConfig) -> TrainerConfig:
    """Refuse another method's run, or one without a checkpoint, before its photographs are loaded."""
    pipeline: Any = config.pipeline
    if not callable(getattr(pipeline._target, "grid_snapshot", None)):
        expected = "a model trained with a Thermoxels method"
        got = f"the checkpoint of another method ({config.method_name})"
        remedy = "Train with ns-train thermoxels, or choose another subcommand of ns-export."
        raise CheckpointError("load_config", expected=expected, got=got, remedy=remedy)
    folder = config.get_checkpoint_dir()
    if not any(folder.glob("step-*.ckpt")):
        remedy = "Run the command in the folder where ns-train ran, or train to the first checkpoint."
        raise CheckpointError("checkpoint", expected=f"a file step-*.ckpt in {folder}", got="none", remedy=remedy)
    return config
