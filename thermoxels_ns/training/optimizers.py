"""Optimisers that update only rows with a gradient, a learning rate that falls late, and settings for nerfstudio."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import torch
from nerfstudio.engine.optimizers import AdamOptimizerConfig, OptimizerConfig
from nerfstudio.engine.schedulers import ExponentialDecayScheduler, ExponentialDecaySchedulerConfig
from torch import Tensor
from torch.optim.lr_scheduler import LambdaLR

from thermoxels_ns.core.threads import run_ranges
from thermoxels_ns.field.refine import GridChange


class RowOptimizer(torch.optim.Optimizer):
    """Base of optimisers that update only the rows (entries along the first axis) that have a gradient.

    Other rows keep their value and their state. The state counts the updates of each row, so that a corner first seen
    late in a training starts like all others. A gradient is a row-sparse tensor (`torch.sparse_coo`, one sparse
    dimension) or a dense tensor, in which a row of zeros counts as a row without a gradient.
    """

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # type: ignore[override]
        """Update all parameters once. There is no `closure`, a function that computes the loss again."""
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is None:
                    continue
                rows, values = touched_rows(parameter.grad)
                state = self.state[parameter]
                if not state:
                    state.update(self.new_state(parameter))
                if len(rows):
                    self.update_rows(parameter.view(len(parameter), -1), rows, values, state, group)

    def new_state(self, parameter: Tensor) -> dict[str, Tensor]:
        """Return the state of a parameter before its first update: tensors by name with one entry per row."""
        raise TypeError(f"{type(self).__name__} has no state")

    def update_rows(
        self, parameter: Tensor, rows: Tensor, gradient: Tensor, state: dict[str, Tensor], group: dict[str, Any]
    ) -> None:
        """Update ``parameter[rows]`` and ``state[name][rows]`` in place by `gradient`, (rows, channels). `parameter` is
        (all rows, channels), `state` is that of `new_state`, and `group` has settings such as lr."""
        raise TypeError(f"{type(self).__name__} does not say how rows are updated")

    def follow(self, old: Tensor, new: torch.nn.Parameter, change: GridChange) -> None:
        """Optimise the parameter `new` in place of `old`, and map the state, by rows, with `change`."""
        for group in self.param_groups:
            group["params"] = [new if parameter is old else parameter for parameter in group["params"]]
        state = self.state.pop(old, None)  # type: ignore[arg-type]
        if state:
            self.state[new] = {}
            for name in list(state):  # one entry after the other, so that only one exists twice at a time
                values = state.pop(name)
                self.state[new][name] = change(values) if values.ndim > 1 else change(values[:, None])[:, 0]


def touched_rows(gradient: Tensor) -> tuple[Tensor, Tensor]:
    """Return the numbers (rows,), ascending, of the rows with a gradient, and their gradients (rows, channels)."""
    if gradient.is_sparse:
        rows = gradient._indices()[0]
        # Accumulation into `grad` forgets that a tensor is coalesced; checking is quicker than coalescing again.
        if not gradient.is_coalesced() and not bool((rows[1:] > rows[:-1]).all()):
            gradient = gradient.coalesce()
        values = gradient._values()
        return gradient._indices()[0], values.view(len(values), -1)
    flat = gradient.reshape(len(gradient), -1)
    rows = (flat != 0).any(-1).nonzero()[:, 0]
    return rows, flat[rows]


class RowAdam(RowOptimizer):
    """Adam (Kingma and Ba 2015) on rows with a gradient; each row has its own bias correction."""

    def __init__(self, params, lr: float = 1e-3, betas: tuple[float, float] = (0.9, 0.999), eps: float = 1e-15):
        super().__init__(params, {"lr": lr, "betas": tuple(betas), "eps": eps})

    def new_state(self, parameter: Tensor) -> dict[str, Tensor]:
        """Return the two moments, of the parameter's shape, and the number of updates of each row; all 0."""
        return {
            "exp_avg": torch.zeros_like(parameter),
            "exp_avg_sq": torch.zeros_like(parameter),
            "updates": torch.zeros(len(parameter), dtype=parameter.dtype, device=parameter.device),
        }

    def update_rows(self, parameter, rows, gradient, state, group):
        """Take one step of Adam on the given rows; see `RowOptimizer.update_rows`."""
        (beta1, beta2), lr, eps = group["betas"], group["lr"], group["eps"]
        first, second = (state[name].view(len(parameter), -1) for name in ("exp_avg", "exp_avg_sq"))
        if parameter.device.type == "cpu":
            from thermoxels_ns.training.optimizer_kernels import adam_rows

            arrays = [t.detach().contiguous().numpy() for t in (rows, gradient)]
            held = [t.detach().numpy() for t in (parameter, first, second, state["updates"])]
            constants = lr, beta1, beta2, eps, _corrections(beta1), _corrections(beta2)
            run_ranges(lambda a, b: adam_rows(a, b, *arrays, *held, *constants), len(rows), 2048)
            return
        updates = state["updates"][rows] + 1
        m = beta1 * first[rows] + (1 - beta1) * gradient
        v = beta2 * second[rows] + (1 - beta2) * gradient * gradient
        first[rows], second[rows], state["updates"][rows] = m, v, updates
        count = (updates + 0.5).floor()  # after a split, interpolated numbers of updates are not whole
        root = (v / (1 - beta2**count)[:, None]).sqrt() + eps
        parameter[rows] -= lr * (m / (1 - beta1**count)[:, None]) / root


class RowRMSprop(RowOptimizer):
    """RMSprop (Tieleman and Hinton 2012), which Plenoxels uses, on rows with a gradient."""

    def __init__(self, params, lr: float = 1e-2, alpha: float = 0.95, eps: float = 1e-8):
        super().__init__(params, {"lr": lr, "alpha": alpha, "eps": eps})

    def new_state(self, parameter: Tensor) -> dict[str, Tensor]:
        """Return the running mean of squared gradients, all 0."""
        return {"square_avg": torch.zeros_like(parameter)}

    def update_rows(self, parameter, rows, gradient, state, group):
        """Take one step of RMSprop on the given rows; see `RowOptimizer.update_rows`."""
        lr, alpha, eps = group["lr"], group["alpha"], group["eps"]
        square = state["square_avg"].view(len(parameter), -1)
        mean = alpha * square[rows] + (1 - alpha) * gradient * gradient
        square[rows] = mean
        parameter[rows] -= lr * gradient / (mean.sqrt() + eps)


@cache
def _corrections(beta: float) -> np.ndarray:
    """Return the table of 1 - beta^t for t = 0, 1, ...; its last entry is 1 and is valid for all later t, too."""
    count = 2 if beta == 0 else min(1_000_000, int(np.ceil(np.log(1e-17) / np.log(beta))) + 2)
    table = 1.0 - np.power(beta, np.arange(count, dtype=np.float64))
    table[-1] = 1.0
    return table


@dataclass
class RowAdamConfig(OptimizerConfig):
    """Settings of `RowAdam`: Adam that updates only rows with a gradient."""

    _target: type = RowAdam
    eps: float = 1e-15
    """Number added to the root of the second moment; tiny, so that corners seen by few rays move as fast as others."""
    betas: tuple[float, float] = (0.9, 0.999)
    """Decay of the running means of the gradient and of its square."""


@dataclass
class RowRMSpropConfig(OptimizerConfig):
    """Settings of `RowRMSprop`: RMSprop, which Plenoxels uses, that updates only rows with a gradient."""

    _target: type = RowRMSprop
    alpha: float = 0.95
    """Decay of the running mean of squared gradients."""


@dataclass
class FusedAdamConfig(AdamOptimizerConfig):
    """Settings of dense Adam, for parameters without rows (the background), in one compiled pass per parameter."""

    eps: float = 1e-15
    """Number added to the root of the second moment."""
    fused: bool = True
    """Use PyTorch's fused implementation."""


class LateDecayScheduler(ExponentialDecayScheduler):
    """Learning rate that falls to `lr_final` along half a cosine (Loshchilov and Hutter 2017) and stays there.

    An exponential decay that ends as low is low for most of the run already; one that ends higher leaves noise. (Not
    nerfstudio's cosine, which rises again if a training goes on past `max_steps`.)
    """

    def get_scheduler(self, optimizer: torch.optim.Optimizer, lr_init: float) -> LambdaLR:
        """Return the schedule of an optimiser whose learning rate begins as `lr_init`."""
        least = 1.0 if self.config.lr_final is None else self.config.lr_final / lr_init

        def share(step: int) -> float:
            return least + (1.0 - least) * 0.5 * (1.0 + math.cos(math.pi * min(step / self.config.max_steps, 1.0)))

        return LambdaLR(optimizer, share)


@dataclass
class LateDecaySchedulerConfig(ExponentialDecaySchedulerConfig):
    """Settings of `LateDecayScheduler`; it has no warm-up."""

    _target: type = LateDecayScheduler
