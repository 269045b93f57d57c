"""Change the code in one place at a time and see whether the tests near it notice.

    python tools/mutate.py --count 60 --seed 1
    python tools/mutate.py thermoxels_ns/heat/sky.py --count 20

What survives is printed with its line: either the change makes no difference (a tolerance, a speed-up), or a test is
missing. Everything happens in a copy of the checkout; tests near a file are those that import it. A change is
"untested" if they fail or are too slow without it.
"""

from __future__ import annotations

import argparse
import ast
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DEFAULT = ("thermoxels_ns/fem/*.py", "thermoxels_ns/heat/*.py", "thermoxels_ns/render/kernels*.py")
PLACES = ("audit", "fem", "heat", "render", "reference", "verification")  # Folders of tests that are looked through
COPIED = ("thermoxels_ns", "tests", "configs", "docs", "pyproject.toml", "README.md")
OPERATORS: dict[type, type] = {
    **{ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult},
    **{ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq},
    **{ast.And: ast.Or, ast.Or: ast.And},
}
NAMES = {"min": "max", "max": "min", "minimum": "maximum", "maximum": "minimum"}


def changes(tree: ast.AST) -> Iterator[tuple[int, str, ast.AST, str, object]]:
    """Yield line, what is changed in words, the node, the field to set, and its new value."""
    skipped = {id(part) for node in ast.walk(tree) for part in _no_behaviour(node)}
    for node in ast.walk(tree):
        if id(node) in skipped:
            continue
        line = getattr(node, "lineno", 0)
        if isinstance(node, (ast.BinOp, ast.BoolOp, ast.AugAssign)) and type(node.op) in OPERATORS:
            new = OPERATORS[type(node.op)]
            yield line, f"{type(node.op).__name__} -> {new.__name__}", node, "op", new()
        elif isinstance(node, ast.Compare) and type(node.ops[0]) in OPERATORS:
            new = OPERATORS[type(node.ops[0])]
            yield line, f"{type(node.ops[0]).__name__} -> {new.__name__}", node, "ops", [new(), *node.ops[1:]]
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
            yield line, "not dropped", node, "op", None
        elif (
            isinstance(node, ast.Constant) and isinstance(node.value, (int, float)) and not isinstance(node.value, bool)
        ):
            yield line, f"{node.value} -> {node.value + 1}", node, "value", node.value + 1
        elif isinstance(node, ast.Name) and node.id in NAMES:
            yield line, f"{node.id} -> {NAMES[node.id]}", node, "id", NAMES[node.id]
        elif isinstance(node, ast.Attribute) and node.attr in NAMES:
            yield line, f"{node.attr} -> {NAMES[node.attr]}", node, "attr", NAMES[node.attr]


def _no_behaviour(node: ast.AST) -> Iterator[ast.AST]:
    """Annotations, messages and what is raised: changes in them are of no interest."""
    fields = [getattr(node, name, None) for name in ("annotation", "returns")]
    fields += [node] if isinstance(node, (ast.JoinedStr, ast.Raise, ast.Assert)) else []
    for field in fields:
        if isinstance(field, ast.AST):
            yield from ast.walk(field)


def mutated(source: str, number: int) -> tuple[int, str, str]:
    """Make the change of a number: its line, what it is, and the new source."""
    tree = ast.parse(source)
    line, what, node, field, value = list(changes(tree))[number]
    if value is None:  # the operand of `not` in its place
        for parent in ast.walk(tree):
            for name, child in ast.iter_fields(parent):
                if child is node:
                    setattr(parent, name, node.operand)  # type: ignore[attr-defined]
                elif isinstance(child, list) and node in child:
                    child[child.index(node)] = node.operand  # type: ignore[attr-defined]
    else:
        setattr(node, field, value)
    return line, what, ast.unparse(ast.fix_missing_locations(tree))


def near_tests(file: Path) -> list[str]:
    """Tests that import a module, its own first; the tests of its room if none does."""
    room, stem = file.parent.name, file.stem
    found = [p for place in PLACES for p in sorted((ROOT / "tests" / place).glob("test_*.py"))]
    named = [p for p in found if f"{room}.{stem} import" in p.read_text() or p.stem == f"test_{stem}"]
    named = named or [p for p in found if p.parent.name in (room, "reference" if room == "render" else room)]
    own_first = sorted(named, key=lambda p: (not p.stem.startswith(f"test_{stem}"), p.parent.name != room, p.name))
    every = {"render": "reference/test_fused_rendering.py", "fem": "stability/test_no_answer_lies.py"}
    whole = [ROOT / "tests" / every[room]] if room in every else []
    return [str(p.relative_to(ROOT)) for p in own_first[:3] + whole]


def outcome(copy: Path, tests: list[str], seconds: float) -> str:
    """Run tests in a copy: "killed" if one fails, "survived" or "too slow"."""
    environment = {**os.environ, "PYTHONPATH": str(copy), "NUMBA_CACHE_DIR": str(copy / "numba")}
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *tests]
    try:
        run = subprocess.run(command, cwd=copy, env=environment, capture_output=True, timeout=seconds, check=False)
    except subprocess.TimeoutExpired:
        return "too slow"
    return "survived" if run.returncode == 0 else "killed"


def main() -> None:
    """Draw changes, try one after the other, and print what became of each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*", default=DEFAULT, help="files or patterns below the checkout")
    parser.add_argument("--count", type=int, default=60, help="how many changes to draw")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=300.0, help="longest run of the tests of one change")
    options = parser.parse_args()
    files = sorted({path for pattern in options.files for path in ROOT.glob(pattern)})
    every = [(file, n) for file in files for n, _ in enumerate(changes(ast.parse(file.read_text())))]
    drawn = random.Random(options.seed).sample(every, min(options.count, len(every)))
    print(f"{len(drawn)} of {len(every)} changes in {len(files)} files", flush=True)
    counts, unchanged = dict[str, int](), dict[Path, str]()
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        for name in COPIED:
            source, ignore = ROOT / name, shutil.ignore_patterns("__pycache__")
            shutil.copytree(source, copy / name, ignore=ignore) if source.is_dir() else shutil.copy(source, copy)
        for file, number in drawn:
            target, source, begin = copy / file.relative_to(ROOT), file.read_text(), time.monotonic()
            line, what, changed = mutated(source, number)
            if file not in unchanged:
                unchanged[file] = outcome(copy, near_tests(file), options.seconds)
            target.write_text(changed)
            found = outcome(copy, near_tests(file), options.seconds) if unchanged[file] == "survived" else "untested"
            target.write_text(source)
            counts[found] = counts.get(found, 0) + 1
            text = source.splitlines()[line - 1].strip() if found == "survived" else ""
            place = f"{file.relative_to(ROOT)}:{line}"
            print(f"{found:9}{time.monotonic() - begin:5.0f} s  {place}  {what}  {text}", flush=True)
    print(", ".join(f"{count} {name}" for name, count in sorted(counts.items())))


if __name__ == "__main__":
    main()
