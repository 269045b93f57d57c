"""Print pages of `page.py` as PDF documents (A4) with WeasyPrint, which needs no browser."""

from __future__ import annotations

from pathlib import Path

from thermoxels_ns.core.checks import replace_when_done
from thermoxels_ns.core.errors import ThermoxelsError


def why_no_pdf() -> str:
    """Return a sentence that says what WeasyPrint lacks here and how to get it; "" if it can be used."""
    from PIL import ImageFile

    damaged_too = ImageFile.LOAD_TRUNCATED_IMAGES
    try:
        import weasyprint  # noqa: F401
    except ImportError:
        return "WeasyPrint is not installed; install it with: pip install weasyprint."
    except OSError as problem:
        library = "apt install libpango-1.0-0 libpangoft2-1.0-0 (Debian, Ubuntu) or brew install pango (macOS)"
        return f"WeasyPrint does not find its system library pango ({problem}); install that: {library}."
    finally:
        ImageFile.LOAD_TRUNCATED_IMAGES = damaged_too  # else this process would take half photographs for whole ones
    return ""


def write_pdf(path: Path, page: str) -> None:
    """Print the html text of a page into a PDF file, whole or not at all.

    Nothing is fetched: pictures lie in the page. Raises `ThermoxelsError` if `why_no_pdf` has a reason.
    """
    lacking = why_no_pdf()
    if lacking:
        raise ThermoxelsError(str(path), expected="a PDF file", got="none", remedy=lacking)
    from weasyprint import HTML

    with replace_when_done(path) as temporary:
        HTML(string=page).write_pdf(temporary)
