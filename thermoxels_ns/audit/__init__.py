"""Heat losses and U-values, with intervals, from measured surface temperatures; a call of it calls `run.audit_mesh`."""

import sys
from importlib import import_module
from types import ModuleType
from typing import Any


class _Callable(ModuleType):
    def __reduce__(self) -> tuple[Any, ...]:  # for pools of processes
        return import_module, (self.__name__,)

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        from thermoxels_ns.audit.run import audit_mesh

        return audit_mesh(*arguments, **named)


sys.modules[__name__].__class__ = _Callable
