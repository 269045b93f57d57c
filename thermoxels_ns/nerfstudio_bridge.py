"""What nerfstudio 1.1.x lacks for plugins; imported by every ``ns-*`` command."""

from __future__ import annotations

import sys
import warnings
from types import ModuleType, TracebackType
from typing import TYPE_CHECKING, Annotated, Any, Union, get_args

import numpy as np
import torch
import tyro

from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.core.option_help import join_help_lines

if TYPE_CHECKING:
    from thermoxels_ns.training.pipeline import ThermoxelsPipeline

_EXPORTER = "nerfstudio.scripts.exporter"
_SUBCOMMAND = "thermoxels-mesh"


def install() -> None:
    """Add what nerfstudio lacks; calling it again changes nothing."""
    allow_checkpoint_globals()
    extend_exporter()
    print_our_errors_plainly()
    # nerfstudio 1.1.5 indexes rays with lists; recent torch says so several times per camera.
    warnings.filterwarnings("ignore", message="Using a non-tuple sequence for multidimensional indexing")


def print_our_errors_plainly() -> None:
    """Let an uncaught `ThermoxelsError` end an ``ns-*`` command with its sentence instead of a traceback.

    The exit status stays 1, and every other exception goes where it went before.
    """
    previous = sys.excepthook
    if getattr(previous, "prints_thermoxels_errors", False):
        return

    def hook(kind: type[BaseException], problem: BaseException, traceback: TracebackType | None) -> None:
        if isinstance(problem, ThermoxelsError):
            print(f"Error: {problem}", file=sys.stderr)
        else:
            previous(kind, problem, traceback)

    hook.prints_thermoxels_errors = True  # type: ignore[attr-defined]
    sys.excepthook = hook


def allow_checkpoint_globals() -> None:
    """Let ``torch.load(weights_only=True)`` read the numpy scalars that nerfstudio's checkpoints hold.

    Learning-rate schedulers save numpy numbers beside the tensors. Since torch 2.6 `torch.load` refuses any type
    that is not registered as harmless; these are: a scalar, its dtype and the classes of the plain number types.
    Torch without the registry loads them anyway.
    """
    register = getattr(torch.serialization, "add_safe_globals", None)
    if register is None:
        return
    numbers = (
        *(np.bool_, np.int8, np.int16, np.int32, np.int64, np.uint8, np.uint16, np.uint32, np.uint64),
        *(np.float16, np.float32, np.float64),
    )
    # The function that pickle names: numpy.core.multiarray.scalar in numpy 1, numpy._core.multiarray.scalar in 2.
    rebuild_scalar = np.float64(0).__reduce__()[0]
    register([rebuild_scalar, np.dtype, *dict.fromkeys(type(np.dtype(number)) for number in numbers)])


def extend_exporter() -> None:
    """Make ``thermoxels-mesh`` a subcommand of nerfstudio's ``ns-export``, beside all of its own.

    nerfstudio's exporter hands its union of subcommands to ``tyro.cli`` when it starts. Its module gets a `tyro` of
    its own whose `cli` extends that union and whose everything else is tyro's. Only a process that has the
    exporter loaded, or is loading it while it imports this plugin, is touched: the other commands never load it.
    """
    main = sys.modules.get("__main__")
    candidates = [sys.modules.get(_EXPORTER)]
    if getattr(getattr(main, "__spec__", None), "name", None) == _EXPORTER:  # python -m nerfstudio.scripts.exporter
        candidates.append(main)
    for exporter in candidates:
        if exporter is not None and getattr(exporter, "tyro", None) is tyro:
            vars(exporter)["tyro"] = _ExporterTyro(exporter)


class _ExporterTyro(ModuleType):
    """Tyro, as nerfstudio's exporter sees it."""

    def __init__(self, exporter: ModuleType) -> None:
        super().__init__("tyro", doc=tyro.__doc__)
        self._exporter = exporter

    def __getattr__(self, name: str) -> Any:
        return getattr(tyro, name)

    def cli(self, f: Any, *args: Any, **kwargs: Any) -> Any:
        """Call `tyro.cli`, with our subcommand added where the exporter's own union is asked for."""
        stock = vars(self._exporter).get("Commands")
        return tyro.cli(_with_mesh_export(f) if f is stock else f, *args, **kwargs)


def _with_mesh_export(commands: Any) -> Any:
    """Add our subcommand to ``Annotated[Union[...], markers]`` or ``Union[...]``, keeping members and markers."""
    from thermoxels_ns.commands.export import ExportThermoxelsMesh

    join_help_lines(ExportThermoxelsMesh)
    ours = Annotated[ExportThermoxelsMesh, tyro.conf.subcommand(name=_SUBCOMMAND)]
    markers = getattr(commands, "__metadata__", ())
    members = get_args(get_args(commands)[0] if markers else commands)
    extended = Union[(*members, ours)]
    return Annotated[(extended, *markers)] if markers else extended


def compare_with_truth(pipeline: ThermoxelsPipeline) -> dict[str, float]:
    """How well a trained surface agrees with the exact scene, see `geometry_metrics`; empty if unknown.

    It stands here because `training` knows no evaluation.
    """
    from nerfstudio.utils.rich_utils import CONSOLE
    from rich.markup import escape

    from thermoxels_ns.core.lattice import input_from_world
    from thermoxels_ns.evaluation.truth_comparison import geometry_metrics, has_truth

    def say(line: str) -> None:
        CONSOLE.print(escape(line))

    datamanager: Any = pipeline.datamanager
    if not has_truth(datamanager.get_datapath(), say):
        return {}
    outputs = datamanager.train_dataparser_outputs
    world_to_input = input_from_world(outputs.dataparser_transform.numpy(), float(outputs.dataparser_scale))
    # With the rays' evidence and the cameras, as an export has them: they decide what is solid.
    return geometry_metrics(pipeline.grid_snapshot(), world_to_input, datamanager.get_datapath(), say)
