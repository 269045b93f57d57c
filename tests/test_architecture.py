"""Data flows one way through the package: no import goes against it, and the files stay small and named."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

import thermoxels_ns

NAME = "thermoxels_ns"
PACKAGE = Path(thermoxels_ns.__file__).parent
MOST_LINES = 450
NAMES_THAT_SAY_NOTHING = {"utils", "util", "helpers", "helper", "common", "misc"}

GROUND = frozenset(
    {"errors", "checks", "units", "lattice", "snapshot", "streams", "schedule", "threads", "scratch", "configs_folder"}
    | {"page_style", "sightlines", "option_help"}
)
# One nerfstudio model, in files of one idea each.
MODEL = frozenset(
    {"losses", "optim", "optim_kernels", "metrics", "model", "model_config", "coarse_to_fine"}
    | {"ray_rendering", "ray_statistics", "pipeline", "trainer", "warm_up"}
    | {"photo_consistency", "photo_kernels", "photo_start", "start_choice", "track_carving", "track_loss"}
    | {"photo_depth", "photo_reading", "plane_sweep", "depth_kernels"}
)

COST = frozenset({"cost", "cost_process", "cost_runs", "cost_report"})


@dataclass(frozen=True)
class Room:
    """Modules that may import the same things; a name stands for a module and for everything below it."""

    modules: frozenset[str]
    may_import: frozenset[str]
    never: frozenset[str] = frozenset()
    """Other packages that it does not import, not even inside a function."""


DRAWING = frozenset({"pyvista", "vtk", "vtkmodules"})
HEAT = frozenset({"skfem"})
RADIANCE = frozenset({"torch", "nerfstudio"})

ROOMS = (
    Room(GROUND, GROUND, frozenset({"nerfstudio", "open3d"}) | DRAWING | HEAT),
    Room(frozenset({"presets"}), GROUND, RADIANCE | DRAWING | HEAT),
    Room(frozenset({"data"}), GROUND | {"data"}, DRAWING | HEAT),
    Room(frozenset({"capture"}), GROUND | {"data", "capture"}, DRAWING | HEAT),
    Room(frozenset({"field"}), GROUND | {"field"}, DRAWING | HEAT),
    Room(frozenset({"render"}), GROUND | {"render"}, DRAWING | HEAT),
    Room(MODEL, GROUND | {"field", "render"} | MODEL, DRAWING | HEAT),
    Room(frozenset({"mesh"}), GROUND | {"mesh"}, RADIANCE | HEAT),
    Room(frozenset({"fem"}), GROUND | {"fem", "mesh.tetrahedra", "mesh.files"}, RADIANCE),
    Room(
        frozenset({"config"}),
        GROUND | {"presets", "data", "nerfstudio_bridge"} | MODEL,
        frozenset({"open3d"}) | DRAWING | HEAT,
    ),
    Room(frozenset({"nerfstudio_bridge"}), GROUND | {"export"}, DRAWING | HEAT),
    # They start the commands that they measure, and stay small themselves.
    Room(COST, GROUND | {"demo_commands"} | COST, RADIANCE | DRAWING | HEAT),
)
"""All rooms but the top one: what ties them together (export, the command line, the demo) may import anything."""

INSIDE_FUNCTIONS = {
    "nerfstudio_bridge": frozenset({"export"}),
    "pipeline": frozenset({"export", "geometry_metrics"}),
}
"""What a module may import only where a function is called, because it loads more than its room may."""


def _inside(module: str, names: frozenset[str]) -> bool:
    """Whether a module is one of the names or below one of them."""
    return any(module == name or module.startswith(f"{name}.") for name in names)


def _is_type_checking(test: ast.expr) -> bool:
    return (isinstance(test, ast.Name) and test.id == "TYPE_CHECKING") or (
        isinstance(test, ast.Attribute) and test.attr == "TYPE_CHECKING"
    )


def _nodes(tree: ast.AST, in_function: bool = False) -> Iterator[tuple[ast.AST, bool]]:
    """Every node that can run, and whether it runs only when a function is called."""
    for child in ast.iter_child_nodes(tree):
        if isinstance(child, ast.If) and _is_type_checking(child.test):
            for other in child.orelse:
                yield other, in_function
                yield from _nodes(other, in_function)
            continue
        yield child, in_function
        deeper = in_function or isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
        yield from _nodes(child, deeper)


def imports(source: str, package: str, modules: frozenset[str]) -> Iterator[tuple[str, bool]]:
    """Yield what a file imports, at its top or inside a function, as full names of modules.

    Args:
        source: The text of the file.
        package: The full name of the package that relative imports start from.
        modules: Full names of our modules, to tell ``from package import module`` from ``from module import name``.
    """
    for node, in_function in _nodes(ast.parse(source)):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name, in_function
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            for alias in node.names:
                full = f"{base}.{alias.name}"
                yield (full if full in modules else base), in_function
        elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
            called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            if called in ("import_module", "__import__"):
                yield str(node.args[0].value), in_function


def forbidden_arrows(module: str, source: str, modules: frozenset[str]) -> list[str]:
    """List the imports of a file that its room may not have.

    Args:
        module: Name of the file's module below the package, such as ``mesh.files``.
        source: The text of the file.
        modules: Full names of all our modules.
    """
    room = next((room for room in ROOMS if _inside(module, room.modules)), None)
    if room is None:
        return []
    package = f"{NAME}.{module}".rpartition(".")[0]
    wrong = []
    for imported, in_function in imports(source, package, modules):
        top, _, rest = imported.partition(".")
        if top != NAME:
            refused = top in room.never
        elif _inside(rest, INSIDE_FUNCTIONS.get(module, frozenset())):
            refused = not in_function
        else:
            refused = bool(rest) and not _inside(rest, room.may_import)
        if refused:
            wrong.append(f"{module} imports {imported}")
    return wrong


def _module(path: Path) -> str:
    return ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix("__init__").rstrip(".")


FILES = sorted(PACKAGE.rglob("*.py"))
MODULES = frozenset(f"{NAME}.{_module(path)}".rstrip(".") for path in FILES)


def test_the_rooms_are_where_the_rules_look() -> None:
    """A module that is renamed or moved takes its rule along."""
    for room in ROOMS:
        for name in room.modules | room.may_import:
            assert f"{NAME}.{name}" in MODULES, f"{name} is in the rules and not in the package"
    for name in INSIDE_FUNCTIONS:
        assert any(_inside(name, room.modules) for room in ROOMS), f"{name} has no room"


@pytest.mark.parametrize("path", FILES, ids=lambda path: _module(path) or NAME)
def test_no_import_goes_against_the_flow(path: Path) -> None:
    assert forbidden_arrows(_module(path), path.read_text(encoding="utf-8"), MODULES) == []


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("lattice", "from thermoxels_ns.field.voxel_grid import VoxelGrid"),
        ("data.splits", "import thermoxels_ns.field.refine"),
        ("field.refine", "from thermoxels_ns.render import march"),
        ("render.march", "from thermoxels_ns.field.field import VoxelField"),
        ("render.march", "from ..field import field"),
        ("model", "def f():\n    from thermoxels_ns.mesh import build"),
        ("model", "def f():\n    from thermoxels_ns import export"),
        ("model", "def f():\n    from thermoxels_ns import geometry_metrics"),
        ("pipeline", "from thermoxels_ns.evaluation.geometry_metrics import half_transparent_share"),
        ("pipeline", "def f():\n    from thermoxels_ns.mesh import solid"),
        ("cost_runs", "def f():\n    import torch"),
        ("losses", "import skfem"),
        ("mesh.build", "class A:\n    def f(self):\n        import torch.nn as nn"),
        ("mesh.build", "from .. import fem"),
        ("mesh.build", "import importlib\nimportlib.import_module('thermoxels_ns.training.model')"),
        ("fem.stepping", "from thermoxels_ns.mesh.build import build_mesh"),
        ("fem.stepping", "if True:\n    from nerfstudio.cameras.rays import RayBundle"),
        ("fem.stepping", "if TYPE_CHECKING:\n    import numpy\nelse:\n    import torch"),
        ("config", "import pyvista"),
        ("config", "from thermoxels_ns.heat.presets import load_heat_preset"),
        ("nerfstudio_bridge", "from thermoxels_ns.commands.export import ExportThermoxelsMesh"),
        ("nerfstudio_bridge", "def f():\n    import thermoxels_ns.commands.export_snapshot"),
    ],
)
def test_the_checker_sees_a_forbidden_import(module: str, source: str) -> None:
    assert len(forbidden_arrows(module, source, MODULES)) == 1


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("model", "from thermoxels_ns.field.field import VoxelField\nimport torch"),
        ("mesh.build", "from thermoxels_ns.core.lattice import Lattice\nfrom . import solid\nimport pyvista"),
        (
            "mesh.build",
            "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from thermoxels_ns.training.model import Model",
        ),
        ("fem.files", "from thermoxels_ns.mesh.tetrahedra import TetMesh\nfrom thermoxels_ns.mesh import files"),
        ("nerfstudio_bridge", "def f():\n    from thermoxels_ns.commands.export import ExportThermoxelsMesh"),
        ("pipeline", "def f():\n    from thermoxels_ns.evaluation.geometry_metrics import half_transparent_share"),
        ("export", "import torch, pyvista, thermoxels_ns.fem.stepping, thermoxels_ns.training.model"),
        ("data.splits", "from thermoxels_ns import __version__"),
    ],
)
def test_the_checker_allows_what_is_allowed(module: str, source: str) -> None:
    assert forbidden_arrows(module, source, MODULES) == []


def test_importing_the_configuration_loads_nothing_heavy() -> None:
    """Every ``ns-*`` command imports it, also where pyvista or open3d cannot be imported."""
    heavy = ["pyvista", "vtk", "vtkmodules", "skfem", "open3d", "pymeshlab", "pycolmap", "numba"]
    ours = [f"{NAME}.{name}" for name in ("mesh", "fem", "export", "cli")]
    code = f"import sys, thermoxels_ns.config; print([m for m in {heavy + ours} if m in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize("path", FILES, ids=lambda path: _module(path) or NAME)
def test_files_are_short_and_their_names_say_something(path: Path) -> None:
    lines = len(path.read_text(encoding="utf-8").splitlines())
    assert lines <= MOST_LINES, f"{path.name} has {lines} lines; is it one idea?"
    assert not NAMES_THAT_SAY_NOTHING & set(path.relative_to(PACKAGE).with_suffix("").parts)
