"""Variance, covariance and straightness of latents as plain modules, for anyone's loss."""

from __future__ import annotations

import torch
from torch import nn

from torchrl_ficreg.objectives.terms import hinge_std, off_diagonal_covariance, straightness


class VarianceHinge(nn.Module):
    """Keeps every latent dimension spread over the batch (VICReg, arXiv 2105.04906).

    Args:
        margin: standard deviation below which a dimension is pushed apart.

    Examples:
        >>> round(VarianceHinge()(torch.zeros(4, 32, 8)).item(), 4)  # collapsed: 1 - sqrt(1e-4)
        0.99
    """

    def __init__(self, margin: float = 1.0) -> None:
        super().__init__()
        if not margin > 0:
            raise ValueError(f"margin must be positive, got {margin}.")
        self.margin = margin

    def forward(self, latent: torch.Tensor) -> torch.Tensor:
        """Latents [..., B, D], B >= 2 the samples -> mean hinge []."""
        _check_samples(latent)
        return hinge_std(latent, -2, self.margin).mean()


class CovariancePenalty(nn.Module):
    """Decorrelates latent dimensions over the batch (VICReg, arXiv 2105.04906).

    Examples:
        >>> CovariancePenalty()(torch.tensor([[1.0, 1.0], [-1.0, -1.0]])).item()  # two equal dimensions
        4.0
    """

    def forward(self, latent: torch.Tensor) -> torch.Tensor:
        """Latents [..., B, D], B >= 2 the samples -> mean penalty []."""
        _check_samples(latent)
        return off_diagonal_covariance(latent).mean()


class TemporalStraightness(nn.Module):
    """Mean cosine between successive latent steps: 1 on straight trajectories, 0 on random walks (arXiv 2603.12231).

    Examples:
        >>> round(TemporalStraightness()(torch.arange(5.0)[:, None] * torch.ones(3)).item(), 4)
        1.0
    """

    def forward(self, latent: torch.Tensor) -> torch.Tensor:
        """Latents [..., T, D] with T >= 3 -> []."""
        if latent.ndim < 2 or latent.shape[-2] < 3:
            shape = list(latent.shape)
            raise ValueError(f"straightness needs trajectories [..., T, D] of T >= 3 latents, got {shape}.")
        return straightness(latent).mean()


def _check_samples(latent: torch.Tensor) -> None:
    if latent.ndim < 2 or latent.shape[-2] < 2:
        raise ValueError(f"a statistic over samples needs latents [..., B, D] with B >= 2, got {list(latent.shape)}.")
