"""Answers from measured surface temperatures, with intervals; called as a function, it is `run.audit_mesh`."""

import sys
from types import ModuleType
from typing import Any


class _Callable(ModuleType):
    def __call__(self, *arguments: Any, **named: Any) -> Any:
        from thermoxels_ns.audit.run import audit_mesh

        return audit_mesh(*arguments, **named)


sys.modules[__name__].__class__ = _Callable
