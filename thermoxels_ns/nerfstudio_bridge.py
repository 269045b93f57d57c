"""Additions to nerfstudio 1.1.x that plugins cannot make otherwise; every ``ns-*`` command imports this module."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from types import ModuleType, TracebackType
from typing import TYPE_CHECKING, Annotated, Any, Union, get_args

import numpy as np
import torch
import tyro
import yaml

from thermoxels_ns.core.config_loader import ConfigLoader, ModuleWith, check_run
from thermoxels_ns.core.errors import CRASH, SceneError, ThermoxelsError, exit_status

if TYPE_CHECKING:
    from thermoxels_ns.evaluation.truth_comparison import RenderedRays
    from thermoxels_ns.training.pipeline import ThermoxelsPipeline

_EXPORTER, _TRAIN = "nerfstudio.scripts.exporter", "nerfstudio.scripts.train"
_EVALUATIONS = ("nerfstudio.scripts.eval", "nerfstudio.scripts.render", "nerfstudio.scripts.viewer.run_viewer")
_SUBCOMMAND, _DATAPARSER = "thermoxels-mesh", "thermal-data"
METHODS = ("thermoxels", "thermoxels-paper", "thermoxels-arco", "plenoxels-t")  # Names of the methods in `config`


def install() -> None:
    """Install all additions to nerfstudio in this process; a second call changes nothing."""
    allow_checkpoint_globals()
    yaml.Loader = ConfigLoader  # nerfstudio loads with Loader=yaml.Loader, which would run code from a file
    extend_commands()
    print_our_errors_plainly()


def print_our_errors_plainly() -> None:
    """Make an uncaught `ThermoxelsError` end an ``ns-*`` command with its message instead of a traceback.

    The exit status is `errors.exit_status`. Every other exception goes to the hook that was installed before.
    """
    previous = sys.excepthook
    if getattr(previous, "prints_thermoxels_errors", False):
        return

    def hook(kind: type[BaseException], problem: BaseException, traceback: TracebackType | None) -> None:
        if isinstance(problem, ThermoxelsError):
            print(f"Error: {problem}", file=sys.stderr)
        else:
            previous(kind, problem, traceback)
        if exit_status(problem) != CRASH and not hasattr(sys, "ps1"):  # an interactive Python goes on
            raise SystemExit(exit_status(problem))

    hook.prints_thermoxels_errors = True  # type: ignore[attr-defined]
    sys.excepthook = hook


def allow_checkpoint_globals() -> None:
    """Allow ``torch.load(weights_only=True)`` to read the numpy scalars in nerfstudio's checkpoints.

    Learning-rate schedulers save numpy scalars beside the tensors, and torch refuses all types not registered as safe.
    This registers the function that rebuilds a scalar, `np.dtype` and the dtype classes of plain numbers.
    """
    # This is numpy.core.multiarray.scalar in numpy 1 and numpy._core.multiarray.scalar in numpy 2.
    rebuild_scalar: Any = np.float64(0).__reduce__()[0]
    kinds = {type(np.dtype(code)) for code in "?efd" + np.typecodes["AllInteger"]}
    torch.serialization.add_safe_globals([rebuild_scalar, np.dtype, *kinds])


def extend_commands() -> None:
    """Add ``thermoxels-mesh`` to ``ns-export``, and make ``ns-*`` commands check first that a run's files exist.

    nerfstudio's scripts call ``tyro.cli`` when they start. In each script (export, train, eval, render, viewer) that is
    loaded now, as a module or as ``__main__``, `tyro` is replaced by a copy whose `cli` is our `_cli`.
    """
    main = sys.modules.get("__main__")
    for name in (_EXPORTER, _TRAIN, *_EVALUATIONS):
        candidates = [sys.modules.get(name)]
        if getattr(getattr(main, "__spec__", None), "name", None) == name:  # python -m nerfstudio.scripts.exporter
            candidates.append(main)
        for script in candidates:
            if script is not None and getattr(script, "tyro", None) is tyro:
                vars(script)["tyro"] = ModuleWith(tyro, cli=partial(_cli, script, name))


def _cli(script: ModuleType, name: str, f: Any, *, args: Sequence[str] | None = None, **kwargs: Any) -> Any:
    """Parse the words of an ``ns-*`` command as `tyro.cli` does, and return the command.

    ns-export has our subcommand too. With ns-train, options of our dataparser may stand anywhere after the method,
    --help shows one page, and --help-all shows every option. `f` is what `tyro.cli` parses into. Raises
    `CheckpointError` if the command loads a run of which a file is missing.
    """
    words = sys.argv[1:] if args is None else list(args)
    stock = name == _EXPORTER and f is vars(script).get("Commands")
    if name == _TRAIN and words and words[0] in METHODS:
        from nerfstudio.configs.dataparser_configs import all_dataparsers

        if {"-h", "--help"} & set(words) and not {*all_dataparsers, "--help-all"} & set(words):
            from thermoxels_ns.commands.train_help import print_first_page

            print_first_page(words[0])
            raise SystemExit(0)
        words = _with_dataparser_last(["--help" if word == "--help-all" else word for word in words])
    command = tyro.cli(_with_mesh_export(f) if stock else f, args=words, **kwargs)
    if name != _TRAIN and isinstance(config := getattr(command, "load_config", None), Path):
        check_run(config)
    return command


def _with_dataparser_last(words: list[str]) -> list[str]:
    """Return the words of ns-train with options of our dataparser moved behind thermal-data, as tyro requires.

    >>> " ".join(_with_dataparser_last("thermoxels --missing-thermal skip --data SCENE".split()))
    'thermoxels --data SCENE thermal-data --missing-thermal skip'
    """
    from nerfstudio.configs.dataparser_configs import all_dataparsers

    from thermoxels_ns.data.dataparser import ThermalDataParserConfig

    names = {field.name for field in dataclasses.fields(ThermalDataParserConfig)} - {"data"}
    if not words or words[0] not in METHODS or (all_dataparsers.keys() - {_DATAPARSER}) & set(words):
        return words
    kept, moved, behind = list[str](), list[str](), False
    for word in words:
        if word.startswith("--"):
            behind = word[2:].partition("=")[0].replace("-", "_") in names
        elif word == _DATAPARSER:
            behind = False
        (moved if behind else kept).append(word)
    return [*kept, *([_DATAPARSER] if moved and _DATAPARSER not in kept else []), *moved]


def _with_mesh_export(commands: Any) -> Any:
    """Return `commands`, ``Annotated[Union[...], markers]``, with our subcommand as a new member of the union."""
    from thermoxels_ns.commands.export import ExportThermoxelsMesh

    ours = Annotated[ExportThermoxelsMesh, tyro.conf.subcommand(name=_SUBCOMMAND)]
    members, *markers = get_args(commands)
    return Annotated[(Union[(*get_args(members), ours)], *markers)]


def compare_with_truth(pipeline: ThermoxelsPipeline) -> dict[str, float]:
    """Return figures of the trained surface and of depths along held-out rays against the exact scene, by name.

    They are those of `geometry_metrics` and `depth_metrics`, which `training` may not import. The result is empty if
    the scene is not known exactly or the comparison fails; the reason of a failure is printed.
    """
    from thermoxels_ns.core.lattice import input_from_world
    from thermoxels_ns.evaluation.truth_comparison import depth_metrics, geometry_metrics, load_known_truth

    datamanager: Any = pipeline.datamanager
    outputs = datamanager.train_dataparser_outputs
    world_to_input = input_from_world(outputs.dataparser_transform.numpy(), float(outputs.dataparser_scale))
    try:
        known = load_known_truth(datamanager.get_datapath())
        if known is None:
            return {}
        # The snapshot has the rays' evidence and the cameras, which decide what is solid, as in an export.
        figures = geometry_metrics(pipeline.grid_snapshot(), world_to_input, known)
    except SceneError as problem:
        print(f"Geometry is not compared with the truth: {problem}")
        return {}
    return figures | depth_metrics(_held_out_rays(pipeline), pipeline.model.grid.lattice, world_to_input, known.scene)


def _held_out_rays(pipeline: ThermoxelsPipeline) -> Iterator[RenderedRays]:
    """Yield the rendered rays of one held-out photograph after another."""
    from thermoxels_ns.evaluation.truth_comparison import RenderedRays

    datamanager: Any = pipeline.datamanager
    cameras = datamanager.eval_dataset.cameras.to(pipeline.device)
    for number in range(len(cameras)):
        rays = cameras.generate_rays(camera_indices=number, keep_shape=True)
        seen = pipeline.model.get_outputs_for_camera_ray_bundle(rays)
        columns = (rays.origins, rays.directions, seen["depth"], seen["accumulation"], seen["in_box"])
        origins, directions, depth, accumulation, in_box = (
            column.reshape(-1, column.shape[-1]).double().cpu().numpy() for column in columns
        )
        yield RenderedRays(origins, directions, depth[:, 0], accumulation[:, 0] > 0.5, in_box[:, 0] > 0)
