"""Terms of the losses as pure functions of tensors, and three of them as modules.

Gradient flows into every tensor argument; a loss detaches what must receive none.
"""

from __future__ import annotations

import torch
from torch import nn, Tensor


def squared_error(prediction: Tensor, target: Tensor) -> Tensor:
    """Squared error by dimension.

    Args:
        prediction (Tensor): [..., C].
        target (Tensor): [..., C].

    Returns:
        Tensor: [..., C], at least float32.

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
        mean (Tensor): [..., C], mu.
        log_var (Tensor): [..., C], s.
        target (Tensor): [..., C], x.

    Returns:
        Tensor: [..., C], at least float32.
    """
    log_var = _widen(log_var)
    return 0.5 * (torch.exp(-log_var) * squared_error(mean, target) + log_var)


def hinge_std(latent: Tensor, dim: int, margin: float = 1.0, eps: float = 1e-4) -> Tensor:
    r"""Hinge on the standard deviation along a dimension (VICReg, arXiv 2105.04906).

    .. math:: \max(0, m - \sqrt{\mathrm{Var} + \epsilon})

    Args:
        latent (Tensor): [..., D], with at least 2 samples along ``dim``.
        dim (int): the dimension of the samples.
        margin (float, optional): m. Default: ``1.0``.
        eps (float, optional): epsilon. Default: ``1e-4``.

    Returns:
        Tensor: the shape of latent without ``dim``, at least float32.
    """
    std = (_widen(latent).var(dim) + eps).sqrt()
    return (margin - std).clamp_min(0)


def off_diagonal_covariance(latent: Tensor, *, centre: bool = True) -> Tensor:
    """Sum of the squared off-diagonal covariances, divided by D (VICReg, arXiv 2105.04906).

    Args:
        latent (Tensor): [..., N, D], N samples.
        centre (bool, optional): whether to subtract the mean over the samples; without it second moments take the place of
            covariances. Default: ``True``.

    Returns:
        Tensor: [...], at least float32.
    """
    latent = _widen(latent)
    centred = latent - latent.mean(-2, keepdim=True) if centre else latent  # [..., N, D]
    samples, dims = latent.shape[-2:]
    covariance = centred.transpose(-2, -1) @ centred / max(samples - 1, 1)  # [..., D, D]
    diagonal = covariance.diagonal(dim1=-2, dim2=-1)  # [..., D]
    return (covariance.square().sum((-2, -1)) - diagonal.square().sum(-1)) / dims


def straightness(latent: Tensor) -> Tensor:
    """Cosine between successive steps of a trajectory, 1 on a straight line; 0 where a step has length zero.

    arXiv 2603.12231 gives reasons why straight latent trajectories help planning.

    Args:
        latent (Tensor): [..., T, D].

    Returns:
        Tensor: [..., T - 2], at least float32.
    """
    steps = _widen(latent).diff(dim=-2)  # [..., T - 1, D]
    return torch.nn.functional.cosine_similarity(steps[..., 1:, :], steps[..., :-1, :], dim=-1)


class VarianceHinge(nn.Module):
    """Mean of :func:`hinge_std` over the batch: penalises dimensions of small variance (VICReg, arXiv 2105.04906).

    Args:
        margin (float, optional): standard deviation below which a dimension is penalised. Default: ``1.0``.

    Raises:
        ValueError: a margin that is not positive, or fewer than 2 samples.

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
    """Mean of :func:`off_diagonal_covariance`: penalises correlated dimensions (VICReg, arXiv 2105.04906).

    Raises:
        ValueError: fewer than 2 samples.

    Examples:
        >>> CovariancePenalty()(torch.tensor([[1.0, 1.0], [-1.0, -1.0]])).item()  # two equal dimensions
        4.0
    """

    def forward(self, latent: torch.Tensor) -> torch.Tensor:
        """Latents [..., B, D], B >= 2 the samples -> mean penalty []."""
        _check_samples(latent)
        return off_diagonal_covariance(latent).mean()


class TemporalStraightness(nn.Module):
    """Mean of :func:`straightness`: 1 on straight trajectories, 0 on random walks (arXiv 2603.12231).

    Raises:
        ValueError: fewer than 3 latents.

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


def _widen(value: Tensor) -> Tensor:
    """At least float32: half precision is too coarse for sums of squares."""
    return value if value.dtype == torch.float64 else value.float()


def _check_samples(latent: torch.Tensor) -> None:
    if latent.ndim < 2 or latent.shape[-2] < 2:
        raise ValueError(f"a statistic over samples needs latents [..., B, D] with B >= 2, got {list(latent.shape)}.")
