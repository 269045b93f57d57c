"""Make docs/nomenclature.md from docs/nomenclature.csv."""

import csv
from pathlib import Path

DOCS = Path(__file__).resolve().parents[1] / "docs"


def page() -> str:
    """The page: a table with one line per word, ordered as data flows."""
    with (DOCS / "nomenclature.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    table = [f"| {r['term']} | {r['symbol']} | {r['unit']} | {r['meaning']} | `{r['where']}` |" for r in rows]
    head = [
        "# Words and symbols",
        "",
        "In the order in which data flows. Made from `nomenclature.csv` by `python tools/nomenclature.py`.",
        "",
        "| word | symbol | unit | what it is | where |",
        "|---|---|---|---|---|",
    ]
    return "\n".join([*head, *table]) + "\n"


if __name__ == "__main__":
    (DOCS / "nomenclature.md").write_text(page(), encoding="utf-8")
