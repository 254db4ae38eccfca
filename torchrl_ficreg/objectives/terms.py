"""The terms of the losses as pure functions of tensors. Who receives gradient is decided by the caller."""

from __future__ import annotations

import torch


def squared_error(prediction: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Mean squared error over the last dimension, in float32: [..., C] and [..., C] -> [...]."""
    return (prediction.float() - target.float()).square().mean(-1)
