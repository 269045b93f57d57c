"""Answers from measured surface temperatures: heat flows, U-values, thermal bridges, with intervals.

Called as a function, ``thermoxels_ns.audit(mesh, conditions)``, this package is `thermoxels_ns.audit.run.audit_mesh`.
"""

import sys
from types import ModuleType
from typing import Any


class _Callable(ModuleType):
    def __call__(self, *arguments: Any, **named: Any) -> Any:
        from thermoxels_ns.audit.run import audit_mesh

        return audit_mesh(*arguments, **named)


sys.modules[__name__].__class__ = _Callable
