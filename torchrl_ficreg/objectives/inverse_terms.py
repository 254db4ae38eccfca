"""The frozen inverse model as a judge: what it says, how far it is trusted, and whether it is worth listening to."""

from __future__ import annotations

from typing import NamedTuple

import torch

from torchrl_ficreg.distributed import gather_clips
from torchrl_ficreg.objectives.terms import gaussian_nll, squared_error

NO_VARIANCE = 1e-6  # of z-scored actions: a dimension that varies less is constant


class Recovered(NamedTuple):
    """What an inverse model makes of transitions, each [..., F * A].

    Attributes:
        action: recovered action blocks.
        log_var: their log-variance, from a Gaussian head; else None.
        spread: variance among the members of an ensemble; else None.
    """

    action: torch.Tensor
    log_var: torch.Tensor | None
    spread: torch.Tensor | None


def inverse_error(recovered: Recovered, action: torch.Tensor) -> torch.Tensor:
    """Training error of an inverse model by dimension, [..., F * A].

    Negative log-likelihood for a Gaussian head; for an ensemble the mean over members of each one's squared error,
    which is that of their mean plus their variance; the squared error else.
    """
    if recovered.log_var is not None:
        return gaussian_nll(recovered.action, recovered.log_var, action)
    error = squared_error(recovered.action, action)
    return error if recovered.spread is None else error + recovered.spread


def trust(real_error: torch.Tensor) -> torch.Tensor:
    """Weight of a judgement from the judge's squared error on the real transition, [..., F * A] -> the same in [0, 1].

    Actions are z-scored, so a judge that knows nothing errs by 1 on average: 1 - error, at least 0, is its R² on this
    very sample and dimension. Where it cannot tell, it does not push.
    """
    return (1 - real_error.detach()).clamp(0, 1)


def judge_report(
    real: torch.Tensor, imagined: torch.Tensor, action: torch.Tensor, mask: torch.Tensor | None
) -> dict[str, torch.Tensor]:
    """How good the judge is, per action dimension, all detached; on several processes on the global batch.

    The shuffled control compares its verdicts on imagined transitions with the actions of *other* clips (the
    previous one of the batch): a judge that likes wrong actions as well is worthless, and its number there is not
    clearly below the true one.

    Args:
        real, imagined: actions recovered from real and imagined transitions, [..., T, F * A].
        action: those taken.
        mask: [..., T] bool, or None.

    Returns:
        ``judge_r2_real``, ``judge_r2_imagined`` and ``judge_r2_shuffled``, each [F * A]; at most 1, 0 or less for a judge
        that knows nothing, and 0 for a dimension of constant actions, where there is nothing to explain.
    """
    with torch.no_grad():
        real, imagined, action = (
            gather_clips(value.float().flatten(0, -3)) for value in (real, imagined, action)
        )  # [B of all processes, T, F * A]
        mask = None if mask is None else gather_clips(mask.flatten(0, -2))  # [B of all processes, T]
        both = None if mask is None else mask & mask.roll(1, 0)  # a masked action is no wrong action, but none
        return {
            "judge_r2_real": _explained(real, action, mask),
            "judge_r2_imagined": _explained(imagined, action, mask),
            "judge_r2_shuffled": _explained(imagined, action.roll(1, 0), both),
        }


def _explained(guess: torch.Tensor, truth: torch.Tensor, mask: torch.Tensor | None) -> torch.Tensor:
    """R² by dimension, [F * A]."""
    guess, truth = guess.flatten(0, -2), truth.flatten(0, -2)  # [N, F * A]
    variance = mean_where((truth - mean_where(truth, mask)).square(), mask)  # [F * A]
    explained = 1 - mean_where((guess - truth).square(), mask) / variance.clamp_min(NO_VARIANCE)
    return torch.where(variance < NO_VARIANCE, 0.0, explained)


def mean_where(value: torch.Tensor, mask: torch.Tensor | None) -> torch.Tensor:
    """Mean over the rows that count, [N, C] and a mask of N entries -> [C]; 0 where there are none."""
    if mask is None:
        return value.mean(0)
    keep = mask.reshape(-1, 1)  # [N, 1]
    return torch.where(keep, value, 0.0).sum(0) / keep.sum().clamp_min(1)
