"""Terms on recovered actions: training error of an inverse model, its reliability, and a report of its accuracy."""

from __future__ import annotations

from typing import NamedTuple

import torch

from torchrl_ficreg.distributed import all_gather
from torchrl_ficreg.objectives.terms import gaussian_nll, squared_error


class Recovered(NamedTuple):
    """Output of an inverse model, each [..., F * A].

    Attributes:
        action: recovered action blocks.
        log_var: their log-variance, from a Gaussian head; else None.
        variance: variance among the members of an ensemble; else None.
    """

    action: torch.Tensor
    log_var: torch.Tensor | None
    variance: torch.Tensor | None


def inverse_error(recovered: Recovered, action: torch.Tensor) -> torch.Tensor:
    """Training error of an inverse model by dimension; differentiable in ``recovered``.

    It is the negative log-likelihood for a Gaussian head, the mean over members of their squared errors for an ensemble,
    which equals the squared error of their mean plus their variance, and the squared error otherwise.

    Args:
        recovered (Recovered): [..., F * A] each.
        action (torch.Tensor): [..., F * A], the actions that were taken.

    Returns:
        torch.Tensor: [..., F * A], at least float32.
    """
    if recovered.log_var is not None:
        return gaussian_nll(recovered.action, recovered.log_var, action)
    error = squared_error(recovered.action, action)
    return error if recovered.variance is None else error + recovered.variance


def reliability_weight(real_error: torch.Tensor) -> torch.Tensor:
    r"""Weight of the consistency term, from the error of the inverse model on the real transition of the same clip.

    .. math:: w = \max(0, \min(1, 1 - e))

    Actions are z-scored, so that 1 - e is the R² of a single sample and dimension: 1 where the inverse model recovers the real
    action, 0 where it does no better than their mean.

    Args:
        real_error (torch.Tensor): [..., F * A], squared errors e; detached here.

    Returns:
        torch.Tensor: [..., F * A], in [0, 1].
    """
    return (1 - real_error.detach()).clamp(0, 1)


def inverse_model_r2(
    real: torch.Tensor, imagined: torch.Tensor, action: torch.Tensor, mask: torch.Tensor | None
) -> dict[str, torch.Tensor]:
    """R² of an inverse model for each action dimension, detached; on several ranks that of the global batch.

    The shuffled control compares the actions recovered from imagined transitions with the actions of *other* clips, the
    previous one of the batch. An informative inverse model scores clearly lower there than with the actions of the clip.

    Args:
        real (torch.Tensor): [..., T, F * A], actions recovered from real transitions.
        imagined (torch.Tensor): [..., T, F * A], actions recovered from imagined transitions.
        action (torch.Tensor): [..., T, F * A], the actions that were taken.
        mask (torch.Tensor or None): [..., T] bool, true where a transition counts.

    Returns:
        dict[str, torch.Tensor]: ``judge_r2_real``, ``judge_r2_imagined`` and ``judge_r2_shuffled``, each [F * A]; at most 1, and
        0 or less where nothing is recovered. 0 for a dimension of constant actions, where R² is not defined.
    """
    with torch.no_grad():
        real, imagined, action = (
            all_gather(value.float().flatten(0, -3)) for value in (real, imagined, action)
        )  # [B of all ranks, T, F * A]
        mask = None if mask is None else all_gather(mask.flatten(0, -2))  # [B of all ranks, T]
        both = None if mask is None else mask & mask.roll(1, 0)  # neither the transition nor the other action is masked
        return {
            "judge_r2_real": _r2(real, action, mask),
            "judge_r2_imagined": _r2(imagined, action, mask),
            "judge_r2_shuffled": _r2(imagined, action.roll(1, 0), both),
        }


def masked_mean(value: torch.Tensor, mask: torch.Tensor | None) -> torch.Tensor:
    """Mean over the unmasked rows, 0 where there are none.

    Args:
        value (torch.Tensor): [N, C].
        mask (torch.Tensor or None): bool of N entries, true where a row counts.

    Returns:
        torch.Tensor: [C].
    """
    if mask is None:
        return value.mean(0)
    keep = mask.reshape(-1, 1)  # [N, 1]
    return torch.where(keep, value, 0.0).sum(0) / keep.sum().clamp_min(1)


_MIN_VARIANCE = 1e-6  # of z-scored actions: a dimension that varies less is constant


def _r2(recovered: torch.Tensor, action: torch.Tensor, mask: torch.Tensor | None) -> torch.Tensor:
    """Coefficient of determination by dimension, [F * A]."""
    recovered, action = recovered.flatten(0, -2), action.flatten(0, -2)  # [N, F * A]
    variance = masked_mean((action - masked_mean(action, mask)).square(), mask)  # [F * A]
    r2 = 1 - masked_mean((recovered - action).square(), mask) / variance.clamp_min(_MIN_VARIANCE)
    return torch.where(variance < _MIN_VARIANCE, 0.0, r2)
