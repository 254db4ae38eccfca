"""BatchNorm over the batches of all processes together."""

from __future__ import annotations

import torch
import torch.distributed as dist
from torch import nn
from torch.distributed.nn.functional import all_reduce


class GlobalBatchNorm1d(nn.BatchNorm1d):
    """``nn.BatchNorm1d`` whose statistics, in training, are those of the global batch.

    One process: exactly ``nn.BatchNorm1d``, the same parameters, buffers and numbers. With ``torch.distributed``
    initialised, count, sum and sum of squares are summed over all ranks, and gradients flow back through those sums.
    ``nn.SyncBatchNorm`` does the same on accelerators only; this one works with every backend.
    """

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """[N, C] -> [N, C]."""
        if not (self.training and dist.is_available() and dist.is_initialized() and dist.get_world_size() > 1):
            return super().forward(x)
        return self._forward_global(x)

    def _forward_global(self, x: torch.Tensor) -> torch.Tensor:
        wide = x.float() if x.dtype in (torch.float16, torch.bfloat16) else x
        count = torch.full_like(wide[:1, :1], len(x))  # [1, 1]
        dist.all_reduce(count)
        mean = all_reduce(wide.sum(0)) / count[0]  # [C]
        variance = all_reduce((wide - mean).square().sum(0)) / count[0]  # [C]
        with torch.no_grad():
            self.num_batches_tracked += 1
            unbiased = variance * count[0] / (count[0] - 1).clamp_min(1)
            self.running_mean.lerp_(mean.to(self.running_mean.dtype), self.momentum)
            self.running_var.lerp_(unbiased.to(self.running_var.dtype), self.momentum)
        normed = (wide - mean) * torch.rsqrt(variance + self.eps)
        return (normed * self.weight + self.bias).to(x.dtype)
