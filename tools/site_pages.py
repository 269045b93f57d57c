"""Pages of the site that lie elsewhere or follow from the code; mkdocs runs this (mkdocs.yml, hooks)."""

from __future__ import annotations

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


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Add the pages to those of docs."""
    pages = {page: _moved((ROOT / file).read_text(encoding="utf-8")) for file, page in BESIDE.items()}
    rooms = sorted(folder for folder in PACKAGE.iterdir() if (folder / "__init__.py").is_file())
    for room in rooms:
        pages[f"reference/{room.name}.md"] = f"# {room.name}\n\n::: {PACKAGE.name}.{room.name}\n"
    for name, content in pages.items():
        files.append(File.generated(config, name, content=content))
    return files


def on_page_markdown(markdown: str, **_: object) -> str:
    """Let links of docs to files beside it lead to their pages."""
    return re.sub(r"\]\(\.\./(\w+\.md)", lambda found: f"]({BESIDE.get(found[1], '../' + found[1])}", markdown)
