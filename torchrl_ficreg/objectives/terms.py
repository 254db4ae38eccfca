"""The terms of the losses as pure functions of tensors. Who receives gradient is decided by the caller."""

from __future__ import annotations

import torch
from torch import Tensor


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
