"""Pages of the site that lie elsewhere or follow from the code; mkdocs runs this (mkdocs.yml, hooks)."""

from __future__ import annotations

import ast
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "thermoxels_ns"
BESIDE = {"README.md": "index.md", "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changes.md"}
"""Files beside the folder docs, and the pages that they become."""


def _moved(text: str) -> str:
    """The text of a file beside docs with its links as they are within docs."""
    text = text.replace("](docs/", "](")
    for file, page in BESIDE.items():
        text = text.replace(f"]({file}", f"]({page}")
    return text


def _rooms() -> dict[str, str]:
    """The rooms of the package by name, with the first line of what each says of itself."""
    files = sorted(PACKAGE.glob("*/__init__.py"))
    return {file.parent.name: (ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) or "") for file in files}


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Add the reference to the last part of the navigation."""
    (pages,) = config.nav[-1].values()
    pages.append({"Reference": ["reference/index.md", *({name: f"reference/{name}.md"} for name in _rooms())]})
    return config


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Add the pages to those of docs."""
    pages = {page: _moved((ROOT / file).read_text(encoding="utf-8")) for file, page in BESIDE.items()}
    lines = [f"- [{room}]({room}.md): {said.splitlines()[0]}" for room, said in _rooms().items()]
    public = f"::: {PACKAGE.name}\n    options: {{show_submodules: false, show_root_heading: false, heading_level: 2}}"
    pages["reference/index.md"] = "\n".join(["# Reference", "", public, "", "The rooms of the code:", "", *lines, ""])
    for room in _rooms():
        pages[f"reference/{room}.md"] = f"::: {PACKAGE.name}.{room}\n"
    for name, content in pages.items():
        files.append(File.generated(config, name, content=content))
    return files


def on_page_markdown(markdown: str, **_: object) -> str:
    """Let links of docs to files beside it lead to their pages."""
    return re.sub(r"\]\(\.\./(\w+\.md)", lambda found: f"]({BESIDE.get(found[1], '../' + found[1])}", markdown)
