import re
from pathlib import Path

DOCS = Path(__file__).parents[2] / "docs"


def code_in(page: str, language: str = "python") -> list[str]:
    """The blocks of code of a language in a page of the docs, in its order."""
    return re.findall(rf"```{language}\n(.*?)```", (DOCS / page).read_text(encoding="utf-8"), re.DOTALL)
