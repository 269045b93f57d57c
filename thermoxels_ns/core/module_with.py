"""A module as another one sees it, with some names replaced."""

from __future__ import annotations

from types import ModuleType
from typing import Any


class ModuleWith(ModuleType):
    """A module with some of its names replaced."""

    def __init__(self, module: ModuleType, **replaced: Any) -> None:
        super().__init__(module.__name__, doc=module.__doc__)
        self._module = module
        vars(self).update(replaced)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._module, name)
