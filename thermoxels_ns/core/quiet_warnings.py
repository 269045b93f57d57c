"""Warnings of other packages that are meant for programmers and that nobody at a command line can act on."""

from __future__ import annotations

import re
import sys
import warnings

PROGRAMMERS_WARNINGS: tuple[tuple[str, type[Warning]], ...] = (
    ("`torch.jit.script` is deprecated", FutureWarning),  # nerfstudio 1.1.5 with newer versions of torch
    ("`torch.cuda.amp.", FutureWarning),  # nerfstudio 1.1.5: custom_fwd, custom_bwd, GradScaler
    ("Using a non-tuple sequence for multidimensional indexing", UserWarning),  # nerfstudio indexes rays with lists
    ("Detected call of `lr_scheduler.step()` before", UserWarning),  # nerfstudio, at its first step
    ("Converting a tensor with requires_grad", UserWarning),  # nerfstudio writes losses to its logs
)
"""How the text of each warning begins, without commas and colons, and its class."""


def silence() -> None:
    """Show none of `PROGRAMMERS_WARNINGS` in this process, unless the user has set warning filters for Python."""
    if not sys.warnoptions:
        for begin, kind in PROGRAMMERS_WARNINGS:
            warnings.filterwarnings("ignore", re.escape(begin), kind)
