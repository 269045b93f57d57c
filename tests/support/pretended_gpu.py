"""A pretended CUDA device: its tensors compute on the CPU, and meeting a tensor of the CPU is an error, as on a GPU.

It finds tensors that were left on the CPU where there is no GPU. It says nothing of speed.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch.utils._pytree import tree_map

DEVICE = torch.device("cuda", 0)


class OnGpu(torch.Tensor):
    """A tensor of the pretended device around one of the CPU."""

    inner: torch.Tensor

    @staticmethod
    def __new__(cls, inner: torch.Tensor) -> "OnGpu":
        wrapper: Any = torch.Tensor._make_wrapper_subclass(
            cls,
            inner.shape,
            strides=inner.stride(),
            storage_offset=inner.storage_offset(),
            dtype=inner.dtype,
            device="cpu",  # for C++, which would look for a driver
        )
        wrapper.inner = inner
        return wrapper

    @property
    def device(self) -> torch.device:  # type: ignore[override]
        return DEVICE

    @property
    def is_cuda(self) -> bool:  # type: ignore[override]
        return True

    __torch_function__ = torch._C._disabled_torch_function_impl

    def __repr__(self) -> str:
        return f"OnGpu({self.inner})"

    def tolist(self) -> Any:
        return self.inner.tolist()

    def numpy(self, **_: Any) -> Any:
        raise TypeError("can't convert a tensor of the GPU to numpy: copy it to the CPU first")

    @classmethod
    def __torch_dispatch__(cls, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        wanted = kwargs.get("device")
        if wanted is not None:
            kwargs["device"] = torch.device("cpu")
        met: list[torch.Tensor] = []
        tree_map(lambda value: met.append(value) if isinstance(value, torch.Tensor) else None, (args, kwargs))
        strangers = [v for v in met if not isinstance(v, OnGpu) and v.dim()]
        if torch._C._current_graph_task_id() != -1:  # formulas of gradients in C++ make zeros on what they take for it
            strangers = [v for v in strangers if bool(v.any())]
        if strangers and function is not torch.ops.aten.copy_.default:
            raise RuntimeError(f"{function}: {len(strangers)} of {len(met)} tensors are on the CPU")
        result = function(*tree_map(_inside, args), **tree_map(_inside, kwargs))
        if function is torch.ops.aten.copy_.default and not isinstance(args[0], OnGpu):
            return args[0]
        if wanted is not None and torch.device(wanted).type == "cpu":
            return result
        # What was changed in place is the same tensor as before.
        same = {id(value.inner): value for value in met if isinstance(value, OnGpu)}

        def wrapped(value: Any) -> Any:
            return (
                (same[id(value)] if id(value) in same else OnGpu(value)) if isinstance(value, torch.Tensor) else value
            )

        return tree_map(wrapped, result)


def _inside(value: Any) -> Any:
    return value.inner if isinstance(value, OnGpu) else value


_FACTORIES = ("arange", "as_tensor", "empty", "eye", "full", "linspace", "ones", "rand", "randint", "tensor", "zeros")


@contextmanager
def pretended_gpu() -> Iterator[None]:
    """Within, the device "cuda" is the pretended one: for factories of torch, `Tensor.to` and `Module.to`."""
    move = torch.Tensor.to

    def to(self: torch.Tensor, *args: Any, **kwargs: Any) -> torch.Tensor:
        if args and isinstance(args[0], torch.Tensor):
            args = args[0].device, args[0].dtype
        places = [value for value in (*args, kwargs.get("device")) if isinstance(value, str | torch.device)]
        if not places:
            return move(self, *args, **kwargs)
        types = [value for value in (*args, kwargs.get("dtype")) if isinstance(value, torch.dtype)]
        cast = move(self, types[0]) if types else self
        there = torch.device(places[0]).type == "cuda"
        return cast if there == isinstance(cast, OnGpu) else _Move.apply(cast, there)  # type: ignore[return-value]

    def on_device(make: Callable[..., torch.Tensor]) -> Callable[..., torch.Tensor]:
        def made(*args: Any, **kwargs: Any) -> torch.Tensor:
            wanted = kwargs.get("device")
            if wanted is None or torch.device(wanted).type != "cuda":
                return make(*args, **kwargs)
            return to(make(*args, **kwargs | {"device": "cpu"}), "cuda")

        return made

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch.Tensor, "to", to)
        patch.setattr(
            torch.Tensor, "new_tensor", lambda self, data: to(torch.tensor(data, dtype=self.dtype), self.device)
        )
        patch.setattr(torch.Tensor, "cpu", lambda self: to(self, "cpu"))
        for name in _FACTORIES:
            patch.setattr(torch, name, on_device(getattr(torch, name)))
        torch.__future__.set_overwrite_module_params_on_conversion(True)
        try:
            yield
        finally:
            torch.__future__.set_overwrite_module_params_on_conversion(False)


class _Move(torch.autograd.Function):
    """Copy to the pretended device or from it; gradients come back."""

    @staticmethod
    def forward(ctx: Any, value: torch.Tensor, there: bool) -> torch.Tensor:
        ctx.there = there
        return OnGpu(value.detach().clone()) if there else value.inner.clone()  # type: ignore[attr-defined]

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> Any:
        return (gradients[0].inner if ctx.there else OnGpu(gradients[0])), None
