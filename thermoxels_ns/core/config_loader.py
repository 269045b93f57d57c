"""Reading of nerfstudio's config.yml without running code from it, typed options, and stand-ins for modules."""

from __future__ import annotations

import dataclasses
import enum
import importlib
import os
import sys
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import yaml

from thermoxels_ns.core.errors import CheckpointError

_PYTHON_TAG = "tag:yaml.org,2002:python/"
_HARMLESS_TAGS = {
    "name:nerfstudio.data.utils.nerfstudio_collate.nerfstudio_collate",  # the one function in stock configurations
    "object/apply:_operator.getitem",  # VanillaDataManager[DepthDataset]
    "object/apply:pathlib.PosixPath",
    "object/apply:pathlib.WindowsPath",
}


class ConfigLoader(yaml.Loader):
    """Yaml loader for the config.yml that ``ns-train`` writes; it refuses entries that could run code.

    The file may make paths, and dataclasses and enumerations of nerfstudio, of this package and of other installed
    plugins of nerfstudio. It may name classes of the same packages and of torch.optim. The whole file is checked before
    any object is made.
    """

    run_folder: ClassVar[Path | None] = None
    """Folder in which the config.yml that is loaded next lies now, perhaps after a move of the run; None: unknown."""

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Return the next yaml node; raise `CheckpointError`, with tag and line, for a tag that could run code."""
        node = super().compose_node(parent, index)
        tag = "" if node is None else node.tag.removeprefix(_PYTHON_TAG)
        if node is not None and node.tag != tag and not _harmless(tag):
            expected = "a config.yml that names only configuration classes of nerfstudio and its installed plugins"
            remedy = "Do not use this file: it could run code. If you trust it, install the package that it names."
            got = f"{tag} in line {node.start_mark.line + 1}"
            raise CheckpointError("load_config", expected=expected, got=got, remedy=remedy)
        return node

    def get_single_data(self) -> Any:
        """Return the content of the file; raise `CheckpointError` if a tag could run code or nesting is too deep. If
        `run_folder` is set and the content has a method ``moved_to``, the method is called with that folder."""
        folder, ConfigLoader.run_folder = ConfigLoader.run_folder, None  # also if what follows fails
        try:
            node = self.get_single_node()
        except RecursionError as problem:
            expected, remedy = "a config.yml that ns-train wrote", "Pass the config.yml of a training run."
            got = "entries nested too deeply to read"
            raise CheckpointError("load_config", expected=expected, got=got, remedy=remedy) from problem
        found = None if node is None else self.construct_document(node)
        if folder is not None and found is not None and hasattr(found, "moved_to"):
            found.moved_to(folder)
        return found


class _PlainLoader(yaml.SafeLoader):
    """Loader that imports nothing: objects become mappings of fields, paths become lists of parts, names are None."""


def _plain(loader: _PlainLoader, _: str, node: yaml.Node) -> Any:
    if isinstance(node, yaml.MappingNode):
        return loader.construct_mapping(node, deep=True)
    return loader.construct_sequence(node, deep=True) if isinstance(node, yaml.SequenceNode) else None


_PlainLoader.add_multi_constructor(_PYTHON_TAG, _plain)


def check_run(config: Path) -> dict[str, Any]:
    """Return the content of a run's config.yml as mappings, lists and plain values; nerfstudio is not imported.

    Raises `CheckpointError` if the file cannot be read, or if the run has no checkpoint or its scene is missing. For a
    run of another method, only the file is checked. Otherwise `ConfigLoader.run_folder` is set to the file's folder.
    """
    got, remedy = "no such file", "Pass that of a run, outputs/<scene>/thermoxels/<time>/config.yml."
    content: Any = None
    if config.is_file():
        try:
            content = yaml.load(config.read_text(encoding="utf-8"), Loader=_PlainLoader)
            got = "no settings of a run"
        except (yaml.YAMLError, OSError, ValueError, RecursionError) as problem:
            got = " ".join(str(problem).split())
    if not isinstance(content, dict):
        raise CheckpointError("load_config", expected="the config.yml of a run", got=f"{config}: {got}", remedy=remedy)
    try:
        models = config.parent.joinpath(*content["relative_model_dir"])
        manager, from_run = content["pipeline"]["datamanager"], content["scene_from_run"]  # other methods lack it
        told = Path(*(manager["data"] or manager["dataparser"]["data"]))
    except (KeyError, TypeError):
        return content
    remedy = "Copy the whole folder of the run, or train to the first checkpoint."
    if not any(models.glob("step-*.ckpt")):
        raise CheckpointError("checkpoint", expected=f"a file step-*.ckpt in {models}", got="none", remedy=remedy)
    if not scene_of_run(config.parent, told, from_run).exists():
        expected, remedy = "the photographs that it was trained on", f"Put the scene folder at {told}"
        remedy += f", or at {from_run} as seen from the folder of the run." if from_run else "."
        raise CheckpointError(f"scene of {config}", expected=expected, got="none", remedy=remedy)
    ConfigLoader.run_folder = config.parent
    return content


def scene_of_run(folder: Path, told: Path, from_run: str) -> Path:
    """Return the path of a run's scene: `from_run` relative to the run's `folder` if it exists, else `told`."""
    beside = Path(os.path.normpath(folder / from_run))
    return beside if from_run and beside.exists() else told


def _harmless(tag: str) -> bool:
    """Return whether a Python tag ``kind:name`` makes plain data or an object that `ConfigLoader` allows."""
    kind, _, name = tag.partition(":")
    if not name or tag in _HARMLESS_TAGS:
        return True
    module, _, attribute = name.rpartition(".")
    if module.split(".")[0] not in _plugin_packages() and not (kind == "name" and module.startswith("torch.optim.")):
        return False
    try:
        found = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError):
        return False
    if not isinstance(found, type) or found.__module__.split(".")[0] != module.split(".")[0]:
        return False
    made_of = {"name": True, "object": dataclasses.is_dataclass(found), "object/apply": issubclass(found, enum.Enum)}
    return made_of.get(kind, False)


def _plugin_packages() -> set[str]:
    """Return nerfstudio, this package, and plugins named by package metadata or nerfstudio's environment variables."""
    groups = ("nerfstudio.method_configs", "nerfstudio.dataparser_configs")
    values = [entry.value for group in groups for entry in entry_points(group=group)]
    for name in ("NERFSTUDIO_METHOD_CONFIGS", "NERFSTUDIO_DATAPARSER_CONFIGS"):
        values += [word.partition("=")[2] for word in os.environ.get(name, "").split(",")]
    return {"nerfstudio", "thermoxels_ns", *(value.split(":")[0].split(".")[0] for value in values)} - {""}


def typed(option: str) -> bool:
    """Return whether an argument of this process's command line begins with `option`; "-" and "_" are equal."""
    start = option.replace("_", "-")
    return any(word.replace("_", "-").startswith(start) for word in sys.argv[1:])


def typed_value(option: str) -> str | None:
    """Return the last value of an option, such as "--max-rays", on this process's command line; None without one."""
    found = None
    for word, following in zip(sys.argv[1:], [*sys.argv[2:], None]):
        name, equals, value = word.partition("=")
        if name.replace("_", "-") == option:
            found = value if equals else following
    return found


class ModuleWith(ModuleType):
    """A stand-in for `module`: names in `replaced` have the values given there, other names the module's values."""

    def __init__(self, module: ModuleType, **replaced: Any) -> None:
        super().__init__(module.__name__, doc=module.__doc__)
        self._module = module
        vars(self).update(replaced)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._module, name)
