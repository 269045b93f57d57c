"""Optimiser settings for the groups of the model."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from nerfstudio.engine.optimizers import AdamOptimizerConfig, OptimizerConfig


@dataclass
class FusedAdamConfig(AdamOptimizerConfig):
    """Adam whose step is one compiled pass over each parameter (several times faster on CPU than the default)."""

    eps: float = 1e-15
    """Added to the root of the second moment; tiny, so that corners few rays see move as fast as the others."""
    fused: bool = True
    """Use the fused implementation."""


@dataclass
class RMSpropConfig(OptimizerConfig):
    """RMSprop as Plenoxels uses it."""

    _target: type = torch.optim.RMSprop
    alpha: float = 0.95
    """Decay of the running mean of squared gradients."""
