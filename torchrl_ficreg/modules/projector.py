"""The BatchNorm projector that ends the encoder and the predictor."""

from __future__ import annotations

import torch
from torch import nn

from torchrl_ficreg.modules.batch_norm import GlobalBatchNorm1d


class Projector(nn.Module):
    """Linear, BatchNorm, GELU, linear: frees the latent from the scale that a LayerNorm fixes (arXiv 2603.19312).

    SIGReg asks for an isotropic Gaussian over the batch. A final LayerNorm puts every latent on a sphere of its own,
    which no batch statistic can undo; a BatchNorm layer acts along the batch and can.

    Args:
        in_dim, hidden_dim, out_dim: widths.
    """

    def __init__(self, in_dim: int, hidden_dim: int, out_dim: int) -> None:
        super().__init__()
        self.layer_in = nn.Linear(in_dim, hidden_dim)
        self.norm = GlobalBatchNorm1d(hidden_dim)
        self.layer_out = nn.Linear(hidden_dim, out_dim)
        self.activation = nn.GELU()

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """[..., in_dim] -> [..., out_dim]; statistics over all leading dimensions."""
        hidden = self.layer_in(x.flatten(0, -2))  # [N, hidden]
        return self.layer_out(self.activation(self.norm(hidden))).unflatten(0, x.shape[:-1])
