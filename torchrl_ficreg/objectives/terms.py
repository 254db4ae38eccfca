"""The terms of the losses as pure functions of tensors. Who receives gradient is decided by the caller."""

from __future__ import annotations

import torch
from torch import nn, Tensor


def _widen(value: Tensor) -> Tensor:
    """At least float32: half precision is for matrix products, not for sums of squares."""
    return value if value.dtype == torch.float64 else value.float()


def squared_error(prediction: Tensor, target: Tensor) -> Tensor:
    """Squared error by dimension, at least float32: [..., C] and [..., C] -> [..., C].

    Raises:
        ValueError: the shapes differ; nothing is broadcast.
    """
    if prediction.shape != target.shape:
        raise ValueError(
            f"a prediction must have the shape of its target, got {list(prediction.shape)} for {list(target.shape)}: "
            "check the widths the networks were built for."
        )
    return (_widen(prediction) - _widen(target)).square()


def gaussian_nll(mean: Tensor, log_var: Tensor, target: Tensor) -> Tensor:
    r"""Negative log-likelihood of a diagonal Gaussian by dimension, without its constant.

    .. math:: \tfrac12 (e^{-s} (\mu - x)^2 + s), \qquad s = \log \sigma^2

    Args:
        mean, log_var, target: [..., C].

    Returns:
        [..., C].
    """
    log_var = _widen(log_var)
    return 0.5 * (torch.exp(-log_var) * squared_error(mean, target) + log_var)


def hinge_std(latent: Tensor, dim: int, margin: float = 1.0, eps: float = 1e-4) -> Tensor:
    r"""Hinge on the standard deviation along a dimension (VICReg, arXiv 2105.04906).

    .. math:: \max(0, m - \sqrt{\mathrm{Var} + \epsilon})

    Args:
        latent: [..., D], with at least 2 samples along ``dim``.
        dim: of the samples.
        margin: m.
        eps: epsilon.

    Returns:
        the shape of latent without ``dim``.
    """
    std = (_widen(latent).var(dim) + eps).sqrt()
    return (margin - std).clamp_min(0)


def off_diagonal_covariance(latent: Tensor, *, centre: bool = True) -> Tensor:
    """Mean over dimensions of the squared off-diagonal covariances, [..., N, D] -> [...] (arXiv 2105.04906).

    The sum of squares of all off-diagonal entries divided by D.

    Args:
        latent: [..., N, D].
        centre: whether to subtract the mean over the N samples; without it second moments take the place of covariances.
    """
    latent = _widen(latent)
    centred = latent - latent.mean(-2, keepdim=True) if centre else latent  # [..., N, D]
    samples, dims = latent.shape[-2:]
    covariance = centred.transpose(-2, -1) @ centred / max(samples - 1, 1)  # [..., D, D]
    diagonal = covariance.diagonal(dim1=-2, dim2=-1)  # [..., D]
    return (covariance.square().sum((-2, -1)) - diagonal.square().sum(-1)) / dims


def straightness(latent: Tensor) -> Tensor:
    """Cosine between successive steps of a trajectory, [..., T, D] -> [..., T - 2]; 1 on a straight line.

    A step of length zero counts as 0. See arXiv 2603.12231 on why straight latent trajectories help planning.
    """
    steps = _widen(latent).diff(dim=-2)  # [..., T - 1, D]
    return torch.nn.functional.cosine_similarity(steps[..., 1:, :], steps[..., :-1, :], dim=-1)


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
