"""BatchNorm over the batches of all processes together."""

from __future__ import annotations

import torch
from torch import nn

from torchrl_ficreg.modules.collectives import num_processes, sum_over_processes


class GlobalBatchNorm1d(nn.BatchNorm1d):
    """``nn.BatchNorm1d`` whose statistics, in training, are those of the global batch.

    One process: exactly ``nn.BatchNorm1d``, the same parameters, buffers and numbers. With ``torch.distributed``
    initialised, count, sum and sum of squares are summed over all ranks, and gradients flow back through those sums.
    ``nn.SyncBatchNorm`` does the same on accelerators only; this one works with every backend.
    """

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """[N, C] -> [N, C], or [N, C, L] -> [N, C, L]."""
        measures = self.training or self.running_mean is None
        if not measures or num_processes() == 1:
            return super().forward(x)
        self._check_input_dim(x)
        if x.ndim == 3:
            rows = self._forward_global(x.transpose(1, 2).flatten(0, 1))  # [N * L, C]
            return rows.unflatten(0, (len(x), -1)).transpose(1, 2)
        return self._forward_global(x)

    def _forward_global(self, x: torch.Tensor) -> torch.Tensor:
        wide = x.float() if x.dtype in (torch.float16, torch.bfloat16) else x
        count = sum_over_processes(wide.new_full((1,), len(x)))  # [1]
        mean = sum_over_processes(wide.sum(0)) / count  # [C]
        variance = sum_over_processes((wide - mean).square().sum(0)) / count  # [C]
        if self.training and self.running_mean is not None:
            self._track(mean.detach(), variance.detach(), count)
        normed = (wide - mean) * torch.rsqrt(variance + self.eps)
        return (normed if self.weight is None else normed * self.weight + self.bias).to(x.dtype)

    def _track(self, mean: torch.Tensor, variance: torch.Tensor, count: torch.Tensor) -> None:
        """Moves the running statistics; a momentum of None stands for their plain average, as in torch."""
        self.num_batches_tracked.add_(1)  # an assignment, which += is too, would break a compiled graph
        share = 1 / self.num_batches_tracked.to(mean.dtype) if self.momentum is None else self.momentum
        unbiased = variance * count / (count - 1).clamp_min(1)
        self.running_mean.add_(share * (mean - self.running_mean))
        self.running_var.add_(share * (unbiased - self.running_var))
